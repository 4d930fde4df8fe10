"""Tests of the checks of the audit, with planted leaks.

Leaks are planted in the split, in captures (copies), in the scaler, in the settings and in the pool of presses for
adaptation.
"""

import doctest
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.experiments import audit
from pipeline.experiments.audit import (
    AuditSettings,
    Labels,
    Sides,
    audit_choice,
    audit_fold,
    audit_scaler,
    nearest_rays,
)
from reskin.errors import ParamsError, SchemaError
from reskin.models.inputs import FIT
from reskin.seeds import rng_for

NONE = np.zeros(0, np.int64)
READINGS_N = 3
NOISE_uT = np.tile([3.3, 3.3, 5.0], 5)  # These are the noise levels of x, y and z in the lab recordings.
UNSEEN = ("lobo", "sensors", "transfer")


def example_presses(boards_n: int = 3, pokes_n: int = 60) -> tuple[Labels, np.ndarray]:
    """Return presses of two skins per board, with three readings each.

    The response of a skin is the sum of a part that all skins share and of a part of its own, which is a third as
    large.
    """
    rng = rng_for(0, "audit")
    common, dbs_uT = rng.normal(0, 25, (9, 15)), []
    for _ in range(2 * boards_n):
        x, y = rng.uniform(0, 3, (2, pokes_n))
        waves = [np.ones(pokes_n), np.sin(x), np.cos(x), np.sin(y), np.cos(y), x * y / 4, np.sin(x - y)]
        shape = np.stack([*waves, np.sin(2 * x), np.sin(2 * y)], axis=1)
        still_uT = rng.uniform(1, 3, (pokes_n, 1)) * (shape @ (common + rng.normal(0, 8, (9, 15))))
        dbs_uT.append(np.repeat(still_uT, READINGS_N, axis=0) + rng.normal(0, NOISE_uT, (READINGS_N * pokes_n, 15)))
    own_n = READINGS_N * pokes_n
    board = np.repeat([f"b{i // 2}" for i in range(2 * boards_n)], own_n)
    skin = np.repeat([f"b{i // 2}_s{i % 2}" for i in range(2 * boards_n)], own_n)
    labels = Labels(board, skin, np.arange(len(board)) // READINGS_N, capture=np.char.add("c_", skin))
    return labels, np.concatenate(dbs_uT).astype(np.float32)


def held_out(labels: Labels, experiment: str = "lobo", board: str = "b0") -> Sides:
    on_board = labels.board == board
    return Sides(experiment, board, np.flatnonzero(~on_board), NONE, np.flatnonzero(on_board))


def run_audit(fold: Sides, labels: Labels, db_uT: np.ndarray):
    return audit_fold(fold, labels, db_uT=db_uT, rng=rng_for(0, "sample"))


def failing(checks) -> list[str]:
    return [check.what for check in checks if not check.holds]


def passes(checks) -> bool:
    return all(check.holds or check.known for check in checks)


LABELS, DB_uT = example_presses()


def test_docstring_example_runs():
    outcome = doctest.testmod(audit, extraglobs={"rng": rng_for(0, "doctest")})
    assert outcome.attempted >= 4
    assert outcome.failed == 0


@pytest.mark.parametrize("experiment", UNSEEN)
@pytest.mark.parametrize("board", ["b0", "b1", "b2"])
def test_folds_without_leaks_pass(experiment, board):
    checks = run_audit(held_out(LABELS, experiment, board), LABELS, DB_uT)
    assert failing(checks) == []
    assert [check.what for check in checks] == ["readings", "boards", "skins", "indentations", "copies"]


def moved_to_train(moved: np.ndarray) -> Sides:
    fold = held_out(LABELS)
    return replace(fold, train=np.union1d(fold.train, fold.test[moved]), test=fold.test[~moved])


FIRST_SKIN = LABELS.skin[LABELS.board == "b0"] == "b0_s0"


@pytest.mark.parametrize(
    ("leak", "named"),
    [
        (FIRST_SKIN, ["boards"]),
        (np.arange(len(FIRST_SKIN)) < 5 * READINGS_N, ["boards", "skins"]),
        (np.arange(len(FIRST_SKIN)) < 1, ["boards", "skins", "indentations"]),
    ],
    ids=["a skin of the board", "five indentations of a skin", "one reading"],
)
def test_rows_of_the_test_side_that_are_used_for_training_are_detected(leak, named):
    checks = run_audit(moved_to_train(leak), LABELS, DB_uT)
    assert not passes(checks)
    assert failing(checks) == named
    assert checks[1].found == "1 of 1 test boards are also in training: b0"


def test_reading_used_for_both_training_and_testing_is_detected():
    rows = np.flatnonzero(LABELS.skin == "b0_s0")
    fold = Sides("single_random", "repeat0", rows[:100], NONE, rows[99:])
    assert failing(run_audit(fold, LABELS, DB_uT)) == ["readings", "indentations"]
    assert not passes(run_audit(fold, LABELS, DB_uT))


def test_leak_of_the_papers_random_split_is_reported_as_known():
    rows = np.flatnonzero(LABELS.skin == "b0_s0")
    checks = run_audit(Sides("single_random", "repeat0", rows[::2], NONE, rows[1::2]), LABELS, DB_uT)
    (leak,) = [check for check in checks if not check.holds]
    assert (leak.what, leak.known) == ("indentations", True)
    # Each press has 3 readings. Two of them are on one side of the split, and one is on the other side.
    assert leak.found.startswith("60 of 60 test indentations are also in training")
    assert passes(checks)


@pytest.mark.parametrize("experiment", ["single_temporal", "single_indentation", "single_pass"])
def test_press_whose_readings_are_partly_training_and_partly_test_rows_is_detected(experiment):
    rows = np.flatnonzero(LABELS.skin == "b0_s0")
    fold = Sides(experiment, "b0_s0", rows[: 20 * READINGS_N], NONE, rows[20 * READINGS_N :])
    assert failing(run_audit(fold, LABELS, DB_uT)) == []
    split_indentation = replace(fold, train=rows[:61], test=rows[61:])
    assert failing(run_audit(split_indentation, LABELS, DB_uT)) == ["indentations"]
    assert not passes(run_audit(split_indentation, LABELS, DB_uT))


def test_tested_presses_and_training_skins_in_the_adaptation_pool_are_detected():
    fold = held_out(LABELS)
    pool, test = fold.test[: 10 * READINGS_N], fold.test[10 * READINGS_N :]
    assert failing(run_audit(replace(fold, pool=pool, test=test), LABELS, DB_uT)) == []
    tested = run_audit(replace(fold, pool=fold.test[:4], test=fold.test[4:]), LABELS, DB_uT)
    assert failing(tested) == ["pool indentations"]
    trained = run_audit(replace(fold, pool=fold.train[:3]), LABELS, DB_uT)
    assert failing(trained) == ["pool skins"]
    assert trained[-1].found == "1 of 1 skins for adaptation are not held out: b1_s0"


def with_copy(
    db_uT: np.ndarray, labels: Labels, source_skin: str, target_skin: str, *, sd_uT: float, factor: float
) -> np.ndarray:
    rng = rng_for(1, "copy")
    planted, source = db_uT.copy(), db_uT[labels.skin == source_skin]
    planted[labels.skin == target_skin] = factor * source + rng.normal(0, sd_uT, source.shape)
    return planted


@pytest.mark.parametrize(("sd_uT", "factor"), [(0, 1), (3, 1), (5, 1), (5, 1.05), (3, 0.9), (0, 1.3)])
def test_noisy_or_scaled_copy_of_another_skin_is_detected(sd_uT, factor):
    planted = with_copy(DB_uT, LABELS, "b2_s1", "b0_s1", sd_uT=sd_uT, factor=factor)
    checks = run_audit(held_out(LABELS), LABELS, planted)
    assert failing(checks) == ["copies"]
    assert checks[-1].found.startswith("2 of 2 test captures compared. ")
    assert checks[-1].found.endswith("of capture c_b0_s1 match skin b2_s1")
    assert not passes(checks)


def test_single_copied_capture_of_a_skin_with_several_captures_is_detected():
    copy_rows, copied = (np.flatnonzero(LABELS.skin == skin) for skin in ("b0_s1", "b2_s1"))
    few = copy_rows[: 8 * READINGS_N]
    capture = LABELS.capture.astype("U20")
    capture[few] = "c_b0_s1_more"
    planted = DB_uT.copy()
    planted[few] = DB_uT[copied[: len(few)]] + rng_for(1, "copy").normal(0, 4, (len(few), 15))
    check = run_audit(held_out(LABELS), replace(LABELS, capture=capture), planted)[-1]
    assert check.found.startswith("3 of 3 test captures compared. ")
    assert check.found.endswith("of capture c_b0_s1_more match skin b2_s1")
    assert not check.holds


def test_copy_is_detected_although_only_a_sample_of_presses_is_compared(monkeypatch):
    monkeypatch.setattr(audit, "PAIRS_MAX_N", 12_000)
    monkeypatch.setattr(audit, "SAMPLE_MIN_N", 1)
    planted = with_copy(DB_uT, LABELS, "b2_s1", "b0_s1", sd_uT=5, factor=1)
    check = run_audit(held_out(LABELS), LABELS, planted)[-1]
    # The sample has 12,000 pairs. Each test press is compared with 240 training presses in 2 captures, so 25 test
    # presses are compared.
    assert "of the 25 compared indentations" in check.found
    assert not check.holds
    assert run_audit(held_out(LABELS), LABELS, DB_uT)[-1].holds


def test_fields_with_equal_directions_and_random_magnitudes_are_not_a_copy():
    planted, on_skin = DB_uT.copy(), LABELS.skin == "b0_s1"
    factor = rng_for(4, "factor").uniform(1, 4, (on_skin.sum() // READINGS_N, 1)).repeat(READINGS_N, axis=0)
    planted[on_skin] = factor * DB_uT[LABELS.skin == "b2_s1"]
    assert run_audit(held_out(LABELS), LABELS, planted)[-1].holds


def test_fields_rotated_by_ten_degrees_are_not_a_copy():
    # If a skin is taken off and placed on its board again, its fields rotate by more than 10 degrees. Here, they rotate
    # by 10 degrees, and each rotated field differs from the nearest multiple of the original field by 0.17 |dB|, which
    # is at least 39 uT.
    planted, source = DB_uT.copy(), DB_uT[LABELS.skin == "b2_s1"]
    one, other = source[:, :14:2], source[:, 1:14:2]
    cos, sin = np.cos(np.radians(10)), np.sin(np.radians(10))
    source[:, :14:2], source[:, 1:14:2] = cos * one - sin * other, sin * one + cos * other
    planted[LABELS.skin == "b0_s1"] = source
    assert run_audit(held_out(LABELS), LABELS, planted)[-1].holds


def test_audit_reports_that_skins_with_too_weak_fields_were_not_checked_for_copies():
    checks = run_audit(held_out(LABELS), LABELS, np.where((LABELS.skin == "b0_s1")[:, None], DB_uT / 1000, DB_uT))
    assert failing(checks) == ["copies"]
    assert checks[-1].found == "not checked, because no field change exceeds 153 µT: b0_s1"
    accepted = AuditSettings(settings="for speed", weak_skins=("b0_s1",))
    assert "weak_skins: [b0_s1]" in checks[-1].remedy
    weak_uT = np.where((LABELS.skin == "b0_s1")[:, None], DB_uT / 1000, DB_uT)
    assert passes(audit_fold(held_out(LABELS), LABELS, db_uT=weak_uT, rng=rng_for(0, "sample"), accepted=accepted))


@given(st.integers(0, 1000), st.booleans(), st.sampled_from([*UNSEEN, "single_random"]))
@settings(max_examples=30, deadline=None)
def test_result_of_the_audit_does_not_depend_on_the_order_of_rows(draw, copied, experiment):
    db_uT = with_copy(DB_uT, LABELS, "b2_s1", "b0_s1", sd_uT=3, factor=1) if copied else DB_uT
    order = rng_for(draw, "order").permutation(len(DB_uT))
    new_index = np.argsort(order)  # This array maps the old index of each row to its new index.
    fold = held_out(LABELS, experiment)
    shuffled = Labels(*(label[order] for label in vars(LABELS).values()))
    moved = replace(fold, train=new_index[fold.train], test=new_index[fold.test])
    assert run_audit(moved, shuffled, db_uT[order]) == run_audit(fold, LABELS, db_uT)


def test_nearest_field_is_the_one_with_the_most_similar_direction(monkeypatch):
    # The pairs are processed in several chunks, because a chunk holds only 100 pairs.
    monkeypatch.setattr(audit, "CHUNK_PAIRS_N", 100)
    rng = rng_for(2, "rays")
    rows, others = (rng.normal(0, 100, (n, 6)).astype(np.float32) for n in (13, 40))
    nearest, off_uT = nearest_rays(rows, others)
    for row, i, off in zip(rows.astype(float), nearest, off_uT, strict=True):
        angles = [np.arccos(row @ o / np.linalg.norm(row) / np.linalg.norm(o)) for o in others.astype(float)]
        assert i == np.argmin(angles)
        # The relative tolerance allows for rays in single precision.
        assert off == pytest.approx(np.linalg.norm(row) * np.sin(min(angles)), rel=1e-5)


def test_audit_passes_lab_recordings_but_detects_a_copy_that_is_planted_in_them(shared_data):
    frames = {
        board: pd.concat([pd.read_csv(shared_data / f"lab/{board}_depth{i}.csv").assign(depth_i=i) for i in (1, 3)])
        for board in ("board1", "board2")
    }
    channels = [f"B{axis}{chip}" for chip in range(5) for axis in "xyz"]
    tables = []
    for frame in frames.values():
        rest = frame[frame.phase == "noload"].groupby(["depth_i", "indent"])[channels].mean()
        pressed = frame[frame.phase == "contact"].groupby(["depth_i", "indent"])[channels].mean()
        tables.append((pressed - rest).to_numpy())
    db_uT = np.concatenate(tables).astype(np.float32)
    board = np.repeat(list(frames), [len(table) for table in tables])
    labels = Labels(board, board, np.arange(len(db_uT)), capture=board)
    fold = held_out(labels, board="board1")
    assert failing(run_audit(fold, labels, db_uT)) == []
    planted = with_copy(db_uT, labels, "board2", "board1", sd_uT=5, factor=0.95)
    assert failing(run_audit(fold, labels, planted)) == ["copies"]


@pytest.mark.parametrize("experiment", ["lobo", "by_weather"])
def test_audit_raises_if_a_fold_has_no_test_rows_or_an_unknown_experiment(experiment):
    fold = replace(held_out(LABELS, experiment), test=NONE)
    sentence = {
        "lobo": "one side of the fold has no rows: 720 to train on, 0",
        "by_weather": "must be one of .*; got by_weath",
    }
    with pytest.raises(ParamsError, match=sentence[experiment]):
        run_audit(fold, LABELS, DB_uT)


TARGET = rng_for(3, "target").uniform(0.1, 16, (len(DB_uT), 3)).astype(np.float32)


def scaler_check(arrays, fold: Sides, db_uT: np.ndarray, scaling: str):
    def fit(db_uT, target):
        return FIT[scaling](db_uT, target).arrays()

    return audit_scaler("lobo.paper.b0.seed0", arrays, db_uT=db_uT, target=TARGET, sides=fold, fit=fit)


@pytest.mark.parametrize("scaling", list(FIT))
@given(st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_scaler_fitted_to_the_training_rows_passes(scaling, draw):
    fold = held_out(LABELS)
    train = rng_for(draw, "order").permutation(fold.train)
    assert scaler_check(FIT[scaling](DB_uT[train], TARGET[train]).arrays(), fold, DB_uT, scaling).holds


@pytest.mark.parametrize("scaling", list(FIT))
@pytest.mark.parametrize("seen_n", [1, 20, 360])
def test_scaler_fitted_to_at_least_one_test_row_is_detected(scaling, seen_n):
    fold = held_out(LABELS)
    seen = np.concatenate([fold.train, fold.test[:seen_n]])
    check = scaler_check(FIT[scaling](DB_uT[seen], TARGET[seen]).arrays(), fold, DB_uT, scaling)
    assert not check.holds
    assert check.what == "scaler"


@pytest.mark.parametrize("scaling", list(FIT))
def test_scaler_fitted_to_one_test_row_among_100000_rows_is_detected(scaling):
    copies_n = 100_000 // len(DB_uT)
    db_uT, target = np.tile(DB_uT, (copies_n, 1)), np.tile(TARGET, (copies_n, 1))
    train = np.arange(len(db_uT) - 2)

    def fit(db_uT, target):
        return FIT[scaling](db_uT, target).arrays()

    fold = Sides("lobo", "b0", train, NONE, np.arange(len(train), len(db_uT)))
    checks = [
        audit_scaler("m", fit(db_uT[seen], target[seen]), db_uT=db_uT, target=target, sides=fold, fit=fit)
        for seen in (train, np.arange(len(train) + 1))
    ]
    assert [check.holds for check in checks] == [True, False]


def test_scaler_that_differs_only_by_rounding_passes():
    fold = held_out(LABELS)
    arrays = FIT["standard"](DB_uT[fold.train], TARGET[fold.train]).arrays()
    rounded = {name: np.nextafter(value, np.float32(np.inf)) for name, value in arrays.items()}
    assert scaler_check(rounded, fold, DB_uT, "standard").holds


def test_scaler_fitted_to_all_rows_is_detected_although_it_differs_by_less_than_1e_7():
    fold = held_out(LABELS)

    def fit(db_uT, target):
        return {"shift": np.array([1 + 1e-10 * len(db_uT)])}

    arrays = fit(DB_uT, TARGET)  # The scaler is fitted to all rows, those of the training side and of the test side.
    check = audit_scaler("m", arrays, db_uT=DB_uT, target=TARGET, sides=fold, fit=fit)
    assert check.found == (
        "relative difference 3.6e-08 from a scaler fitted to the training rows, and 0 from a scaler fitted to "
        "training and test rows"
    )
    assert not check.holds


def test_scaler_with_nan_fails_the_check_and_a_missing_array_raises():
    fold = held_out(LABELS)
    arrays = FIT["standard"](DB_uT[fold.train], TARGET[fold.train]).arrays()
    assert not scaler_check(arrays | {"target_shift": np.full(3, np.nan, np.float32)}, fold, DB_uT, "standard").holds
    arrays.pop("input_scale")
    with pytest.raises(SchemaError, match="lobo.paper.b0.seed0: scaler array input_scale .* is missing"):
        scaler_check(arrays, fold, DB_uT, "standard")


RECIPE = {"scaling": "standard", "steps_n": 4000, "rate_max": 0.003}
CHOICE = {
    "scene": "tuning", "source": "simulated", "seed": 777, "boards": ["b0", "b1"], "skins": ["b0_s0", "b1_s0"],
    "chosen": {"train_multi": RECIPE, "train_single": RECIPE | {"steps_n": 500}}, "minutes": 12.5,
}  # fmt: skip


def choice_checks(choice=CHOICE, recipes=None, source="simulated", seed=2021):
    recipes = {"train_multi": dict(RECIPE)} if recipes is None else recipes
    names = {"test_boards": ["b0", "b2"], "test_skins": ["b0_s0", "b0_s1", "b2_s0"], "physics": "abc"}
    return audit_choice(choice, recipes, source=source, seed=seed, **names)


def test_settings_that_were_chosen_in_a_run_with_another_seed_pass():
    assert failing(choice_checks()) == []
    assert failing(choice_checks(source="recorded")) == []


@pytest.mark.parametrize(("source", "seed"), [("simulated", 777), ("recorded", 5)])
def test_settings_chosen_on_test_boards_are_detected(source, seed):
    checks = choice_checks(CHOICE | {"source": source}, source=source, seed=seed)
    assert failing(checks) == ["settings: boards", "settings: skins"]
    assert checks[1].found == "1 of 3 tested skins were used to choose the settings: b0_s0"
    assert not passes(checks)


@pytest.mark.parametrize(
    ("recipe", "found"),
    [
        (RECIPE | {"rate_max": 0.001}, "rate_max 0.001 (study: 0.003)"),
        (RECIPE | {"steps_n": 500}, "steps_n 500 (study: 4000)"),
        ({"scaling": "standard", "rate_max": 0.003, "tau": 1}, "steps_n absent (study: 4000), tau 1 (study: absent)"),
    ],
)  # fmt: skip
def test_recipe_that_differs_from_the_chosen_settings_is_reported(recipe, found):
    checks = choice_checks(recipes={"train_multi": recipe})
    assert passes(checks)
    assert checks[-1].found == f"not chosen by the study: {found}"


def test_missing_choice_is_reported_and_a_choice_without_skins_raises():
    checks = choice_checks(recipes={"adapt": RECIPE})
    assert passes(checks)
    assert checks[-1].found == "not chosen by the study: the study chose no recipe for this stage"
    with pytest.raises(ParamsError, match="skins is missing"):
        choice_checks({key: value for key, value in CHOICE.items() if key != "skins"})
