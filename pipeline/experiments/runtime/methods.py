"""The ways to sum a skin. In: a trial and a rule of quadrature. Out: how many nodes, and a call that gives dB.

What a call leaves out: drawing the skin and tabulating its flow, done once for thousands of pokes; for magpylib also
moving the nodes and making its objects. Refuses to know references and clocks.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from magpylib import getB
from magpylib.magnet import Cuboid
from magpylib.misc import Dipole
from scipy.constants import mu_0
from scipy.spatial.transform import Rotation

from pipeline.experiments.runtime.lattices import box_m, gauss_everywhere, midpoints
from pipeline.experiments.runtime.motion import Path, paths
from pipeline.experiments.runtime.trials import Trial, laid
from pipeline.experiments.verification.field import field_of
from pipeline.physics.change import change_of_field
from pipeline.physics.nodes import Nodes, Quadrature, place_nodes
from pipeline.physics.skin import Skin, changes_of_field

Changes = Float[np.ndarray, "n k 3"]


@dataclass(frozen=True)
class Prepared:
    """A skin that only waits to be poked: all pokes of its trial in one call."""

    nodes_n: int
    call: Callable[[], Changes]


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
        rest = skin.nodes_m, skin.moments_A_m2
        return np.stack(
            [change_of_field(rest, now, trial.board.chips_m) for now in zip(path.nodes_m, moments, strict=True)]
        )

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
        one = at_origin(i)
        one.position = np.vstack([place_m, path.nodes_m[:, i]])
        one.orientation = Rotation.from_rotvec(np.vstack([np.zeros(3), path.turns_rad[:, i]]))
        objects.append(one)

    def call() -> Changes:
        b_T = getB(objects, chips_m, sumup=True).reshape(-1, len(chips_m), 3)
        return b_T[1:] - b_T[0]

    return Prepared(len(objects), call)
