"""Tests that simulated captures agree with their protocol and with the simulated field.

Other tests check the names of captures, random seeds, and optional terms of the physics such as ageing.
"""

import numpy as np
import pytest

from reskin.data.grid import points_mm
from reskin.errors import ParamsError
from reskin.physics.board import draw_board
from reskin.physics.skin import changes_of_field, draw_skin, forces
from reskin.simulation.capture import list_captures, simulate_capture
from tests.simulation.scene import (
    AGEING,
    DRAG,
    GRID,
    HAND,
    LOAD,
    RELAXATION,
    RIGID,
    SECTIONS,
    TEMPERATURE,
    synthesis,
    with_protocol,
)

LIFTED_N, MOVING_N, DWELL_N = 1 + 4, 2, 1 + 3
FRAMES_N = LIFTED_N + MOVING_N + DWELL_N + MOVING_N
READ = slice(LIFTED_N + MOVING_N + 1, LIFTED_N + MOVING_N + DWELL_N)


def capture_of(scene=None, protocol="grid", *, board="b0", skin="b0_s0", seed=1):
    return simulate_capture(scene or synthesis(), protocol, board=board, skin=skin, seed=seed)


@pytest.fixture(scope="module")
def capture():
    return capture_of()


def noiseless_scene(**changes):
    return synthesis("chip", noise_xy_uT=0.0, noise_z_uT=0.0, **changes)


def same(one, other):
    arrays = ("b_uT", "temperature_degC", "arrived_frames_n", "arrived_s")
    logs = [(getattr(one.probe, name), getattr(other.probe, name)) for name in one.probe.__dataclass_fields__]
    return all(np.array_equal(*pair, equal_nan=True) for pair in logs if pair[0].dtype != bool) and all(
        getattr(one, name).tobytes() == getattr(other, name).tobytes() for name in arrays
    )


def frames_by_indentation(capture, frames_n=FRAMES_N):
    """Return the fields of a capture, as an array [indentation, frame, chip, axis]."""
    return capture.b_uT.astype(np.float64).reshape(-1, frames_n, 5, 3)


def labels_in_contact(capture, name):
    return getattr(capture.probe, name)[capture.probe.contact]


def test_each_indentation_has_the_frames_and_dwells_of_the_protocol(capture):
    indentations_n = 2 * 2 * 65
    assert capture.b_uT.shape == (indentations_n * FRAMES_N, 15)
    assert capture.temperature_degC.shape == (indentations_n * FRAMES_N, 5)
    assert len(capture.probe) == 2 * indentations_n
    assert set(capture.overruns.values()) == {0}


def test_capture_without_noise_equals_the_simulated_field():
    scene = noiseless_scene()
    b_uT = frames_by_indentation(capture_of(scene))
    board = draw_board(scene.boards["rigid"].design, scene.spreads, seed=1, name="b0")
    rule = scene.boards["rigid"].quadrature.in_si()
    skin = draw_skin(scene.skin, scene.spreads, seed=1, name="b0_s0", rule=rule)
    pokes_m = np.array([[x - 8, y - 8, depth] for depth in (0.6, 1.2) for x, y in points_mm()]) * 1e-3
    _, changes_T = changes_of_field(board, skin, pokes_m)
    truth_uT = 1e6 * np.einsum("kij,klj,nkl->nki", board.sensitivity, board.turn, changes_T)
    found_uT = (b_uT[:, READ] - b_uT[:, 1:2])[:130]
    # The tolerance is one step of z, because two readings are rounded.
    assert np.abs(found_uT - truth_uT[:, None]).max() < 0.75


def test_position_errors_of_the_robot_change_fields_and_not_labels():
    exact, loose = capture_of(noiseless_scene()), capture_of(synthesis("rig", robot_place_sd_mm=0.3))
    assert np.array_equal(exact.probe.x_mm, loose.probe.x_mm)
    moved_uT = (frames_by_indentation(exact) - frames_by_indentation(loose))[:, READ].std()
    assert moved_uT > 2 * 5.0  # This limit is twice the noise of a reading.


def test_labels_have_the_commanded_place_and_the_measured_force(capture):
    log = capture.probe
    np.testing.assert_array_equal(
        np.column_stack([labels_in_contact(capture, "x_mm"), labels_in_contact(capture, "y_mm")]),
        np.tile(points_mm(), (4, 1)),
    )
    assert not log.depth_mm[~log.contact].any()
    scene = synthesis()
    skin = draw_skin(scene.skin, scene.spreads, seed=1, name="b0_s0")
    noise_N = labels_in_contact(capture, "Fz_N") - forces(skin, np.repeat([0.6e-3, 1.2e-3] * 2, 65))
    assert noise_N.std() == pytest.approx(0.006, rel=0.2)  # The tolerance is four standard errors for 260 draws.
    assert np.abs(np.concatenate([noise_N, log.Fz_N[~log.contact], log.Fx_N, log.Fy_N])).max() < 6 * 0.006


SLEEVE = {
    "letter": "v", "boards_n": 1, "skins_per_board_n": 1,
    "design": RIGID | {"tiles": {"columns_n": 2, "rows_n": 4, "pitch_mm": 25.4}},
    "skin_mm": (50.8, 101.6), "quadrature": {"cell_mm": 2.2, "layers_n": 2},
}  # fmt: skip
SCATTER = {
    "kind": "scatter", "boards": "sleeve", "skins_n": 1, "pokes_n": 6, "depth_mm": (0.6, 1.2), "margin_mm": 4.0,
    "terms": [],
}  # fmt: skip


def sleeve(**changes):
    return with_protocol("sleeve", SCATTER, boards=SECTIONS["boards"] | {"sleeve": SLEEVE}, **changes)


def test_fields_of_scattered_pokes_are_those_at_the_labelled_places():
    scene = sleeve(chip=SECTIONS["chip"] | {"noise_xy_uT": 0.0, "noise_z_uT": 0.0})
    one = capture_of(scene, "sleeve", board="v0", skin="v0_s0")
    place_mm = np.column_stack([labels_in_contact(one, "x_mm"), labels_in_contact(one, "y_mm")]).astype(float)
    board = draw_board(scene.boards["sleeve"].design, scene.spreads, seed=1, name="v0")
    rule = scene.boards["sleeve"].quadrature.in_si()
    skin = draw_skin(scene.skin, scene.spreads, seed=1, name="v0_s0", rule=rule, sides_m=(50.8e-3, 101.6e-3))
    pokes_m = np.column_stack([place_mm - (25.4, 50.8), labels_in_contact(one, "depth_mm")]) * 1e-3
    _, changes_T = changes_of_field(board, skin, pokes_m)
    truth_uT = 1e6 * np.einsum("kij,klj,nkl->nki", board.sensitivity, board.turn, changes_T)
    b_uT = one.b_uT.astype(np.float64).reshape(-1, FRAMES_N, 40, 3)
    # The tolerance is one step of z, because two readings are rounded. The rounding of labels to single precision (4
    # nm) is negligible.
    assert np.abs(b_uT[:, READ] - b_uT[:, 1:2] - truth_uT[:, None]).max() < 0.75


def test_hand_pokes_have_fields_but_no_labels():
    one = capture_of(with_protocol("hand", HAND), "hand")
    for name in ("x_mm", "y_mm", "depth_mm", "Fx_N", "Fy_N", "Fz_N"):
        assert np.isnan(labels_in_contact(one, name)).all()
    np.testing.assert_array_equal(labels_in_contact(one, "pass_i"), np.repeat([0, 1, 2], 4))
    assert one.name == "b0_s0-hand"
    change_uT = np.linalg.norm(
        (frames_by_indentation(one)[:, READ] - frames_by_indentation(one)[:, 1:2]).mean(axis=1).reshape(12, 15), axis=1
    )
    # Noise alone would give 13 uT: it is a difference of two readings in 15 channels, averaged over 3.
    assert change_uT.min() > 30


def aged_capture(**changes):
    grid = GRID | {"terms": list(changes)}
    return with_protocol("grid", grid, terms=changes)


def test_ageing_softens_the_skin_and_moves_its_no_load_field(capture):
    old = capture_of(aged_capture(ageing=AGEING))
    ratio = labels_in_contact(old, "Fz_N")[-65:] / labels_in_contact(capture, "Fz_N")[-65:]
    # Contact 227 is in the middle of the last 65 contacts. There, the remaining force is 1 - 0.1 (1 - exp(-227/300)) -
    # 0.01 log10(1.227) = 0.946.
    assert np.median(ratio) == pytest.approx(0.946, abs=0.005)
    drift_uT = (frames_by_indentation(old)[:, 1:5].mean(axis=1) - frames_by_indentation(capture)[:, 1:5].mean(axis=1))[
        -1
    ]
    assert np.abs(drift_uT).max() > 5
    early_uT = (frames_by_indentation(old)[:, 1:5].mean(axis=1) - frames_by_indentation(capture)[:, 1:5].mean(axis=1))[
        0
    ]
    # Without drift, there would only be the noise of a difference of two means, each of two readings with 5 uT of
    # noise. The limit is three standard deviations of this noise.
    assert np.abs(early_uT).max() < 12


def test_relaxation_lowers_only_the_force(capture):
    slack = capture_of(aged_capture(relaxation=RELAXATION))
    ratio = np.median(labels_in_contact(slack, "Fz_N")[65:130] / labels_in_contact(capture, "Fz_N")[65:130])
    # After 1 s, the two fastest terms of the relaxation (0.05 each) and at most a tenth of the third term have relaxed.
    assert 0.88 < ratio < 0.91
    assert np.array_equal(slack.b_uT, capture.b_uT)


def test_warming_raises_chip_temperatures_and_weakens_the_field(capture):
    warm = capture_of(aged_capture(temperature=TEMPERATURE))
    assert warm.temperature_degC[-50:].mean() - warm.temperature_degC[:50].mean() == pytest.approx(2.3, abs=0.3)
    before_uT, after_uT = (frames_by_indentation(one)[-40:, 1:5].mean(axis=(0, 1)) for one in (capture, warm))
    change_uT = np.abs(after_uT).sum() - np.abs(before_uT).sum()
    # Chips have constant offsets with a standard deviation of 200 uT. This is the expected sum of their magnitudes over
    # 15 channels, because the mean of |normal| is 0.8.
    offset = 5 * 3 * 200 * 0.8
    assert change_uT == pytest.approx(-0.0012 * 2.5 * np.abs(before_uT).sum(), abs=0.003 * offset)


def test_adding_boards_skins_or_protocols_does_not_change_other_captures(capture):
    boards = {"rigid": SECTIONS["boards"]["rigid"] | {"boards_n": 3, "skins_per_board_n": 5}}
    more = with_protocol("hand", HAND, boards=boards)
    assert set(list_captures(synthesis(), "grid")) < {(f"b{b}", f"b{b}_s{s}") for b in range(3) for s in range(5)}
    assert same(capture, capture_of(more))


@pytest.mark.parametrize(
    ("protocol", "changes", "message"),
    [
        (GRID | {"skins_n": 5}, {}, "skins_n 5 is more than the 4 skins of rigid boards"),
        (GRID | {"boards": "soft"}, {}, "boards must be one of .'rigid'., not 'soft'"),
        (GRID | {"terms": ["ageing"]}, {}, "terms must be those that the protocols list"),
        (GRID, {"terms": {"ageing": AGEING}}, "terms must be those that the protocols list"),
        (HAND | {"depth_mm": (1.2, 0.4)}, {}, "must list the smaller depth first"),
        (HAND | {"tilt_sd_deg": 5.0}, {}, "a tilted stylus .tilt_sd_deg. needs the term friction"),
        (DRAG | {"terms": []}, {}, "protocol other: a drag needs the term friction"),
        (LOAD | {"passes_n": 1}, {}, "protocols.other.passes_n must be greater than or equal to 2; got 1"),
    ],
)
def test_contradictory_scene_is_refused(protocol, changes, message):
    with pytest.raises(ParamsError, match=message):
        with_protocol("other", protocol, **changes)


def test_depth_beyond_the_skin_is_refused():
    with pytest.raises(ParamsError, match="depth must be"):
        capture_of(with_protocol("deep", GRID | {"depths_mm": (2.5,)}), "deep")
