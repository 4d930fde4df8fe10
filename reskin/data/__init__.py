"""Datasets: rows for training and testing, baselines that are subtracted, and splits into training and test rows."""
