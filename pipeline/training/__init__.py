"""Trainings of one scene: its rows and folds -> jobs -> models on disk, and these at work again.

Refuses to know how a network learns (`learning`) and what is shown.
"""
