"""Physics of the synthetic skin, in SI units; chips read in uT (`chip`)."""
