"""Helpers for tests of live boards.

They make scripts, which are the bytes and times of an emulated board. In a script, two pokes alternate. A model for
these pokes and readers of scripts are here as well.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from reskin import io
from reskin.board.wire import Frames, Wire
from reskin.live.emulator import Script, encode_pieces, make_port, play
from reskin.live.models import Models
from reskin.live.tracker import Estimates, LiveSkin
from reskin.models.network import draw_weights, paper_layers
from reskin.recordings import clocks
from reskin.recordings.header import ARRIVALS_FILE, STREAM_FILE, Clock, write_capture
from reskin.seeds import rng_for
from tests.recordings.headers import make_header

RATE_HZ = 400.0
QUIET_S, POKE_S = 1.5, 1.0
PAUSE_S = 2.0
# These are the places x and y (mm) and the forces (N) of the two pokes, which alternate.
PLACES = np.array([[4.0, 12.0, 0.8], [12.0, 4.0, 1.6]])
INPUT_SCALE_uT = 300.0


def make_script(
    *, pokes_n: int = 2, chips_n: int = 5, wire: Wire = "binary", rate_hz: float = RATE_HZ, quiet_s: float = QUIET_S
) -> Script:
    """Return a script: no contact at first, then pokes with pauses.

    The noise is 3 uT, and the steps of readings are 0.15 uT (x, y) and 0.242 uT (z).
    """
    frames_n = round((quiet_s + pokes_n * (POKE_S + PAUSE_S)) * rate_hz)
    t_s, rng = np.arange(frames_n) / rate_hz, rng_for(0, "board")
    poke_i, since_s = np.divmod(t_s - quiet_s, POKE_S + PAUSE_S)
    poked = (t_s >= quiet_s) & (since_s < POKE_S)
    b_uT = 500.0 * rng.standard_normal((chips_n, 3)) + 3 * rng.standard_normal((frames_n, chips_n, 3))
    b_uT[poked] += changes_uT(chips_n)[poke_i[poked].astype(int) % 2].reshape(-1, chips_n, 3)
    step_uT = np.array([0.15, 0.15, 0.242])
    b_uT = (np.rint(b_uT / step_uT) * step_uT).reshape(frames_n, -1).astype(np.float32)
    temperature_degC = (25 + 0.02 * rng.standard_normal((frames_n, chips_n))).astype(np.float32)
    frames = Frames(b_uT, temperature_degC, t_s.astype(np.float32).astype(np.float64), np.zeros(frames_n, np.int64))
    return Script("recorded", wire, frames, encode_pieces(frames, wire), t_s)


def changes_uT(chips_n: int) -> np.ndarray:
    """Return the field changes of the two pokes [2 ch].

    The field changes differ from chip to chip, unlike field changes by a distant magnet.
    """
    return 200.0 * rng_for(1, "pokes").standard_normal((2, 3 * chips_n))


def write_model(folder: Path, name: str = "model", *, off_mm: float = 0.0, chips_n: int = 5) -> Path:
    """Write a linear network.

    For the two pokes, its predictions are exact, except for an offset of `off_mm` along x.
    """
    # These are the weights of a linear model that computes place and force from the channels, as an array [3 ch].
    linear = np.linalg.lstsq(changes_uT(chips_n) / INPUT_SCALE_uT, PLACES - (off_mm, 0, 0), rcond=None)[0].T
    weights = {key: 0 * value for key, value in draw_weights(paper_layers(3 * chips_n), rng_for(0, "net")).items()}
    # ReLUs set negative values to 0. To keep negative values, each value is passed through the layers twice: once
    # unchanged and once with the opposite sign.
    weights["layer1.weight"][:6] = np.concatenate([linear, -linear])
    for layer_i in range(2, 6):
        weights[f"layer{layer_i}.weight"][:6, :6] = np.eye(6)
    weights["layer6.weight"][:, :6] = np.hstack([np.eye(3), -np.eye(3)])
    scaler = {"input_shift": np.zeros(3 * chips_n), "input_scale": np.full(3 * chips_n, INPUT_SCALE_uT)}
    scaler |= {"target_shift": np.array([off_mm * 2, 0, 0]), "target_scale": np.ones(3)}
    tensors = weights | {key: value.astype(np.float32) for key, value in scaler.items()}
    card_input = {"quantity": "change of field", "unit": "uT", "channels_n": 3 * chips_n}
    card = {
        "format": "reskin-model/3", "scene": "quick", "recipe": {"inputs": "raw", "architecture": "paper"},
        "input": card_input, "output": {"x_mm": "mm", "y_mm": "mm", "Fz_N": "N"}, "collapsed": False,
    }  # fmt: skip
    io.write_model(folder / f"{name}.safetensors", tensors, card)
    return folder / f"{name}.safetensors"


def write_script(script: Script, folder: Path) -> Path:
    """Write the bytes of a script to a folder, as `reskin record` does."""
    ends = np.cumsum([len(piece) for piece in script.pieces])
    files = {
        STREAM_FILE: b"".join(script.pieces),
        ARRIVALS_FILE: clocks.render(clocks.Arrivals(ends, 5 + script.t_s)).encode(),
    }
    clock = Clock(kind="arrivals", rate_hz=None, marks=())
    chips_n = script.frames.temperature_degC.shape[1]
    header = make_header(capture=folder.name, layout="native", wire=script.wire, chips_n=chips_n, clock=clock)
    write_capture(folder, header, files)
    return folder


class ScriptReader:
    """A reader that returns the bytes of a script, with the times of the script. It needs no port and no thread.

    Results therefore do not depend on the load of the machine.
    """

    plugged_in, was_plugged_in, problem, missed_bytes_n, taken_s = True, True, "", 0, 0.0

    def __init__(self, script: Script, *, frames_n: int = 20) -> None:
        self._script, self._frames_n, self._i = script, frames_n, 0

    def start(self, *, must_exist: bool) -> None:
        """Do nothing: there is no port to open."""

    def stop(self) -> None:
        """Do nothing: there is no port to close."""

    @property
    def at_end(self) -> bool:
        return self._i >= len(self._script)

    def unix_s(self) -> float:
        return float(self._script.t_s[min(self._i, len(self._script) - 1)])

    def take(self, _wait_s: float) -> list[tuple[bytes, float]]:
        pieces = self._script.pieces[self._i : self._i + self._frames_n]
        self._i += len(pieces)
        return [(b"".join(pieces), self.unix_s())] if pieces else []


def play_to_skin(script: Script, models: Models = ()) -> tuple[LiveSkin, list[Estimates]]:
    """Play a script to a skin as fast as possible. Return the skin and all its estimates."""
    skin, estimates = LiveSkin("played", models), []
    skin.reader = reader = ScriptReader(script)
    while not reader.at_end:
        if (found := skin.poll(0.0)) is not None:
            estimates.append(found)
    return skin, estimates


def zero_requests(monkeypatch) -> list[LiveSkin]:
    """Return a list to which each call of `LiveSkin.zero` appends its skin.

    Tests use the list, because the page may show "zeroing" too briefly to be seen.
    """
    zeroed, zero = [], LiveSkin.zero
    monkeypatch.setattr(LiveSkin, "zero", lambda skin: (zero(skin), zeroed.append(skin)))
    return zeroed


class FailingModel:
    """A model that raises an unexpected error at the first contact."""

    channels_n, name = 15, "a model that raises"

    def set_noload(self, b_uT: np.ndarray) -> None:
        """Accept any no-load reading."""

    def describe(self, model_name: str) -> dict[str, str]:
        return {"model": model_name}

    def __call__(self, db_uT: np.ndarray) -> None:
        raise RuntimeError("out of memory")


@contextmanager
def plugged_in(script: Script, port: str = "pty", **options: object) -> Iterator[str]:
    """Play a script on a pseudo-terminal, and yield the name of its port."""
    end, stop = make_port(port), threading.Event()
    player = threading.Thread(target=play, args=[script, end, stop], kwargs=options)
    player.start()
    try:
        yield end.name
    finally:
        stop.set()
        player.join()
        end.unplug()
