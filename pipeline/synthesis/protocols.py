"""Where the tip goes, in what order: grid, drag lines, hand. In: a section of a scene. Out: a `Plan` of stops.

Places are labels: mm from 0 to 16, the middle of the skin at (8, 8). A stop is a place and a depth at which readings
are taken; an indentation is one stop, or the many of a dragged line. Refuses to know robots' errors, clocks and fields.
"""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from pipeline.dataset.grid import CENTRE_MM, PITCH_MM, SIDE_POINTS_N, protocol
from pipeline.synthesis import pressing
from pipeline.synthesis.plans import Count, Depth_mm, Duration_s, Plan, Rate_hz, Shared
from pipeline.synthesis.scattering import Scatter, scatter


class Grid(Shared):
    """The paper's grid: 65 places, depth by depth, pass by pass (section 3)."""

    kind: Literal["grid"]
    passes_n: Count
    depths_mm: Annotated[tuple[Depth_mm, ...], Field(min_length=1)]


class Drag(Shared):
    """Drag lines every 2 mm, along x and along y, over the whole grid (section 4, shear)."""

    kind: Literal["drag"]
    passes_n: Count
    depths_mm: Annotated[tuple[Depth_mm, ...], Field(min_length=1)]
    step_mm: Annotated[float, Field(gt=0, le=4)]  # between stops


class Hand(Shared):
    """Pokes by hand along lines: only their order is known, not their place, depth or force (section 5.2)."""

    kind: Literal["hand"]
    lines_n: Count
    pokes_per_line_n: Annotated[int, Field(ge=2, le=1000)]
    depth_mm: tuple[Depth_mm, Depth_mm]  # from, to: anything between them
    place_sd_mm: Annotated[float, Field(ge=0, le=2)]  # off the line, and along it
    tilt_sd_deg: Annotated[float, Field(ge=0, le=20)]  # of the stylus, about each axis

    @model_validator(mode="after")
    def _depths_rise(self) -> "Hand":
        if not self.depth_mm[0] <= self.depth_mm[1]:
            raise ValueError(f"depth_mm goes from the shallower to the deeper, not {self.depth_mm}")
        return self


class _Pressed(Shared):
    # Ageing and relaxation would change the force between stops, which no model here follows; nothing goes sideways.
    terms: tuple[Literal["temperature"], ...]

    @model_validator(mode="after")
    def _ranges_rise(self) -> "_Pressed":
        for name, value in self:
            if isinstance(value, tuple) and len(value) == 2 and value[0] > value[1]:
                raise ValueError(f"{name} goes from the lower to the higher, not {value}")
        return self


class Load(_Pressed):
    """A glass that is filled step by step at the skin's middle (section 6); its foot taken as the rig's round tip."""

    kind: Literal["load"]
    # Fillings: a direction is fitted on one half of them, and tested on the other.
    passes_n: Annotated[int, Field(ge=2, le=100_000)]
    force_max_N: Annotated[float, Field(gt=0, le=100)]
    step_N: Annotated[float, Field(gt=0, le=100)]

    @model_validator(mode="after")
    def _steps_fill_it(self) -> "Load":
        steps = self.force_max_N / self.step_N
        if round(steps) < 1 or abs(steps - round(steps)) > 1e-6:
            raise ValueError(f"force_max_N is a whole number of step_N, not {steps:.4g}")
        return self


class Press(_Pressed):
    """Presses that never rest: each frame is a stop (section 7, dynamic data), so the frames' rate belongs to it."""

    kind: Literal["press"]
    presses_n: Count
    duration_s: tuple[Duration_s, Duration_s]  # from, to: evenly in the logarithm
    depth_mm: tuple[Depth_mm, Depth_mm]
    rate_hz: Rate_hz


class Walk(_Pressed):
    """Steps of a shoe or touches of a glove, in one log without labels (section 6: dog shoe, glove)."""

    kind: Literal["walk"]
    steps_n: Count
    stance_s: tuple[Duration_s, Duration_s]
    swing_s: tuple[Duration_s, Duration_s]
    quiet_s: Duration_s  # before the first step
    depth_mm: tuple[Depth_mm, Depth_mm]
    rate_hz: Rate_hz


SKIN_MM = (20.0, 20.0)  # authors' CAD
Protocol = Annotated[Grid | Drag | Hand | Scatter | Load | Press | Walk, Field(discriminator="kind")]


def make_plan(asked: Protocol, rng: np.random.Generator, *, skin_mm: tuple[float, float] = SKIN_MM) -> Plan:
    """Lay out the stops of a protocol on a skin of these sides; grid, drag and load are not random."""
    match asked:
        case Grid():
            return _grid(asked)
        case Drag():
            return _drag(asked)
        case Hand():
            return _hand(asked, rng)
        case Scatter():
            return scatter(asked, skin_mm, rng)
        case Load():
            return _load(asked)
        case Press():
            return _press(asked, rng)
        case Walk():
            return _walk(asked, rng)


def _grid(asked: Grid) -> Plan:
    pokes = protocol(asked.depths_mm, asked.passes_n)
    return Plan(
        pass_i=pokes.pass_i,
        x_mm=pokes.x_mm[:, None],
        y_mm=pokes.y_mm[:, None],
        depth_mm=pokes.depth_mm[:, None],
        tilt=np.zeros((len(pokes), 2)),
        labelled=True,
        words=f"65-point grid, {len(asked.depths_mm)} depths, {asked.passes_n} passes",
    )


def _drag(asked: Drag) -> Plan:
    # Snake: each next line is dragged the other way, along x on every row, then along y on every column.
    stops_n = round(2 * CENTRE_MM / asked.step_mm) + 1
    along_mm = np.linspace(0, 2 * CENTRE_MM, stops_n)
    there = np.where((np.arange(SIDE_POINTS_N) % 2 == 0)[:, None], along_mm, along_mm[::-1])
    across_mm = np.repeat(PITCH_MM * np.arange(SIDE_POINTS_N)[:, None], stops_n, axis=1)
    one_x_mm, one_y_mm = np.concatenate([there, across_mm]), np.concatenate([across_mm, there])
    lines_n, depths_n = len(one_x_mm), len(asked.depths_mm)
    x_mm, y_mm = (np.tile(one, (depths_n, 1)) for one in (one_x_mm, one_y_mm))
    # Every second pass goes back along the lines, or where the tip is would tell which way it is pushed.
    turned = [slice(None, None, -1 if pass_i % 2 else 1) for pass_i in range(asked.passes_n)]
    depth_mm = np.tile(np.repeat(np.array(asked.depths_mm), lines_n), asked.passes_n)
    return Plan(
        pass_i=np.repeat(np.arange(asked.passes_n, dtype=np.int32), depths_n * lines_n),
        x_mm=np.concatenate([x_mm[:, way] for way in turned]),
        y_mm=np.concatenate([y_mm[:, way] for way in turned]),
        depth_mm=np.repeat(depth_mm[:, None], stops_n, axis=1),
        tilt=np.zeros((len(depth_mm), 2)),
        labelled=True,
        words=f"drag lines every {PITCH_MM:g} mm, {depths_n} depths, {asked.passes_n} passes, "
        f"stops every {2 * CENTRE_MM / (stops_n - 1):g} mm",
    )


def _hand(asked: Hand, rng: np.random.Generator) -> Plan:
    # Lines side by side over the grid; the pass counts lines, so that the order along one line is what is known.
    across_mm = np.linspace(0, 2 * CENTRE_MM, asked.lines_n) if asked.lines_n > 1 else np.array([CENTRE_MM])
    along_mm = np.linspace(0, 2 * CENTRE_MM, asked.pokes_per_line_n)
    pokes_n = asked.lines_n * asked.pokes_per_line_n
    place_mm = np.stack([np.tile(along_mm, asked.lines_n), np.repeat(across_mm, asked.pokes_per_line_n)], axis=1)
    place_mm = np.clip(place_mm + asked.place_sd_mm * rng.standard_normal((pokes_n, 2)), 0, 2 * CENTRE_MM)
    return Plan(
        pass_i=np.repeat(np.arange(asked.lines_n, dtype=np.int32), asked.pokes_per_line_n),
        x_mm=place_mm[:, :1],
        y_mm=place_mm[:, 1:],
        depth_mm=rng.uniform(*asked.depth_mm, size=(pokes_n, 1)),
        tilt=np.tan(np.radians(asked.tilt_sd_deg) * rng.standard_normal((pokes_n, 2)).clip(-2, 2)),
        labelled=False,
        words=f"by hand, {asked.lines_n} lines of {asked.pokes_per_line_n} pokes, order known only",
    )


def _load(asked: Load) -> Plan:
    weight_N = np.tile(pressing.weights_N(asked.force_max_N, asked.step_N), (asked.passes_n, 1))
    middle_mm = np.full(weight_N.shape, CENTRE_MM)
    return Plan(
        pass_i=np.arange(asked.passes_n, dtype=np.int32),
        x_mm=middle_mm,
        y_mm=middle_mm,
        depth_mm=np.full(weight_N.shape, np.nan),
        tilt=np.zeros((asked.passes_n, 2)),
        labelled=True,
        words=f"{asked.passes_n} fillings of a glass, to {asked.force_max_N:g} N by {asked.step_N:g} N",
        weight_N=weight_N,
    )


def _press(asked: Press, rng: np.random.Generator) -> Plan:
    stops = pressing.presses(
        asked.presses_n, duration_s=asked.duration_s, depth_mm=asked.depth_mm, rate_hz=asked.rate_hz, rng=rng
    )
    least_s, most_s = asked.duration_s
    return _of_stops(stops, f"{asked.presses_n} presses of {least_s:g} to {most_s:g} s, read throughout")


def _walk(asked: Walk, rng: np.random.Generator) -> Plan:
    stops = pressing.footfalls(
        asked.steps_n, stance_s=asked.stance_s, swing_s=asked.swing_s, depth_mm=asked.depth_mm, rate_hz=asked.rate_hz,
        rng=rng,
    )  # fmt: skip
    return _of_stops(stops, f"a walk of {asked.steps_n} steps")


def _of_stops(stops: pressing.Stops, words: str) -> Plan:
    n = len(stops.depth_mm)
    passes = np.zeros(n, np.int32)
    return Plan(passes, stops.x_mm, stops.y_mm, stops.depth_mm, np.zeros((n, 2)), labelled=True, words=words)
