"""Physics of the synthetic skin, in SI units; simulated readings (module `chip`) are in uT."""
