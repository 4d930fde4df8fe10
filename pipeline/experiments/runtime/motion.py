"""Where given nodes go under every poke, for software that cannot move them. In: a trial, a skin. Out: paths.

The flow is that of `pipeline.physics.flow`, its steps and its reach included, so that only what is summed differs.
Refuses to know fields and errors.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.interpolate import RectBivariateSpline

from pipeline.experiments.runtime.trials import Trial
from pipeline.physics import flow, flow_map
from pipeline.physics.skin import Skin

RADII_N, HEIGHTS_N = 56, 16  # twice as many change dB by 0.1 %


@dataclass(frozen=True)
class Path:
    """Place and rotation vector of every node under every poke."""

    nodes_m: Float[np.ndarray, "n s 3"]
    turns_rad: Float[np.ndarray, "n s 3"]


def paths(trial: Trial, skin: Skin) -> Path:
    """Follow the skin's nodes through every poke of the trial."""
    nodes_m = np.tile(skin.nodes_m, (len(trial.pokes_m), 1, 1))
    turns_rad = np.zeros_like(nodes_m)
    true_m = trial.pokes_m[:, 2] + skin.depth_zero_m
    press = flow.Press(skin.thickness_m, skin.tip_radius_m, skin.base)
    bends, reach_m = _bends(press, tuple(np.unique(true_m).tolist()))
    for poke_i, (poke_m, depth_m) in enumerate(zip(trial.pokes_m, true_m, strict=True)):
        bend = bends[float(depth_m)]
        away_m = skin.nodes_m[:, :2] - poke_m[:2]
        r_m = np.hypot(*away_m.T)
        outward_m, up_m, angle_rad = np.sqrt(r_m**2 + bend.grown_m2) - r_m, np.zeros_like(r_m), np.zeros_like(r_m)
        here = r_m < reach_m
        for part, spline in zip((outward_m, up_m, angle_rad), bend.splines, strict=True):
            part[here] = spline.ev(r_m[here], skin.nodes_m[here, 2])
        cos, sin = (away_m / np.where(r_m > 0, r_m, 1.0)[:, None]).T
        nodes_m[poke_i] += np.stack([outward_m * cos, outward_m * sin, up_m], axis=1)
        turns_rad[poke_i] += angle_rad[:, None] * np.stack([-sin, cos, np.zeros_like(cos)], axis=1)
    return Path(nodes_m, turns_rad)


@dataclass(frozen=True)
class _Bend:
    """Splines of the change of r, of z and of the angle over (r, z); past their reach r^2 grows."""

    splines: tuple[RectBivariateSpline, ...]
    grown_m2: float


@lru_cache(maxsize=8)
def _bends(press: flow.Press, depths_m: tuple[float, ...]) -> tuple[dict[float, _Bend], float]:
    reach_m = press.thickness_m * flow_map.reach(press.tip_radius_m / press.thickness_m, press.base)
    r_m = reach_m * np.linspace(0, 1, RADII_N) ** 1.5
    z_m = press.thickness_m * np.linspace(0, 1, HEIGHTS_N)
    r0_m, z0_m = (part.ravel() for part in np.meshgrid(r_m, z_m, indexing="ij"))
    steps_m = flow.steps(depths_m, press)
    found = {}
    for step_m, at in zip(steps_m, flow.follow(r0_m, z0_m, steps_m, press=press), strict=True):
        changes = [part.reshape(RADII_N, HEIGHTS_N) for part in (at.r_m - r0_m, at.z_m - z0_m, flow.angle(at.f))]
        edge_m = reach_m + float(changes[0][-1].mean())
        grown_m2 = edge_m**2 - reach_m**2 if press.base == "slipping" else 0.0
        found[float(step_m)] = _Bend(tuple(RectBivariateSpline(r_m, z_m, one) for one in changes), grown_m2)
    return found, reach_m
