"""Tests of experiment compare, which fits the simulation to recordings.

The fits must recover the parameters of skins and the orientations of axes, from simulated and from real recordings.
"""

import itertools
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.experiments import compare
from pipeline.experiments.compare import (
    Compare,
    agreement,
    check_frames,
    chip_rotations,
    compare_boards,
    estimate_memory,
    to_board_axes,
)
from reskin.config import parse, read_yaml
from reskin.errors import ParamsError, SchemaError
from reskin.physics import layer
from reskin.physics.skin import SkinDesign
from reskin.recordings.readers import lab
from reskin.seeds import rng_for
from reskin.simulation.defaults import nominal
from reskin.universal import law
from reskin.universal import law as fit
from reskin.universal.presses import RecordedPresses, cosines, explained, growth, memory, pool
from tests.benchmarks import FULL
from tests.data.tables import readings
from tests.recordings.test_recordings import LAB, ingest

ROOT = Path(__file__).resolve().parents[3]
SECTION = parse(Compare, read_yaml(ROOT / "pipeline/scenes/lab.yaml")["compare"], "lab.yaml: compare")
# The nominal skin is pressed with the same tip as the boards, because tables for another tip would take seconds to
# compute.
DESIGN = parse(SkinDesign, nominal("skin") | {"tip_radius_mm": 2.0}, "params.yaml: skin")
SETUP = law.Setup(DESIGN, np.array(SECTION.design.places_mm), 1.1, SECTION.skin_mm, True, SECTION.tip_radius_mm)
TRUE = law.Law(0.4, -0.3, 0.0, 1.6, 1.8, 0.5, -0.6, 0.22, 6.0, 40.0, 10.0)
# The tolerances are the errors of a fit to 50 presses with 3 uT of noise. The tolerances of gap and amplitude are
# large, because an error of the gap can be compensated by an error of the amplitude.
TOLERANCES = law.Law(0.05, 0.05, 0.0, 0.15, 0.3, 0.1, 0.1, 0.03, 0.6, 3.0, 3.0)
ROTATIONS = chip_rotations(SECTION)


def simulated_presses(parameters: law.Law = TRUE, noise_uT: float = 3.0) -> RecordedPresses:
    """Return simulated presses at 25 places with two forces each, along the axes of scene lab."""
    rng = rng_for(0, "compare")
    grid_mm = np.stack(np.meshgrid(*[np.linspace(-7, 7, 5)] * 2), axis=-1).reshape(-1, 2)
    place_mm, force_N = np.tile(grid_mm, (2, 1)), np.repeat([1.0, 4.0], 25)
    db_uT = np.einsum("kij,nki->nkj", ROTATIONS, law.simulate_uT(parameters, SETUP, place_mm, force_N))
    rest_uT = np.einsum("kij,ki->kj", ROTATIONS, law.at_rest_uT(parameters, SETUP))
    return RecordedPresses(
        board="b", groups=("soft", "hard"), group_i=np.repeat([0, 1], 25), capture_i=np.repeat([0, 1], 25),
        place_mm=place_mm * (1, -1) + SECTION.labels_middle_mm, force_N=force_N,
        db_uT=db_uT + noise_uT * rng.standard_normal(db_uT.shape), noload_uT=np.tile(rest_uT, (50, 1, 1)),
        noise_uT=np.full(3, noise_uT), excluded_n=0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def recorded() -> RecordedPresses:
    return simulated_presses()


def sentence(pokes: RecordedPresses) -> str:
    return check_frames(to_board_axes(pokes, SECTION), SETUP, SECTION)["sentence"]


def test_fit_recovers_the_parameters_of_a_simulated_skin(recorded):
    fitted, near = asdict(fit.fit(to_board_axes(recorded, SECTION), SETUP, fit.TEN)), asdict(TOLERANCES)
    assert {
        name: (fitted[name], true) for name, true in asdict(TRUE).items() if abs(fitted[name] - true) > near[name]
    } == {}


def test_second_fit_for_a_single_board_changes_only_the_parameters_of_this_board(recorded):
    start = replace(fit.START, modulus_MPa=0.25, away_um_mm=6.0, give_x_um=40.0, give_y_um=10.0)
    fitted = fit.fit(
        to_board_axes(simulated_presses(replace(TRUE, rotation_deg=2.0)), SECTION), SETUP, fit.SEVEN, start
    )
    assert fitted.rotation_deg == pytest.approx(2.0, abs=0.3)
    assert (fitted.seat_x_mm, fitted.seat_y_mm) == pytest.approx((0.4, -0.3), abs=0.05)
    assert [getattr(fitted, name) for name in fit.TEN[6:]] == [0.25, 6.0, 40.0, 10.0]


def test_recording_that_agrees_with_the_scene_has_no_departure(recorded):
    assert sentence(recorded) == "Labels, chips and skin are oriented as the scene states."


def test_exchanged_chips_are_reported(recorded):
    swapped = replace(recorded, db_uT=recorded.db_uT[:, [0, 2, 1, 3, 4]])
    assert sentence(swapped) == "Contrary to the scene, chips 1 and 2 are exchanged."


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_axis_along_which_all_chips_are_mirrored_is_reported(recorded, axis):
    signs = np.where(np.arange(3) == axis, -1.0, 1.0)
    assert sentence(replace(recorded, db_uT=recorded.db_uT * signs)) == (
        f"Contrary to the scene, all chips are mirrored along {'xyz'[axis]}."
    )


def test_rotated_chip_is_reported(recorded):
    db_uT = recorded.db_uT.copy()
    db_uT[:, 3] = db_uT[:, 3] @ compare.quarter_turn(1)
    assert sentence(replace(recorded, db_uT=db_uT)) == (
        "Contrary to the scene, chip 3 is turned by 90 degrees more than the scene says."
    )


@pytest.mark.parametrize("axis", [0, 1])
def test_axis_along_which_labels_are_mirrored_is_reported(recorded, axis):
    place_mm = recorded.place_mm.copy()
    place_mm[:, axis] = 16.0 - place_mm[:, axis]
    assert sentence(replace(recorded, place_mm=place_mm)) == (
        f"Contrary to the scene, the labels are mirrored along {'xy'[axis]}."
    )


def test_skin_with_exchanged_poles_is_reported(recorded):
    flipped = replace(recorded, db_uT=-recorded.db_uT)
    assert sentence(flipped) == "Contrary to the scene, the skin is flipped: every field has the opposite sign."


def test_sixteen_orientations_of_a_skin_are_distinct():
    matrices = {tuple(turn.matrix.ravel().round().astype(int)) for turn in compare.TURNS}
    assert len(matrices) == len(compare.TURNS) == 16
    assert compare.TURNS[0].describe() == ""
    assert all(turn.matrix[2, 2] == (1 if i < 8 else -1) for i, turn in enumerate(compare.TURNS))


def test_flipped_checkerboard_skin_equals_the_skin_rotated_by_a_quarter_turn():
    plain, flipped = (replace(SETUP, skin_flipped=is_flipped).rest for is_flipped in (False, True))
    turn = compare.quarter_turn(1)
    moments_by_node = {
        tuple(np.round(node * 1e6).astype(int)): moment
        for node, moment in zip(plain.nodes_m, plain.moments_A_m2, strict=True)
    }
    for node, moment in zip(flipped.nodes_m[::97], flipped.moments_A_m2[::97], strict=True):
        before = moments_by_node[tuple(np.round(turn.T @ node * 1e6).astype(int))]
        np.testing.assert_allclose(turn @ before, moment, atol=1e-6 * np.abs(plain.moments_A_m2).max())


def test_fields_of_the_law_without_slide_equal_those_of_the_nominal_skin():
    plain = law.Law(0.0, 0.0, 0.0, 1.1, 1.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0)
    setup = replace(SETUP, tip_radius_mm=DESIGN.tip_radius_mm)
    place_mm = np.array([[3.0, -2.0], [0.0, 6.0]])
    nominal_uT = law.nominal_uT(setup, place_mm, np.array([0.5, 0.5]))
    # The depth of `nominal_uT` is fixed, so the force of this depth is found by trying many forces.
    lengths = [
        np.linalg.norm(nominal_uT - law.simulate_uT(plain, setup, place_mm, np.full(2, force_N)))
        for force_N in np.geomspace(0.2, 8, 30)
    ]
    assert min(lengths) < 0.05 * np.linalg.norm(nominal_uT)


def test_presses_deeper_than_the_greatest_depth_get_the_field_of_this_depth():
    deepest_m = np.array([0.72e-3 * DESIGN.thickness_mm])
    layer_settings = {"modulus_Pa": 1e6 * TRUE.modulus_MPa, "thickness_m": SETUP.thickness_m, "tip_radius_m": 2e-3}
    (deepest_N,) = layer.force(deepest_m, **layer_settings, base="slipping") * 0.28**-1.5
    force_N = deepest_N * np.array([0.5, 0.999, 1.001, 3.0])
    assert law.beyond_n(TRUE, SETUP, force_N) == 2
    # The skin does not slide here, because the slide would change the field with the force even at a constant depth.
    without_slide = replace(TRUE, away_um_mm=0.0)
    held_uT = law.simulate_uT(without_slide, SETUP, np.zeros((4, 2)), force_N)
    # A skin with half the modulus is indented as deeply by half the force.
    soft = replace(TRUE, modulus_MPa=TRUE.modulus_MPa / 2)
    assert law.beyond_n(soft, SETUP, force_N[1:]) == 3
    np.testing.assert_allclose(held_uT[2], held_uT[3])


def test_presses_harder_than_the_largest_force_of_the_nominal_skin_are_counted():
    known_N, _ = law._nominal_curve(SETUP)
    assert law.beyond_n(None, SETUP, known_N[-1] * np.array([0.9, 1.1, 2.0])) == 2


def test_measures_of_agreement_have_the_expected_values_for_simple_fields():
    one_uT = np.array([[[3.0, 0.0, 0.0]], [[0.0, 4.0, 0.0]]])
    assert cosines(one_uT, 2 * one_uT).tolist() == [1.0, 1.0]
    assert cosines(one_uT, one_uT[:, :, [1, 0, 2]]).tolist() == [0.0, 0.0]
    assert explained(0.5 * one_uT, one_uT).tolist() == [0.75, 0.75]
    pokes = simulated_presses(noise_uT=0.0)
    power_uT = np.ones((50, 5, 3)) * pokes.force_N[:, None, None] ** 0.3
    assert growth(pokes, power_uT) == pytest.approx(0.3)
    assert growth(replace(pokes, force_N=np.ones(50)), power_uT) is None


def test_field_memory_is_estimated_while_the_no_load_field_drifts():
    pokes, rng = simulated_presses(), rng_for(1, "compare")
    for part in (0.0, 0.07):
        rest_uT = np.linspace(0, 60, 50)[:, None, None] ** 2 / 60 + 0.3 * rng.standard_normal((50, 5, 3))
        rest_uT[1:] += part * pokes.db_uT[:-1]
        assert memory(pokes, pokes.db_uT, rest_uT) == pytest.approx(part, abs=0.004)
    # The memory cannot be estimated if all no-load readings are the same.
    assert memory(pokes, pokes.db_uT, np.tile(rest_uT[:1], (50, 1, 1))) is None


def test_presses_are_means_of_the_readings_with_a_force():
    one = readings(f=6, indentation=np.array([0, 0, 0, 1, 1, 2], np.int32), x_mm=np.zeros(6, np.float32),
                   Fz_N=np.array([1, 2, 3, 4, 4, np.nan], np.float32))  # fmt: skip
    pokes = pool([one])
    assert pokes.force_N.tolist() == [2.0, 4.0]
    # The first press is the mean of rows 0 to 2, the second one the mean of rows 3 and 4. Row 5 has no force.
    assert pokes.db_uT[:, 0, 0].tolist() == [1.0, 3.5]
    assert pokes.excluded_n == 1
    assert pokes.groups == ("c0 1 mm",)
    with pytest.raises(SchemaError, match="experiment compare: board .* has no press with a known place and force"):
        pool([readings(Fz_N=np.full(6, np.nan, np.float32))])
    with pytest.raises(ParamsError, match="1 chips were recorded, but compare.design has 5"):
        to_board_axes(pokes, SECTION)


def test_presses_of_many_different_depths_are_grouped_by_thirds_of_depth():
    depths_mm = np.arange(60, 0, -5, np.float32) / 100
    one = readings(
        f=12, indentation=np.arange(12, dtype=np.int32), depth_mm=np.append(depths_mm[:-1], np.float32(np.nan))
    )
    pokes = pool([one])
    assert pokes.groups == ("c0", "c0 0.1 to 0.267 mm", "c0 0.267 to 0.433 mm", "c0 0.433 to 0.6 mm")
    assert pokes.group_i.tolist() == [3] * 4 + [2] * 3 + [1] * 4 + [0]
    ten = replace(one, depth_mm=np.append(depths_mm[:-2], depths_mm[:2]))
    assert len(pool([ten]).groups) == 10  # With ten different depths, each depth is a group.


@pytest.fixture(scope="module")
def real(shared_data, tmp_path_factory) -> dict[str, RecordedPresses]:
    """Return the presses of the recordings of lab boards 1 and 2."""
    captures: dict[str, list] = {}
    for name in LAB:
        file = shared_data / "lab" / f"{name}.csv"
        board = name.partition("_")[0]
        one, _ = ingest(lab, file, tmp_path_factory.mktemp(name), board=board, capture=name)
        captures.setdefault(board, []).append(one)
    return {board: pool(recordings) for board, recordings in captures.items()}


@pytest.mark.skipif(not FULL, reason="slow: run `make bench`")
def test_simulation_fitted_at_a_third_of_the_places_agrees_at_all_places(real):
    # Parameters are fitted to a third of the places (22 of 65 in each of three recordings). With them, the simulation
    # must agree with the presses at all places.
    third = {board: _select(pokes, np.arange(len(pokes)) % 65 % 3 == 0) for board, pokes in real.items()}
    numbers, figure_data = compare_boards(third, SECTION, DESIGN, seed=2021)
    cosine_min = {"fitted": 0.89, "refitted": 0.85}
    for board, way in itertools.product(real, cosine_min):
        parameters, seen = numbers["by_board"][board]["laws"][way], to_board_axes(real[board], SECTION)
        fitted = law.Law(**{name: parameters[name] for name in law.Law.__dataclass_fields__})
        agreed = agreement(seen, law.simulate_uT(fitted, SETUP, seen.place_mm, seen.recorded.force_N))
        assert agreed["cosine_mean"] > cosine_min[way]
        assert agreed["explained_median"] > 0.78
        assert agreed["growth"]["simulated"] == pytest.approx(agreed["growth"]["recorded"], abs=0.12)
    for board, of_board in numbers["by_board"].items():
        assert 0.6 < of_board["nominal"]["cosine_mean"] < 0.82
        assert of_board["frames"]["sentence"] == "Labels, chips and skin are oriented as the scene states."
        assert of_board["pokes_n"] == 66
        assert len(figure_data["boards"][board]["arrows_uT"]["recorded"]) == len(
            figure_data["boards"][board]["places_mm"]
        )
    assert numbers["over_boards"]["refitted"]["cosine_mean"]["n"] == 2


def _select(pokes: RecordedPresses, chosen: np.ndarray) -> RecordedPresses:
    names = ("group_i", "capture_i", "place_mm", "force_N", "db_uT", "noload_uT")
    return replace(pokes, **{name: getattr(pokes, name)[chosen] for name in names})


def test_field_memory_is_5_to_8_percent_in_recordings_and_as_set_in_the_simulation(real):
    for pokes in real.values():
        seen = to_board_axes(pokes, SECTION)
        fitted = estimate_memory(seen, seen.db_uT, SECTION, seed=2021)["memory"]
        assert 0.05 < fitted["recorded"] < 0.08
        assert fitted["simulated"] == pytest.approx(SECTION.memory, abs=0.005)
