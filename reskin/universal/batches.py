"""Random batches of presses, on which the networks of the universal model are trained.

A batch contains presses on several skins, most of them simulated. The simulation (the law, `reskin.universal.law`) does
not describe real skins exactly. Therefore, a random error of the law is drawn for each skin and added to its field
changes. The presses on which the network is conditioned are also drawn at random. `reskin.universal.training` trains on
these batches. This module does not import PyTorch, because that import takes a second.
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

# Number of skins in the batch of each training step. If there are recorded skins, the second number of them is among
# the skins of a batch.
SKINS_PER_STEP_N, RECORDED_PER_STEP_N = 10, 2
# For this fraction of the skins, the network is conditioned on no press. For the other skins, it is conditioned on 1 to
# 65 presses.
NO_PRESSES_SHARE = 0.25
NOISE_uT = (3.3, 3.3, 5.0)  # standard deviations of a reading's noise along x, y and z
# The error of the law that is expected from recorded boards is multiplied by a random factor between 0 and this value.
RESIDUAL_SCALE_MAX = 2.0
# Ranges of the relative rms error of the law, from which the error of each skin is drawn. The first range is for
# simulated skins if recorded boards of the same rig are known. The second range is for simulated skins if no board is
# known, and the third range is for recorded boards.
ERROR_OF_RIG, ERROR_OF_NOMINAL, ERROR_OF_RECORDED = (0.1, 0.4), (0.1, 0.5), (0.15, 0.15)
# The random error of the law is a sum of cosine waves: range of its length scale in place, its length scale in log
# force, and number of waves.
ERROR_MM, ERROR_LOG_N, ERROR_WAVES_N = (2.5, 5.0), 1.2, 48
NOMINAL_NAME = "nominal"  # name of the prior that uses no recorded board


class TrainingSettings(Strict):
    """Settings of a training run: numbers of simulated skins, of training steps, and of networks (one per seed)."""

    skins_n: Annotated[int, Field(ge=1, le=100_000)]
    steps_n: Annotated[int, Field(ge=2, le=1_000_000)]
    seeds_n: Annotated[int, Field(ge=1, le=20)]


@dataclass(frozen=True)
class RecordedBoard:
    """Recorded presses on a board, in the frame and along the axes of the board.

    Each of the m presses has the same number r of readings.
    """

    db_uT: Float32[np.ndarray, "m r ch"]
    rest_uT: Float32[np.ndarray, " ch"]
    place_mm: Float32[np.ndarray, "m 2"]
    force_N: Float32[np.ndarray, "m r"]


@dataclass(frozen=True)
class SkinPrior:
    """Distribution of the skins on which networks are trained.

    Parameters
    ----------
    name : name of the distribution
    centre : central law. A law is the set of parameters of a physical model of a skin (`reskin.universal.law`). The
        parameters of simulated skins are drawn around those of this law.
    spreads : standard deviation of each parameter that is drawn
    setup : what is the same for all skins, such as the positions of the chips
    recorded : presses on recorded boards of the same rig, if there are such boards
    residual : model that predicts the errors of the law on a new skin. It is fitted to the errors of the law on
        recorded boards. None if there are no recorded boards.
    follows_law : True if skins follow the law exactly, as in a simulated scene. No errors of the law are then added.
    forces : distribution of the forces of presses
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
    """The skins of one training step, with the presses on each skin.

    The first `PLACES_N` presses of a skin are for conditioning: the network is conditioned on each of them for which
    `kept` is 1. For the remaining presses of the skin, the network is trained to predict `target`, which contains
    scaled values of x, y and log F.
    """

    db_uT: Float32[np.ndarray, "b m ch"]
    rest_uT: Float32[np.ndarray, "b ch"]
    target: Float32[np.ndarray, "b q 3"]
    kept: Float32[np.ndarray, "b c"]


class Batches:
    """Generator of the random batches of a training run."""

    def __init__(self, skins: Population, prior: SkinPrior) -> None:
        self.skins, self.recorded = skins, prior.recorded
        self.log_N = np.log(skins.force_N)
        self.residual_uT = None if prior.residual is None else residual_uT(skins, prior.residual)
        self.error = ERROR_OF_NOMINAL if prior.residual is None else ERROR_OF_RIG
        if prior.follows_law:
            self.error = 0.0, 0.0

    def draw(self, rng: np.random.Generator) -> Batch:
        """Draw one batch: skins with presses, to which noise and errors of the law are added."""
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
    """Draw 130 presses of a recorded board at random, and one reading of each of these presses.

    If the board has fewer than 130 presses, some are drawn repeatedly.
    """
    press = np.resize(rng.permutation(len(board.db_uT)), PRESSES_N)
    reading = rng.integers(board.db_uT.shape[1], size=PRESSES_N)
    return board.db_uT[press, reading], board.rest_uT, board.place_mm[press], np.log(board.force_N[press, reading])


def draw_kept(n: int, rng: np.random.Generator) -> Float32[np.ndarray, "n c"]:
    """Draw the presses on which the network is conditioned, for each of n skins.

    The result is 1 for these presses, and 0 for others. A fraction `NO_PRESSES_SHARE` of the skins has no such press.
    The other skins have 1 to 65 such presses.
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
    """Add a random error of the law to the field changes of each skin.

    The error varies smoothly with place and log force. One half of the error of a channel is proportional to |dB| at
    the chip of this channel, and the other half to |dB| over all chips. The relative rms error of each skin is drawn
    uniformly between the two values of `size`.
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
    """Return the error of the law in uT that a residual predicts for each press of a population."""
    added = np.empty_like(skins.db_uT)
    for i in range(len(skins)):
        relative: Float[np.ndarray, "m ch"] = residual.at(skins.place_mm[i], np.log(skins.force_N[i]))
        added[i] = relative * np.linalg.norm(skins.db_uT[i], axis=1, keepdims=True)
    return added
