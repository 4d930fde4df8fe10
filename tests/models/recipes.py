"""Recipes small enough for tests."""

from reskin.models.recipe import Recipe


def recipe(**changes: object) -> Recipe:
    values = {
        "architecture": "paper",
        "inputs": "raw",
        "scaling": "standard",
        "triplet_weight": 0.0,
        "steps_n": 4,
        "batch_n": 16,
        "rate_max": 3e-3,
        "gradient_norm_max": 1.0,
        "weight_decay": 0.0,
    }
    return Recipe.model_validate(values | changes)
