"""Stiff, extreme and broken cases end as they should, and a product that lets one through is found out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.experiments.stability import extremes as extremes_module
from pipeline.experiments.stability import physics, survey, wire
from pipeline.experiments.stability.cases import measured, peak_bytes, refused
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


def broken(cases):
    return {case.case for case in cases if not case.holds}


@pytest.fixture(scope="module")
def cases():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(physics, "POKES_N", 100)  # checked types and traced memory are slow together
        return survey(DESIGN, SEED)


def test_every_case_ends_as_it_should(cases):
    assert broken(cases) == set()


def test_every_row_is_its_own_and_says_what_happened(cases):
    assert len({(case.area, case.case) for case in cases}) == len(cases)
    assert {case.area for case in cases} == {"time", "physics", "chip", "wire"}
    assert all(case.should and case.happened for case in cases)
    assert all((case.error is None) == (case.limit is None) for case in cases)


def test_the_same_seed_gives_the_same_words():
    assert chip_cases(DESIGN.chip, 5, SEED) == chip_cases(DESIGN.chip, 5, SEED)
    assert time_cases() == time_cases()


def sliding():
    return sliding_cases(BOARD, DESIGN.spreads, skin=DESIGN.skin, seed=SEED)


def test_a_base_that_gives_nothing_away_is_found_out(monkeypatch):
    monkeypatch.setattr(contact, "_in_series", lambda layer_N_per_m, _: layer_N_per_m[:, None, None] * np.eye(2))
    assert broken(sliding()) == {
        "a drag with friction 10 on a skin that slides",
        "a tip that pulls the skin and is lifted there",
    }


def test_a_slide_that_forgets_to_turn_and_a_depth_between_straight_lines_are_found_out(monkeypatch):
    def straight(force_N, *, thickness_m, **of):
        curve_m = np.linspace(0, slide.DEEPEST * thickness_m, 2000)
        return np.interp(force_N, slide.force_at(curve_m, thickness_m=thickness_m, **of), curve_m)

    rigid = slide.rigid_motion
    monkeypatch.setattr(slide, "rigid_motion", lambda *of: replace(rigid(*of), spin_rad=np.zeros(len(of[0]))))
    monkeypatch.setattr(slide, "depth_at", straight)
    assert broken(sliding()) == {
        "the slide of a skin that is poked at its free edge",
        "pressed to 0.72 of the thickness by force, and let go",
    }


def extremes():
    return extreme_cases(BOARD, DESIGN.spreads, skin=DESIGN.skin, seed=SEED)


def test_deep_presses_by_a_table_that_ends_too_early_are_found_out(monkeypatch):
    at_depth = deformation.at_depth
    monkeypatch.setattr(
        deformation, "at_depth", lambda flow, depth_m: at_depth(flow, min(depth_m, 0.62 * flow.thickness_m))
    )
    assert broken(extremes()) == {"dB of a press to 0.66 of the thickness", "dB of a press to 0.72 of the thickness"}


def test_a_layer_of_another_compliance_is_found_out_by_every_tip(monkeypatch):
    compliance, kept = layer.slipping_compliance, (layer.contact_of_depth, layer._force_curve)
    monkeypatch.setattr(layer, "slipping_compliance", lambda kh: compliance(1.5 * kh))
    for one in kept:
        one.cache_clear()
    assert broken(tips(DESIGN.skin.base)) == {f"a tip of {size} thicknesses" for size in ("0.1", "1", "10")}
    for one in kept:
        one.cache_clear()


def test_cells_as_wide_as_the_gap_are_found_out_under_near_chips(monkeypatch):
    monkeypatch.setattr(extremes_module, "CELL_SHARE", 1.5)
    assert len(broken(near(DESIGN.skin))) >= 2


def test_a_stiffening_that_knows_a_millimetre_is_found_out_by_thin_and_thick_skins(monkeypatch):
    monkeypatch.setattr(slide, "stiffening", lambda depth_m, thickness_m: 1 + np.maximum(depth_m, 0) / 1e-3)
    assert broken(extremes()) == {"a skin of 0.2 mm", "a skin of 20 mm"}


def test_a_skin_that_no_springs_hold_has_no_such_case():
    assert sliding_cases(BOARD, DESIGN.spreads, skin=DESIGN.skin.model_copy(update={"hold": None}), seed=SEED) == []


@pytest.mark.parametrize(("chips_n", "gain_sel"), [(1, 7), (8, 0)])
def test_streams_of_other_boards_are_surveyed_too(monkeypatch, chips_n, gain_sel):
    monkeypatch.setattr(wire, "BLOCKS_N", 1)  # and four times as many, under traced memory; three stand in `cases`
    assert broken(wire_cases(gain_sel, chips_n, SEED)) == set()


def test_what_is_not_refused_and_what_is_no_number_does_not_hold():
    def raises():
        raise CaptureError("here: a thing must be so; got nothing. Mend it.")

    assert refused("wire", "a", should="b", attempt=raises).happened.startswith("refused: here: a thing")
    assert not refused("wire", "a", should="b", attempt=lambda: None).holds
    assert not measured("wire", "a", should="b", happened="c", error=np.nan, limit=1.0).holds


def test_an_error_of_ours_is_no_refusal():
    with pytest.raises(ZeroDivisionError):
        refused("wire", "a", should="b", attempt=lambda: 1 / 0)


def test_the_peak_is_what_is_held_at_once():
    def one_after_another():
        for _ in range(3):
            np.ones(125_000)

    assert peak_bytes(one_after_another) == pytest.approx(1e6, rel=0.1)  # bytes beside the array


# Each fault is planted where the product has its guard.


def test_the_naive_quotient_of_a_small_step_is_found_out(monkeypatch):
    monkeypatch.setattr(aging, "_mean_decay", lambda x: (1 - np.exp(-x)) / np.where(x > 0, x, 1.0))
    assert "dt / tau_min 1e-16" in broken(time_cases())


def test_time_that_may_run_backwards_is_found_out(monkeypatch):
    monkeypatch.setattr(aging.np, "isfinite", lambda _: np.True_)
    assert "a time step of inf s" in broken(time_cases())


def test_a_force_sensor_without_a_range_and_a_flag_that_never_rises_are_found_out(monkeypatch):
    monkeypatch.setattr(rig, "FORCE_RANGE_N", (np.inf,) * 3)
    monkeypatch.setattr(layer, "VERIFIED_DEPTH", 0.99)
    monkeypatch.setattr(physics, "POKES_N", 10)
    wrong = broken(physics_cases(BOARD, DESIGN.spreads, skin=DESIGN.skin, seed=SEED))
    assert wrong == {
        "a stiff skin, E = 1 GPa",
        "depths of 0.2, 0.59, 0.6 and 0.8 of the thickness",
    }


def test_a_chip_that_never_saturates_is_found_out(monkeypatch):
    monkeypatch.setattr(chip, "FIELD_MAX_T", 1.0)
    assert broken(chip_cases(DESIGN.chip, 5, SEED)) == {"60, -4 and -70 mT at GAIN_SEL 7"}


@pytest.mark.parametrize(
    ("guard", "blind", "case"),
    [
        ("failed_reads", lambda b_uT, _: np.zeros((len(b_uT), 5), bool), "50 dropped readings of one chip"),
        ("stuck_chips", lambda b_uT: np.zeros((len(b_uT), 5), bool), "a chip that stops while the board moves"),
        ("reset_chips", lambda *_: np.zeros(5, bool), "chip 3 lost its settings"),
    ],
)
def test_a_fault_that_nobody_looks_for_is_found_out(monkeypatch, guard, blind, case):
    monkeypatch.setattr(faults, guard, blind)
    assert any(name.startswith(case) for name in broken(chip_cases(DESIGN.chip, 5, SEED)))


def test_a_stream_that_forgets_bytes_is_found_out(monkeypatch):
    right = stream.FrameStream.account
    monkeypatch.setattr(wire, "BLOCKS_N", 1)
    monkeypatch.setattr(stream.FrameStream, "account", lambda self: right(self) | {"skipped_truncated_bytes_n": 0})
    assert "last frame truncated (binary)" in broken(wire_cases(7, 5, SEED))
