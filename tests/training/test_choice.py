"""Tests of choosing training settings from the model cards of candidate networks."""

from typing import Any

import pytest

from pipeline.training.choice import choose
from reskin.errors import ParamsError
from tests.report import synthetic
from tests.scenes import RECIPE

Card = dict[str, Any]


def card(experiment: str, name: str, mse_xy_mm2: float, fold: str = "b0", **changes: Any) -> Card:
    """Return a model card with one skin per board.

    All scores are computed from the place error, such that settings with a smaller place error have a worse accuracy
    and a larger force error.
    """
    score = {"accuracy_pct": mse_xy_mm2, "mse_xy_mm2": mse_xy_mm2, "mse_f_N2": 1 / mse_xy_mm2}
    scores = {
        "all": score,
        "registered": score,
        "by_skin": {f"{fold}_s0": score},
        "board_of": {f"{fold}_s0": fold},
        "rows_n": 4,
    }
    data = {"scene": "tuning", "test_boards": [fold], "test_skins": [f"{fold}_s0"]}
    outcome = {"collapsed": False, "collapsed_before_n": 0}
    return synthetic.card(experiment, fold, scores, name) | data | outcome | changes


def adapted_card(name: str, mse_xy_mm2: float, base: str, *, unlabelled_weight: float = 0.1, **changes: Any) -> Card:
    schedule = {"batch_n": 64, "rate_max": 1e-3, "weight_decay": 0.0, "steps_n": 400}
    settings = {"base": base, "unlabelled_weight": unlabelled_weight} | schedule
    recipe = RECIPE | {"triplet_weight": WEIGHTS[base]}
    return card("adapt", name, mse_xy_mm2, recipe=recipe, **changes) | {
        "tuning": {"pokes_n": 390, "settings": settings}
    }


WEIGHTS = {"light": 0.1, "heavy": 1.0}
CARDS = [
    card("lobo", "slow", 0.5, recipe=RECIPE | {"rate_max": 1e-3}),
    card("lobo", "fast", 0.3, recipe=RECIPE | {"rate_max": 6e-3}),
    card("lobo", "fastest", 0.4, recipe=RECIPE | {"rate_max": 9e-3}),
    card("triplet", "light", 0.35, recipe=RECIPE | {"triplet_weight": 0.1}),
    card("triplet", "heavy", 0.6, recipe=RECIPE | {"triplet_weight": 1.0}),
    adapted_card("from-light", 0.34, "light"),
    adapted_card("from-heavy", 0.25, "heavy"),
]


def names(chosen: dict[str, Any]) -> dict[str, str]:
    return {stage: one["recipe_name"] for stage, one in chosen.items()}


def test_settings_with_the_smallest_place_error_are_chosen():
    chosen = choose(CARDS)
    assert names(chosen) == {"train_multi": "fast", "adapt": "from-heavy", "train_triplet": "heavy"}
    assert chosen["train_multi"]["settings"]["rate_max"] == 6e-3
    # Recipe `light` is better without adaptation, and recipe `heavy` is better after adaptation.
    assert chosen["train_triplet"]["settings"]["triplet_weight"] == 1.0
    assert chosen["adapt"]["settings"]["unlabelled_weight"] == 0.1


def test_settings_are_compared_by_the_mean_over_boards():
    # The seeds of a board are averaged first. Therefore the mean is (0.4 + 0.9) / 2, which is less than 0.695. The mean
    # over all networks, (0.4 + 0.9 + 0.9) / 3, would not be less.
    boards = [
        card("lobo", "fast", 0.29, "b0", recipe=RECIPE | {"rate_max": 6e-3}),
        card("lobo", "fast", 1.1, "b1", recipe=RECIPE | {"rate_max": 6e-3}),
        card("lobo", "even", 0.4, "b0"),
        card("lobo", "even", 0.85, "b1"),
        card("lobo", "even", 0.95, "b1", seed_i=1),
    ]
    chosen = choose([one for one in CARDS if one["question"] != "lobo"] + boards)["train_multi"]
    scores = {one["recipe_name"]: one["mse_xy_mm2"].mean for one in chosen["candidates"]}
    assert scores == {"fast": pytest.approx(0.695), "even": pytest.approx(0.65)}
    assert chosen["recipe_name"] == "even"


def test_scores_of_adapted_skins_are_averaged_over_boards():
    # Board b0 has two skins with the errors 0.2 and 0.4, and board b1 has one skin with the error 0.9. The expected
    # mean is (0.3 + 0.9) / 2, and not the mean over three skins.
    skins = [
        adapted_card("from-light", error, "light", fold=fold, test_skins=[skin])
        for fold, skin, error in (("b0", "b0_s0", 0.2), ("b0", "b0_s1", 0.4), ("b1", "b1_s0", 0.9))
    ]
    chosen = choose([one for one in CARDS if one["question"] != "adapt"] + skins)["adapt"]
    scores = chosen["candidates"][0]["mse_xy_mm2"]
    assert scores.mean == pytest.approx(0.6)
    assert scores.sd_seeds is None  # The spread over skins is not a spread over seeds.


@pytest.mark.parametrize(
    ("cards", "stage"),
    [
        ([], "train_multi"),
        ([one for one in CARDS if one["question"] != "lobo"], "train_multi"),
        ([one for one in CARDS if one["question"] != "adapt"], "adapt"),
        ([*CARDS[:5], adapted_card("control", 0.1, "light", unlabelled_weight=0.0)], "adapt"),
    ],
    ids=["nothing", "nothing pooled", "nothing adapted", "a control alone"],
)
def test_choice_without_candidates_is_refused(cards, stage):
    with pytest.raises(ParamsError, match=f"no candidates of {stage}. Run experiments lobo"):
        choose(cards)


def with_steps(one: Card, steps_n: int, **scores: float) -> Card:
    """Return a copy of a model card with another number of steps and another error."""
    return card(one["question"], f"{one['recipe_name']}-{steps_n}", scores["mse_xy_mm2"],
                recipe=one["recipe"] | {"steps_n": steps_n})  # fmt: skip


def test_choice_raises_if_candidates_differ_in_the_number_of_steps():
    slow, fast = (card("lobo", name, mse, recipe=RECIPE | {"rate_max": rate, "steps_n": 100})
                  for name, mse, rate in (("slow", 0.5, 1e-3), ("fast", 0.4, 6e-3)))  # fmt: skip
    others = [one for one in CARDS if one["question"] != "lobo"]
    unfair = [slow, fast, with_steps(slow, 900, mse_xy_mm2=0.1)]
    with pytest.raises(ParamsError, match="candidate fast of train_multi was trained with numbers of steps"):
        choose([*unfair, *others])
    chosen = choose([*unfair, with_steps(fast, 900, mse_xy_mm2=0.15), *others])["train_multi"]
    # The mean error is 0.275 for `fast`, and 0.3 for `slow`.
    assert chosen["recipe_name"] == "fast" or chosen["settings"]["rate_max"] == 6e-3


@pytest.mark.parametrize("failure", [{"collapsed": True}, {"collapsed_before_n": 1}])
def test_settings_with_which_a_training_collapsed_are_not_chosen(failure):
    # With the same settings, the training on the other board did not collapse.
    again = card("lobo", "fast", 0.1, "b1", recipe=RECIPE | {"rate_max": 6e-3}, **failure)
    assert names(choose([*CARDS, again]))["train_multi"] == "fastest"
    collapsed_cards = [one | failure if one["question"] == "lobo" else one for one in CARDS]
    with pytest.raises(ParamsError, match="all candidates of train_multi have a collapsed"):
        choose(collapsed_cards)
