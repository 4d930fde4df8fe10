"""Physics of the synthetic skin, in SI units; readings of chips are in uT (`chip`)."""
