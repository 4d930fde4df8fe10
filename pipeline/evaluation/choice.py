"""Which settings were best on the boards of a study? In: cards of its trainings. Out: the choice, and its candidates.

By the mean squared error of places over the boards held out in turn; the paper's inputs only, as its method is what is
set. The base of adaptation is chosen with it: alone, the triplet term only costs. Refuses to know who uses a choice.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.errors import ParamsError, complain
from pipeline.evaluation.summary import over_folds, pool_skins

BY = "mse_xy_mm2"
PAPER_INPUTS = "raw"
VARIED = ("steps_n", "batch_n", "rate_max", "weight_decay", "triplet_weight", "base", "unlabelled_weight")
BUDGET = ("steps_n", "base")  # how long is a scene's budget; what a base is called is no setting

Cards = Sequence[dict[str, Any]]


def choose(cards: Cards) -> dict[str, dict[str, Any]]:
    """Choose for every stage: `recipe_name`, its settings, `by` which number, `candidates` with their scores."""
    own = [card for card in cards if card["recipe"]["inputs"] == PAPER_INPUTS]
    adapted = [card for card in own if card["question"] == "adapt" and settings_of(card)["unlabelled_weight"] > 0]
    chosen = {"train_multi": _best([card for card in own if card["question"] == "lobo"], "train_multi")}
    chosen["adapt"] = _best(adapted, "adapt")
    base = next(card for card in adapted if card["recipe_name"] == chosen["adapt"]["recipe_name"])
    triplets = [card for card in own if card["question"] == "triplet"]
    chosen["train_triplet"] = {
        "recipe_name": settings_of(base)["base"],
        "settings": trimmed(base["recipe"]),
        "by": "MSE_xy of the networks adapted from it",
        "candidates": _candidates(triplets),
    }
    return chosen


def to_record(chosen: Mapping[str, Mapping[str, Any]], cards: Cards, *, source: str, seed: int) -> dict[str, Any]:
    """Write down what was chosen on which boards and skins, for the audit of the scenes that use it."""
    return {
        "scene": cards[0]["scene"],
        "source": source,
        "seed": seed,
        "boards": sorted({board for card in cards for board in card["test_boards"]}),
        "skins": sorted({skin for card in cards for skin in card["test_skins"]}),
        "chosen": {stage: one["settings"] for stage, one in chosen.items()},
    }


def _best(cards: Cards, stage: str) -> dict[str, Any]:
    if not cards:
        raise ParamsError(
            complain("choice of settings", f"candidates of {stage}", "one or more", "none", "Ask lobo, triplet, adapt.")
        )
    candidates = _candidates(cards)
    best = min(candidates, key=lambda one: one[BY]["mean"])["recipe_name"]
    card = next(card for card in cards if card["recipe_name"] == best)
    return {"recipe_name": best, "settings": trimmed(settings_of(card)), "by": "MSE_xy", "candidates": candidates}


def _candidates(cards: Cards) -> list[dict[str, Any]]:
    names = dict.fromkeys(card["recipe_name"] for card in cards)
    by_name = {name: [card for card in cards if card["recipe_name"] == name] for name in names}
    return [
        {
            "recipe_name": name,
            "settings": ", ".join(f"{key} {value}" for key, value in settings_of(own[0]).items() if key in VARIED),
            **over_folds(pool_skins(own) if "tuning" in own[0] else own),
        }
        for name, own in by_name.items()
    ]


def settings_of(card: dict[str, Any]) -> dict[str, Any]:
    """Give what a training was set to: its recipe, or how it went on from one."""
    settings: dict[str, Any] = card["tuning"]["settings"] if "tuning" in card else card["recipe"]
    return settings


def trimmed(settings: dict[str, Any]) -> dict[str, Any]:
    """Leave out what is no setting of the method."""
    return {name: value for name, value in settings.items() if name not in BUDGET}
