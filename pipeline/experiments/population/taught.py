"""What a scene's experts are taught: its skin as designed -> a population, and networks of ever more of its skins.

What is finished is kept beside compiled code, in parts: a run that was killed goes on where it was. Refuses to know the
scene's own skins.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field
from scipy.constants import mega, milli

import reskin.universal
from reskin import io
from reskin.code import digest, imported
from reskin.config import Strict
from reskin.errors import ParamsError
from reskin.physics.skin import SkinDesign
from reskin.physics.slide import force_at
from reskin.seeds import rng_for
from reskin.simulation.settings import BoardKind
from reskin.universal.law import Law, Setup
from reskin.universal.map import OF_RIG, Tables
from reskin.universal.map import tabulate as tabulate_map
from reskin.universal.network import Weights
from reskin.universal.population import Forces, Population, draw_population
from reskin.universal.training import Syllabus, draw_weights, train

PACKAGE = Path(reskin.universal.__file__).parent
TRAINS = "reskin.universal.training"
PART_N = 100  # skins that are kept together
STEPS_OF_FORCE = 0.6  # at most, of log F between two tabulated forces
FORCE_SHARES = (0.7, 1.5)  # of the least and of the largest force of the skin as designed: skins differ


class Taught(Strict):
    """How many skins there are, of which networks are taught the first so many, each for as many steps."""

    skins_n: Annotated[tuple[Annotated[int, Field(ge=1, le=100_000)], ...], Field(min_length=1)]
    steps_n: Annotated[int, Field(ge=2, le=1_000_000)]


@dataclass(frozen=True)
class Lesson:
    """A syllabus of skins as a scene's are designed, with forces as its depths ask for."""

    syllabus: Syllabus
    forces_N: tuple[float, float]
    seed: int

    def skins(self, name: str, which: slice, weight_N: float | None = None) -> Population:
        """Draw some skins of the population that bears this name; where a weight is given, its press comes last."""
        centre, spreads, setup = self.syllabus.centre, self.syllabus.spreads, self.syllabus.setup
        rng = rng_for(self.seed, "population", name)
        return draw_population(centre, spreads, setup, which, rng, Forces(*self.forces_N, weight_N))

    def tables(self) -> Tables:
        """Tabulate the skin as designed, for the map."""
        first, last = np.log(self.forces_N)
        forces_N = np.exp(np.linspace(first, last, 1 + int(np.ceil((last - first) / STEPS_OF_FORCE))))
        return tabulate_map(self.syllabus.centre, self.syllabus.spreads, self.syllabus.setup, forces_N)


def lesson_of(design: SkinDesign, kind: BoardKind, depths_mm: tuple[float, ...], seed: int) -> Lesson:
    """Put a designed skin over designed boards: the law's numbers as the design has them, its slide included."""
    if design.hold is None:
        remedy = "Ask this question of a scene whose skin has hold."
        raise ParamsError("params.yaml: skin", "hold", "that of a skin that slides, as the law's", "null", remedy)
    modulus_MPa = design.modulus_kPa * 1e-3
    law = Law(
        0.0, 0.0, 0.0, kind.design.gap_mm, 1.0, 0.0, 0.0, modulus_MPa, design.hold.away_um_mm,
        *design.hold.give_um, lets_go_N=design.hold.lets_go_mm2 * modulus_MPa,
        grip_N_mm=design.hold.springs_N_mm / design.hold.friction,
    )  # fmt: skip
    chips_mm = np.array(kind.design.places_mm)
    setup = Setup(design, chips_mm, kind.design.gap_mm, kind.skin_mm, design.flipped, design.tip_radius_mm)
    deep_m = 1e-3 * np.array([min(depths_mm), max(depths_mm)])
    tip_m = design.tip_radius_mm * milli
    ends_N = FORCE_SHARES * force_at(
        deep_m, modulus_Pa=mega * modulus_MPa, thickness_m=setup.thickness_m, tip_radius_m=tip_m
    )
    syllabus = Syllabus("as designed", law, OF_RIG, setup, follows_law=True)
    return Lesson(syllabus, (float(ends_N[0]), float(ends_N[1])), seed)


def draw(lesson: Lesson, skins_n: int, tell: Callable[[str], None]) -> Population:
    """Draw a population part by part."""
    parts = []
    for first in range(0, skins_n, PART_N):
        which = slice(first, min(first + PART_N, skins_n))
        parts.append(_once(lesson, f"skins {which}", partial(_stack_of, lesson, which)))
        tell(f"{which.stop} of {skins_n} skins are drawn")
    return _unstack(np.concatenate(parts))


def network(lesson: Lesson, skins: Population, skins_n: int, steps_n: int) -> Weights:
    """Train a network on the first skins of a population."""
    first = Population(*(getattr(skins, name)[:skins_n] for name in Population.__annotations__))
    rng_name = (lesson.seed, "population", "network")  # without the number: equal first weights
    empty = draw_weights(skins.rest_uT.shape[1], rng_for(*rng_name))

    def teach() -> Float[np.ndarray, " w"]:
        weights, _ = train(first, lesson.syllabus, steps_n, rng_for(*rng_name))
        return np.concatenate([weights[name].ravel() for name in empty])

    flat, found, start = _once(lesson, f"network of {skins_n} skins, {steps_n} steps", teach), {}, 0
    for name, value in empty.items():
        found[name] = flat[start : start + value.size].reshape(value.shape)
        start += value.size
    return found


def _once(lesson: Lesson, what: str, make: Callable[[], np.ndarray]) -> np.ndarray:
    """Give what is kept under this name and these lessons; the first skin's fields stand for all physics below."""
    seen = hashlib.sha256(_stack_of(lesson, slice(1)).tobytes()).hexdigest()
    spreads = sorted(lesson.syllabus.spreads.items())
    code = [digest(module) for module in imported(TRAINS)]
    of = f"torch {version('torch')}; {code}; {seen}"
    name = f"{what}; {of}; {lesson.syllabus.centre}; {spreads}; {lesson.forces_N}; seed {lesson.seed}"
    found = io.load(PACKAGE, name)
    if found is None:
        found = make()
        io.save(PACKAGE, name, found)
    return found


def _stack_of(lesson: Lesson, which: slice) -> np.ndarray:
    return _stack(lesson.skins("taught", which))


def _stack(skins: Population) -> np.ndarray:
    rest_uT = np.repeat(skins.rest_uT[:, None], skins.db_uT.shape[1], axis=1)
    return np.concatenate([skins.db_uT, rest_uT, skins.place_mm, skins.force_N[..., None]], axis=2)


def _unstack(stacked: np.ndarray) -> Population:
    channels_n = (stacked.shape[2] - 3) // 2
    db_uT, rest_uT, place_mm, force_N = np.split(stacked, (channels_n, 2 * channels_n, -1), axis=2)
    return Population(db_uT, rest_uT[:, 0], place_mm, force_N[..., 0])
