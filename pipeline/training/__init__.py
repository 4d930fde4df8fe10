"""Trainings of one scene: jobs from its rows and folds, models with cards, and studies that use these models."""
