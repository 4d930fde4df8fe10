"""Benchmarks: scripts that measure and print. `python -m tools.benchmarks` runs those of this project's budgets."""
