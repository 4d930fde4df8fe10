"""Tests of experiment population, which trains and tests the universal model on simulated skins."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from pipeline.experiments import population
from pipeline.experiments.population import (
    WAYS,
    WEIGHT_N,
    WEIGHT_SD,
    CalibrationSize,
    DesignedSkins,
    calibrate_ways,
    designed_skins,
    estimate,
    find_weight,
    over_boards,
    scene_skins,
    score_skin,
    simulated_skins,
)
from pipeline.training.universal import BOARD_POWERS
from pipeline.training.universal_variants import Frame
from reskin.data.rows import Rows
from reskin.data.splits import Fold
from reskin.errors import SchemaError
from reskin.seeds import rng_for
from reskin.simulation.settings import BoardKind
from reskin.universal.map import Estimate, new_map
from reskin.universal.model import PriorModel
from reskin.universal.network import draw_weights
from reskin.universal.population import Population
from tests.universal.skins import DESIGN, make_population, make_tables

KIND = BoardKind(
    letter="b", boards_n=1, skins_per_board_n=1, skin_mm=(20.0, 20.0), quadrature={"cell_mm": 0.8, "layers_n": 5},
    design={"chips_xy_mm": ((0.0, 0.0),), "chips_turn_deg": (0.0,), "gap_mm": 1.1},
)  # fmt: skip
STAT = {"mean": 90.0, "sd": 2.0, "n": 6}
METRICS = ("accuracy_pct", "mse_xy_mm2", "mse_f_N2", "mse_f_weight_N2", "mse_f_factor_N2", "coverage_pct")


@pytest.fixture(scope="module")
def model() -> PriorModel:
    return PriorModel(new_map(make_tables()), [draw_weights(15, rng_for(0, "population"))])


@pytest.fixture(scope="module")
def skins():
    return simulated_skins(make_population(3, rng_for(1, "population"), WEIGHT_N), rng_for(2, "population"))


def test_mean_of_the_prior_of_skins_is_the_simulated_skin():
    designed = designed_skins(DESIGN, KIND, (0.2, 1.2), seed=0)
    law = designed.prior.centre
    assert (law.gap_mm, law.amplitude, law.away_um_mm) == (1.1, 1.0, DESIGN.hold.away_um_mm)
    assert (law.modulus_MPa, law.grip_N_mm) == (pytest.approx(1e-3 * DESIGN.modulus_kPa), pytest.approx(8.75))
    # The range of forces covers those of presses with depths of 0.2 and 1.2 mm.
    assert designed.forces_N[0] < 0.05 < 5 < designed.forces_N[1]
    with pytest.raises(ValueError, match="hold of section skin is null"):
        designed_skins(DESIGN.model_copy(update={"hold": None}), KIND, (0.2,), seed=0)


def test_resumed_run_draws_only_the_parts_that_are_missing(monkeypatch):
    drawn, shelf = [], {}
    all_skins = make_population(7, rng_for(0, "skins"))

    def draw(_: DesignedSkins, name: str, which: slice) -> Population:
        drawn.append(which)
        return Population(*(getattr(all_skins, name)[which] for name in Population.__annotations__))

    monkeypatch.setattr(DesignedSkins, "draw", draw)
    monkeypatch.setattr(population, "PART_N", 3)
    monkeypatch.setattr(population.io, "load_cached_array", lambda _, name: shelf.get(name))
    monkeypatch.setattr(population.io, "save_cached_array", lambda _, name, part: shelf.update({name: part}))
    designed = designed_skins(DESIGN, KIND, (0.2, 1.2), seed=0)
    population.draw(designed, 6, lambda line: None)
    drawn.clear()
    found = population.draw(designed, 7, lambda line: None)
    # The first skin is always drawn, because it is part of the cache key.
    assert [which for which in drawn if which != slice(1)] == [slice(6, 7)]
    for name in Population.__annotations__:
        np.testing.assert_array_equal(getattr(found, name), getattr(all_skins, name))


def test_calibration_pool_has_one_press_per_place_and_no_test_press():
    places_n, depths_n, readings_n = 4, 3, 2
    # There are two passes. `press` is the number of the press to which each row belongs.
    press = np.repeat(np.arange(2 * places_n * depths_n), readings_n)
    target = np.stack([press % places_n, press % places_n, 1 + press], axis=1).astype(np.float32)
    names = (np.full(len(press), name) for name in ("c", "b0", "b0_s0"))
    pass_i = (press // (places_n * depths_n)).astype(np.int32)
    rows = Rows(*names, np.tile(press[:, None], (1, 3)).astype(np.float32), target, pass_i, press, {})
    fold = Fold("lobo", "b0", np.zeros(0, np.int64), np.flatnonzero(pass_i == 1), np.flatnonzero(pass_i == 0))
    data = SimpleNamespace(rows=rows, settings=SimpleNamespace(seed=0))
    (skin,) = scene_skins(data, fold, Frame(np.eye(3)[None], (8.0, 8.0), mirrored=False), {"b0_s0": np.zeros(3)})
    assert sorted((skin.pool.place_mm[:, 0] + 8).tolist()) == [0, 1, 2, 3]
    # Field change and force belong to the same press.
    np.testing.assert_array_equal(skin.pool.db_uT[:, 0] + 1, skin.pool.force_N)
    assert not set(skin.pool.force_N) & set(skin.true[:, 2])
    assert len(skin.true) == len(fold.test)


def test_known_weight_is_the_press_near_the_middle_with_the_nearest_force():
    # There are five presses with two readings each. These are the forces of the readings.
    force_N = np.repeat([1.0, 4.0, 8.0, 1.0, 4.5], 2).astype(np.float32)
    x_mm = np.repeat([8.0, 8.0, 8.0, 10.0, 10.0], 2).astype(np.float32)
    target, press = np.stack([x_mm, np.full(10, 8.0, np.float32), force_N], axis=1), np.repeat(np.arange(5), 2)
    names = (np.full(10, name) for name in ("c", "b0", "b0_s0"))
    db_uT = np.stack([force_N, x_mm, force_N], axis=1)
    data = SimpleNamespace(rows=Rows(*names, db_uT, target, np.zeros(10, np.int32), press, {}))
    weight = find_weight(data, np.arange(10), Frame(np.eye(3)[None], (8.0, 8.0), mirrored=False), rng_for(0, "weight"))
    np.testing.assert_array_equal(weight.db_uT, [4, 8, 4])
    assert 3.5 < weight.force_N < 4.5  # The weight of 4 N is known to 2 %, so a random error is added.
    assert weight.force_N != 4.0


def weight_of_central_presses(force_N: list[float]):
    """Return the known weight that is chosen from presses in the middle.

    The presses have these forces and one reading each.
    """
    force = np.array(force_N, np.float32)
    names = (np.full(len(force), name) for name in ("c", "b0", "b0_s0"))
    target, db_uT = np.full((len(force), 3), 8, np.float32), np.repeat(force[:, None], 3, axis=1)
    target[:, 2] = force
    rows = Rows(*names, db_uT, target, np.zeros(len(force), np.int32), np.arange(len(force)), {})
    frame, rng = Frame(np.eye(3)[None], (8.0, 8.0), mirrored=False), rng_for(0, "weight")
    return find_weight(SimpleNamespace(rows=rows), np.arange(len(force)), frame, rng)


@pytest.mark.parametrize("zero_N", [0.0, -0.01, -5.0, np.nan])
def test_press_without_a_positive_force_is_not_used_as_known_weight(zero_N):
    assert weight_of_central_presses([zero_N, 4.0, 1.0]).db_uT[0] == 4
    with pytest.raises(SchemaError, match="skin b0_s0: none of the 2 presses near the middle has a force above 0 N"):
        weight_of_central_presses([zero_N, zero_N])


def test_tables_and_figure_list_every_method():
    rows = [{"way": way, "pokes_n": 65, "labels_n": 0, **dict.fromkeys(METRICS, STAT)} for way in population.NAMES]
    numbers = {
        "told": rows, "scaling": [row | {"skins_n": n} for row in rows for n in (30, 3000)], "steps_n": 5,
        "fresh": [row | {"labels_n": n} for n in (0, 5) for row in rows],
        "pool_n": 65, "skins_asked_n": 12, "rows_asked_n": 24000, "coverage_further_pct": {"map": 90.0},
        "weight_N": 5.0, "weight_sd": 0.02,
    }  # fmt: skip
    tables = population.tables(numbers, "simulated")
    assert len(tables["population"]) == 3
    assert [*tables["population_fresh"]["labels"]] == ["0", "5"]
    held = [column for column in tables["population_fresh"] if "90 %" in column]
    # There is one column of intervals for each method: map, map with network, and network.
    assert [*tables["population_fresh"]][-4:] == [*held, "n"]
    earlier = {name: value for name, value in numbers.items() if name != "fresh"}
    assert set(tables) - set(population.tables(earlier, "simulated")) == {"population_fresh"}
    assert set(tables["population_scaling"]["training skins"]) == {"30", "3000"}
    assert all("universal" in method for method in tables["population"]["method"])
    assert (
        "simulated skins that the network was trained on"
        in population.figures(numbers, {}, "simulated")["population_scaling.svg"]
    )
    one = numbers | {"scaling": [row for row in numbers["scaling"] if row["skins_n"] == 3000]}
    # A single number of skins shows no dependence, so there is no figure.
    assert population.figures(one, {}, "simulated") == {}


def test_means_are_taken_over_skins_first_and_then_over_boards():
    keys = {"way": "map", "pokes_n": 0, "labels_n": 0}
    rows = pd.DataFrame(keys | {"board": ["b0", "b0", "b1"], "accuracy_pct": [1.0, 3.0, 6.0]})
    (found,) = over_boards(rows, "way", "pokes_n", "labels_n")
    assert (found["accuracy_pct"]["mean"], found["accuracy_pct"]["n"]) == (4.0, 2)


def test_presses_for_calibration_and_for_tests_are_different(skins):
    for skin in skins:
        pooled, tested = ({tuple(row) for row in part} for part in (skin.pool.db_uT, skin.test_uT))
        assert not pooled & tested
        # The pool has one press per place.
        assert len(np.unique(skin.pool.place_mm.round(0), axis=0)) == len(skin.pool)


def test_force_errors_of_the_map_fall_with_labels_and_are_below_an_untrained_network(model, skins):
    sizes = CalibrationSize(0, 0), CalibrationSize(65, 40)
    calibration = calibrate_ways(model, skins, sizes[0])
    rows = [row for size in sizes for skin in skins for row in score_skin(model, skin, size, calibration)]
    off_N2 = {
        (way, n): np.mean([row["mse_f_N2"] for row in rows if (row["way"], row["labels_n"]) == (way, n)])
        for way in WAYS
        for n in (0, 40)
    }
    assert off_N2["map", 40] < off_N2["map", 0] < off_N2["network", 0]
    for row in rows:
        # The best possible factor is fitted to the test presses themselves, so no other factor has a smaller error.
        assert row["mse_f_factor_N2"] <= min(row["mse_f_N2"], row["mse_f_weight_N2"]) + 1e-9


def test_known_weight_is_appended_to_the_estimates_without_changing_the_others(model, skins):
    skin, once = skins[0], dict.fromkeys(WAYS, 1.0)
    (found,) = estimate(model, skin, CalibrationSize(16, 0), [once])
    assert all(len(one.force_N) == len(skin.true) + 1 for one in found.values())
    heavier = replace(skin, weight=replace(skin.weight, db_uT=2 * skin.weight.db_uT))
    (changed,) = estimate(model, heavier, CalibrationSize(16, 0), [once])
    for way in WAYS:
        np.testing.assert_array_equal(changed[way].force_N[:-1], found[way].force_N[:-1])
        assert changed[way].force_N[-1] != found[way].force_N[-1]
    off = [np.log(one.weight.force_N / WEIGHT_N) for one in skins]
    assert 0 < np.abs(off).max() < 5 * WEIGHT_SD


def test_weight_share_is_computed_at_the_calibrated_likelihood_power(skins, monkeypatch):
    # The estimates of this test are made up: force errors grow with the likelihood power, and only one power has
    # intervals that cover 90 %.
    def fake_estimate(model, skin, size, powers):
        found = []
        for one in powers:
            power = one["map"]
            reach = 10.0 if power == BOARD_POWERS[1] else 0.0
            true_mm = np.vstack([skin.true[:, :2], [[0, 0]]])
            force_N = np.append(skin.true[:, 2] * np.exp(power), skin.weight.force_N * np.exp(0.1))
            fake = Estimate(true_mm + 0.1, np.full_like(true_mm, reach), force_N, *np.full((2, len(force_N)), np.nan))
            found.append(dict.fromkeys(WAYS, fake))
        return found

    monkeypatch.setattr(population, "estimate", fake_estimate)
    calibration = calibrate_ways(None, skins, CalibrationSize(0, 0))
    assert set(calibration.power.values()) == {BOARD_POWERS[1]}
    assert calibration.weight_share == pytest.approx(dict.fromkeys(WAYS, BOARD_POWERS[1] / 0.1))
