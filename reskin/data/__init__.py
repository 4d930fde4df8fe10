"""Datasets: rows for training and tests, no-load baselines, and splits."""
