"""Tests that the simulator agrees with independent references, and that a check fails if a fault is planted."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.experiments.verification import mechanics, verify
from pipeline.experiments.verification.checks import Check, no_spread
from pipeline.experiments.verification.mechanics import check_contact, one_small_step
from pipeline.experiments.verification.signals import check_electronics, check_field, check_frames, check_relaxation
from reskin.board import stream, wire
from reskin.config import parse, read_yaml
from reskin.physics import aging, chip, deformation, layer, magnet
from reskin.physics import magnet as change
from reskin.physics.board import draw_board
from reskin.physics.layer import IndentedLayer
from reskin.physics.skin import draw_skin
from reskin.simulation.defaults import nominal
from reskin.simulation.settings import SimulationSettings

ROOT = Path(__file__).resolve().parents[2]
SHARED = {name: nominal(name) for name in ("rig", "skin", "chip", "spreads", "terms")}
QUICK = read_yaml(ROOT / "pipeline" / "scenes" / "quick.yaml")
DESIGN = parse(SimulationSettings, SHARED | QUICK["simulate"], "simulate")
DEPTHS_M = (0.4e-3, 1.2e-3)
SEED = 2021


def failed(checks):
    return {f"{check.subject}: {check.law}" for check in checks if not check.holds}


@pytest.fixture(scope="module")
def checks():
    return verify(DESIGN, depths_m=DEPTHS_M, seed=SEED)


def test_simulator_passes_every_check(checks):
    assert failed(checks) == set()


def test_each_row_describes_its_check(checks):
    for check in checks:
        assert all((check.subject, check.law, check.against, check.unit, check.reason))
        assert np.isfinite(check.error)
        assert check.error >= 0
    assert len({(check.subject, check.law, check.against) for check in checks}) == len(checks)


def test_checks_against_the_specified_references_exist(checks):
    against = " ".join(check.against for check in checks)
    names = "magpylib Cuboid", "magpylib Dipole", "Hertz", "Dimitriadis", "Long", "mpmath", "struct", "data sheet"
    assert [name for name in names if name not in against] == []


def test_results_of_checks_are_reproducible():
    for check_all in (check_relaxation, lambda: check_field(DESIGN.skin, SEED), lambda: check_contact(DESIGN.skin)):
        assert check_all() == check_all()


def test_check_fails_if_its_error_is_nan_or_above_the_tolerance():
    check = Check("a", "b", "c", error=1.0, unit="1", tolerance=1.0, reason="d")
    assert check.holds
    assert not replace(check, error=1.0 + 1e-12).holds
    assert not replace(check, error=np.nan).holds


def test_function_no_spread_sets_all_spreads_to_zero():
    exact = no_spread(DESIGN.spreads).model_dump()
    assert exact.pop("skin_filler_length_mm") == DESIGN.spreads.skin_filler_length_mm
    assert not any(exact.values())


# Each of the following tests plants one fault in the simulator. One of the checks must then fail.


def test_wrong_sign_of_the_field_inside_magnets_is_detected(monkeypatch):
    original = magnet._corner
    monkeypatch.setattr(magnet, "_corner", lambda from_m: -original(from_m))
    wrong = failed(check_field(DESIGN.skin, SEED))
    assert "field of a box: inside, including the polarisation J" in wrong
    assert f"magnetising array, {DESIGN.skin.polarity}: field in the skin" in wrong


def test_check_of_div_b_detects_a_wrong_field_of_the_magnet_array(monkeypatch):
    original = magnet.array_field
    monkeypatch.setattr(magnet, "array_field", lambda at_m, h_m, polarity: original(at_m, h_m, polarity) * (1, 1, 1.01))
    assert f"magnetising array, {DESIGN.skin.polarity}: div B = 0" in failed(check_field(DESIGN.skin, SEED))


def test_magnetic_constant_with_a_relative_error_of_1e_minus_10_is_detected(monkeypatch):
    monkeypatch.setattr(change, "MU0_4PI", 1e-7)
    # The relative error is 1.3e-10. This is less than the difference between the values of mu_0 of two CODATA years.
    assert failed(check_field(DESIGN.skin, SEED)) == set()
    monkeypatch.setattr(change, "MU0_4PI", 1.001e-7)
    assert failed(check_field(DESIGN.skin, SEED)) == {
        "change of field: dipoles that move and turn",
        "dipole instead of a cube: relative error decreases with the distance r as (side / r)^4",
        "field of dipoles: at rest",
    }


def test_compliance_of_a_half_space_is_detected_by_every_reference_for_bonded_layers(monkeypatch):
    monkeypatch.setattr(layer, "bonded_compliance", np.ones_like)  # This is the compliance of a half-space.
    layer._force_curve.cache_clear()
    layer.contact_of_depth.cache_clear()
    try:
        wrong = {check.against for check in check_contact(DESIGN.skin) if not check.holds}
    finally:
        layer._force_curve.cache_clear()
        layer.contact_of_depth.cache_clear()
    assert {"Dimitriadis et al. 2002, bonded", "Long et al. 2011", "1.770"} <= wrong


def test_stretch_that_does_not_conserve_volume_is_detected(monkeypatch):
    original = layer.displacement

    def stretched(r_m, z_m, of):
        u = original(r_m, z_m, of)
        return replace(u, z_m=1.01 * u.z_m, z_z=1.01 * u.z_z, z_r=1.01 * u.z_r)

    monkeypatch.setattr(layer, "displacement", stretched)
    wrong = failed(one_small_step(IndentedLayer(2e-3, 3e-3, DESIGN.skin.base), DEPTHS_M[-1]))
    assert "one linear step of the deformation: volume is conserved: div u = 0 (displacement u)" in wrong
    assert "one linear step of the deformation: surface in the contact has the shape of the tip" in wrong


def test_moments_that_do_not_rotate_are_detected(monkeypatch):
    original = deformation.move_dipoles

    def without_rotation(table, rest, poke_m):
        moved = original(table, rest, poke_m)
        return replace(moved, after=(moved.after[0], moved.before[1]))

    board = draw_board(DESIGN.boards["rigid"].design, DESIGN.spreads, seed=SEED, name="b0")
    skin = draw_skin(DESIGN.skin, DESIGN.spreads, seed=SEED, name="b0_s0", rule=mechanics.COARSE)
    assert mechanics.approximations(board, skin, DEPTHS_M[-1], "deepest", mechanics.PLACES_M[:1]).holds
    monkeypatch.setattr(deformation, "move_dipoles", without_rotation)
    assert not mechanics.approximations(board, skin, DEPTHS_M[-1], "deepest", mechanics.PLACES_M[:1]).holds


def test_inaccurate_quotient_in_small_time_steps_is_detected(monkeypatch):
    def naive(x):
        return np.where(x > 0, (1 - np.exp(-x)) / np.where(x > 0, x, 1.0), 1.0)

    monkeypatch.setattr(aging, "_mean_decay", naive)
    assert any("one step" in law for law in failed(check_relaxation()))


def test_wrong_step_of_chip_readings_is_detected(monkeypatch):
    # These are the steps for another value of HALLCONF in the data sheet.
    monkeypatch.setattr(chip, "STEP_AT_GAIN_ONE_uT", (0.161, 0.161, 0.294))
    wrong = failed(check_electronics(DESIGN.chip, SEED))
    assert "chip: field per count, GAIN_SEL 6 and 7" in wrong
    assert "chip: readings of fields beyond the range, up to 50 mT, GAIN_SEL 7" in wrong


def test_noise_that_differs_from_recorded_noise_is_detected():
    quiet = DESIGN.chip.model_copy(update={"noise_xy_uT": 1.0})
    assert any("range of recorded noise" in law for law in failed(check_electronics(quiet, SEED)))


def test_wrong_order_of_channels_in_frames_is_detected(monkeypatch):
    encode, original = wire.encode, stream.FrameStream.feed
    monkeypatch.setattr(wire, "encode", lambda frames, layout: encode(rotate_chips(frames), layout))
    assert {law.split(": ")[1] for law in failed(check_frames(DESIGN.chip.gain_sel, 5, SEED))} == {
        "bytes that the simulator encodes", "values that struct decodes from the simulator's bytes",
    }  # fmt: skip
    monkeypatch.setattr(wire, "encode", encode)
    monkeypatch.setattr(stream.FrameStream, "feed", lambda self, data: rotate_chips(original(self, data)))
    wrong = failed(check_frames(DESIGN.chip.gain_sel, 5, SEED))
    assert len(wrong) == 4
    assert all(": values that our decoder reads" in law for law in wrong)


def rotate_chips(frames):
    return replace(frames, b_uT=np.roll(frames.b_uT, 1, axis=1))
