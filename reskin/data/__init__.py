"""Datasets: rows that a model sees, no-load baselines, splits."""
