"""A scene's experts are taught the skin as designed; what is killed goes on; a pool is one poke at each place."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from pipeline.experiments import population
from pipeline.experiments.population import _weight, cases, over_boards
from pipeline.training.universal import Frame
from reskin.data.rows import Rows
from reskin.data.splits import Fold
from reskin.errors import SchemaError
from reskin.seeds import rng_for
from reskin.simulation.settings import BoardKind
from reskin.universal.population import Population
from tests.universal.skins import DESIGN, made_population

KIND = BoardKind(
    letter="b", boards_n=1, skins_per_board_n=1, skin_mm=(20.0, 20.0), quadrature={"cell_mm": 0.8, "layers_n": 5},
    design={"chips_xy_mm": ((0.0, 0.0),), "chips_turn_deg": (0.0,), "gap_mm": 1.1},
)  # fmt: skip
STAT = {"mean": 90.0, "sd": 2.0, "n": 6}
METRICS = ("accuracy_pct", "mse_xy_mm2", "mse_f_N2", "mse_f_weight_N2", "mse_f_factor_N2", "coverage_pct")


def test_the_designed_skin_is_the_law_that_its_scene_simulates():
    lesson = population.lesson_of(DESIGN, KIND, (0.2, 1.2), seed=0)
    law = lesson.syllabus.centre
    assert (law.gap_mm, law.amplitude, law.away_um_mm) == (1.1, 1.0, DESIGN.hold.away_um_mm)
    assert (law.modulus_MPa, law.grip_N_mm) == (pytest.approx(1e-3 * DESIGN.modulus_kPa), pytest.approx(8.75))
    assert lesson.forces_N[0] < 0.05 < 5 < lesson.forces_N[1]  # of 0.2 and 1.2 mm
    with pytest.raises(ValueError, match="hold must be"):
        population.lesson_of(DESIGN.model_copy(update={"hold": None}), KIND, (0.2,), seed=0)


def test_a_killed_run_draws_no_part_again(monkeypatch):
    drawn, shelf = [], {}
    whole = made_population(7, rng_for(0, "skins"))

    def skins(_: str, which: slice) -> Population:
        drawn.append(which)
        return Population(*(getattr(whole, name)[which] for name in Population.__annotations__))

    syllabus = SimpleNamespace(spreads={}, centre=None)
    lesson = SimpleNamespace(skins=skins, syllabus=syllabus, forces_N=(1.0, 2.0), seed=0)
    monkeypatch.setattr(population, "PART_N", 3)
    monkeypatch.setattr(population.io, "load", lambda _, name: shelf.get(name))
    monkeypatch.setattr(population.io, "save", lambda _, name, part: shelf.update({name: part}))
    population.draw(lesson, 6, lambda line: None)
    drawn.clear()
    found = population.draw(lesson, 7, lambda line: None)
    assert [which for which in drawn if which != slice(1)] == [slice(6, 7)]  # the first skin is a part of the names
    for name in Population.__annotations__:
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))


def test_a_skins_pool_is_one_poke_at_each_place_and_none_of_it_is_tested():
    places_n, depths_n, readings_n = 4, 3, 2
    poke = np.repeat(np.arange(2 * places_n * depths_n), readings_n)  # two passes
    target = np.stack([poke % places_n, poke % places_n, 1 + poke], axis=1).astype(np.float32)
    names = (np.full(len(poke), name) for name in ("c", "b0", "b0_s0"))
    pass_i = (poke // (places_n * depths_n)).astype(np.int32)
    rows = Rows(*names, np.tile(poke[:, None], (1, 3)).astype(np.float32), target, pass_i, poke, {})
    fold = Fold("lobo", "b0", np.zeros(0, np.int64), np.flatnonzero(pass_i == 1), np.flatnonzero(pass_i == 0))
    data = SimpleNamespace(rows=rows, settings=SimpleNamespace(seed=0))
    (case,) = cases(data, fold, Frame(np.eye(3)[None], (8.0, 8.0), mirrored=False), {"b0_s0": np.zeros(3)})
    assert sorted((case.pool.place_mm[:, 0] + 8).tolist()) == [0, 1, 2, 3]
    np.testing.assert_array_equal(case.pool.db_uT[:, 0] + 1, case.pool.force_N)  # the readings of that poke
    assert not set(case.pool.force_N) & set(case.true[:, 2])
    assert len(case.true) == len(fold.test)


def test_the_weight_is_the_press_of_the_middle_that_comes_next_to_its_force():
    force_N = np.repeat([1.0, 4.0, 8.0, 1.0, 4.5], 2).astype(np.float32)  # two readings of each of five presses
    x_mm = np.repeat([8.0, 8.0, 8.0, 10.0, 10.0], 2).astype(np.float32)
    target, poke = np.stack([x_mm, np.full(10, 8.0, np.float32), force_N], axis=1), np.repeat(np.arange(5), 2)
    names = (np.full(10, name) for name in ("c", "b0", "b0_s0"))
    db_uT = np.stack([force_N, x_mm, force_N], axis=1)
    data = SimpleNamespace(rows=Rows(*names, db_uT, target, np.zeros(10, np.int32), poke, {}))
    weight = _weight(data, np.arange(10), Frame(np.eye(3)[None], (8.0, 8.0), mirrored=False), rng_for(0, "weight"))
    np.testing.assert_array_equal(weight.db_uT, [4, 8, 4])
    assert 3.5 < weight.force_N < 4.5  # of 4 N, known to 2 %
    assert weight.force_N != 4.0


def weight_of_middle(force_N: list[float]):
    """Take the weight from presses of the middle, one reading each."""
    force = np.array(force_N, np.float32)
    names = (np.full(len(force), name) for name in ("c", "b0", "b0_s0"))
    target, db_uT = np.full((len(force), 3), 8, np.float32), np.repeat(force[:, None], 3, axis=1)
    target[:, 2] = force
    rows = Rows(*names, db_uT, target, np.zeros(len(force), np.int32), np.arange(len(force)), {})
    frame, rng = Frame(np.eye(3)[None], (8.0, 8.0), mirrored=False), rng_for(0, "weight")
    return _weight(SimpleNamespace(rows=rows), np.arange(len(force)), frame, rng)


@pytest.mark.parametrize("nothing_N", [0.0, -0.01, -5.0, np.nan])
def test_a_press_without_a_force_above_nothing_is_no_known_weight(nothing_N):
    assert weight_of_middle([nothing_N, 4.0, 1.0]).db_uT[0] == 4
    with pytest.raises(
        SchemaError, match="skin b0_s0: the known weight must be of a press with a force above 0 N; got 2"
    ):
        weight_of_middle([nothing_N, nothing_N])


def test_tables_and_figure_show_every_way():
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
    assert [*tables["population_fresh"]][-4:] == [*held, "n"]  # the map, both, the network
    before = {name: value for name, value in numbers.items() if name != "fresh"}
    assert set(tables) - set(population.tables(before, "simulated")) == {"population_fresh"}
    assert set(tables["population_scaling"]["skins taught"]) == {"30", "3000"}
    assert all("universal" in method for method in tables["population"]["method"])
    assert "skins that the network was taught" in population.figures(numbers, {}, "simulated")["population_scaling.svg"]


def test_boards_are_the_unit():
    told = {"way": "map", "pokes_n": 0, "labels_n": 0}
    rows = pd.DataFrame(told | {"board": ["b0", "b0", "b1"], "accuracy_pct": [1.0, 3.0, 6.0]})
    (found,) = over_boards(rows, "way", "pokes_n", "labels_n")
    assert (found["accuracy_pct"]["mean"], found["accuracy_pct"]["n"]) == (4.0, 2)
