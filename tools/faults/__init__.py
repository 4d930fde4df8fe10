"""Fault injection: `python -m tools.faults` damages copies of a finished checkout, and prints what is lost."""
