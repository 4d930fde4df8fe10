"""What a board is made to send is what was recorded: bytes, times, and a card's log too."""

import numpy as np
import pytest

from reskin.errors import ReskinError
from reskin.live.emulator import read_script
from reskin.recordings.header import LOG_FILE, Clock, write_capture
from reskin.recordings.readers.sd_card import render
from tests.live.boards import make_script, write_script
from tests.recordings.headers import make_header
from tests.stages.checkout import ROOT

SCRIPT = make_script(pokes_n=1)


@pytest.mark.parametrize("wire", ["binary", "binary-clock", "text-xyzt", "text-txyz"])
def test_a_recorded_capture_is_sent_byte_by_byte_at_its_times(tmp_path, wire):
    sent = make_script(pokes_n=1, wire=wire)
    write_script(sent, tmp_path / "c0")
    script = read_script(str(tmp_path / "c0"))
    assert script.pieces == sent.pieces
    np.testing.assert_allclose(script.t_s, SCRIPT.t_s, atol=1e-6)
    assert script.duration_s == pytest.approx(len(script) / 400)


def test_a_cards_log_is_sent_as_frames(tmp_path):
    frames = SCRIPT.frames
    log = render(1 + SCRIPT.t_s, frames.b_uT, frames.temperature_degC)
    header = make_header(capture="c0", layout="sd-card", clock=Clock(kind="recording", rate_hz=None, marks=()))
    write_capture(tmp_path / "c0", header, {LOG_FILE: log.encode()})
    script = read_script(str(tmp_path / "c0"))
    np.testing.assert_allclose(script.frames.b_uT, frames.b_uT, atol=0.006)  # two decimals
    np.testing.assert_allclose(script.t_s, SCRIPT.t_s, atol=1e-4)


@pytest.mark.parametrize("source", ["nominal", str(ROOT / "pipeline/scenes/ci.yaml")])
def test_a_simulated_scene_is_a_skin_that_is_poked(source):
    script = read_script(source)
    assert script.frames.b_uT.shape == (len(script), 15)
    assert np.all(np.diff(script.t_s) >= 0)
    assert np.ptp(script.frames.b_uT, axis=0).max() > 100  # uT


def test_what_is_neither_a_capture_nor_simulated_is_refused(tmp_path):
    for source in (str(tmp_path), "nowhere", str(ROOT / "pipeline/scenes/lab.yaml"), "../scenes/quick"):
        with pytest.raises(ReskinError, match="not the folder of a capture|not a simulated scene") as told:
            read_script(source)
        assert "Traceback" not in str(told.value)
