"""Fault injection: `make faults` damages copies of a checkout whose pipeline has run, and writes docs/faults.md."""
