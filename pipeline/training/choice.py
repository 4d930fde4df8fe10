"""Choose settings from the model cards of a scene in which each board was held out in turn.

The criterion is the mean squared error of places on the held-out boards, for networks with the paper's inputs. The
budget, which is the number of training steps, is not chosen, because each scene sets it. Every candidate is tried with
the same budgets, and its errors are averaged over the budgets, so that no candidate wins by training longer. Settings
with a collapsed training run (a network whose predictions are nearly constant) are not chosen.

Unless a network is adapted later, the triplet term of the loss only increases its error. The weight of the triplet term
is therefore chosen together with the settings of the adaptation.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.scores import rows_of_cards
from pipeline.statistics import over_folds
from reskin.errors import ParamsError

BY = "mse_xy_mm2"
PAPER_INPUTS = "raw"
# Settings that the description of a candidate lists.
VARIED = (
    "steps_n", "batch_n", "rate_max", "gradient_norm_max", "weight_decay", "triplet_weight", "base",
    "unlabelled_weight",
)  # fmt: skip
BUDGET = ("steps_n", "base")  # a scene's number of steps and the name of a base recipe are not settings of the method
WHERE = "choice of settings"

Card = Mapping[str, Any]
Cards = Sequence[Card]


def choose(cards: Cards) -> dict[str, dict[str, Any]]:
    """Choose the settings of every stage.

    Returns for each stage the name of the chosen recipe (`recipe_name`), its `settings`, the criterion (`by`), and all
    `candidates` with their scores. The choice for `adapt` also contains the error of the control. The control is the
    same network, trained further for as many steps as the adapted network, but without pokes of the new skin.
    """
    by_paper = [card for card in cards if card["recipe"]["inputs"] == PAPER_INPUTS]
    multi, triplet, tuned = ([card for card in by_paper if card["question"] == q] for q in ("lobo", "triplet", "adapt"))
    collapsed = [without_budget(card["recipe"]) for card in triplet if _has_collapsed(card)]
    with_pokes = [card for card in tuned if settings_of(card)["unlabelled_weight"] > 0]
    eligible = [card for card in with_pokes if without_budget(card["recipe"]) not in collapsed]
    _, chosen_multi, _ = _choose(multi, multi, "train_multi")
    best, chosen_adapt, errors = _choose(tuned, eligible, "adapt")
    chosen_adapt["error"] = errors[best["recipe_name"]]
    without = _key(best) | {"unlabelled_weight": 0.0}
    if control := [card["recipe_name"] for card in tuned if _key(card) == without]:
        chosen_adapt["control"] = errors[control[0]]
    chosen_triplet = {
        "recipe_name": settings_of(best)["base"],
        "settings": without_budget(best["recipe"]),
        "by": "MSE_xy of the networks that were adapted from networks of this recipe",
        "candidates": _candidates(triplet),
    }
    return {"train_multi": chosen_multi, "adapt": chosen_adapt, "train_triplet": chosen_triplet}


def to_record(chosen: Mapping[str, Mapping[str, Any]], cards: Cards, *, source: str, seed: int) -> dict[str, Any]:
    """Record the choice with its boards and skins, for the audit of the scenes that use the chosen settings."""
    return {
        "scene": cards[0]["scene"], "source": source, "seed": seed,
        "boards": sorted({board for card in cards for board in card["test_boards"]}),
        "skins": sorted({skin for card in cards for skin in card["test_skins"]}),
        "chosen": {stage: choice["settings"] for stage, choice in chosen.items()},
    }  # fmt: skip


def settings_of(card: Card) -> dict[str, Any]:
    """Return the settings of a training run: its recipe, or the settings of its adaptation if it has one."""
    settings: dict[str, Any] = card["tuning"]["settings"] if "tuning" in card else card["recipe"]
    return settings


def without_budget(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings without the keys in `BUDGET`, which are not settings of the method."""
    return {name: value for name, value in settings.items() if name not in BUDGET}


def _choose(cards: Cards, eligible: Cards, stage: str) -> tuple[Card, dict[str, Any], dict[str, float]]:
    """Find the eligible card with the smallest error; return it, the choice, and the errors by recipe."""
    what = f"candidates of {stage}"
    if not eligible:
        raise ParamsError(f"{WHERE}: no {what}. Run experiments lobo, triplet and adapt in this scene.")
    _check_budgets(cards, stage)
    collapsed = [_key(card) for card in cards if _has_collapsed(card)]
    stable = [card for card in eligible if _key(card) not in collapsed]
    if not stable:
        raise ParamsError(f"{WHERE}: all {what} have a collapsed training run. Add candidates with a smaller rate_max.")
    candidates = _candidates(cards)
    errors = _errors(cards, candidates)
    best = min(stable, key=lambda card: (errors[card["recipe_name"]], _budget(card)))
    chosen = {"recipe_name": best["recipe_name"], "settings": without_budget(settings_of(best))}
    by = "mean of MSE_xy over all numbers of training steps"
    return best, chosen | {"by": by, "candidates": candidates}, errors


def _has_collapsed(card: Card) -> bool:
    return bool(card["collapsed"] or card["collapsed_before_n"])


def _errors(cards: Cards, candidates: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Average the error over budgets, by recipe; recipes that differ only in their budget get the same value."""
    settings = {card["recipe_name"]: (_key(card), _budget(card)) for card in cards}
    errors = {candidate["recipe_name"]: candidate[BY].mean for candidate in candidates}

    def over_budgets(key: Mapping[str, Any]) -> float:
        by_budget = {budget: errors[name] for name, (other, budget) in settings.items() if other == key}
        return float(np.mean(list(by_budget.values())))  # two recipes with equal settings and steps count only once

    return {name: over_budgets(key) for name, (key, _) in settings.items()}


def _check_budgets(cards: Cards, stage: str) -> None:
    """Raise `ParamsError` unless every candidate was tried with the same numbers of steps."""
    budgets_by_name = {
        card["recipe_name"]: {_budget(other) for other in cards if _key(other) == _key(card)} for card in cards
    }
    all_budgets = set().union(*budgets_by_name.values())
    for name, budgets in budgets_by_name.items():
        if budgets != all_budgets:
            what = f"candidate {name} of {stage} was trained with numbers of steps (training, adaptation)"
            tried = f"{sorted(budgets)}, but all candidates together with {sorted(all_budgets)}"
            raise ParamsError(f"{WHERE}: {what} {tried}. Train every candidate with every number of steps.")


def _key(card: Card) -> dict[str, Any]:
    """Return the settings without budget; for an adaptation, also the settings of the pretrained network."""
    return without_budget(card["recipe"]) | (without_budget(settings_of(card)) if "tuning" in card else {})


def _budget(card: Card) -> tuple[int, int]:
    """Return the numbers of steps of training and of adaptation (0 without adaptation)."""
    return (card["recipe"]["steps_n"], card["tuning"]["settings"]["steps_n"] if "tuning" in card else 0)


def _candidates(cards: Cards) -> list[dict[str, Any]]:
    # The order is reversed, so that the settings of the first card of each recipe are kept.
    settings = {card["recipe_name"]: settings_of(card) for card in reversed(cards)}
    return [
        {
            "recipe_name": name,
            "settings": ", ".join(f"{key} {value}" for key, value in settings[name].items() if key in VARIED),
            **over_folds(rows),
        }
        for name, rows in rows_of_cards(cards).groupby("recipe", sort=False)
    ]
