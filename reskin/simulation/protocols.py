"""Protocols of simulated captures.

A protocol plans a sequence of indentations. An indentation has one or more stops, which are places and depths of the
tip at which readings are taken. The plan contains the stops of all indentations in order of time.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float, Float64, Int32
from pydantic import Field, model_validator
from scipy.optimize import brentq

from reskin.config import Strict
from reskin.data.grid import CENTRE_MM, PITCH_MM, SIDE_POINTS_N, points_mm, protocol
from reskin.errors import ParamsError
from reskin.physics.skin import Skin, forces

# Depth at a stop at which the tip is above the skin and does not touch it. Such stops are not in the robot's log.
LIFTED_MM = -1.0
# Tolerance of the depth under a load. For a skin with a stiffness of 10 N/mm, this is a tolerance of 1e-8 N.
DEPTH_STEP_M = 1e-12
DEEPEST_SHARE = 0.999  # largest depth under a load, as a fraction of the thickness or the tip radius (the smaller one)


Count = Annotated[int, Field(ge=1, le=100_000)]
Depth_mm = Annotated[float, Field(gt=0, le=10)]
Depths_mm = Annotated[tuple[Depth_mm, ...], Field(min_length=1)]
Duration_s = Annotated[float, Field(gt=0, le=100)]
Rate_hz = Annotated[float, Field(gt=0, le=1e4)]
Sides_mm = tuple[float, float]


@dataclass(frozen=True)
class Plan:
    """A plan of n indentations with p stops each, in order of time."""

    pass_i: Int32[np.ndarray, " n"]  # index of the pass to which each indentation belongs
    x_mm: Float64[np.ndarray, "n p"]
    y_mm: Float64[np.ndarray, "n p"]
    depth_mm: Float64[np.ndarray, "n p"]  # negative at stops above the skin; NaN if `weight_N` commands loads instead
    tilt: Float64[np.ndarray, "n 2"]  # slope of the stylus, dx/dz and dy/dz
    description: str
    labelled: bool = True  # whether the probe log contains the places, depths and forces
    weight_N: Float64[np.ndarray, "n p"] | None = None  # commanded loads
    centre_mm: tuple[float, float] = (CENTRE_MM, CENTRE_MM)  # the skin's centre, in the coordinate system of the labels

    def __len__(self) -> int:
        return len(self.pass_i)


class ProtocolSettings(Strict):
    """The settings that all protocols have."""

    boards: str  # the kind of the boards, which is a key of the scene's section `boards`
    # Number of skins with which the protocol is executed. First, the first skin of each board is used, then the second
    # skin of each board, and so on.
    skins_n: Count
    terms: tuple[
        Literal["ageing", "friction", "memory", "relaxation", "temperature"], ...
    ]  # optional physical effects to simulate
    # Frame rate. By default, it is the rate of the rig. Boards with more chips need a lower rate.
    rate_hz: Rate_hz | None = None


class _RandomDepth(ProtocolSettings):
    depth_mm: tuple[Depth_mm, Depth_mm]  # depths are uniformly distributed between these limits

    @model_validator(mode="after")
    def _check_depths(self) -> "_RandomDepth":
        if not self.depth_mm[0] <= self.depth_mm[1]:
            raise ValueError(f"depth_mm must list the smaller depth first, not {self.depth_mm}")
        return self


class _OnlyTemperature(ProtocolSettings):
    # Base class of protocols that can simulate only one optional effect, the temperature. Ageing and relaxation are not
    # allowed, because they would change the force between the stops of an indentation, which is not modelled. Friction
    # is not allowed, because it would have no effect: the tip does not move sideways.
    terms: tuple[Literal["temperature"], ...]

    @model_validator(mode="after")
    def _check_ranges(self) -> "_OnlyTemperature":
        for name, value in self:
            if isinstance(value, tuple) and len(value) == 2 and value[0] > value[1]:
                raise ValueError(f"{name} must list the smaller value first, not {value}")
        return self


class Grid(ProtocolSettings):
    """The paper's grid of 65 places, pressed at several depths in several passes (paper section 3)."""

    kind: Literal["grid"]
    passes_n: Count
    depths_mm: Depths_mm

    def plan(self, rng: np.random.Generator, skin_mm: Sides_mm) -> Plan:
        """Plan one indentation per place, depth and pass.

        In each pass, all places are pressed at the first depth, then all places at the second depth, and so on.
        """
        pokes = protocol(self.depths_mm, self.passes_n)
        return _upright_plan(
            (pokes.x_mm[:, None], pokes.y_mm[:, None], pokes.depth_mm[:, None]),
            f"presses at the 65 places of the grid, at {len(self.depths_mm)} depths, in {self.passes_n} passes",
            pokes.pass_i,
        )


class Drag(ProtocolSettings):
    """A tip that is dragged over the whole grid, along lines parallel to x and to y (paper section 4, shear).

    The distance between adjacent lines is 2 mm.
    """

    kind: Literal["drag"]
    passes_n: Count
    depths_mm: Depths_mm
    step_mm: Annotated[float, Field(gt=0, le=4)]  # distance between stops

    def plan(self, rng: np.random.Generator, skin_mm: Sides_mm) -> Plan:
        """Plan one indentation per line, depth and pass.

        The direction in which the tip moves alternates from line to line.
        """
        stops_n = round(2 * CENTRE_MM / self.step_mm) + 1
        along_mm = np.linspace(0, 2 * CENTRE_MM, stops_n)
        alternating_mm = np.where((np.arange(SIDE_POINTS_N) % 2 == 0)[:, None], along_mm, along_mm[::-1])
        across_mm = np.repeat(PITCH_MM * np.arange(SIDE_POINTS_N)[:, None], stops_n, axis=1)
        lines_n, depths_n = 2 * SIDE_POINTS_N, len(self.depths_mm)
        x_mm = np.tile(np.concatenate([alternating_mm, across_mm]), (depths_n, 1))
        y_mm = np.tile(np.concatenate([across_mm, alternating_mm]), (depths_n, 1))
        # In every second pass, the direction of each line is reversed. Otherwise, a model could infer the direction of
        # the tangential force from the place.
        directions = [slice(None, None, -1 if pass_i % 2 else 1) for pass_i in range(self.passes_n)]
        depth_mm = np.tile(np.repeat(np.array(self.depths_mm), lines_n), self.passes_n)
        stops_mm = (
            np.concatenate([x_mm[:, direction] for direction in directions]),
            np.concatenate([y_mm[:, direction] for direction in directions]),
            np.repeat(depth_mm[:, None], stops_n, axis=1),
        )
        description = f"tip dragged along lines every {PITCH_MM:g} mm, at {depths_n} depths, in {self.passes_n} passes"
        description += f", with stops every {2 * CENTRE_MM / (stops_n - 1):g} mm"
        pass_i = np.repeat(np.arange(self.passes_n, dtype=np.int32), depths_n * lines_n)
        return _upright_plan(stops_mm, description, pass_i)


class Hand(_RandomDepth):
    """Indentations by hand, whose places, depths and forces are not measured (paper section 5.2).

    The user presses the skin along parallel lines. Only the order of the indentations along each line is known.
    """

    kind: Literal["hand"]
    lines_n: Count
    pokes_per_line_n: Annotated[int, Field(ge=2, le=1000)]
    # standard deviation of the place from the intended place, across the line and along the line
    place_sd_mm: Annotated[float, Field(ge=0, le=2)]
    tilt_sd_deg: Annotated[float, Field(ge=0, le=20)]  # standard deviation of the stylus's tilt about x and about y

    def plan(self, rng: np.random.Generator, skin_mm: Sides_mm) -> Plan:
        """Plan indentations along parallel lines over the grid. Each line is one pass."""
        across_mm = np.linspace(0, 2 * CENTRE_MM, self.lines_n) if self.lines_n > 1 else np.array([CENTRE_MM])
        along_mm = np.linspace(0, 2 * CENTRE_MM, self.pokes_per_line_n)
        pokes_n = self.lines_n * self.pokes_per_line_n
        place_mm = np.stack([np.tile(along_mm, self.lines_n), np.repeat(across_mm, self.pokes_per_line_n)], axis=1)
        place_mm = np.clip(place_mm + self.place_sd_mm * rng.standard_normal((pokes_n, 2)), 0, 2 * CENTRE_MM)
        return Plan(
            pass_i=np.repeat(np.arange(self.lines_n, dtype=np.int32), self.pokes_per_line_n),
            x_mm=place_mm[:, :1],
            y_mm=place_mm[:, 1:],
            depth_mm=rng.uniform(*self.depth_mm, size=(pokes_n, 1)),
            tilt=np.tan(np.radians(self.tilt_sd_deg) * rng.standard_normal((pokes_n, 2)).clip(-2, 2)),
            description=f"presses by hand along {self.lines_n} lines, {self.pokes_per_line_n} per line; only the order "
            "of the presses is known",
            labelled=False,
        )


class Scatter(_RandomDepth):
    """Indentations at random places, which are uniformly distributed over a skin (paper section 6, arm sleeve).

    In the labels, x = 0 and y = 0 is a corner of the skin.
    """

    kind: Literal["scatter"]
    pokes_n: Count
    margin_mm: Annotated[float, Field(ge=0)]  # smallest distance of a place from the edges of the skin

    def plan(self, rng: np.random.Generator, skin_mm: Sides_mm) -> Plan:
        """Draw places and depths from uniform distributions."""
        if not 2 * self.margin_mm < min(skin_mm):
            rule = f"less than half of the skin's shorter side, {min(skin_mm) / 2:g} mm"
            raise ParamsError("protocol scatter", "margin_mm", rule, self.margin_mm, "Reduce margin_mm.")
        most_mm = np.array(skin_mm) - self.margin_mm
        place_mm = rng.uniform(self.margin_mm, most_mm, size=(self.pokes_n, 2))
        depth_mm = rng.uniform(*self.depth_mm, size=(self.pokes_n, 1))
        description = f"{self.pokes_n} presses at random places on a skin of {skin_mm[0]:g} x {skin_mm[1]:g} mm, "
        description += f"at least {self.margin_mm:g} mm from its edges"
        stops_mm = (place_mm[:, :1], place_mm[:, 1:], depth_mm)
        return _upright_plan(stops_mm, description, centre_mm=(skin_mm[0] / 2, skin_mm[1] / 2))


class Load(_OnlyTemperature):
    """A glass that stands on the skin and is filled in steps (paper section 6).

    The glass is modelled as the tip of the rig, which presses the centre of the skin with the weight of the glass.
    """

    kind: Literal["load"]
    # Number of times that the glass is filled. It must be at least 2, because an experiment fits a model to half of the
    # fillings and tests the model on the other half.
    passes_n: Annotated[int, Field(ge=2, le=100_000)]
    force_max_N: Annotated[float, Field(gt=0, le=100)]  # weight at the end of a filling
    step_N: Annotated[float, Field(gt=0, le=100)]  # increase of the weight from stop to stop

    @model_validator(mode="after")
    def _check_steps(self) -> "Load":
        steps = self.force_max_N / self.step_N
        if round(steps) < 1 or abs(steps - round(steps)) > 1e-6:
            raise ValueError(f"force_max_N must be a multiple of step_N, not {steps:.4g} times step_N")
        return self

    def plan(self, rng: np.random.Generator, skin_mm: Sides_mm) -> Plan:
        """Plan one filling per pass, with one stop per load.

        The depths in the plan are NaN, because they depend on the skin (see `depths_under_load`).
        """
        weight_N = np.tile(load_steps_N(self.force_max_N, self.step_N), (self.passes_n, 1))
        centre_mm = np.full(weight_N.shape, CENTRE_MM)
        stops_mm = (centre_mm, centre_mm, np.full(weight_N.shape, np.nan))
        description = f"a glass on the skin, filled {self.passes_n} times to {self.force_max_N:g} N "
        description += f"in steps of {self.step_N:g} N"
        return _upright_plan(stops_mm, description, np.arange(self.passes_n, dtype=np.int32), weight_N=weight_N)


class Walk(_OnlyTemperature):
    """Steps of a shoe, or touches of a glove, in one continuous recording (paper section 6: dog shoe, glove)."""

    kind: Literal["walk"]
    steps_n: Count
    stance_s: tuple[Duration_s, Duration_s]  # limits of the time in which the skin is touched in one step
    swing_s: tuple[Duration_s, Duration_s]  # limits of the time without contact after each step
    quiet_s: Duration_s  # time without contact before the first step
    depth_mm: tuple[Depth_mm, Depth_mm]  # limits of the largest depth in one step
    rate_hz: Rate_hz

    def plan(self, rng: np.random.Generator, skin_mm: Sides_mm) -> Plan:
        """Plan a walk as a single indentation, in which each frame is one stop.

        After each step, the tip stays above the skin for some time.
        """
        stance_n, swing_n = (
            np.maximum(np.round(rng.uniform(*range_s, size=self.steps_n) * self.rate_hz).astype(np.int64), 1)
            for range_s in (self.stance_s, self.swing_s)
        )
        peaks_mm = rng.uniform(*self.depth_mm, size=self.steps_n)
        place_mm = np.repeat(_draw_places_mm(self.steps_n, rng), stance_n + swing_n, axis=0)
        parts = [
            part
            for stance, swing, peak_mm in zip(stance_n, swing_n, peaks_mm, strict=True)
            for part in (half_sine(int(stance), float(peak_mm)), np.full(int(swing), LIFTED_MM))
        ]
        stops_mm = (place_mm[None, :, 0], place_mm[None, :, 1], np.concatenate(parts)[None])
        return _upright_plan(stops_mm, f"{self.steps_n} steps of a walk in one continuous recording")


Protocol = Annotated[Grid | Drag | Hand | Scatter | Load | Walk, Field(discriminator="kind")]


def _upright_plan(
    stops_mm: tuple[np.ndarray, np.ndarray, np.ndarray],
    description: str,
    pass_i: Int32[np.ndarray, " n"] | None = None,
    *,
    weight_N: Float64[np.ndarray, "n p"] | None = None,
    centre_mm: tuple[float, float] = (CENTRE_MM, CENTRE_MM),
) -> Plan:
    """Create a plan with an upright tip, from x, y and depth at the p stops of n indentations.

    If `pass_i` is None, all indentations belong to one pass.
    """
    n = len(stops_mm[0])
    passes = np.zeros(n, np.int32) if pass_i is None else pass_i
    return Plan(passes, *stops_mm, np.zeros((n, 2)), description, weight_N=weight_N, centre_mm=centre_mm)


def load_steps_N(force_max_N: float, step_N: float) -> Float64[np.ndarray, " p"]:
    """Return the loads of one filling, which increase from 0 to the maximum in equal steps."""
    return step_N * np.arange(round(force_max_N / step_N) + 1)


def depths_under_load(skin: Skin, load_N: Float[np.ndarray, "n p"]) -> Float64[np.ndarray, "n p"]:
    """Return the commanded depth in m at which the force on the skin equals each load.

    At the load 0, the tip just touches the skin.

    Raises
    ------
    ParamsError
        If a load exceeds the force at the greatest depth.
    """
    distinct_N, index = np.unique(load_N, return_inverse=True)
    return np.array([_depth_under_load(skin, float(distinct)) for distinct in distinct_N])[index].reshape(load_N.shape)


def _depth_under_load(skin: Skin, load_N: float) -> float:
    if load_N == 0:
        return -skin.depth_zero_m
    deepest_m = DEEPEST_SHARE * min(skin.thickness_m, skin.tip_radius_m) - skin.depth_zero_m

    def missing_N(depth_m: float) -> float:
        return float(forces(skin, np.array([depth_m]))[0]) - load_N

    if missing_N(deepest_m) < 0:
        rule = f"at most {missing_N(deepest_m) + load_N:.3g} N, the force at the greatest depth"
        raise ParamsError(f"skin {skin.name}", "weight", rule, f"{load_N:.3g} N", "Reduce force_max_N.")
    return float(brentq(missing_N, -skin.depth_zero_m, deepest_m, xtol=DEPTH_STEP_M))


def half_sine(frames_n: int, peak_mm: float) -> Float64[np.ndarray, " p"]:
    """Return the depth in mm of a press at the middle of each frame.

    The depth over time is half a period of a sine with the amplitude `peak_mm`.
    """
    return peak_mm * np.sin(np.pi * (np.arange(frames_n) + 0.5) / frames_n)


def _draw_places_mm(places_n: int, rng: np.random.Generator) -> Float64[np.ndarray, "n 2"]:
    grid_mm = points_mm()
    return grid_mm[rng.integers(len(grid_mm), size=places_n)]
