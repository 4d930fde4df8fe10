"""Which settings were best on the boards of a study? In: cards of its trainings. Out: the choice, and its candidates.

By the mean squared error of places over the boards held out in turn; the paper's inputs only, as its method is what is
set. How many steps there are is a scene's budget: every candidate is tried with the same budgets, and its errors are
averaged over them, so that no setting wins by training longer. Settings with which a training collapsed are not
chosen. Settings of adaptation are chosen together with the triplet weight of the network that they start from: alone,
the triplet term only costs. Refuses to know who uses a choice.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.core.errors import ParamsError
from pipeline.evaluation.scores import over_folds, tidy

BY = "mse_xy_mm2"
PAPER_INPUTS = "raw"
VARIED = (
    "steps_n", "batch_n", "rate_max", "gradient_norm_max", "weight_decay", "triplet_weight", "base",
    "unlabelled_weight",
)  # fmt: skip
BUDGET = ("steps_n", "base")  # how long is a scene's budget; what a base is called is no setting

Cards = Sequence[dict[str, Any]]


def choose(cards: Cards) -> dict[str, dict[str, Any]]:
    """Choose for every stage: `recipe_name`, its settings, `by` which number, `candidates` with their scores.

    An adaptation's `control` is what it must beat: fine-tuned as long from the same network, without the pokes.
    """
    own = [card for card in cards if card["recipe"]["inputs"] == PAPER_INPUTS]
    tuned = [card for card in own if card["question"] == "adapt"]
    chosen = {"train_multi": _best([card for card in own if card["question"] == "lobo"], "train_multi")}
    dead = [trimmed(card["recipe"]) for card in own if card["question"] == "triplet" and _has_collapsed(card)]
    eligible = [card for card in tuned if trimmed(card["recipe"]) not in dead]
    chosen["adapt"] = _best(tuned, "adapt", [one for one in eligible if settings_of(one)["unlabelled_weight"] > 0])
    best = next(card for card in tuned if card["recipe_name"] == chosen["adapt"]["recipe_name"])
    control = [card for card in tuned if _key(card) == _key(best) | {"unlabelled_weight": 0.0}]
    chosen["adapt"] |= {"error": _error(tuned, best)} | ({"control": _error(tuned, control[0])} if control else {})
    chosen["train_triplet"] = {
        "recipe_name": settings_of(best)["base"],
        "settings": trimmed(best["recipe"]),
        "by": "MSE_xy of the networks adapted from it",
        "candidates": _candidates([card for card in own if card["question"] == "triplet"]),
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


def _best(cards: Cards, stage: str, eligible: Cards | None = None) -> dict[str, Any]:
    """Find the settings of the least error among `eligible` (all, if it is not given); list all."""
    among = cards if eligible is None else eligible
    if not among:
        raise ParamsError(
            "choice of settings", f"candidates of {stage}", "one or more", "none", "Ask lobo, triplet, adapt."
        )
    _check_budgets(cards, stage)
    sound = [card for card in among if not any(_has_collapsed(one) for one in cards if _key(one) == _key(card))]
    if not sound:
        rule = "one or more without a collapsed training"
        raise ParamsError("choice of settings", f"candidates of {stage}", rule, "none", "Try lower rates.")
    card = min(sound, key=lambda one: (_error(cards, one), _budget(one)))
    words = {"recipe_name": card["recipe_name"], "settings": trimmed(settings_of(card))}
    return words | {"by": "MSE_xy, mean over all budgets of steps", "candidates": _candidates(cards)}


def _has_collapsed(card: dict[str, Any]) -> bool:
    return bool(card["collapsed"] or card["collapsed_before_n"])


def _error(cards: Cards, of: dict[str, Any]) -> float:
    """Mean over budgets of the error of all cards with the settings of one."""
    alike = [card for card in cards if _key(card) == _key(of)]
    budgets = [[card for card in alike if _budget(card) == one] for one in sorted({*map(_budget, alike)})]
    return float(np.mean([over_folds(tidy(own))[BY]["mean"] for own in budgets]))


def _check_budgets(cards: Cards, stage: str) -> None:
    tried = {card["recipe_name"]: {_budget(one) for one in cards if _key(one) == _key(card)} for card in cards}
    every = set().union(*tried.values())
    for name, budgets in tried.items():
        if budgets != every:
            got = f"{sorted(budgets)} of {sorted(every)}"
            raise ParamsError("choice of settings", f"steps of {stage}'s {name}", "those of all candidates", got,
                         "Try every candidate with every number of steps.")  # fmt: skip


def _key(card: dict[str, Any]) -> dict[str, Any]:
    """Name settings without their budget; an adaptation's with those of the network that it starts from."""
    return trimmed(card["recipe"]) | (trimmed(settings_of(card)) if "tuning" in card else {})


def _budget(card: dict[str, Any]) -> tuple[int, int]:
    return (card["recipe"]["steps_n"], card["tuning"]["settings"]["steps_n"] if "tuning" in card else 0)


def _candidates(cards: Cards) -> list[dict[str, Any]]:
    names = dict.fromkeys(card["recipe_name"] for card in cards)
    by_name = {name: [card for card in cards if card["recipe_name"] == name] for name in names}
    return [
        {
            "recipe_name": name,
            "settings": ", ".join(f"{key} {value}" for key, value in settings_of(own[0]).items() if key in VARIED),
            **over_folds(tidy(own)),
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
