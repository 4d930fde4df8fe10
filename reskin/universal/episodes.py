"""Random episodes, on which the network of the universal model is trained.

An episode is what a user of a skin has and wants: presses on one skin as context, some of them labelled, and further
readings of the same skin whose places and forces are to be estimated. Most skins are simulated. The simulation (the
law, `reskin.universal.law`) does not describe real skins exactly. Therefore, `disturb` adds what the simulation omits:
errors of the law, memory of earlier presses, differences between equal presses, and noise. This module does not import
PyTorch.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float32, Int64
from pydantic import Field

from reskin.config import Strict
from reskin.universal.network import LOG_N, PLACE_MM
from reskin.universal.population import PRESSES_N, Population

SKINS_PER_STEP_N, RECORDED_PER_STEP_N = 8, 2  # skins in a training step; recorded ones among them, if there are any
QUERIES_N = 40  # readings of a skin that are estimated, at most
# Numbers of labelled presses in the context, and of presses at unknown places with and without labelled ones. All skins
# of a step have the same numbers.
LABELS_N = (0, 0, 1, 3, 5, 10, 10, 20, 40, 40, 60)
UNLABELLED_N, UNLABELLED_ALONE_N = (0, 12, 30, 56, 56), (0, 12, 40, 65, 65)
# Shares of the episodes whose labelled presses are only on one side of the skin, and whose whole context is around one
# to `PLACES_MAX_N` places. In the other episodes, presses are anywhere.
ONE_SIDE_SHARE, FEW_PLACES_SHARE, PLACES_MAX_N = 0.1, 0.1, 5
OTHER_SESSION_SHARE = 0.05  # share of the skins whose labelled presses are of another session than all other presses
UNKNOWN_FORCE_SHARE = 0.05  # share of the skins of whose labelled presses only the places are known
EXTERNAL_SHARE, EXTERNAL_uT = 0.15, (10.0, 300.0)  # share of the steps with external fields, and range of their size
# Standard deviations of the errors of labels: of places, and of the logarithms of forces. Each skin has its own one,
# whose logarithm is uniformly distributed in this range.
LABEL_ERROR_MM, LABEL_ERROR_LOG_N = (0.01, 0.1), (0.005, 0.05)
NOISE_uT = (3.3, 3.3, 5.0)  # standard deviations of a reading's noise along x, y and z
# Relative rms error of the law, of which each skin has its own one: range for simulated skins, and for recorded boards.
LAW_ERROR, LAW_ERROR_OF_RECORDED = (0.1, 0.5), (0.15, 0.15)
# The error of the law is a sum of cosine waves: range of its length scale in place, its length scale in log force, and
# number of waves.
ERROR_MM, ERROR_LOG_N, ERROR_WAVES_N = (2.5, 5.0), 1.2, 48
# Largest fraction of the field change of the press before that remains, and largest relative difference between equal
# presses. Each skin has its own values between 0 and these. In recordings, a memory of 5 to 8 % was measured.
MEMORY_MAX, DIFFERENCE_MAX = 0.08, 0.03


class TrainingSettings(Strict):
    """Settings of a training: numbers of simulated skins and of training steps."""

    skins_n: Annotated[int, Field(ge=1, le=100_000)]
    steps_n: Annotated[int, Field(ge=2, le=1_000_000)]


@dataclass(frozen=True)
class RecordedBoard:
    """Recorded presses on one skin of a board, in the frame and along the axes of the board.

    Each of the m presses has the same number r of readings. The name is that of the board, or `board/skin`.
    """

    name: str
    db_uT: Float32[np.ndarray, "m r ch"]
    rest_uT: Float32[np.ndarray, " ch"]
    place_mm: Float32[np.ndarray, "m 2"]
    force_N: Float32[np.ndarray, "m r"]

    @property
    def board(self) -> str:
        """Name of the board, which several skins may share."""
        return self.name.partition("/")[0]


class Episodes(NamedTuple):
    """The episodes of one training step.

    The first `labels_n` of the c presses of the context are labelled. `labels` are the inputs for their labels: scaled
    x, y and log F, 1, and whether F is known. `target` are scaled x, y and log F of the readings `query_uT`.
    """

    rest_uT: Float32[np.ndarray, "b ch"]
    context_uT: Float32[np.ndarray, "b c ch"]
    labels: Float32[np.ndarray, "b l 5"]
    query_uT: Float32[np.ndarray, "b q ch"]
    target: Float32[np.ndarray, "b q 3"]
    external_uT: float


class Shape(NamedTuple):
    """What all skins of a step have in common: sizes of the context, and where its presses are."""

    labels_n: int
    unlabelled_n: int
    kind: str  # anywhere, one side or few places


def draw_shape(rng: np.random.Generator) -> Shape:
    """Draw the sizes of the context and the places of its presses."""
    labels_n = int(rng.choice(LABELS_N))
    unlabelled_n = int(rng.choice(UNLABELLED_N if labels_n else UNLABELLED_ALONE_N))
    chance = rng.random()
    if chance < ONE_SIDE_SHARE:
        return Shape(labels_n, unlabelled_n, "one side")
    if chance < ONE_SIDE_SHARE + FEW_PLACES_SHARE:
        return Shape(min(labels_n, 10), min(unlabelled_n, 12), "few places")
    return Shape(labels_n, unlabelled_n, "anywhere")


def draw_episodes(skins: Population, recorded: Sequence[RecordedBoard], rng: np.random.Generator) -> Episodes:
    """Draw the episodes of one training step, from simulated skins and recorded boards."""
    shape = draw_shape(rng)
    external_uT = 0.0
    if rng.random() < EXTERNAL_SHARE:
        external_uT = float(np.exp(rng.uniform(*np.log(EXTERNAL_uT))))
    parts = [simulated_presses(skins, SKINS_PER_STEP_N - (RECORDED_PER_STEP_N if recorded else 0), rng)]
    if recorded:
        drawn = [draw_recorded(recorded[int(rng.integers(len(recorded)))], rng) for _ in range(RECORDED_PER_STEP_N)]
        of_boards = [np.stack(part) for part in zip(*drawn, strict=True)]
        db_uT = disturb(of_boards[0], of_boards[2], of_boards[3], LAW_ERROR_OF_RECORDED, rng)
        parts.append((db_uT, *of_boards[1:]))
    db_uT, rest_uT, place_mm, force_N = (np.concatenate(part) for part in zip(*parts, strict=True))
    db_uT = db_uT + external(external_uT, db_uT.shape, rng)
    order = np.stack([order_presses(place, shape, rng) for place in place_mm])
    context_n = shape.labels_n + shape.unlabelled_n
    context, queries = order[:, :context_n], order[:, context_n : context_n + QUERIES_N]
    skin_i = np.arange(len(db_uT))[:, None]
    other = (rng.random(len(db_uT)) < OTHER_SESSION_SHARE).astype(int)
    session = np.where(np.arange(context_n) < shape.labels_n, other[:, None], 0)
    true = np.concatenate([place_mm / PLACE_MM, np.log(force_N)[..., None] / LOG_N], axis=-1)
    labelled = true[skin_i, order[:, : shape.labels_n]]
    return Episodes(
        rest_uT, db_uT[skin_i, session, context], disturb_labels(labelled, rng), db_uT[skin_i, 0, queries],
        true[skin_i, queries], external_uT,
    )  # fmt: skip


def simulated_presses(skins: Population, n: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Draw n simulated skins; return field changes with errors, no-load fields, places and forces."""
    i = rng.integers(len(skins), size=n)
    place_mm, force_N = skins.place_mm[i], skins.force_N[i]
    return disturb(skins.db_uT[i], place_mm, force_N, LAW_ERROR, rng), skins.rest_uT[i], place_mm, force_N


def draw_recorded(board: RecordedBoard, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Draw 130 presses of a recorded board at random, and one reading of each of these presses, as one session.

    If the board has fewer than 130 presses, some are drawn repeatedly. The same presses count as both sessions.
    """
    press = np.resize(rng.permutation(len(board.db_uT)), PRESSES_N)
    reading = rng.integers(board.db_uT.shape[1], size=PRESSES_N)
    db_uT = board.db_uT[press, reading]
    return np.stack([db_uT, db_uT]), board.rest_uT, board.place_mm[press], board.force_N[press, reading]


def order_presses(
    place_mm: Float32[np.ndarray, "m 2"], shape: Shape, rng: np.random.Generator
) -> Int64[np.ndarray, " m"]:
    """Return the order of the presses of a skin: labelled presses, presses at unknown places, readings to estimate."""
    order = rng.permutation(len(place_mm))
    if shape.kind == "one side":
        angle = rng.uniform(0, 2 * np.pi)
        along_mm = place_mm[order] @ np.array([np.cos(angle), np.sin(angle)])
        side = along_mm <= np.quantile(along_mm, max(0.5, shape.labels_n / len(order)))
        first = np.flatnonzero(side)[: shape.labels_n]
        return np.concatenate([order[first], np.delete(order, first)])
    if shape.kind == "few places":
        centres = place_mm[rng.choice(len(place_mm), int(rng.integers(1, PLACES_MAX_N + 1)), replace=False)]
        away_mm = np.linalg.norm(place_mm[order, None] - centres, axis=-1).min(axis=1)
        near = np.argsort(away_mm, kind="stable")[: shape.labels_n + shape.unlabelled_n]
        rng.shuffle(near)
        return np.concatenate([order[near], np.delete(order, near)])
    return order


def disturb(
    db_uT: Float32[np.ndarray, "b 2 m ch"],
    place_mm: Float32[np.ndarray, "b m 2"],
    force_N: Float32[np.ndarray, "b m"],
    law_error: tuple[float, float],
    rng: np.random.Generator,
) -> Float32[np.ndarray, "b 2 m ch"]:
    """Add what the simulation omits: errors of the law, memory, differences between equal presses, and noise.

    `law_error` is the range of the relative rms error of the law. The error of a skin is the same in both sessions.
    """
    skins_n, _, presses_n, channels_n = db_uT.shape
    size_uT = np.linalg.norm(db_uT, axis=-1, keepdims=True) / np.float32(np.sqrt(channels_n))
    db_uT = add_error(db_uT, place_mm, np.log(force_N), law_error, rng)
    before = rng.permuted(np.tile(np.arange(presses_n), (skins_n, 1)), axis=1)
    remains = rng.uniform(0, MEMORY_MAX, (skins_n, 1, 1, 1)) * np.take_along_axis(db_uT, before[:, None, :, None], 2)
    difference = rng.uniform(0, DIFFERENCE_MAX, (skins_n, 1, 1, 1)).astype(np.float32)
    noise_uT = np.tile(np.array(NOISE_uT, np.float32), channels_n // len(NOISE_uT))
    normals = rng.standard_normal((2, *db_uT.shape), np.float32)
    return (db_uT - remains + size_uT * difference * normals[0] + noise_uT * normals[1]).astype(np.float32)


def add_error(
    db_uT: Float32[np.ndarray, "b 2 m ch"],
    place_mm: Float32[np.ndarray, "b m 2"],
    log_N: Float32[np.ndarray, "b m"],
    size: tuple[float, float],
    rng: np.random.Generator,
) -> Float32[np.ndarray, "b 2 m ch"]:
    """Add a random error of the law to the field changes of each skin.

    The error varies smoothly with place and log force. One half of the error of a channel is proportional to |dB| at
    the chip of this channel, and the other half to |dB| over all chips. The relative rms error of each skin is drawn
    uniformly between the two values of `size`.
    """
    skins_n, channels_n = len(db_uT), db_uT.shape[-1]
    rms = rng.uniform(*size, (skins_n, 1, 1, 1)).astype(np.float32)
    wave = rng.standard_normal((skins_n, 3, ERROR_WAVES_N), np.float32)
    wave[:, :2] /= rng.uniform(*ERROR_MM, (skins_n, 1, 1))
    wave[:, 2] /= ERROR_LOG_N
    coordinates = np.concatenate([place_mm, log_N[..., None]], axis=-1)
    phase = rng.uniform(0, 2 * np.pi, (skins_n, 1, ERROR_WAVES_N)).astype(np.float32)
    amplitude = rng.standard_normal((skins_n, ERROR_WAVES_N, channels_n), np.float32)
    unit = np.cos(coordinates @ wave + phase) @ amplitude * np.float32(np.sqrt(2 / ERROR_WAVES_N))  # unit variance
    axes_n = len(NOISE_uT)
    chips = db_uT.reshape(*db_uT.shape[:-1], -1, axes_n)
    chip_scale = np.repeat(np.linalg.norm(chips, axis=-1), axes_n, axis=-1) / np.sqrt(np.float32(axes_n))
    total_scale = np.linalg.norm(db_uT, axis=-1, keepdims=True) / np.sqrt(np.float32(channels_n))
    return db_uT + rms * unit[:, None] * 0.5 * (chip_scale + total_scale)


def external(size_uT: float, shape: tuple[int, ...], rng: np.random.Generator) -> Float32[np.ndarray, "b 2 m ch"]:
    """Draw external fields: the same vector at all chips, with this standard deviation of each component."""
    if not size_uT:
        return np.zeros(shape, np.float32)
    vector = rng.standard_normal((*shape[:-1], 3), np.float32)
    return np.float32(size_uT) * np.tile(vector, shape[-1] // 3)


def disturb_labels(labelled: Float32[np.ndarray, "b l 3"], rng: np.random.Generator) -> Float32[np.ndarray, "b l 5"]:
    """Return the inputs for labels, from scaled x, y and log F, with errors of places and forces."""
    skins_n, labels_n, _ = labelled.shape

    def sizes(limits: tuple[float, float], scale: float) -> np.ndarray:
        return np.exp(rng.uniform(np.log(limits[0]), np.log(limits[1]), (skins_n, 1, 1))) / scale

    size = [sizes(LABEL_ERROR_MM, PLACE_MM)] * 2 + [sizes(LABEL_ERROR_LOG_N, LOG_N)]
    values = labelled + np.concatenate(size, axis=2) * rng.standard_normal(labelled.shape)
    known = np.repeat(rng.random((skins_n, 1, 1)) >= UNKNOWN_FORCE_SHARE, labels_n, axis=1)
    values[..., 2:] *= known
    return np.concatenate([values, np.ones_like(known), known], axis=2).astype(np.float32)
