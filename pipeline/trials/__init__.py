"""Trainings of one scene: its rows and folds -> trials -> models on disk, and these at work again."""
