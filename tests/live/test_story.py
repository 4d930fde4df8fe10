"""Test of the path from an emulated board to live estimates: emulate, record, add, run stages, open."""

import os
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from pipeline import plan
from reskin import io
from reskin.board.wire import Frames
from reskin.live.emulator import Script, encode_pieces
from reskin.models.trained import read_network
from reskin.recordings import clocks, probe
from reskin.recordings.header import ARRIVALS_FILE, HEADER_FILE, STREAM_FILE, parse, seal
from reskin.recordings.probe import ProbeLog
from reskin.seeds import rng_for
from tests.live.boards import RATE_HZ, play_to_skin, write_script
from tests.live.faults import inject
from tests.live.test_processes import Shell, wait_until
from tests.stages.checkout import copy_checkout, warm_stages

POKES_N, QUIET_S, DWELL_S = 30, 1.0, 0.3
CRLF = "crlf@2+1"
LABELS = ("--board", "b", "--skin", "s", "--scene", "pressed")
SCENE = {
    "source": "recorded", "seed": 1, "experiments": ["single_temporal"], "selection": {"force_min_N": 0.0},
    "split": {"temporal_test_fraction": 0.34},
    "train_single": {"recipe": "paper", "steps_n": 400, "seeds_n": 1, "variants": {}},
}  # fmt: skip
pytestmark = [pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo-terminals"), pytest.mark.timeout(900)]


def make_poke_script() -> tuple[Script, ProbeLog]:
    """Return a script of pokes on a grid with varying pauses, and the log of the robot.

    The clock of the robot is 100 s ahead.
    """
    rng = rng_for(0, "poked")
    starts_s = QUIET_S + np.cumsum(DWELL_S + rng.uniform(0.1, 0.25, POKES_N))
    place_mm, force_N = 4.0 * rng.integers(1, 4, (POKES_N, 2)), rng.uniform(0.5, 2.0, POKES_N)
    t_s = np.arange(round((starts_s[-1] + 1.0) * RATE_HZ)) / RATE_HZ
    poke_i = np.searchsorted(starts_s, t_s, "right") - 1
    poked = (poke_i >= 0) & (t_s < starts_s[poke_i] + DWELL_S)
    pushed = np.column_stack([place_mm - 8, np.full(POKES_N, 4.0)]) * force_N[:, None]
    change_uT = pushed @ (15 * rng.standard_normal((3, 15)))
    b_uT = 500 * rng.standard_normal(15) + 3 * rng.standard_normal((len(t_s), 15)) + poked[:, None] * change_uT[poke_i]
    step_uT = np.tile([0.15, 0.15, 0.242], 5)
    b_uT = (np.rint(b_uT / step_uT) * step_uT).astype(np.float32)
    temperature_degC = (25 + 0.02 * rng.standard_normal((len(t_s), 5))).astype(np.float32)
    frames = Frames(b_uT, temperature_degC, np.full(len(t_s), np.nan), np.zeros(len(t_s), np.int64))
    contact = np.tile([False, True], POKES_N)
    begin_s = 100 + np.column_stack([starts_s - 0.08, starts_s + 0.02]).ravel()
    x_mm, y_mm = np.repeat(place_mm, 2, axis=0).astype(np.float32).T
    Fz_N = np.where(contact, np.repeat(force_N, 2), 0).astype(np.float32)
    zero = np.zeros(2 * POKES_N, np.float32)
    log = ProbeLog(
        indentation=np.arange(2 * POKES_N, dtype=np.int32) // 2, pass_i=np.arange(2 * POKES_N, dtype=np.int32) // 20,
        contact=contact, t_start_s=begin_s, t_end_s=begin_s + np.where(contact, DWELL_S - 0.04, 0.08),
        x_mm=x_mm, y_mm=y_mm, depth_mm=np.full_like(zero, np.nan), Fx_N=zero, Fy_N=zero, Fz_N=Fz_N,
    )  # fmt: skip
    return Script("recorded", "binary", frames, encode_pieces(frames, "binary"), t_s), log


def write_punctual_arrivals(folder: Path, sent: Script) -> None:
    """Replace the recorded arrival times by those of a machine that causes no delays."""
    data, header = (folder / STREAM_FILE).read_bytes(), parse((folder / HEADER_FILE).read_text(), "header")
    first = b"".join(sent.pieces).find(data)
    assert first >= 0  # The recorded bytes are the last bytes that were sent.
    ends = np.cumsum([len(piece) for piece in sent.pieces]) - first
    received = (ends > 0) & (ends <= len(data))
    times = clocks.Arrivals(ends[received], 1e9 + sent.t_s[received])
    (folder / ARRIVALS_FILE).write_text(clocks.render(times))
    seal(folder, header)


def test_recorded_board_becomes_a_model_that_estimates_live(tmp_path):
    script, log = make_poke_script()
    root, link = copy_checkout(tmp_path / "checkout"), tmp_path / "board"
    (root / "robot.csv").write_text(probe.render(log))
    with (root / "pipeline/scenes/pressed.yaml").open("w") as stream:
        YAML().dump(SCENE, stream)
    plan.use(root, [])
    with closing(Shell(root)) as shell:
        sent = inject(script, CRLF)
        shell.start("emulate", write_script(sent, tmp_path / "c0"), "--port", link)
        wait_until(link.is_symlink)
        # This message means that the script has ended.
        assert "(unplugged after" in shell.run("record", "--port", link, "--out", "run1")
        write_punctual_arrivals(root / "run1", sent)
        shell.run("add", "run1", "--layout", "capture", "--probe", "robot.csv", *LABELS)
        shell.run("scenes", "use", "pressed")
    # tests/recordings/test_lab_story.py tests the report of a recorded scene.
    with warm_stages(root) as run_stages:
        run_stages("code", "ingest@pressed-run1", "split@pressed", "train_single@pressed")

    counts = io.read_ingest_counts(root / "data/indentations/pressed/run1.parquet")
    assert counts["logged_indentations_n"] == POKES_N
    assert counts["frames_n"] * 82 == counts["frame_bytes_n"]
    # When a terminal is opened or closed, bytes that wait there are discarded.
    assert counts["frames_n"] > 0.7 * len(script)
    model = min((root / "data/models/pressed/train_single").glob("*.safetensors"))
    _, readings = play_to_skin(script, [read_network(model)])
    t_s = np.concatenate([batch.t_s[batch.contact] for batch in readings])
    found = np.concatenate([batch.target[batch.contact] for batch in readings])
    assert len(found) > 0.8 * POKES_N * DWELL_S * RATE_HZ
    pressed = log.contact.nonzero()[0][np.searchsorted(log.t_start_s[log.contact] - 100, t_s + 0.1) - 1]
    true = np.column_stack([log.x_mm, log.y_mm, log.Fz_N])[pressed]
    # The limits are in mm, mm and N. The errors are small, because the network was trained on most of these presses.
    assert (np.median(np.abs(found - true), axis=0) < (1, 1, 0.2)).all()
