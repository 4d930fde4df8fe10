"""The ways to sum a skin. In: a trial and a rule of quadrature. Out: how many nodes, and a call that gives dB.

What a call leaves out: drawing the skin and tabulating its flow, done once for thousands of pokes; for magpylib also
moving the nodes (by `flow`, its steps and its reach included, so that only what is summed differs) and making its
objects. Refuses to know references and clocks.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float
from magpylib import getB
from magpylib.magnet import Cuboid
from magpylib.misc import Dipole
from scipy.constants import mu_0
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from pipeline.experiments.runtime.trials import Trial, box_m, gauss_everywhere, laid, midpoints
from pipeline.experiments.verification.field import field_of
from reskin.physics import flow_map, layer, slide
from reskin.physics.magnet import Nodes, Quadrature, change_of_field, place_nodes
from reskin.physics.skin import Skin, changes_of_field, press_slides

RADII_N, HEIGHTS_N = 56, 16  # of the splines that move nodes; twice as many change dB by 0.1 %
Changes = Float[np.ndarray, "n k 3"]


@dataclass(frozen=True)
class Prepared:
    """A skin that only waits to be poked: all pokes of its trial in one call."""

    nodes_n: int
    call: Callable[[], Changes]


@dataclass(frozen=True)
class Path:
    """Place and rotation vector of every node under every poke."""

    nodes_m: Float[np.ndarray, "n s 3"]
    turns_rad: Float[np.ndarray, "n s 3"]


def whole(trial: Trial, rest: Nodes) -> Prepared:
    """Take the product's way over any nodes: flow and field of every poke."""
    skin = laid(trial, rest)
    return Prepared(len(skin.nodes_m), lambda: changes_of_field(trial.board, skin, trial.pokes_m)[1])


def gauss_in_z(trial: Trial, rule: Quadrature) -> Prepared:
    """Take the product's way: cells that end at the seams, Gauss nodes over the thickness, flow and field included."""
    return whole(trial, place_nodes(trial.skin.thickness_m, rule))


def midpoint(trial: Trial, rule: Quadrature) -> Prepared:
    """Take the product's way over the middles of equal boxes."""
    return whole(trial, midpoints(trial.skin.thickness_m, rule))


def gauss_in_xyz(trial: Trial, rule: Quadrature) -> Prepared:
    """Take the product's way over 2 x 2 Gauss nodes in each cell, times the Gauss nodes over the thickness."""
    return whole(trial, gauss_everywhere(trial.skin.thickness_m, rule, per_cell_n=2))


def kernel_alone(trial: Trial, rule: Quadrature) -> Prepared:
    """Sum the product's nodes by its compiled kernel, moved before: what magpylib's times are to be compared with.

    It computes each node at rest and moved, and so needs no difference of large sums; magpylib's rest is kept instead.
    """
    skin = laid(trial, place_nodes(trial.skin.thickness_m, rule))
    path = paths(trial, skin)
    moments = _turned(path, skin.moments_A_m2)

    def call() -> Changes:
        rest, poked = (skin.nodes_m, skin.moments_A_m2), zip(path.nodes_m, moments, strict=True)
        return np.stack([change_of_field(rest, now, trial.board.chips_m) for now in poked])

    return Prepared(len(skin.nodes_m), call)


def magpylib_core(trial: Trial, rule: Quadrature) -> Prepared:
    """Sum the product's nodes by magpylib.core: every pair of node and chip in one vectorised call a poke."""
    skin = laid(trial, place_nodes(trial.skin.thickness_m, rule))
    path = paths(trial, skin)
    moments = _turned(path, skin.moments_A_m2)
    rest_T = field_of((skin.nodes_m, skin.moments_A_m2), trial.board.chips_m)

    def call() -> Changes:
        poked = zip(path.nodes_m, moments, strict=True)
        return np.stack([field_of(now, trial.board.chips_m) - rest_T for now in poked])

    return Prepared(len(skin.nodes_m), call)


def magpylib_dipoles(trial: Trial, rule: Quadrature) -> Prepared:
    """Sum the product's nodes by magpylib's objects: one Dipole a node, each with its path through all pokes."""
    skin = laid(trial, place_nodes(trial.skin.thickness_m, rule))
    return _by_objects(trial, skin, lambda i: Dipole(moment=skin.moments_A_m2[i]))


def magpylib_cuboids(trial: Trial, rule: Quadrature) -> Prepared:
    """Sum equal boxes by magpylib's objects: one Cuboid a box that moves and turns with its middle, undeformed."""
    rest = midpoints(trial.skin.thickness_m, rule)
    skin = laid(trial, rest)
    j_T = mu_0 * skin.moments_A_m2 / rest.volumes_m3[:, None]
    sides_m = box_m(trial.skin.thickness_m, rule)
    return _by_objects(trial, skin, lambda i: Cuboid(polarization=j_T[i], dimension=sides_m))


METHODS: dict[str, Callable[[Trial, Quadrature], Prepared]] = {
    "Gauss in z": gauss_in_z,
    "midpoint": midpoint,
    "Gauss in x, y and z": gauss_in_xyz,
    "kernel alone": kernel_alone,
    "magpylib.core dipoles": magpylib_core,
    "magpylib dipoles": magpylib_dipoles,
    "magpylib cuboids": magpylib_cuboids,
}


def _turned(path: Path, moments_A_m2: Float[np.ndarray, "s 3"]) -> Float[np.ndarray, "n s 3"]:
    return np.stack([Rotation.from_rotvec(turns_rad).apply(moments_A_m2) for turns_rad in path.turns_rad])


def _by_objects(trial: Trial, skin: Skin, at_origin: Callable[[int], Any]) -> Prepared:
    chips_m, path = trial.board.chips_m, paths(trial, skin)
    objects = []
    for i, place_m in enumerate(skin.nodes_m):
        # The first place of each path is rest, so that one call gives the field before and under every poke.
        source = at_origin(i)
        source.position = np.vstack([place_m, path.nodes_m[:, i]])
        source.orientation = Rotation.from_rotvec(np.vstack([np.zeros(3), path.turns_rad[:, i]]))
        objects.append(source)

    def call() -> Changes:
        b_T = getB(objects, chips_m, sumup=True).reshape(-1, len(chips_m), 3)
        return b_T[1:] - b_T[0]

    return Prepared(len(objects), call)


def paths(trial: Trial, skin: Skin) -> Path:
    """Follow the skin's nodes through every poke of the trial."""
    nodes_m = np.tile(skin.nodes_m, (len(trial.pokes_m), 1, 1))
    turns_rad = np.zeros_like(nodes_m)
    true_m = trial.pokes_m[:, 2] + skin.depth_zero_m
    press = layer.Press(skin.thickness_m, skin.tip_radius_m, skin.base)
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
    if skin.hold is not None:
        true_poke_m = np.column_stack([trial.pokes_m[:, :2], true_m])
        _slide(nodes_m, turns_rad, press_slides(skin, skin.hold, true_poke_m), skin.seat_m)
    return Path(nodes_m, turns_rad)


def _slide(
    nodes_m: Float[np.ndarray, "n s 3"], turns_rad: Float[np.ndarray, "n s 3"], motion: slide.Slide,
    middle_m: Float[np.ndarray, "2"],
) -> None:  # fmt: skip
    for poke_i, spin_rad in enumerate(motion.spin_rad):
        spin = Rotation.from_rotvec((0.0, 0.0, spin_rad))
        nodes_m[poke_i], _ = slide.apply(motion, poke_i, (nodes_m[poke_i], turns_rad[poke_i]), middle_m)
        turns_rad[poke_i] = (spin * Rotation.from_rotvec(turns_rad[poke_i])).as_rotvec()


@dataclass(frozen=True)
class _Bend:
    """Splines of the change of r, of z and of the angle over (r, z); past their reach r^2 grows."""

    splines: tuple[RectBivariateSpline, ...]
    grown_m2: float


@lru_cache(maxsize=8)
def _bends(press: layer.Press, depths_m: tuple[float, ...]) -> tuple[dict[float, _Bend], float]:
    reach_m = press.thickness_m * flow_map.reach(press.tip_radius_m / press.thickness_m, press.base)
    r_m = reach_m * np.linspace(0, 1, RADII_N) ** 1.5
    z_m = press.thickness_m * np.linspace(0, 1, HEIGHTS_N)
    r0_m, z0_m = (part.ravel() for part in np.meshgrid(r_m, z_m, indexing="ij"))
    steps_m = layer.steps(depths_m, press)
    found = {}
    for step_m, end in zip(steps_m, layer.follow(r0_m, z0_m, steps_m, press=press), strict=True):
        changes = [part.reshape(RADII_N, HEIGHTS_N) for part in (end.r_m - r0_m, end.z_m - z0_m, layer.angle(end.f))]
        edge_m = reach_m + float(changes[0][-1].mean())
        grown_m2 = edge_m**2 - reach_m**2 if press.base == "slipping" else 0.0
        found[float(step_m)] = _Bend(tuple(RectBivariateSpline(r_m, z_m, change) for change in changes), grown_m2)
    return found, reach_m
