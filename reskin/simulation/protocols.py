"""Protocols of simulated captures. A protocol plans the places and depths of the tip in order of time."""

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

LIFTED_MM = -1.0  # depth of a tip above the skin, without contact; such stops are not in the robot's log
DEPTH_STEP_M = 1e-12  # tolerance of the depth under a load; 1e-8 N for a skin with a stiffness of 10 N/mm
DEEPEST_SHARE = 0.999  # largest depth under a load, relative to the smaller of thickness and tip radius


@dataclass(frozen=True)
class Stops:
    """Positions of the tip in mm, for n indentations with p stops each."""

    x_mm: Float64[np.ndarray, "n p"]
    y_mm: Float64[np.ndarray, "n p"]
    depth_mm: Float64[np.ndarray, "n p"]


Count = Annotated[int, Field(ge=1, le=100_000)]
Depth_mm = Annotated[float, Field(gt=0, le=10)]
Depths_mm = Annotated[tuple[Depth_mm, ...], Field(min_length=1)]
Duration_s = Annotated[float, Field(gt=0, le=100)]
Rate_hz = Annotated[float, Field(gt=0, le=1e4)]
Sides_mm = tuple[float, float]


@dataclass(frozen=True)
class Plan:
    """The stops of the tip at which readings are taken, in order of time: n indentations with p stops each.

    A negative depth is a stop above the skin. Depths are NaN if `weight_N` commands loads instead. `tilt` is the slope
    of the stylus, dx/dz and dy/dz. `centre_mm` is the skin's centre in the coordinate system of the labels.
    """

    pass_i: Int32[np.ndarray, " n"]
    x_mm: Float64[np.ndarray, "n p"]
    y_mm: Float64[np.ndarray, "n p"]
    depth_mm: Float64[np.ndarray, "n p"]
    tilt: Float64[np.ndarray, "n 2"]
    description: str
    labelled: bool = True  # whether places, depths and forces are in the probe log
    weight_N: Float64[np.ndarray, "n p"] | None = None  # commanded loads
    centre_mm: tuple[float, float] = (CENTRE_MM, CENTRE_MM)

    def __len__(self) -> int:
        return len(self.pass_i)


class ProtocolSettings(Strict):
    """Settings that all protocols have."""

    boards: str  # kind of board: a key of the scene's section `boards`
    # number of skins; the first skin of each board is used first, then the second skin of each board, ...
    skins_n: Count
    terms: tuple[
        Literal["ageing", "friction", "memory", "relaxation", "temperature"], ...
    ]  # physical effects to simulate
    rate_hz: Rate_hz | None = None  # frame rate (lower for boards with more chips); default: the rate of the rig


class _RandomDepth(ProtocolSettings):
    depth_mm: tuple[Depth_mm, Depth_mm]  # depths are uniformly distributed between these limits

    @model_validator(mode="after")
    def _check_depths(self) -> "_RandomDepth":
        if not self.depth_mm[0] <= self.depth_mm[1]:
            raise ValueError(f"depth_mm must list the smaller depth first, not {self.depth_mm}")
        return self


class _OnlyTemperature(ProtocolSettings):
    # The other effects are not allowed. Ageing and relaxation would change the force between stops, which is not
    # modelled. Friction has no effect, because the tip does not move sideways.
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
        """Plan one indentation per place, depth and pass; all places are pressed at one depth before the next depth."""
        pokes = protocol(self.depths_mm, self.passes_n)
        stops = Stops(pokes.x_mm[:, None], pokes.y_mm[:, None], pokes.depth_mm[:, None])
        return _upright_plan(
            stops, f"65-point grid, {len(self.depths_mm)} depths, {self.passes_n} passes", pokes.pass_i
        )


class Drag(ProtocolSettings):
    """A tip that is dragged along lines in x and in y, 2 mm apart, over the whole grid (paper section 4, shear)."""

    kind: Literal["drag"]
    passes_n: Count
    depths_mm: Depths_mm
    step_mm: Annotated[float, Field(gt=0, le=4)]  # distance between stops

    def plan(self, rng: np.random.Generator, skin_mm: Sides_mm) -> Plan:
        """Plan one indentation per line, depth and pass; the direction alternates from line to line."""
        stops_n = round(2 * CENTRE_MM / self.step_mm) + 1
        along_mm = np.linspace(0, 2 * CENTRE_MM, stops_n)
        alternating_mm = np.where((np.arange(SIDE_POINTS_N) % 2 == 0)[:, None], along_mm, along_mm[::-1])
        across_mm = np.repeat(PITCH_MM * np.arange(SIDE_POINTS_N)[:, None], stops_n, axis=1)
        lines_n, depths_n = 2 * SIDE_POINTS_N, len(self.depths_mm)
        x_mm = np.tile(np.concatenate([alternating_mm, across_mm]), (depths_n, 1))
        y_mm = np.tile(np.concatenate([across_mm, alternating_mm]), (depths_n, 1))
        # In every second pass, all lines are reversed, so that the direction of the force cannot be inferred from the
        # place.
        directions = [slice(None, None, -1 if pass_i % 2 else 1) for pass_i in range(self.passes_n)]
        depth_mm = np.tile(np.repeat(np.array(self.depths_mm), lines_n), self.passes_n)
        stops = Stops(
            np.concatenate([x_mm[:, direction] for direction in directions]),
            np.concatenate([y_mm[:, direction] for direction in directions]),
            np.repeat(depth_mm[:, None], stops_n, axis=1),
        )
        description = f"drag lines every {PITCH_MM:g} mm, {depths_n} depths, {self.passes_n} passes, "
        description += f"stops every {2 * CENTRE_MM / (stops_n - 1):g} mm"
        pass_i = np.repeat(np.arange(self.passes_n, dtype=np.int32), depths_n * lines_n)
        return _upright_plan(stops, description, pass_i)


class Hand(_RandomDepth):
    """Manual indentations without labels: only their order along lines is known (paper section 5.2)."""

    kind: Literal["hand"]
    lines_n: Count
    pokes_per_line_n: Annotated[int, Field(ge=2, le=1000)]
    place_sd_mm: Annotated[float, Field(ge=0, le=2)]  # standard deviation of the place, across the line and along it
    tilt_sd_deg: Annotated[float, Field(ge=0, le=20)]  # standard deviation of the stylus's tilt about x and about y

    def plan(self, rng: np.random.Generator, skin_mm: Sides_mm) -> Plan:
        """Plan indentations along parallel lines over the grid; each line is one pass."""
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
            description=f"by hand, {self.lines_n} lines of {self.pokes_per_line_n} pokes, order known only",
            labelled=False,
        )


class Scatter(_RandomDepth):
    """Indentations at random places, uniformly distributed over a skin (paper section 6, arm sleeve).

    The origin of the labels is a corner of the skin.
    """

    kind: Literal["scatter"]
    pokes_n: Count
    margin_mm: Annotated[float, Field(ge=0)]  # smallest distance of a place from the edges of the skin

    def plan(self, rng: np.random.Generator, skin_mm: Sides_mm) -> Plan:
        """Draw places and depths from uniform distributions."""
        if not 2 * self.margin_mm < min(skin_mm):
            rule = f"less than half of the skin's shorter side, {min(skin_mm) / 2:g} mm"
            raise ParamsError("protocol scatter", "margin_mm", rule, self.margin_mm, "Lower it.")
        most_mm = np.array(skin_mm) - self.margin_mm
        place_mm = rng.uniform(self.margin_mm, most_mm, size=(self.pokes_n, 2))
        depth_mm = rng.uniform(*self.depth_mm, size=(self.pokes_n, 1))
        description = f"{self.pokes_n} pokes scattered over {skin_mm[0]:g} x {skin_mm[1]:g} mm, "
        description += f"{self.margin_mm:g} mm from its edges"
        stops = Stops(place_mm[:, :1], place_mm[:, 1:], depth_mm)
        return _upright_plan(stops, description, centre_mm=(skin_mm[0] / 2, skin_mm[1] / 2))


class Load(_OnlyTemperature):
    """A glass on the skin's centre that is filled in steps (paper section 6), modelled as a load on the rig's tip."""

    kind: Literal["load"]
    # Number of fillings; at least 2, because an experiment fits to half of the fillings and tests on the other half.
    passes_n: Annotated[int, Field(ge=2, le=100_000)]
    force_max_N: Annotated[float, Field(gt=0, le=100)]
    step_N: Annotated[float, Field(gt=0, le=100)]

    @model_validator(mode="after")
    def _check_steps(self) -> "Load":
        steps = self.force_max_N / self.step_N
        if round(steps) < 1 or abs(steps - round(steps)) > 1e-6:
            raise ValueError(f"force_max_N must be a multiple of step_N, not {steps:.4g} times step_N")
        return self

    def plan(self, rng: np.random.Generator, skin_mm: Sides_mm) -> Plan:
        """Plan one filling per pass. The depths are NaN: they will be computed from the loads and the skin."""
        weight_N = np.tile(load_steps_N(self.force_max_N, self.step_N), (self.passes_n, 1))
        centre_mm = np.full(weight_N.shape, CENTRE_MM)
        stops = Stops(centre_mm, centre_mm, np.full(weight_N.shape, np.nan))
        description = f"{self.passes_n} fillings of a glass, to {self.force_max_N:g} N by {self.step_N:g} N"
        return _upright_plan(stops, description, np.arange(self.passes_n, dtype=np.int32), weight_N=weight_N)


class Press(_OnlyTemperature):
    """Presses at grid places, whose depth is half a sine over time; each frame is a stop.

    These presses represent the dynamic data in section 7 of the paper.
    """

    kind: Literal["press"]
    presses_n: Count
    duration_s: tuple[Duration_s, Duration_s]  # durations are log-uniform between these limits
    depth_mm: tuple[Depth_mm, Depth_mm]
    rate_hz: Rate_hz

    def plan(self, rng: np.random.Generator, skin_mm: Sides_mm) -> Plan:
        """Draw places, durations and depths. After a short press, the tip stays lifted until the longest would end."""
        least_s, most_s = self.duration_s
        long_s = np.exp(rng.uniform(np.log(least_s), np.log(most_s), size=self.presses_n))
        long_n = np.maximum(np.round(long_s * self.rate_hz).astype(np.int64), 1)
        place_mm = _draw_places_mm(self.presses_n, rng)
        depths_mm = np.full((self.presses_n, int(long_n.max())), LIFTED_MM)
        for i, peak_mm in enumerate(rng.uniform(*self.depth_mm, size=self.presses_n)):
            depths_mm[i, : long_n[i]] = half_sine(int(long_n[i]), float(peak_mm))
        flat = np.ones(depths_mm.shape)
        stops = Stops(place_mm[:, :1] * flat, place_mm[:, 1:] * flat, depths_mm)
        return _upright_plan(stops, f"{self.presses_n} presses of {least_s:g} to {most_s:g} s, read throughout")


class Walk(_OnlyTemperature):
    """Footfalls of a shoe, or touches of a glove, in one continuous recording (paper section 6: dog shoe, glove)."""

    kind: Literal["walk"]
    steps_n: Count
    stance_s: tuple[Duration_s, Duration_s]
    swing_s: tuple[Duration_s, Duration_s]
    quiet_s: Duration_s  # time without contact before the first step
    depth_mm: tuple[Depth_mm, Depth_mm]
    rate_hz: Rate_hz

    def plan(self, rng: np.random.Generator, skin_mm: Sides_mm) -> Plan:
        """Plan a walk as one indentation with one stop per frame; footfalls alternate with swings above the skin."""
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
        stops = Stops(place_mm[None, :, 0], place_mm[None, :, 1], np.concatenate(parts)[None])
        return _upright_plan(stops, f"a walk of {self.steps_n} steps")


Protocol = Annotated[Grid | Drag | Hand | Scatter | Load | Press | Walk, Field(discriminator="kind")]


def _upright_plan(
    stops: Stops,
    description: str,
    pass_i: Int32[np.ndarray, " n"] | None = None,
    *,
    weight_N: Float64[np.ndarray, "n p"] | None = None,
    centre_mm: tuple[float, float] = (CENTRE_MM, CENTRE_MM),
) -> Plan:
    """Create a plan with an upright tip; without `pass_i`, all indentations are in one pass."""
    n = len(stops.depth_mm)
    passes = np.zeros(n, np.int32) if pass_i is None else pass_i
    return Plan(
        passes, stops.x_mm, stops.y_mm, stops.depth_mm, np.zeros((n, 2)), description, weight_N=weight_N,
        centre_mm=centre_mm,
    )  # fmt: skip


def load_steps_N(force_max_N: float, step_N: float) -> Float64[np.ndarray, " p"]:
    """Return the loads of one filling, from 0 to the maximum in equal steps."""
    return step_N * np.arange(round(force_max_N / step_N) + 1)


def depths_under_load(skin: Skin, load_N: Float[np.ndarray, "n p"]) -> Float64[np.ndarray, "n p"]:
    """Solve for the commanded depth in m at which the force equals each load; at load 0, the tip just touches the skin.

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
        raise ParamsError(f"skin {skin.name}", "weight", rule, f"{load_N:.3g} N", "Lower force_max_N.")
    return float(brentq(missing_N, -skin.depth_zero_m, deepest_m, xtol=DEPTH_STEP_M))


def half_sine(frames_n: int, peak_mm: float) -> Float64[np.ndarray, " p"]:
    """Return the depth in mm at the middle of each frame of a press whose depth is half a sine over time."""
    return peak_mm * np.sin(np.pi * (np.arange(frames_n) + 0.5) / frames_n)


def _draw_places_mm(places_n: int, rng: np.random.Generator) -> Float64[np.ndarray, "n 2"]:
    grid_mm = points_mm()
    return grid_mm[rng.integers(len(grid_mm), size=places_n)]
