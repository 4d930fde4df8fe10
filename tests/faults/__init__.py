"""Fault injection: `python -m tests.faults` damages copies of a finished checkout, and writes docs/faults.md."""
