"""Fault injection into a finished checkout: `make faults` writes docs/faults.md."""
