"""Cards of trainings, made by hand, with all that the table of scores reads."""

from typing import Any

import numpy as np

from reskin.metrics import score_groups
from reskin.seeds import rng_for
from tests.scenes import RECIPE

SKINS = [("b0", "s0"), ("b0", "s1"), ("b1", "s2"), ("b1", "s3")]


def card(experiment: str, fold: str, scores: dict, recipe: str = "paper", seed_i: int = 0, **changes: Any) -> dict:
    """A card; one of an adaptation was adapted by 390 pokes."""
    words = {
        "question": experiment, "recipe_name": recipe, "recipe": dict(RECIPE), "fold": fold, "seed_i": seed_i,
        "scores": scores, "train_skins": ["s8", "s9"], "train_rows_n": 100,
    }  # fmt: skip
    tuning = {"tuning": {"pokes_n": 390, "settings": {"base": "paper"}}} if experiment == "adapt" else {}
    return words | tuning | changes


def of_skin(fold: str, skin: str, seed_i: int, *, off_mm: float = 1.0, force: bool = True) -> dict:
    """The card of a network that was adapted to one skin, and misses by about so much on it."""
    rng = rng_for(seed_i, "adapted", fold, skin)
    true = rng.uniform(0, 16, (10, 3))
    predicted = true + rng.normal(0, off_mm, true.shape)
    if not force:
        true[:, 2] = np.nan
    scores = score_groups(true, predicted, np.repeat(fold, 10), np.repeat(skin, 10))
    return card("adapt", fold, scores, seed_i=seed_i)


def every(**changes: Any) -> list[dict]:
    """Three networks of two boards with two skins each, adapted to each skin."""
    return [of_skin(fold, skin, seed_i, **changes) for seed_i in range(3) for fold, skin in SKINS]
