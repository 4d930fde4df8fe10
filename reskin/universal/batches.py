"""Skins on which networks of the universal model are trained, and random batches of their presses.

A batch has presses on some skins. For each skin, an error of the law (`reskin.universal.law`) is drawn at random, and
so are the presses on which the network is conditioned. `reskin.universal.training` trains on these batches. This module
does not import PyTorch, because that import takes a second.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Float32
from pydantic import Field

from reskin.config import Strict
from reskin.universal.law import Law, Setup
from reskin.universal.map import Residual
from reskin.universal.network import LOG_N, PLACE_MM
from reskin.universal.population import DEFAULT_FORCES, PLACES_N, PRESSES_N, Forces, Population

SKINS_PER_STEP_N, RECORDED_PER_STEP_N = 10, 2  # number of skins per step, and of recorded skins among them, if any
NO_PRESSES_SHARE = 0.25  # fraction of skins for which the network is conditioned on no press; for others, on 1 to 65
NOISE_uT = (3.3, 3.3, 5.0)  # standard deviation of a reading's noise along x, y and z
RESIDUAL_SCALE_MAX = 2.0  # the residual from recorded boards is multiplied by a random factor between 0 and this value
# Ranges from which the law's relative rms error is drawn: for simulated skins of a prior made with known boards, for
# simulated skins of the nominal prior, and for recorded boards.
ERROR_OF_RIG, ERROR_OF_NOMINAL, ERROR_OF_RECORDED = (0.1, 0.4), (0.1, 0.5), (0.15, 0.15)
ERROR_MM, ERROR_LOG_N, ERROR_WAVES_N = (2.5, 5.0), 1.2, 48  # the error's scales in place and log F; number of cosines
NOMINAL_NAME = "nominal"  # name of the prior that uses no recorded board


class TrainingSettings(Strict):
    """Numbers of simulated skins, of training steps, and of networks."""

    skins_n: Annotated[int, Field(ge=1, le=100_000)]
    steps_n: Annotated[int, Field(ge=2, le=1_000_000)]
    seeds_n: Annotated[int, Field(ge=1, le=20)]


@dataclass(frozen=True)
class RecordedBoard:
    """Readings of a recorded board in the board's frame and axes, with the same number of readings for each press."""

    db_uT: Float32[np.ndarray, "m r ch"]
    rest_uT: Float32[np.ndarray, " ch"]
    place_mm: Float32[np.ndarray, "m 2"]
    force_N: Float32[np.ndarray, "m r"]


@dataclass(frozen=True)
class SkinPrior:
    """Distribution of the skins that networks are trained on.

    Skins are simulated with parameters around those of a central law. If boards of the rig were recorded, `recorded`
    has their readings, and `residual` predicts the law's errors on a new skin from its errors on these boards.
    follows_law: True if skins follow the law exactly, as in a simulated scene; no errors of the law are then added.
    forces: distribution of the forces.
    """

    name: str
    centre: Law
    spreads: Mapping[str, float]
    setup: Setup
    recorded: Sequence[RecordedBoard] = ()
    residual: Residual | None = None
    follows_law: bool = False
    forces: Forces = DEFAULT_FORCES


@dataclass(frozen=True)
class Batch:
    """Skins of one training step, with the presses on each skin.

    The first `PLACES_N` presses of a skin serve for conditioning: the network is conditioned on those for which `kept`
    is 1. The network is trained to predict `target` (scaled x, y and log F) for the other presses.
    """

    db_uT: Float32[np.ndarray, "b m ch"]
    rest_uT: Float32[np.ndarray, "b ch"]
    target: Float32[np.ndarray, "b q 3"]
    kept: Float32[np.ndarray, "b c"]


class Batches:
    """Draws the batches of a training run."""

    def __init__(self, skins: Population, prior: SkinPrior) -> None:
        self.skins, self.recorded = skins, prior.recorded
        self.log_N = np.log(skins.force_N)
        self.residual_uT = None if prior.residual is None else residual_uT(skins, prior.residual)
        self.error = ERROR_OF_NOMINAL if prior.residual is None else ERROR_OF_RIG
        if prior.follows_law:
            self.error = 0.0, 0.0

    def draw(self, rng: np.random.Generator) -> Batch:
        """Draw simulated skins, and recorded skins if there are any, with noise and errors of the law."""
        recorded_n = RECORDED_PER_STEP_N if self.recorded else 0
        parts = [self._simulated(SKINS_PER_STEP_N - recorded_n, rng)]
        if recorded_n:
            parts.append(self._recorded(recorded_n, rng))
        db_uT, rest_uT, place_mm, log_N = (np.concatenate(part) for part in zip(*parts, strict=True))
        noise_uT = np.tile(np.array(NOISE_uT, np.float32), db_uT.shape[-1] // len(NOISE_uT))
        db_uT = db_uT + noise_uT * rng.standard_normal(db_uT.shape, np.float32)
        target = np.concatenate([place_mm / PLACE_MM, log_N[..., None] / LOG_N], axis=-1)[:, PLACES_N:]
        return Batch(db_uT, rest_uT, target, draw_kept(len(db_uT), rng))

    def _simulated(self, n: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
        i = rng.integers(len(self.skins), size=n)
        db_uT, place_mm, log_N = self.skins.db_uT[i], self.skins.place_mm[i], self.log_N[i]
        if self.residual_uT is not None:
            db_uT = db_uT + RESIDUAL_SCALE_MAX * rng.random((n, 1, 1), np.float32) * self.residual_uT[i]
        return add_error(db_uT, place_mm, log_N, self.error, rng), self.skins.rest_uT[i], place_mm, log_N

    def _recorded(self, n: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
        drawn = [draw_recorded(self.recorded[int(rng.integers(len(self.recorded)))], rng) for _ in range(n)]
        db_uT, rest_uT, place_mm, log_N = (np.stack(part) for part in zip(*drawn, strict=True))
        return add_error(db_uT, place_mm, log_N, ERROR_OF_RECORDED, rng), rest_uT, place_mm, log_N


def draw_recorded(board: RecordedBoard, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Draw 130 presses of a recorded board (some repeatedly if the board has fewer), and one reading of each press."""
    press = np.resize(rng.permutation(len(board.db_uT)), PRESSES_N)
    reading = rng.integers(board.db_uT.shape[1], size=PRESSES_N)
    return board.db_uT[press, reading], board.rest_uT, board.place_mm[press], np.log(board.force_N[press, reading])


def draw_kept(n: int, rng: np.random.Generator) -> Float32[np.ndarray, "n c"]:
    """Draw which presses of each skin the network is conditioned on (1: yes, 0: no).

    A fraction `NO_PRESSES_SHARE` of the skins has no such press; the others have 1 to 65.
    """
    kept_n = np.where(rng.random(n) < NO_PRESSES_SHARE, 0, rng.integers(1, PLACES_N + 1, n))
    rank = rng.random((n, PLACES_N)).argsort(axis=1).argsort(axis=1)
    return (rank < kept_n[:, None]).astype(np.float32)


def add_error(
    db_uT: Float32[np.ndarray, "b m ch"],
    place_mm: Float32[np.ndarray, "b m 2"],
    log_N: Float32[np.ndarray, "b m"],
    size: tuple[float, float],
    rng: np.random.Generator,
) -> Float32[np.ndarray, "b m ch"]:
    """Add a random error of the law that is smooth in place and log F.

    Half of a channel's error is proportional to |dB| at its chip, half to |dB| over all chips. size: bounds between
    which the relative rms error of each skin is drawn uniformly.
    """
    skins_n, _, channels_n = db_uT.shape
    rms = rng.uniform(*size, (skins_n, 1, 1)).astype(np.float32)
    wave = rng.standard_normal((skins_n, 3, ERROR_WAVES_N), np.float32)
    wave[:, :2] /= rng.uniform(*ERROR_MM, (skins_n, 1, 1))
    wave[:, 2] /= ERROR_LOG_N
    coordinates = np.concatenate([place_mm, log_N[..., None]], axis=-1)
    phase = rng.uniform(0, 2 * np.pi, (skins_n, 1, ERROR_WAVES_N)).astype(np.float32)
    amplitude = rng.standard_normal((skins_n, ERROR_WAVES_N, channels_n), np.float32)
    unit = np.cos(coordinates @ wave + phase) @ amplitude * np.float32(np.sqrt(2 / ERROR_WAVES_N))  # unit variance
    chips = db_uT.reshape(*db_uT.shape[:2], -1, len(NOISE_uT))
    chip_scale = np.repeat(np.linalg.norm(chips, axis=-1), len(NOISE_uT), axis=-1) / np.sqrt(np.float32(len(NOISE_uT)))
    total_scale = np.linalg.norm(db_uT, axis=-1, keepdims=True) / np.sqrt(np.float32(channels_n))
    return db_uT + rms * unit * 0.5 * (chip_scale + total_scale)


def residual_uT(skins: Population, residual: Residual) -> Float32[np.ndarray, "s m ch"]:
    """Return the law's expected error in uT for each press of a population."""
    added = np.empty_like(skins.db_uT)
    for i in range(len(skins)):
        relative: Float[np.ndarray, "m ch"] = residual.at(skins.place_mm[i], np.log(skins.force_N[i]))
        added[i] = relative * np.linalg.norm(skins.db_uT[i], axis=1, keepdims=True)
    return added
