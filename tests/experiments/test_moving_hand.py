"""Tests of experiment moving_hand, which studies touches while a hand moves in magnetic fields.

The tests check the external fields, their compensation, thresholds for contacts, places, and the whole stage.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pipeline.training.universal_variants import Frame

from pipeline.experiments import moving_hand as hand
from pipeline.experiments.compare import chip_rotations
from pipeline.experiments.moving_hand import FIRST_HALF, MAGNET, NO_FIELD, OTHER, TURNED, MovingHand, Pad
from pipeline.settings import read_settings
from pipeline.stages.ingest import ingest
from reskin import io
from reskin.config import parse
from reskin.data.contact import CONTACT_SDS, magnitudes_uT
from reskin.errors import ParamsError
from reskin.physics import external
from reskin.recordings.header import HEADER_FILE, render
from reskin.recordings.readers import leaphand
from reskin.recordings.readers.lab import READINGS
from reskin.seeds import rng_for
from reskin.universal.law import CHIPS_MM, to_board
from reskin.universal.model import load_universal
from reskin.universal.population import grid
from tests.recordings.headers import make_header
from tests.recordings.readers.test_leaphand import numbers as leaphand_rows
from tests.universal.skins import poked_uT

ROOT = Path(__file__).resolve().parents[2]
SECTION = read_settings("hand", ROOT).section(MovingHand, "moving_hand")
NOISE_uT = 4.0


def pad_of(db_uT: np.ndarray, joint_counts: np.ndarray | None = None) -> Pad:
    joints = np.zeros((len(db_uT), 8)) if joint_counts is None else joint_counts
    return Pad(db_uT + NOISE_uT * rng_for(1, "moving hand", len(db_uT)).standard_normal(db_uT.shape), joints, NOISE_uT)


# --- External fields ---


def test_estimated_distance_and_field_of_the_magnet_equal_the_simulated_ones():
    cov = external.covariance(np.array(CHIPS_MM), 100.0, 60.0)
    rng = rng_for(0, "moving hand", "source")
    db_uT = rng.multivariate_normal(np.zeros(15), cov, 2000, method="eigh") + NOISE_uT * rng.standard_normal((2000, 15))
    assert hand.find_source(db_uT, NOISE_uT) == (60.0, 100.0)


def test_uniform_field_has_the_same_length_after_the_board_is_turned():
    changes_uT = to_board(hand.turn(50.0, 3000, rng_for(0, "turn"))).reshape(-1, 5, 3)
    np.testing.assert_allclose(changes_uT, np.repeat(changes_uT[:, :1], 5, axis=1), atol=1e-9)
    # After the turn, the fields have random directions, so their mean is 0 and the mean change is minus the first
    # field.
    start_uT = -changes_uT[:, 0].mean(axis=0)
    # The standard error of each component is 50 / sqrt(3 x 3000) = 0.5 uT.
    assert np.linalg.norm(start_uT) == pytest.approx(50, abs=3)
    np.testing.assert_allclose(np.linalg.norm(changes_uT[:, 0] + start_uT, axis=1), 50, atol=3)


def test_field_of_a_moved_magnet_has_the_stated_size_at_the_board():
    changes_uT = to_board(hand.move_magnet(140.0, (40.0, 40.0), 20_000, rng_for(0, "magnet"))).reshape(-1, 5, 3)
    # All changes start from the same field, so their standard deviation is that of the later fields.
    sd_uT = changes_uT.std(axis=0)
    # The first chip is at the centre of the board. The standard error is below 1 %.
    np.testing.assert_allclose(sd_uT[0], 140, rtol=0.03)
    # Outer chips can be nearer to the magnet, so their fields are larger.
    assert (sd_uT[1:].mean(axis=1) > sd_uT[0].mean()).all()


# --- Contacts ---


@pytest.mark.parametrize("external_uT", [0.0, 100.0])
def test_contact_threshold_equals_that_of_the_live_page(external_uT):
    readings_uT = NOISE_uT * rng_for(0, "live").standard_normal((4000, 15))
    matrix = load_universal(external_uT=external_uT).suppressor(NOISE_uT)
    live_uT = np.median(magnitudes_uT(readings_uT, matrix)) + CONTACT_SDS * NOISE_uT
    # The live page computes the noise from a median, which is up to 1.5 % below the root mean square.
    assert hand.live_threshold(NOISE_uT, matrix) == pytest.approx(live_uT, rel=0.02)


@pytest.mark.parametrize("learner", ["ridge", "boosting"])
@pytest.mark.parametrize("trained_on", [OTHER, FIRST_HALF])
def test_compensation_by_joint_angles_removes_fields_that_depend_on_them(learner, trained_on):
    rng = rng_for(0, "moving hand", learner)
    slopes = rng.normal(size=15)
    pads = []
    for _ in range(2):
        joints = np.full((300, 8), 2000.0)
        joints[:, 1] += rng.uniform(0, 500, 300)
        pads.append(pad_of(joints[:, 1:2] / 5 * slopes, joints))
    threshold, tested = hand.compensate(learner, trained_on, (pads[0], pads[1]), 30)
    assert (len(threshold.db_uT), len(tested.db_uT)) == (150, 150)
    rms_uT = np.sqrt((tested.db_uT**2).mean())
    assert rms_uT < (1.1 if learner == "ridge" else 3) * NOISE_uT < pads[1].db_uT.std() / 3


def test_option_for_external_fields_removes_false_contacts_and_keeps_true_ones():
    rng = rng_for(0, "moving hand", "contacts")
    cov = external.covariance(np.array(CHIPS_MM), 100.0)
    pairs = [
        tuple(pad_of(hand.to_chips(rng.multivariate_normal(np.zeros(15), cov, 300, method="eigh"))) for _ in range(2))
    ]
    touches_uT = 400 * rng.standard_normal((500, 15))
    off, on = (hand.count_contacts(pairs, touches_uT, uT, SECTION, rng_for(0, "draws")) for uT in (0.0, 100.0))
    assert off["live_false_pct"] > 90
    assert on["live_false_pct"] < 5
    for row in (off, on):
        for part, scale in zip(row["thresholds"], SECTION.touch_scales, strict=True):
            assert part["touch_scale"] == scale
            # The tolerance is four standard errors of a 99 % quantile of 500 values (0.45 % each).
            assert part["detected_pct"] == pytest.approx(99, abs=1.8)
    still = [(pad_of(np.zeros((300, 15))), pad_of(np.zeros((300, 15))))]
    assert hand.count_contacts(still, touches_uT, 0.0, SECTION, rng_for(0, "draws"))["live_false_pct"] == 0


def test_groups_with_unknown_captures_or_unequal_numbers_of_them_are_refused():
    pads = {"a": pad_of(np.zeros((10, 15)))}
    group = hand.Group(name="one", threshold=("a",), tested=("b",))
    with pytest.raises(ParamsError, match=r"groups: one: no capture b of layout leaphand in the scene \(it has: a\)"):
        hand.pairs_of(group, pads)
    with pytest.raises(ParamsError, match="1 captures in threshold, but 2 in tested"):
        hand.pairs_of(group.model_copy(update={"tested": ("a", "a")}), pads)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"pad_chips": [0, 1, 2, 3, 3]}, "pad_chips must contain each number from 0 to 4 once"),
        ({"magnet_mm": [80.0, 40.0]}, "magnet_mm must contain the smallest distance, then the largest distance"),
        (
            {"groups": 2 * [SECTION.groups[0].model_dump()]},
            "groups must have different names, and none may be called none",
        ),
    ],
)
def test_settings_that_contradict_each_other_are_refused(change, expected):
    with pytest.raises(ParamsError, match=expected):
        parse(MovingHand, SECTION.model_dump(mode="json") | change, "moving_hand")


def test_scene_without_recordings_of_presses_is_refused():
    with pytest.raises(ParamsError, match="no recordings of presses.* reskin fetch lab --scene hand"):
        hand.read_boards(read_settings("hand", ROOT), SECTION.presses, [])


# --- The whole stage ---


COLUMNS = ["indent", "phase", "x_mm", "y_mm"]
COLUMNS += [f"{name}{chip}" for chip in range(5) for name in ("T", "Bx", "By", "Bz")] + ["Fx", "Fy", "Fz"]


def write_capture(folder: Path, frame: Frame, board: str, force_N: float) -> None:
    """Write a synthetic recording in the layout `lab`, with one press at each place of the grid.

    It has noise, but no drift.
    """
    rng, place_mm = rng_for(0, board, force_N), grid()
    number = {"board1": np.array([0.5, -0.5, 0.3]), "board2": np.array([-0.5, 0.2, -0.3])}[board]
    force_N = force_N * rng.uniform(0.8, 1.2, len(place_mm))
    change_uT = poked_uT(place_mm, force_N, number).reshape(-1, 5, 3)
    # Fields are rotated from the axes of the board to those of the chips.
    change_uT = np.einsum("kji,nkj->nki", frame.turn, change_uT)
    lines = [",".join(COLUMNS)]
    for i, (label_mm, force) in enumerate(zip(frame.label(place_mm), force_N, strict=True)):
        for phase in ["noload"] * 3 + ["contact"] * 2:
            pressed = float(phase == "contact")
            b_uT = pressed * change_uT[i] + 100 * np.arange(15).reshape(5, 3) + 4 * rng.standard_normal((5, 3))
            fields = [f"21.5,{','.join(f'{value:.3f}' for value in chip_uT)}" for chip_uT in b_uT]
            forces = f"{0.1 * pressed * label_mm[0]:.3f},{0.02 * pressed * i:.3f},{-pressed * force:.3f}"
            lines.append(f"{i},{phase},{label_mm[0]:g},{label_mm[1]:g},{','.join(fields)},{forces}")
    folder.mkdir(parents=True)
    (folder / READINGS).write_text("\n".join(lines) + "\n")
    header = make_header(capture=folder.name, board=board, skin=f"skin of {board}".replace(" ", "-"))
    (folder / HEADER_FILE).write_text(render(header))


def write_pad(folder: Path, pad: int) -> None:
    rows = leaphand_rows(30)
    rows[6:, :30] += 300 * np.sin(np.arange(24)[:, None] / 9 + np.arange(30))
    folder.mkdir(parents=True)
    np.savetxt(folder / leaphand.READINGS, rows)
    options = {"pad": str(pad)}
    header = make_header(capture=folder.name, board=f"pad{pad}", skin=f"skin{pad}", layout="leaphand", options=options)
    (folder / HEADER_FILE).write_text(render(header))


def test_whole_stage_runs_on_synthetic_recordings(tmp_path):
    settings = read_settings("hand", ROOT)
    presses = SECTION.presses
    frame = Frame(chip_rotations(presses), presses.labels_middle_mm, presses.labels_mirrored)
    for force_N in (1.0, 4.0):
        write_capture(tmp_path / "raw" / f"board1_{force_N:g}N", frame, "board1", force_N)
    for name in ("first", "second"):
        write_pad(tmp_path / "raw" / name, 1)
    settings = replace(settings, captures=())
    for folder in (tmp_path / "raw").iterdir():
        ingest(settings, folder, tmp_path / "indentations" / f"{folder.name}.parquet")
    group = hand.Group(name="pads", threshold=("first",), tested=("second",))
    few = {"boosting_iterations_n": 2, "draws_n": 1, "readings_n": 20, "skins_n": 2, "changes_n": 20}
    options = {"external_uT": (0.0, 140.0), "compensated_uT": (0.0,), "places_uT": (0.0, 140.0), "labels_n": (0, 4)}
    section = SECTION.model_copy(update={"groups": (group,), **options, **few})
    hand.moving_hand(settings, section, tmp_path / "raw", tmp_path / "indentations", tmp_path / "results.json")
    numbers = io.read_json(tmp_path / "results.json")["numbers"]
    assert [row["capture"] for row in numbers["recordings"]] == ["first", "second"]
    assert [row["rows_n"] for row in numbers["recordings"]] == [24, 24]
    # There is a row for each of two values of the option, and for each of two learners trained on each of two kinds of
    # data.
    assert len(numbers["contacts"]) == 2 + 2 * 2
    by_field = {
        (row["field"], row["external_uT"], row["labels_n"]): row["mse_xy_mm2"]["mean"]
        for row in numbers["superposed_places"]
    }
    assert set(by_field) == {(field, uT, n) for field in (NO_FIELD, "pads") for uT in (0.0, 140.0) for n in (0, 4)}
    assert by_field["pads", 0.0, 4] > by_field[NO_FIELD, 0.0, 4]
    simulated = {(row["field"], row["external_uT"]): row for row in numbers["simulated_contacts"]}
    assert set(simulated) == {(field, uT) for field in (NO_FIELD, TURNED, MAGNET) for uT in (0.0, 140.0)}
    assert simulated[NO_FIELD, 0.0]["live_false_pct"] == 0
    assert simulated[MAGNET, 140.0]["live_false_pct"] < simulated[MAGNET, 0.0]["live_false_pct"]
    shown = hand.tables(numbers, "recorded")
    kinds = {name: set(table["source"]) for name, table in shown.items()}
    assert kinds == {
        "moving_hand_recordings": {"recorded"}, "moving_hand": {"recorded"}, "moving_hand_detection": {"superposed"},
        "moving_hand_simulated": {"simulated"}, "moving_hand_places": {"recorded", "superposed"},
        "moving_hand_places_simulated": {"simulated"},
    }  # fmt: skip
    assert hand.figures(numbers, {}, "recorded")["moving_hand.svg"].startswith("<?xml")
