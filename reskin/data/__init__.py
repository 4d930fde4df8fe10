"""Datasets: rows for training and testing, baselines, and train/test splits."""
