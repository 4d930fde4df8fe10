"""Stage logs: an SD card's log -> contacts, places and forces over time (section 6, dog shoe and glove).

A simulated log is scored, and read again as of a board that pitches in the earth's field, part of the quiet start.
Refuses to know how a contact is found and estimated (`estimates`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from scipy.constants import micro
from scipy.spatial.transform import Rotation

from pipeline.experiments.ambient.fields import Instrument, guessed_uT, seen_uT, take_board
from pipeline.experiments.answer import only, write_answer
from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.synthesis import synthesis_of
from reskin.live.contacts import Answers, contacts_n, describe, estimate, estimate_after, score_contacts, thin, truth_at
from reskin.models.trained import networks_without
from reskin.physics.ambient import EARTH_SIZE_T, EARTH_T
from reskin.recordings import probe
from reskin.recordings.header import LOG_FILE, PROBE_FILE
from reskin.recordings.ingest import read_header
from reskin.recordings.readers import sd_card
from reskin.seeds import rng_for

PITCHES_DEG = (0.0, 10.0, 20.0, 45.0)  # assumed: how far a shoe leans to either side, once a step
PERIOD_S = 1.0  # assumed, for a log with fewer than two contacts
TOLD = ("false_readings_n", "missed_readings_n", "mse_f_N2", "accuracy_pct", "spread")


@dataclass(frozen=True)
class Log:
    """A log of a board that keeps its place, its quiet start, and what was true of it."""

    t_s: Float64[np.ndarray, " f"]
    b_uT: Float32[np.ndarray, "f ch"]
    true: Float64[np.ndarray, "f 3"]  # NaN where nothing touches
    quiet_n: int


def turn_log(log: Log, own: Instrument, networks: Sequence[Answers], rng: np.random.Generator) -> list[dict[str, Any]]:
    """Let the board pitch by more and more after its quiet start; score it as it is, and less what a chip aside reads.

    `own.noise_uT` is that of one reading of the chip aside.
    """
    period_s = step_period_s(log.t_s, np.isfinite(log.true[:, 2]))
    told = []
    for pitch_deg in PITCHES_DEG:
        swing_rad = np.radians(pitch_deg) * swing(log.t_s, start_s=float(log.t_s[log.quiet_n - 1]), period_s=period_s)
        field_T = earth_T(swing_rad)
        added_uT = seen_uT(own.board, np.repeat(field_T[:, None], len(own.turn), axis=1))
        less_uT = added_uT - guessed_uT(own, field_T, rng)
        told.append(
            {"pitch_deg": pitch_deg} | _told(log, added_uT, networks)
            | {"reference_chip": _told(log, less_uT, networks)}
        )  # fmt: skip
    return told


def step_period_s(t_s: Float64[np.ndarray, " f"], touched: Bool[np.ndarray, " f"]) -> float:
    """Give the usual time from the start of one contact to that of the next."""
    starts_s = t_s[np.flatnonzero(np.diff(touched.astype(int), prepend=0) == 1)]
    return float(np.median(np.diff(starts_s))) if len(starts_s) > 1 else PERIOD_S


def swing(t_s: Float64[np.ndarray, " f"], *, start_s: float, period_s: float) -> Float64[np.ndarray, " f"]:
    """Give a sine that begins at `start_s`, and rest before."""
    return np.sin(2 * np.pi * np.maximum(t_s - start_s, 0) / period_s)


def earth_T(pitch_rad: Float64[np.ndarray, " f"]) -> Float[np.ndarray, "f 3"]:
    """Give the earth's field in the axes of a board that is turned about its y axis; at rest its x axis points north.

    Assumed: walking north, so that the whole field lies in the plane of turning. It is the worst way to go.
    """
    return Rotation.from_euler("y", pitch_rad[:, None]).inv().apply(EARTH_T)


def _told(log: Log, added_uT: Float[np.ndarray, "f ch"], networks: Sequence[Answers]) -> dict[str, Any]:
    found = estimate_after(log.quiet_n, log.t_s, (log.b_uT + added_uT).astype(np.float32), networks)
    scores = score_contacts(found, log.true)
    return {"contacts_n": contacts_n(found.contact)} | {name: scores[name] for name in TOLD if name in scores}


def turned(log: Log, board: str, settings: Settings, networks: Sequence[Answers]) -> dict[str, Any]:
    """Tell what the networks find in the log if its board turns in the earth's field."""
    of, seed = synthesis_of(settings), settings.seed
    noise_uT = np.array([of.chip.noise_xy_uT, of.chip.noise_xy_uT, of.chip.noise_z_uT])  # a log's readings are single
    own = replace(take_board(of, board, seed=seed), noise_uT=noise_uT)
    return {
        "turning": turn_log(log, own, networks, rng_for(seed, "logs", board, "aside")),
        "turning_period_s": step_period_s(log.t_s, np.isfinite(log.true[:, 2])),
        "earth_uT": EARTH_SIZE_T / micro,
    }


def logs(settings: Settings, raw: Path, models: Path, answer: Path) -> None:
    """Read a folder's walk with networks that never saw its board; score it where its truth is kept, and turn it."""
    folder = only(sorted(child for child in raw.iterdir() if child.is_dir()), raw)
    t_s, b_uT, _, account = sd_card.read_log(folder / LOG_FILE)
    board = read_header(folder).board
    networks = networks_without(models, board)
    found = estimate(t_s, b_uT, networks, where=str(folder / LOG_FILE))
    numbers, true = describe(found) | {"networks_n": len(networks), "account": account}, None
    if (folder / PROBE_FILE).is_file():
        log = probe.parse(folder / PROBE_FILE, str(folder / PROBE_FILE))
        known = np.stack([log.x_mm, log.y_mm, log.Fz_N], axis=1)
        known[~log.contact] = np.nan
        true = truth_at(t_s, log.t_start_s, log.t_end_s, known)
        numbers |= score_contacts(found, true) | turned(Log(t_s, b_uT, true, found.quiet_n), board, settings, networks)
    losses = {"accounts": [numbers["account"]], "left_out": {}}
    write_answer(answer, numbers, thin(found, true), losses)
    say(f"{settings.scene}: {numbers['contacts_n']} contacts in {numbers['duration_s']:.1f} s of log")
