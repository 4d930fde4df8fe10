"""Faults injected for real, and what becomes of them: `make faults` writes docs/faults.md."""
