"""Choose the settings of training and adaptation from the results of a scene that tried several candidates.

In this scene, each board is held out in turn. The results are read from model cards, the JSON files that describe
trained networks and their scores. The criterion is the mean squared error of places on the held-out boards. Only
networks with the paper's inputs are candidates.

The number of training steps, called the budget, is not chosen here, because every scene sets its own budget. So that no
candidate wins by training longer, every candidate is tried with the same budgets, and its errors are averaged over the
budgets. A candidate is excluded if one of its training runs collapsed, which means that the network predicts nearly the
same for all inputs.

The settings of adaptation and the weight of the triplet loss are chosen together. Without adaptation, the triplet loss
only increases the error, so that its weight cannot be chosen from the networks before adaptation.

The record of a choice contains a fingerprint of the simulated skin. An audit later compares it with the fingerprint
that the current code computes, to detect that the simulation has changed since the choice.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.constants import micro, milli

from pipeline.statistics import over_folds, tidy
from reskin.config import parse
from reskin.errors import ParamsError
from reskin.physics.board import BoardDesign, Spreads, draw_board
from reskin.physics.magnet import Quadrature
from reskin.physics.skin import SkinDesign, changes_of_field, draw_skin, forces

BY = "mse_xy_mm2"
PAPER_INPUTS = "raw"
# The settings that are listed when a candidate is described.
VARIED = (
    "steps_n", "batch_n", "rate_max", "gradient_norm_max", "weight_decay", "triplet_weight", "base",
    "unlabelled_weight",
)  # fmt: skip
# Keys that are ignored when settings are compared, because they are not settings of the method: the number of steps,
# which the scene sets, and the name of the recipe with which the adapted network was pretrained.
BUDGET = ("steps_n", "base")
WHERE = "choice of settings"

Card = Mapping[str, Any]
Cards = Sequence[Card]


def choose(cards: Cards) -> dict[str, dict[str, Any]]:
    """Choose settings for the stages `train_multi`, `train_triplet` and `adapt`.

    Returns
    -------
    For each stage, a dictionary with these keys: `recipe_name` and `settings` of the best candidate, `by` (the
    criterion), and `candidates` (all candidates with their scores). For stage `adapt`, there are also the keys `error`
    and `control`. The latter is the error of the control experiment, in which the same network is trained for equally
    many further steps, but without pokes of the new skin.
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
        "by": "MSE_xy of the networks adapted from it",
        "candidates": _candidates(triplet),
    }
    return {"train_multi": chosen_multi, "adapt": chosen_adapt, "train_triplet": chosen_triplet}


def to_record(
    chosen: Mapping[str, Mapping[str, Any]], cards: Cards, *, source: str, seed: int, physics: str
) -> dict[str, Any]:
    """Return the record of a choice, as it is written to a JSON file.

    The record names the boards and skins on which the settings were chosen. Audits need it to check the scenes that use
    the chosen settings. `physics` is the fingerprint of the simulated skin (see `fingerprint`).
    """
    return {
        "scene": cards[0]["scene"], "source": source, "seed": seed, "physics": physics,
        "boards": sorted({board for card in cards for board in card["test_boards"]}),
        "skins": sorted({skin for card in cards for skin in card["test_skins"]}),
        "chosen": {stage: choice["settings"] for stage, choice in chosen.items()},
    }  # fmt: skip


def settings_of(card: Card) -> dict[str, Any]:
    """Return the settings of a training run: those of the adaptation if it is one, otherwise those of the recipe."""
    settings: dict[str, Any] = card["tuning"]["settings"] if "tuning" in card else card["recipe"]
    return settings


def without_budget(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings without the keys in `BUDGET`, which are not settings of the method."""
    return {name: value for name, value in settings.items() if name not in BUDGET}


def _choose(cards: Cards, eligible: Cards, stage: str) -> tuple[Card, dict[str, Any], dict[str, float]]:
    """Choose the settings of one stage among the eligible cards.

    Returns the card with the smallest error, the choice as a dictionary, and the errors of all cards by recipe.
    """
    what = f"candidates of {stage}"
    if not eligible:
        raise ParamsError(f"{WHERE}: no {what}. Run experiments lobo, triplet and adapt.")
    _check_budgets(cards, stage)
    collapsed = [_key(card) for card in cards if _has_collapsed(card)]
    stable = [card for card in eligible if _key(card) not in collapsed]
    if not stable:
        raise ParamsError(f"{WHERE}: all {what} have a collapsed training run. Try lower learning rates.")
    candidates = _candidates(cards)
    errors = _errors(cards, candidates)
    best = min(stable, key=lambda card: (errors[card["recipe_name"]], _budget(card)))
    chosen = {"recipe_name": best["recipe_name"], "settings": without_budget(settings_of(best))}
    return best, chosen | {"by": "MSE_xy, mean over all budgets of steps", "candidates": candidates}, errors


def _has_collapsed(card: Card) -> bool:
    return bool(card["collapsed"] or card["collapsed_before_n"])


def _errors(cards: Cards, candidates: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the error of each recipe, averaged over budgets.

    Recipes that differ only in their budget are the same candidate, so they have the same average.
    """
    settings = {card["recipe_name"]: (_key(card), _budget(card)) for card in cards}
    errors = {candidate["recipe_name"]: candidate[BY]["mean"] for candidate in candidates}

    def over_budgets(key: Mapping[str, Any]) -> float:
        by_budget = {budget: errors[name] for name, (other, budget) in settings.items() if other == key}
        # If two recipes have equal settings and budgets under different names, only one of them is counted.
        return float(np.mean(list(by_budget.values())))

    return {name: over_budgets(key) for name, (key, _) in settings.items()}


def _check_budgets(cards: Cards, stage: str) -> None:
    """Raise `ParamsError` unless all candidates were tried with the same set of budgets."""
    budgets_by_name = {
        card["recipe_name"]: {_budget(other) for other in cards if _key(other) == _key(card)} for card in cards
    }
    all_budgets = set().union(*budgets_by_name.values())
    for name, budgets in budgets_by_name.items():
        if budgets != all_budgets:
            what, tried = f"steps of {stage}'s {name}", f"{sorted(budgets)} of {sorted(all_budgets)}"
            remedy = "Try every candidate with every number of steps."
            raise ParamsError(f"{WHERE}: {what} differ between candidates: {tried}. {remedy}")


def _key(card: Card) -> dict[str, Any]:
    """Return the settings by which candidates are distinguished: all settings except the budget.

    For an adaptation, these are the settings of the adaptation and those of the network that is adapted.
    """
    return without_budget(card["recipe"]) | (without_budget(settings_of(card)) if "tuning" in card else {})


def _budget(card: Card) -> tuple[int, int]:
    """Return the number of training steps, and the number of adaptation steps, which is 0 without adaptation."""
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
        for name, rows in tidy(cards).groupby("recipe", sort=False)
    ]


# --- Fingerprint of the simulation. It does not change as long as equal indentations give equal fields and forces. ---

RULE = Quadrature(cell_m=0.8e-3, layers_n=5)  # the same quadrature as in scene quick
BOARD = BoardDesign(
    chips_xy_mm=((0.0, 0.0), (-7.0, 0.0), (0.0, -7.0), (7.0, 0.0), (0.0, 7.0)),
    chips_turn_deg=(0.0, 180.0, 270.0, 90.0, 0.0),
    gap_mm=1.1,
)
PLACES_MM = ((0.0, 0.0), (4.0, -2.0), (-6.0, 4.0), (8.0, 4.0))
DEPTHS_MM = (0.2, 0.6, 1.2)
# Simulated values are rounded to this number of significant digits. Changes of the physics alter these digits, but
# rounding errors do not.
DIGITS = 4


def fingerprint(sections: Mapping[str, Any]) -> str:
    """Return a digest that identifies the simulated skin.

    The digest is computed from the fields and forces of two simulated skins under fixed indentations, and from the
    settings of the rig and of the chips. It changes if the physics or one of these settings changes. It does not change
    if the code is only restructured.
    """
    design = parse(SkinDesign, sections["skin"], "skin")
    spreads = parse(Spreads, sections["spreads"], "spreads")
    indentations_m = milli * np.array([(*place, depth) for place in PLACES_MM for depth in DEPTHS_MM])
    simulated = []
    for name in ("b0", "b1"):
        board = draw_board(BOARD, spreads, seed=0, name=name)
        skin = draw_skin(design, spreads, seed=0, name=f"{name}_s0", rule=RULE)
        rest_T, change_T = changes_of_field(board, skin, indentations_m)
        simulated += [rest_T.ravel() / micro, change_T.ravel() / micro, forces(skin, indentations_m[:, 2])]
    rounded = [f"{value:.{DIGITS - 1}e}" for value in np.concatenate(simulated)]
    content = json.dumps([rounded, sections["rig"], sections["chip"]], sort_keys=True, default=str)
    return hashlib.sha256(content.encode()).hexdigest()[:16]
