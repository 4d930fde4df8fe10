"""The simulator agrees with every independent reference, and a wrong simulator is told from a right one."""

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


def broken(checks):
    return {f"{check.subject}: {check.law}" for check in checks if not check.holds}


@pytest.fixture(scope="module")
def checks():
    return verify(DESIGN, depths_m=DEPTHS_M, seed=SEED)


def test_every_check_holds(checks):
    assert broken(checks) == set()


def test_every_row_says_what_why_and_how_much(checks):
    for check in checks:
        assert all((check.subject, check.law, check.against, check.unit, check.reason))
        assert np.isfinite(check.error)
        assert check.error >= 0
    assert len({(check.subject, check.law, check.against) for check in checks}) == len(checks)


def test_each_reference_that_the_specification_names_is_there(checks):
    against = " ".join(check.against for check in checks)
    names = "magpylib Cuboid", "magpylib Dipole", "Hertz", "Dimitriadis", "Long", "mpmath", "struct", "data sheet"
    assert [name for name in names if name not in against] == []


def test_the_same_scene_and_seed_give_the_same_digits():
    for check_all in (check_relaxation, lambda: check_field(DESIGN.skin, SEED), lambda: check_contact(DESIGN.skin)):
        assert check_all() == check_all()


def test_an_error_past_its_tolerance_or_no_number_does_not_hold():
    check = Check("a", "b", "c", error=1.0, unit="1", tolerance=1.0, reason="d")
    assert check.holds
    assert not replace(check, error=1.0 + 1e-12).holds
    assert not replace(check, error=np.nan).holds


def test_without_spreads_nothing_differs_but_the_length_is_kept():
    exact = no_spread(DESIGN.spreads).model_dump()
    assert exact.pop("skin_filler_length_mm") == DESIGN.spreads.skin_filler_length_mm
    assert not any(exact.values())


# Each fault is planted where the product has its number, and must show in the row that is about it.


def test_a_field_of_the_wrong_sign_inside_magnets_is_seen(monkeypatch):
    right = magnet._corner
    monkeypatch.setattr(magnet, "_corner", lambda from_m: -right(from_m))
    wrong = broken(check_field(DESIGN.skin, SEED))
    assert "field of a box: inside, J included" in wrong
    assert f"magnetising array, {DESIGN.skin.polarity}: field in the skin" in wrong


def test_a_wrong_place_of_the_array_is_not_this_tables_business_but_a_wrong_size_of_its_cubes_breaks_maxwell(
    monkeypatch,
):
    # The reference takes the sizes from the product's constants; Maxwell's laws do not.
    right = magnet.array_field
    monkeypatch.setattr(magnet, "array_field", lambda at_m, h_m, polarity: right(at_m, h_m, polarity) * (1, 1, 1.01))
    assert f"magnetising array, {DESIGN.skin.polarity}: div B = 0" in broken(check_field(DESIGN.skin, SEED))


def test_a_constant_of_exactly_1e_7_is_below_and_one_of_1_001e_7_above_the_tolerance(monkeypatch):
    monkeypatch.setattr(change, "MU0_4PI", 1e-7)
    assert broken(check_field(DESIGN.skin, SEED)) == set()  # 1.3e-10, less than between two years of CODATA
    monkeypatch.setattr(change, "MU0_4PI", 1.001e-7)
    assert broken(check_field(DESIGN.skin, SEED)) == {
        "change of field: dipoles that move and turn",
        "dipole for a cube: error falls with (side / r)^4",
        "field of dipoles: at rest",
    }


def test_a_layer_that_is_not_bonded_is_seen_by_every_reference(monkeypatch):
    monkeypatch.setattr(layer, "bonded_compliance", np.ones_like)  # a half-space: no base at all
    layer._force_curve.cache_clear()
    layer.contact_of_depth.cache_clear()
    try:
        wrong = {check.against for check in check_contact(DESIGN.skin) if not check.holds}
    finally:
        layer._force_curve.cache_clear()
        layer.contact_of_depth.cache_clear()
    assert {"Dimitriadis et al. 2002, bonded", "Long et al. 2011", "1.770"} <= wrong


def test_waves_that_stretch_without_narrowing_lose_volume(monkeypatch):
    right = layer.displacement

    def stretched(r_m, z_m, of):
        u = right(r_m, z_m, of)
        return replace(u, z_m=1.01 * u.z_m, z_z=1.01 * u.z_z, z_r=1.01 * u.z_r)

    monkeypatch.setattr(layer, "displacement", stretched)
    wrong = broken(one_small_step(IndentedLayer(2e-3, 3e-3, DESIGN.skin.base), DEPTHS_M[-1]))
    assert "one small step: div u = 0" in wrong
    assert "one small step: the surface lies on the tip" in wrong


def test_moments_that_do_not_turn_with_the_material_are_seen(monkeypatch):
    right = deformation.move_dipoles

    def unturned(table, rest, poke_m):
        moved = right(table, rest, poke_m)
        return replace(moved, after=(moved.after[0], moved.before[1]))

    board = draw_board(DESIGN.boards["rigid"].design, DESIGN.spreads, seed=SEED, name="b0")
    skin = draw_skin(DESIGN.skin, DESIGN.spreads, seed=SEED, name="b0_s0", rule=mechanics.COARSE)
    assert mechanics.approximations(board, skin, DEPTHS_M[-1], "deepest", mechanics.PLACES_M[:1]).holds
    monkeypatch.setattr(deformation, "move_dipoles", unturned)
    assert not mechanics.approximations(board, skin, DEPTHS_M[-1], "deepest", mechanics.PLACES_M[:1]).holds


def test_the_naive_quotient_of_a_small_step_is_seen(monkeypatch):
    def naive(x):
        return np.where(x > 0, (1 - np.exp(-x)) / np.where(x > 0, x, 1.0), 1.0)

    monkeypatch.setattr(aging, "_mean_decay", naive)
    assert any("one step" in law for law in broken(check_relaxation()))


def test_a_wrong_step_of_the_chip_is_seen(monkeypatch):
    monkeypatch.setattr(chip, "STEP_AT_GAIN_ONE_uT", (0.161, 0.161, 0.294))  # the data sheet's other HALLCONF
    wrong = broken(check_electronics(DESIGN.chip, SEED))
    assert "chip: uT a count, GAIN_SEL 6 and 7" in wrong
    assert "chip: past its range, GAIN_SEL 7, to 50 mT" in wrong


def test_noise_that_no_recorded_board_has_is_seen():
    quiet = DESIGN.chip.model_copy(update={"noise_xy_uT": 1.0})
    assert any("outside the recorded" in law for law in broken(check_electronics(quiet, SEED)))


def test_frames_in_another_order_are_seen(monkeypatch):
    encode, right = wire.encode, stream.FrameStream.feed
    monkeypatch.setattr(wire, "encode", lambda frames, layout: encode(turned(frames), layout))
    assert {law.split(": ")[1] for law in broken(check_frames(DESIGN.chip.gain_sel, 5, SEED))} == {
        "what is written", "what struct reads of it",
    }  # fmt: skip
    monkeypatch.setattr(wire, "encode", encode)
    monkeypatch.setattr(stream.FrameStream, "feed", lambda self, data: turned(right(self, data)))
    wrong = broken(check_frames(DESIGN.chip.gain_sel, 5, SEED))
    assert len(wrong) == 4
    assert all(": what is read" in law for law in wrong)


def turned(frames):
    return replace(frames, b_uT=np.roll(frames.b_uT, 1, axis=1))
