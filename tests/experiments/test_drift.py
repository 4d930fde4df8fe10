"""Tests of experiment drift: windows and no-load policies against naive loops, statistics against SciPy, and a run."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML
from scipy.stats import linregress, sem

from pipeline.experiments import drift as experiment
from pipeline.experiments.drift import Drift, cut, figures, force_left_pct, run, summarise, take
from pipeline.scores import make_table
from pipeline.settings import Settings, read_shared_files
from reskin.data.grid import points_mm
from reskin.data.rows import Selection
from reskin.errors import ParamsError
from reskin.metrics import score
from reskin.schema import Readings
from reskin.seeds import rng_for
from tests.data.tables import readings

ROOT = Path(__file__).resolve().parents[2]
# A capture has 390 contacts. With each contact, the no-load field of every channel drifts by DRIFT_uT.
DEPTHS_MM, PASSES_N, DRIFT_uT = (0.6, 1.2), 3, 0.3
WEAK_N = 0.01  # below the least force that is selected


def capture(name: str = "s0-wear", skin: str = "s0", board: str = "b0", pokes_n: int | None = None) -> Readings:
    """Return a capture with two readings per contact, whose field change is linear in place and force."""
    places = np.tile(points_mm(), (len(DEPTHS_MM) * PASSES_N, 1))[:pokes_n]
    depth_mm = np.tile(np.repeat(DEPTHS_MM, 65), PASSES_N)[:pokes_n]
    n = len(places)
    target = np.repeat(np.column_stack([places, 2 * depth_mm]), 2, axis=0)
    poke_i = np.repeat(np.arange(n, dtype=np.int32), 2)
    noload_uT = 1000 + DRIFT_uT * poke_i[:, None] * np.ones(15)
    x_mm, y_mm, Fz_N = target.T.astype(np.float32)
    return replace(
        readings(name, board, skin, f=2 * n), source="simulated", indentation=poke_i, n_contacts=poke_i,
        pass_i=poke_i // 130, reading_i=np.tile(np.arange(2, dtype=np.int32), n), x_mm=x_mm, y_mm=y_mm, Fz_N=Fz_N,
        depth_mm=np.repeat(depth_mm, 2).astype(np.float32), noload_uT=noload_uT.astype(np.float32), t_s=0.5 * poke_i,
        b_uT=(noload_uT + target @ rng_for(0, "mix").normal(0, 10, (3, 15))).astype(np.float32),
        temperature_degC=np.full((2 * n, 5), 25, np.float32),
    )  # fmt: skip


SCENE = YAML(typ="safe").load((ROOT / "pipeline/scenes/ci.yaml").read_text())
SCENE["drift"]["training"]["steps_n"] = 300
CI = Settings(
    "ci", "ci.yaml", SCENE, read_shared_files(ROOT)
)  # windows of 30 presses after every 100 presses; policy `regular` has 20 presses
SECTION, SELECTION = CI.section(Drift, "drift"), Selection(force_min_N=0.1)


@pytest.fixture
def scene(tmp_path, monkeypatch) -> Settings:
    """Return the settings of scene ci, with a cache in the folder of the test."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RESKIN_EXECUTOR", "here")
    return CI


# --- Windows and no-load policies ---

runs_n = st.lists(st.integers(1, 3), min_size=6, max_size=30)  # numbers of readings of the presses


@given(runs_n, st.integers(1, 4), st.integers(1, 4), st.integers(0, 3), st.integers(1, 5))
@settings(deadline=None)
def test_windows_and_no_load_fields_equal_those_of_a_loop(runs_n, train_n, test_n, more_n, regular_n):
    every_n = max(train_n, test_n) + more_n
    presses_n, f = len(runs_n), sum(runs_n)
    press = np.repeat(np.arange(presses_n, dtype=np.int32), runs_n)
    noload_uT = np.repeat(press[:, None], 3, axis=1).astype(np.float32)
    force_N = np.where(np.arange(f) % 7 == 3, WEAK_N, 1).astype(np.float32)
    one = readings(f=f, indentation=5 + 3 * press, n_contacts=press, noload_uT=noload_uT, Fz_N=force_N)
    sizes = {"train_n": train_n, "test_n": test_n, "every_n": every_n, "regular_n": regular_n}
    drift = SECTION.model_copy(update=sizes)
    if presses_n < every_n + test_n:
        with pytest.raises(ParamsError, match="the shortest capture must be at least drift.every_n"):
            cut([one], drift, SELECTION)
        return
    series = cut([one], drift, SELECTION)
    rows = np.concatenate([window.row for windows in series for window in windows])
    assert rows.tolist() == list(range(len(rows)))
    for policy, windows in zip(drift.policies, series, strict=True):
        starts = [0, *(n for n in range(every_n, presses_n, every_n) if n + test_n <= presses_n)]
        lengths = [train_n] + [test_n] * (len(starts) - 1)
        used = []
        for start, n, window in zip(starts, lengths, windows, strict=True):
            inside = [i for i in range(f) if start <= press[i] < start + n]
            baselines = [{"initial": 0, "regular": press[i] // regular_n * regular_n, "each": press[i]}[policy]
                         for i in inside]  # fmt: skip
            assert window.readings.noload_uT[:, 0].tolist() == baselines
            assert window.readings.b_uT.tolist() == one.b_uT[inside].tolist()
            assert len(window.row) == sum(force_N[i] > WEAK_N for i in inside)
            assert window.contacts_n == start
            off_uT = [press[i] - baseline for i, baseline in zip(inside, baselines, strict=True)]
            assert window.noload_off_uT == pytest.approx(np.sqrt(np.mean(np.square(off_uT, dtype=float))))
            used += window.readings.indentation.tolist()
        assert len(set(used)) == sum(lengths)  # no press is in two windows


def make_touches(rows_n: int, touches_n: int = 200, walk_uT: float = 1.0) -> Readings:
    """Return readings with a field that differs between touches, and a no-load field that drifts at random.

    A touch has `rows_n` readings.
    """
    rng = rng_for(0, "touched")
    rest_uT = np.cumsum(walk_uT * rng.standard_normal((touches_n, 15)), axis=0)
    touch_uT = 60 * rng.standard_normal((touches_n, 15))
    indentation = np.repeat(np.arange(touches_n, dtype=np.int32), rows_n)
    noload_uT = rest_uT[indentation].astype(np.float32)
    b_uT = noload_uT + touch_uT[indentation].astype(np.float32)
    return readings(f=len(b_uT), indentation=indentation, b_uT=b_uT, noload_uT=noload_uT)


@pytest.mark.parametrize("rows_n", [1, 4, 50])
def test_no_load_field_that_is_judged_from_readings_follows_the_drift(rows_n):
    touches = make_touches(rows_n)
    within_uT = experiment.alike_within_uT(take(touches, touches.indentation < 20))
    assert within_uT == pytest.approx(2.0, rel=0.2)
    off_uT = experiment.free_field(touches, within_uT) - touches.noload_uT
    # The result is usually less than one touch old, and occasionally one or two touches.
    assert np.sqrt((off_uT**2).mean()) < 0.7
    assert np.sqrt(((touches.noload_uT[0] - touches.noload_uT) ** 2).mean()) > 5


def test_no_load_reading_is_not_replaced_during_a_long_slide():
    touches = make_touches(1, walk_uT=0.1)
    sent = [field for pair in zip(touches.noload_uT, touches.b_uT, strict=True) for field in pair]
    slid = [*sent[:100], *(sent[101] + 20 * i for i in range(60)), *sent[100:]]
    found = list(experiment.follow_free(slid, within_uT=0.5))
    np.testing.assert_array_equal(found[159], sent[98])
    np.testing.assert_array_equal(found[-1], sent[-2])


def test_no_load_field_that_is_judged_from_readings_does_not_depend_on_later_readings():
    touches = make_touches(2)
    whole, part = (experiment.free_field(take(touches, np.arange(400) < n), 2.0) for n in (400, 123))
    np.testing.assert_array_equal(whole[:123], part)


@pytest.mark.parametrize(
    ("captures", "sentence"),
    [
        ([capture("c0"), capture("c1")], "of the same skin, and their order in time is unknown: c0, c1"),
        ([capture(pokes_n=129)], "must be at least drift.every_n . drift.test_n = 130 units long; got 129"),
    ],
)
def test_captures_of_unknown_order_or_too_few_contacts_are_refused(captures, sentence):
    with pytest.raises(ParamsError, match=sentence):
        cut(captures, SECTION, SELECTION)


# --- Scores ---


def answer(data, job):
    """Predict the true target with an error that depends on the network."""
    errors = rng_for(job.seed_i, job.fold).normal(0.1 * job.seed_i, 0.7, (len(job.test), 3))
    predicted = (data.rows.target[job.test] + errors).astype(np.float32)
    return SimpleNamespace(predicted=predicted, collapsed=False, collapsed_before_n=0)


@pytest.fixture
def results(scene, monkeypatch):
    """Return the results of two skins with networks that are not trained, and the data that they received."""
    given = []

    def train(data, jobs, stage):
        given.append((data, jobs))
        return [answer(data, job) for job in jobs]

    monkeypatch.setattr(experiment, "train_jobs", train)
    captures = [capture("s0-wear"), capture("s1-wear", "s1", "b1")]
    return run(scene, SECTION, captures), *given[0]


def test_scores_equal_those_of_a_loop_over_networks_and_windows(results):
    found, data, jobs = results
    expected = []
    for job in jobs:
        predicted, skin, policy = answer(data, job).predicted, *job.fold.split("-")
        for window_i, start in enumerate((100, 200, 300)):
            part = slice(60 * window_i, 60 * window_i + 60)  # 30 presses with two readings
            true = data.rows.target[job.test][part]
            press = np.repeat(np.arange(start, start + 30), 2)
            age_n = {"initial": press, "regular": press % 20, "each": 0 * press}[policy]
            bias_N = float(np.mean(predicted[part, 2].astype(float) - true[:, 2]))
            expected.append(
                {"method": policy, "skin": skin, "board": f"b{skin[1]}", "recipe": "paper", "seed": job.seed_i,
                 "contacts_n": start, "window_i": window_i, "rows_n": 60, "bias_f_N": bias_N, "experiment": "drift",
                 "noload_off_uT": DRIFT_uT * np.sqrt(np.mean(age_n**2.0))} | score(true, predicted[part])
            )  # fmt: skip
    # The relative tolerance is the rounding of fields of 1000 uT to single precision.
    pd.testing.assert_frame_equal(found.scores, make_table(expected), check_like=True, rtol=1e-3)
    assert len(found.scores) == 2 * 3 * 2 * 3


def test_late_bias_and_its_standard_error_over_indentations_equal_scipy(results):
    found, data, jobs = results
    late = summarise(found.scores, found.measured)["late"]
    forces: dict[int, list] = {0: [], 1: []}
    for job in (job for job in jobs if job.fold.endswith("regular")):
        pair = np.stack([data.rows.target[job.test, 2], answer(data, job).predicted[:, 2]])[:, -60:].astype(float)
        forces[job.seed_i].append(pair.reshape(2, 30, 2).mean(axis=2))  # two readings of each press
    assert (late["policy"], late["contacts_n"], late["indentations_n"]) == ("regular", 300, 60)
    each = [np.concatenate(of_seed, axis=1) for of_seed in forces.values()]
    for name, value in (
        ("bias_N", lambda true, predicted: np.mean(predicted - true)),
        ("bias_pct", lambda true, predicted: 100 * np.mean(predicted - true) / np.mean(true)),
        ("bias_se_N", lambda true, predicted: sem(predicted - true)),
        ("slope", lambda true, predicted: linregress(true, predicted).slope),
    ):
        assert late[name] == pytest.approx(np.mean([value(*pair) for pair in each]))
    networks = [forces[seed_i][skin_i] for skin_i in (0, 1) for seed_i in (0, 1)]
    assert late["network_bias_N"] == pytest.approx([np.mean(pair[1] - pair[0]) for pair in networks])
    assert late["network_board"] == ["b0", "b0", "b1", "b1"]
    assert late["force_left_pct"] == pytest.approx(100)  # the skin does not soften


def test_recording_without_forces_has_scores_of_places_only(scene, monkeypatch):
    monkeypatch.setattr(experiment, "train_jobs", lambda data, jobs, stage: [answer(data, job) for job in jobs])
    unknown = np.full(780, np.nan, np.float32)
    found = run(scene, SECTION, [replace(capture(), Fz_N=unknown, depth_mm=unknown)])
    content = summarise(found.scores, found.measured)
    assert set(content["each"][0]["spread"]) == {"accuracy_pct", "mse_xy_mm2"}
    assert "late" not in content
    assert set(content["claims"]["higher"]) == {"mse_xy_mm2"}
    assert list(figures(content, {"late": found.points}, "recorded")) == ["drift.svg"]


# --- Claims ---


def errors(**lines: tuple[float, float]) -> pd.DataFrame:
    """Return scores on four boards; a line has the error in the first window and its growth in 10,000 contacts."""
    return pd.DataFrame(
        {"method": policy, "board": f"b{i}", "skin": f"b{i}_s0", "seed": 0, "window_i": w, "contacts_n": 5000 * (w + 1),
         "accuracy_pct": 95 + i, "mse_xy_mm2": start * (1 + 0.01 * i) + growth / 2 * w * (1 + 0.01 * i)}
        for policy, (start, growth) in lines.items() for i in range(4) for w in range(4)
    )  # fmt: skip


# --- Measured on the captures ---


def readings_at(points_mm: list, force_N: list) -> Readings:
    """Return readings at these places x, y and depths in mm."""
    x_mm, y_mm, depth_mm = np.array(points_mm, np.float32).T
    return readings(f=len(points_mm), x_mm=x_mm, y_mm=y_mm, depth_mm=depth_mm, Fz_N=np.array(force_N, np.float32))


@given(st.floats(0.5, 1.0), st.permutations(range(4)))
def test_remaining_force_compares_readings_at_equal_places_and_depths(left, order):
    points_mm, force_N = [[0, 0, 1], [2, 0, 1], [0, 0, 2], [4, 4, 1]], [1.0, 2.0, 4.0, np.nan]
    early = readings_at([points_mm[i] for i in order], [force_N[i] for i in order])
    late_mm = [points_mm[i] for i in (1, 0, 0, 3)] + [[6, 6, 1]]
    # The tolerance is rounding, because forces are in single precision.
    late = readings_at(late_mm, [2 * left, left, left, 9.0, 9.0])
    assert force_left_pct(early, late) == pytest.approx(100 * left, rel=1e-6)


# --- Run ---
