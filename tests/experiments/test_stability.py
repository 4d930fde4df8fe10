"""Tests that all cases of experiment stability pass, and that a fault planted in the library makes a case fail."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.experiments.stability import extremes as extremes_module
from pipeline.experiments.stability import physics, survey, wire
from pipeline.experiments.stability.cases import error_case, peak_bytes, rejection_case
from pipeline.experiments.stability.chip import chip_cases
from pipeline.experiments.stability.extremes import extreme_cases, near, tips
from pipeline.experiments.stability.physics import physics_cases, time_cases
from pipeline.experiments.stability.sliding import sliding_cases
from pipeline.experiments.stability.wire import wire_cases
from reskin.board import faults, stream
from reskin.config import parse, read_yaml
from reskin.errors import CaptureError
from reskin.physics import aging, chip, deformation, layer, slide
from reskin.simulation import contact, rig
from reskin.simulation.defaults import nominal
from reskin.simulation.settings import SimulationSettings

ROOT = Path(__file__).resolve().parents[2]
SHARED = {name: nominal(name) for name in ("rig", "skin", "chip", "spreads", "terms")}
QUICK = read_yaml(ROOT / "pipeline" / "scenes" / "quick.yaml")
DESIGN = parse(SimulationSettings, SHARED | QUICK["simulate"], "simulate")
BOARD = DESIGN.boards["rigid"].design
SEED = 2021


def failed(cases):
    return {case.case for case in cases if not case.holds}


@pytest.fixture(scope="module")
def cases():
    with pytest.MonkeyPatch.context() as patch:
        # Fewer pokes are used, because checks of arrays are slow while memory is traced.
        patch.setattr(physics, "POKES_N", 100)
        # The error of a reference with 48 steps or more is below 0.3 %, and the limit of these cases is 2 %.
        patch.setattr(extremes_module, "FINER", 2)
        return survey(DESIGN, SEED)


def test_every_case_passes(cases):
    assert failed(cases) == set()


def test_each_case_has_one_row_with_expected_and_actual_outcome(cases):
    assert len({(case.area, case.case) for case in cases}) == len(cases)
    assert {case.area for case in cases} == {"time", "physics", "chip", "wire"}
    assert all(case.should and case.happened for case in cases)
    assert all((case.error is None) == (case.limit is None) for case in cases)


def test_cases_are_reproducible():
    assert chip_cases(DESIGN.chip, 5, SEED) == chip_cases(DESIGN.chip, 5, SEED)
    assert time_cases() == time_cases()


def sliding():
    return sliding_cases(BOARD, DESIGN.spreads, skin=DESIGN.skin, seed=SEED)


def test_sliding_cases_detect_a_base_without_damping(monkeypatch):
    monkeypatch.setattr(contact, "_in_series", lambda layer_N_per_m, _: layer_N_per_m[:, None, None] * np.eye(2))
    assert failed(sliding()) == {
        "a drag with a coefficient of friction of 10 on a sliding skin",
        "a tip that drags the skin and is then lifted",
    }


def test_sliding_cases_detect_a_missing_rotation_and_a_wrong_force_curve(monkeypatch):
    def straight(force_N, *, thickness_m, **kwargs):
        curve_m = np.linspace(0, slide.DEEPEST * thickness_m, 2000)
        return np.interp(force_N, slide.force_at(curve_m, thickness_m=thickness_m, **kwargs), curve_m)

    rigid = slide.rigid_motion
    monkeypatch.setattr(slide, "rigid_motion", lambda *args: replace(rigid(*args), spin_rad=np.zeros(len(args[0]))))
    monkeypatch.setattr(slide, "depth_at", straight)
    assert failed(sliding()) == {
        "motion of a skin that is poked near its free edge",
        "force control up to a depth of 0.72 of the thickness, and back to 0",
    }


def extremes():
    return extreme_cases(BOARD, DESIGN.spreads, skin=DESIGN.skin, seed=SEED)


def test_depth_table_that_ends_before_the_greatest_depth_is_detected(monkeypatch):
    monkeypatch.setattr(extremes_module, "FINER", 1)  # A less accurate reference is enough to detect this fault.
    at_depth = deformation.at_depth
    monkeypatch.setattr(
        deformation, "at_depth", lambda flow, depth_m: at_depth(flow, min(depth_m, 0.62 * flow.thickness_m))
    )
    assert failed(extremes()) == {
        "dB of a press to 0.66 of the thickness",
        "dB of a press to 0.72 of the thickness",
    }


def test_wrong_layer_compliance_is_detected_for_all_tips(monkeypatch):
    compliance, kept = layer.slipping_compliance, (layer.contact_of_depth, layer._force_curve)
    monkeypatch.setattr(layer, "slipping_compliance", lambda kh: compliance(1.5 * kh))
    for one in kept:
        one.cache_clear()
    sizes = ("0.1", "1", "10")
    assert failed(tips(DESIGN.skin.base)) == {f"a tip whose radius is {size} times the thickness" for size in sizes}
    for one in kept:
        one.cache_clear()


def test_quadrature_with_cells_wider_than_the_gap_is_detected(monkeypatch):
    monkeypatch.setattr(extremes_module, "CELL_SHARE", 1.5)
    assert len(failed(near(DESIGN.skin))) >= 2


def test_stiffening_that_ignores_the_thickness_of_the_skin_is_detected(monkeypatch):
    monkeypatch.setattr(extremes_module, "FINER", 1)  # A less accurate reference is enough to detect this fault.
    monkeypatch.setattr(slide, "stiffening", lambda depth_m, thickness_m: 1 + np.maximum(depth_m, 0) / 1e-3)
    assert failed(extremes()) == {
        f"a skin of {size} mm thickness, with all other lengths scaled too" for size in ("0.2", "20")
    }


def test_skin_without_springs_has_no_sliding_cases():
    assert sliding_cases(BOARD, DESIGN.spreads, skin=DESIGN.skin.model_copy(update={"hold": None}), seed=SEED) == []


@pytest.mark.parametrize(("chips_n", "gain_sel"), [(1, 7), (8, 0)])
def test_all_cases_of_byte_streams_pass_for_other_boards(monkeypatch, chips_n, gain_sel):
    monkeypatch.setattr(wire, "BLOCKS_N", 1)  # A single block is used, because decoding is slow while memory is traced.
    assert failed(wire_cases(gain_sel, chips_n, SEED)) == set()


def test_case_fails_if_the_expected_error_is_not_raised_or_its_value_is_nan():
    def raises():
        raise CaptureError("here: a thing must be so; got nothing. Mend it.")

    assert rejection_case("wire", "a", should="b", attempt=raises).happened.startswith("error: here: a thing")
    assert not rejection_case("wire", "a", should="b", attempt=lambda: None).holds
    assert not error_case("wire", "a", should="b", happened="c", error=np.nan, limit=1.0).holds


def test_rejection_case_does_not_catch_errors_of_unexpected_types():
    with pytest.raises(ZeroDivisionError):
        rejection_case("wire", "a", should="b", attempt=lambda: 1 / 0)


def test_peak_memory_counts_arrays_that_exist_at_once():
    def one_after_another():
        for _ in range(3):
            np.ones(125_000)

    # The tolerance allows for the overhead of array objects.
    assert peak_bytes(one_after_another) == pytest.approx(1e6, rel=0.1)


# Each of the following tests disables one check or limit (guard) of the library. A stability case must then fail.


def test_formula_that_loses_digits_in_small_time_steps_is_detected(monkeypatch):
    monkeypatch.setattr(aging, "_mean_decay", lambda x: (1 - np.exp(-x)) / np.where(x > 0, x, 1.0))
    assert "dt / tau_min 1e-16" in failed(time_cases())


def test_missing_check_for_infinite_time_steps_is_detected(monkeypatch):
    monkeypatch.setattr(aging.np, "isfinite", lambda _: np.True_)
    assert "a time step of inf s" in failed(time_cases())


def test_missing_range_of_the_force_sensor_and_wrong_verified_depth_are_detected(monkeypatch):
    monkeypatch.setattr(rig, "FORCE_RANGE_N", (np.inf,) * 3)
    monkeypatch.setattr(layer, "VERIFIED_DEPTH", 0.99)
    monkeypatch.setattr(physics, "POKES_N", 10)
    wrong = failed(physics_cases(BOARD, DESIGN.spreads, skin=DESIGN.skin, seed=SEED))
    assert wrong == {
        "a stiff skin, E = 1 GPa",
        "depths of 0.2, 0.59, 0.6 and 0.8 of the thickness",
    }


def test_missing_chip_saturation_is_detected(monkeypatch):
    monkeypatch.setattr(chip, "FIELD_MAX_T", 1.0)
    assert failed(chip_cases(DESIGN.chip, 5, SEED)) == {"60, -4 and -70 mT at GAIN_SEL 7"}


@pytest.mark.parametrize(
    ("guard", "disabled", "case"),
    [
        ("failed_reads", lambda b_uT, _: np.zeros((len(b_uT), 5), bool), "50 failed readings of one chip"),
        ("stuck_chips", lambda b_uT: np.zeros((len(b_uT), 5), bool), "a chip that repeats one reading"),
        ("reset_chips", lambda *_: np.zeros(5, bool), "chip 3 lost its settings"),
    ],
)
def test_chip_cases_detect_that_a_check_for_faults_is_disabled(monkeypatch, guard, disabled, case):
    monkeypatch.setattr(faults, guard, disabled)
    assert any(name.startswith(case) for name in failed(chip_cases(DESIGN.chip, 5, SEED)))


def test_lost_stream_bytes_are_detected(monkeypatch):
    account = stream.FrameStream.account
    monkeypatch.setattr(wire, "BLOCKS_N", 1)
    monkeypatch.setattr(stream.FrameStream, "account", lambda self: account(self) | {"skipped_truncated_bytes_n": 0})
    assert "last frame truncated (binary)" in failed(wire_cases(7, 5, SEED))
