"""Teaches a network simulated skins, and recorded ones beside them: population -> weights; the same from the same seed.

Every step draws some skins, what the law misses on each, and which of its pokes are shown. Refuses to know recordings'
files, folds and scores.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float, Float32
from pydantic import Field
from torch import nn
from torch.nn.functional import huber_loss

from reskin.config import Strict
from reskin.models.reproducible import affine, exp
from reskin.seeds import rng_for
from reskin.universal.law import Law, Setup
from reskin.universal.map import Residual
from reskin.universal.network import (
    CODE_WIDTH,
    DIRECTION_GAIN,
    FULL_SET_N,
    LAYERS_N,
    LOG_N,
    LOG_SD,
    PLACE_MM,
    SET_WIDTH,
    WIDTH,
    LENGTH_MIN_uT,
    LOG_uT,
    REST_uT,
    Weights,
)
from reskin.universal.population import PLACES_N, POKES_N, Population, draw_population

FILM_SD = 0.02  # of first weights: a code changes little at first
ANSWERS_N = 6  # x, y, log F, and the log sd of each


class Network(nn.Module):
    """Set encoder and regressor of weights as `draw_weights` names them."""

    def __init__(self, weights: Weights) -> None:
        super().__init__()
        self.weights = nn.ParameterDict({name: torch.from_numpy(np.array(value)) for name, value in weights.items()})

    def encode(
        self, db_uT: Float[torch.Tensor, "b c ch"], rest_uT: Float[torch.Tensor, "b ch"],
        kept: Float[torch.Tensor, "b c"],
    ) -> Float[torch.Tensor, "b 64"]:  # fmt: skip
        """Give the code of each skin from the pokes that are kept (1, else 0); with none, zeros are pooled."""
        each = torch.relu(self._linear("set1", inputs(db_uT, rest_uT)))
        each = torch.relu(self._linear("set2", each)) * kept[..., None]
        kept_n = kept.sum(1, keepdim=True)
        pooled = each.sum(1) / kept_n.clamp_min(1)
        return torch.relu(self._linear("code", torch.cat([pooled, kept_n / FULL_SET_N], 1)))

    def forward(
        self, db_uT: Float[torch.Tensor, "b n ch"], rest_uT: Float[torch.Tensor, "b ch"],
        code: Float[torch.Tensor, "b 64"],
    ) -> tuple[Float[torch.Tensor, "b n 3"], Float[torch.Tensor, "b n 3"]]:  # fmt: skip
        """Give scaled x, y, log F, and the log sd of each."""
        values = inputs(db_uT, rest_uT)
        for i in range(LAYERS_N):
            gain, shift = self._linear(f"film{i}", code)[:, None].chunk(2, -1)
            values = torch.relu(self._linear(f"layer{i}", values) * (1 + gain) + shift)
        answer, log_sd = self._linear("answer", values).chunk(2, -1)
        return answer, log_sd.clamp(*LOG_SD)

    def _linear(self, name: str, values: torch.Tensor) -> torch.Tensor:
        return affine(values, self.weights[f"{name}_weight"].mT, self.weights[f"{name}_bias"][None])


def inputs(db_uT: Float[torch.Tensor, "b n ch"], rest_uT: Float[torch.Tensor, "b ch"]) -> Float[torch.Tensor, "b n i"]:
    """Return direction and log length of each change of field, and the skin's field at rest; scaled to about 1.

    Computed in NumPy, as `torch.log` differs between processors; gradients do not reach the readings.
    """
    db, rest = db_uT.numpy(), rest_uT.numpy() / np.float32(REST_uT)
    length_uT = np.maximum(np.linalg.norm(db, axis=-1, keepdims=True), np.float32(LENGTH_MIN_uT))
    shape = (*db.shape[:2], rest.shape[-1])
    parts = [DIRECTION_GAIN * db / length_uT, np.log(length_uT) - LOG_uT, np.broadcast_to(rest[:, None], shape)]
    return torch.from_numpy(np.concatenate(parts, axis=-1))


def draw_weights(channels_n: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Draw first weights as PyTorch does for linear layers: uniform within 1/sqrt(fan in); of FiLM, near zero."""
    inputs_n = 2 * channels_n + 1
    shapes = {"set1": (SET_WIDTH, inputs_n), "set2": (SET_WIDTH, SET_WIDTH), "code": (CODE_WIDTH, SET_WIDTH + 1)}
    shapes |= {f"layer{i}": (WIDTH, WIDTH if i else inputs_n) for i in range(LAYERS_N)}
    shapes["answer"] = (ANSWERS_N, WIDTH)
    weights = {}
    for name, (out_n, in_n) in shapes.items():
        limit = in_n**-0.5
        weights[f"{name}_weight"] = rng.uniform(-limit, limit, (out_n, in_n)).astype(np.float32)
        weights[f"{name}_bias"] = rng.uniform(-limit, limit, out_n).astype(np.float32)
    for i in range(LAYERS_N):
        weights[f"film{i}_weight"] = (FILM_SD * rng.standard_normal((2 * WIDTH, CODE_WIDTH))).astype(np.float32)
        weights[f"film{i}_bias"] = np.zeros(2 * WIDTH, np.float32)
    return weights


SKINS_A_STEP_N, RECORDED_A_STEP_N = 10, 2  # of these, where boards are known
RATE_MAX, WEIGHT_DECAY, WARM_UP, GRADIENT_NORM_MAX = 2.5e-3, 1e-4, 0.15, 1.0
HUBER_DELTA, HUBER_WEIGHT, SPREAD_WEIGHT = 0.1, 4.0, 0.02
UNTOLD = 0.25  # of the skins come without a poke, the others with 1 to 65
NOISE_uT = (3.3, 3.3, 5.0)  # of one reading, by axis
CARRIED_MAX = 2.0  # times what is expected of known boards' errors: none to nearly all of them
# How far the law is off, rms of |dB|, where boards are known and where none is; on recorded ones what else may differ.
ERROR_OF_RIG, ERROR_OF_NOMINAL, ERROR_OF_RECORDED = (0.1, 0.4), (0.1, 0.5), (0.15, 0.15)
ERROR_MM, ERROR_LOG_N, ERROR_WAVES_N = (2.5, 5.0), 1.2, 48  # over which such errors are alike; cosines that make them
NAMELESS = "nominal"  # of the syllabus that knows no board
BLOCK_STEPS_N = 100  # over which the loss is averaged in a curve


class Lessons(Strict):
    """How much a network is taught."""

    skins_n: Annotated[int, Field(ge=1, le=100_000)]
    steps_n: Annotated[int, Field(ge=2, le=1_000_000)]
    seeds_n: Annotated[int, Field(ge=1, le=20)]


@dataclass(frozen=True)
class Recorded:
    """Readings of a known board's pokes, in its frame and axes; as many of each poke."""

    db_uT: Float32[np.ndarray, "m r ch"]
    rest_uT: Float32[np.ndarray, " ch"]
    place_mm: Float32[np.ndarray, "m 2"]
    force_N: Float32[np.ndarray, "m r"]


@dataclass(frozen=True)
class Syllabus:
    """What networks are taught: skins about a centre; where boards of the rig are known, these and their errors."""

    name: str
    centre: Law
    spreads: Mapping[str, float]
    setup: Setup
    recorded: Sequence[Recorded] = ()
    residual: Residual | None = None
    follows_law: bool = False  # skins of a simulated scene: no law misses anything


@dataclass(frozen=True)
class Batch:
    """Skins of one step: the first `PLACES_N` pokes of each may be shown, the others are asked for."""

    db_uT: Float32[np.ndarray, "b m ch"]
    rest_uT: Float32[np.ndarray, "b ch"]
    target: Float32[np.ndarray, "b q 3"]
    kept: Float32[np.ndarray, "b c"]


def teach(syllabus: Syllabus, lessons: Lessons, seed: int) -> list[dict[str, np.ndarray]]:
    """Draw a population and train networks on it, one after the other; give their weights."""
    rng = rng_for(seed, "universal", syllabus.name, "skins")
    skins = draw_population(syllabus.centre, syllabus.spreads, syllabus.setup, lessons.skins_n, rng)
    names = ("universal", syllabus.name, "network")
    return [
        train(skins, syllabus, lessons.steps_n, rng_for(seed, *names, seed_i))[0] for seed_i in range(lessons.seeds_n)
    ]


def train(
    skins: Population, syllabus: Syllabus, steps_n: int, rng: np.random.Generator
) -> tuple[dict[str, np.ndarray], list[float]]:
    """Train one network; give its weights, and the mean loss of its places and forces by block of steps."""
    torch.set_num_threads(1)  # the same sums in the same order, however many processes run beside this one
    network = Network(draw_weights(skins.rest_uT.shape[1], rng))
    optimizer = torch.optim.AdamW(network.parameters(), RATE_MAX, weight_decay=WEIGHT_DECAY, fused=True)
    rate = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE_MAX, total_steps=steps_n, pct_start=WARM_UP)
    feed, losses = Feed(skins, syllabus), []
    for _ in range(steps_n):
        batch = feed.draw(rng)
        loss, error = loss_of(network, batch)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), GRADIENT_NORM_MAX)
        optimizer.step()
        rate.step()
        losses.append(float(error.detach()))
    blocks = np.array_split(losses, -(-steps_n // BLOCK_STEPS_N))
    weights = {name: value.detach().numpy().copy() for name, value in network.weights.items()}
    return weights, [float(block.mean()) for block in blocks]


def loss_of(network: Network, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
    """Give what is descended, and the part of it that is of answers, not of how sure they are."""
    db_uT, rest_uT = torch.from_numpy(batch.db_uT), torch.from_numpy(batch.rest_uT)
    target, kept = torch.from_numpy(batch.target), torch.from_numpy(batch.kept)
    shown_n = kept.shape[1]
    answer, log_sd = network(db_uT[:, shown_n:], rest_uT, network.encode(db_uT[:, :shown_n], rest_uT, kept))
    error = HUBER_WEIGHT * huber_loss(answer, target, delta=HUBER_DELTA)
    # The spread learns from errors, not errors from the spread: Gaussian likelihood alone gives hard pokes up.
    off = (answer - target).detach()
    surprise = (log_sd + 0.5 * off**2 * exp(-2 * log_sd)).mean()
    return error + SPREAD_WEIGHT * surprise, error


class Feed:
    """Draws the batches of a training."""

    def __init__(self, skins: Population, syllabus: Syllabus) -> None:
        self.skins, self.recorded = skins, syllabus.recorded
        self.log_N = np.log(skins.force_N)
        self.carried_uT = None if syllabus.residual is None else carried_uT(skins, syllabus.residual)
        self.error = ERROR_OF_NOMINAL if syllabus.residual is None else ERROR_OF_RIG
        if syllabus.follows_law:
            self.error = 0.0, 0.0

    def draw(self, rng: np.random.Generator) -> Batch:
        """Draw simulated skins, and recorded ones where there are any; with noise, and with the law's errors."""
        recorded_n = RECORDED_A_STEP_N if self.recorded else 0
        parts = [self._simulated(SKINS_A_STEP_N - recorded_n, rng)]
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
        if self.carried_uT is not None:
            db_uT = db_uT + CARRIED_MAX * rng.random((n, 1, 1), np.float32) * self.carried_uT[i]
        return add_error(db_uT, place_mm, log_N, self.error, rng), self.skins.rest_uT[i], place_mm, log_N

    def _recorded(self, n: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
        drawn = [draw_recorded(self.recorded[int(rng.integers(len(self.recorded)))], rng) for _ in range(n)]
        db_uT, rest_uT, place_mm, log_N = (np.stack(part) for part in zip(*drawn, strict=True))
        return add_error(db_uT, place_mm, log_N, ERROR_OF_RECORDED, rng), rest_uT, place_mm, log_N


def draw_recorded(board: Recorded, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Draw a reading of each of 130 pokes of a known board; of fewer, some come again."""
    poke = np.resize(rng.permutation(len(board.db_uT)), POKES_N)
    reading = rng.integers(board.db_uT.shape[1], size=POKES_N)
    return board.db_uT[poke, reading], board.rest_uT, board.place_mm[poke], np.log(board.force_N[poke, reading])


def draw_kept(n: int, rng: np.random.Generator) -> Float32[np.ndarray, "n c"]:
    """Draw which pokes of each skin are shown: none of some skins, 1 to 65 of others."""
    shown_n = np.where(rng.random(n) < UNTOLD, 0, rng.integers(1, PLACES_N + 1, n))
    rank = rng.random((n, PLACES_N)).argsort(axis=1).argsort(axis=1)
    return (rank < shown_n[:, None]).astype(np.float32)


def add_error(
    db_uT: Float32[np.ndarray, "b m ch"],
    place_mm: Float32[np.ndarray, "b m 2"],
    log_N: Float32[np.ndarray, "b m"],
    size: tuple[float, float],
    rng: np.random.Generator,
) -> Float32[np.ndarray, "b m ch"]:
    """Add what a law misses: smooth over place and log F, half as large as |dB| of the chip, half as of all chips."""
    skins_n, _, channels_n = db_uT.shape
    part = rng.uniform(*size, (skins_n, 1, 1)).astype(np.float32)
    wave = rng.standard_normal((skins_n, 3, ERROR_WAVES_N), np.float32)
    wave[:, :2] /= rng.uniform(*ERROR_MM, (skins_n, 1, 1))
    wave[:, 2] /= ERROR_LOG_N
    at = np.concatenate([place_mm, log_N[..., None]], axis=-1)
    phase = rng.uniform(0, 2 * np.pi, (skins_n, 1, ERROR_WAVES_N)).astype(np.float32)
    amplitude = rng.standard_normal((skins_n, ERROR_WAVES_N, channels_n), np.float32)
    unit = np.cos(at @ wave + phase) @ amplitude * np.float32(np.sqrt(2 / ERROR_WAVES_N))  # a variance of 1
    chips = db_uT.reshape(*db_uT.shape[:2], -1, len(NOISE_uT))
    of_chip = np.repeat(np.linalg.norm(chips, axis=-1), len(NOISE_uT), axis=-1) / np.sqrt(np.float32(len(NOISE_uT)))
    of_all = np.linalg.norm(db_uT, axis=-1, keepdims=True) / np.sqrt(np.float32(channels_n))
    return db_uT + part * unit * 0.5 * (of_chip + of_all)


def carried_uT(skins: Population, residual: Residual) -> Float32[np.ndarray, "s m ch"]:
    """Give what known boards' errors add to every poke of a population."""
    added = np.empty_like(skins.db_uT)
    for i in range(len(skins)):
        relative: Float[np.ndarray, "m ch"] = residual.at(skins.place_mm[i], np.log(skins.force_N[i]))
        added[i] = relative * np.linalg.norm(skins.db_uT[i], axis=1, keepdims=True)
    return added
