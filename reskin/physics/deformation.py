"""Finite deformation of the skin under a spherical tip, computed in small steps and tabulated.

All values are in SI units. The linear solution of module `layer` is valid only for small depths. In this module, the
depth is therefore increased in small steps (12 to 24 steps for the usual depths). Each step first solves for the change
of the pressure that keeps the deformed surface of the skin on the surface of the tip. It then displaces the material by
the linear solution for this change of the pressure.

The deformation is axisymmetric around the tip. If all lengths are divided by the thickness of the skin, the deformation
depends only on the ratio R/h of the tip radius to the thickness. Therefore, a few tables for different values of R/h
suffice for skins of any thickness. To simulate an indentation, the deformation is interpolated between these tables.
"""

from dataclasses import asdict, dataclass
from functools import lru_cache
from math import sqrt
from pathlib import Path
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit
from scipy.interpolate import CubicSpline

from reskin import io
from reskin.errors import ParamsError
from reskin.physics import layer
from reskin.physics.layer import Displacement, IndentedLayer, Waves, contact_of_radius, displacement, waves
from reskin.physics.magnet import Dipoles

# Increase of the depth in one step, in units of `depth_scale`; about 0.05 mm for a skin with a thickness of 2 mm. If
# the steps were half as large, the field change dB would differ by 0.3 % on a slipping base and by 0.6 % on a bonded
# base.
STEP = 0.025
# The ladder: the depth after each step, in units of `depth_scale`. The same depths are used for all indentations. The
# first step is divided into three, because the contact radius grows as the square root of the depth, which is fast at
# first.
LADDER = np.array([0.0, STEP / 4, STEP / 2, *(STEP * np.arange(1, round(1 / STEP) + 1))])
# Largest height of the bulging rim around the tip, in thicknesses. Above a height of 1, the waves of the linear
# solution grow as exp(kz).
RIM_MAX = 1.2
MARKERS_N = 48  # number of markers on the surface; the markers are denser towards the axis
# Number of basis pressures (see `pressure_change`). With 4 or 8 basis pressures, the positions of the markers at a
# depth of 1.2 mm would differ by less than 0.03 mm.
PRESSURES_N = 6
DAMPING = 1e-3  # damping of the least-squares solution for the pressure, relative to the largest singular value


@dataclass(frozen=True)
class Material:
    """The current state of s points of the material, in cylindrical coordinates.

    The state of a point is its position and its deformation gradient F. Because the deformation is axisymmetric, F
    consists of a part in the r-z plane and of the circumferential stretch. Its other entries are zero.
    """

    r_m: Float[np.ndarray, " s"]  # distance from the axis
    z_m: Float[np.ndarray, " s"]  # height above the base
    f: Float[np.ndarray, "s 2 2"]  # part of F in the r-z plane; both rows and columns are in the order r, z
    hoop: Float[np.ndarray, " s"]  # circumferential stretch


def follow(
    r_m: Float[np.ndarray, " s"], z_m: Float[np.ndarray, " s"], depths_m: Float[np.ndarray, " d"], press: IndentedLayer
) -> list[Material]:
    """Compute how points of the material move while a tip indents the layer step by step.

    The function also moves markers, which are points on the surface. Each step solves for the change of the pressure
    that moves the markers onto the tip. If the pressure were computed for the undeformed surface instead, the deformed
    surface would be up to 0.3 mm away from the tip at a depth of 1.2 mm.

    Parameters
    ----------
    r_m, z_m : positions of the points before the indentation
    depths_m : depths of the tip after each step, in increasing order; the first depth is 0
    press : the layer and the tip

    Returns
    -------
    One `Material` per depth, which contains the given points but not the markers.
    """
    path = [with_markers(r_m, z_m, press)]
    for depth_m in map(float, depths_m[1:]):
        path.append(displace(path[-1], pressure_change(path[-1], depth_m, press), depth_m, press))
    return [Material(*(getattr(at, name)[MARKERS_N:] for name in Material.__dataclass_fields__)) for at in path]


def depth_scale(size: float) -> float:
    """Return the greatest depth that can be computed, in thicknesses, for R/h = `size`.

    A depth can be computed only if it is below the thickness and below the tip radius. The result is therefore below 1
    and below `size`, and it is a smooth function of `size`.
    """
    return size / (1 + size**4) ** 0.25


def undeformed(r_m: Float[np.ndarray, " s"], z_m: Float[np.ndarray, " s"]) -> Material:
    """Return points of the undeformed material, so that the deformation gradient F is the identity matrix."""
    return Material(r_m, z_m, np.tile(np.eye(2), (len(r_m), 1, 1)), np.ones(len(r_m)))


def with_markers(r_m: Float[np.ndarray, " s"], z_m: Float[np.ndarray, " s"], press: IndentedLayer) -> Material:
    """Return points of the undeformed material: first `MARKERS_N` markers on the surface, then the given points.

    The markers are inside the contact at the greatest depth, which is the widest contact that can occur.
    """
    widest = press.contact(press.thickness_m * depth_scale(press.tip_radius_m / press.thickness_m))
    r_m = np.append(widest.radius_m * np.linspace(0, 1, MARKERS_N) ** 2, r_m)
    return undeformed(r_m, np.append(np.full(MARKERS_N, press.thickness_m), z_m))


def pressure_change(material: Material, depth_m: float, press: IndentedLayer) -> Waves:
    """Solve for the change of the pressure that moves the surface markers onto the tip at a greater depth.

    The first points of `material` must be the markers. The change of the pressure is a weighted sum of `PRESSURES_N`
    basis pressures. A basis pressure is the pressure that the same tip would exert in a smaller contact, or in the
    contact at the new depth. The weights are determined by damped least squares, such that all markers inside the
    contact move from their current positions to the surface of the tip. Damping is needed because the solution is
    ill-conditioned: pressure waves that are shorter than the depth hardly move markers that are already deep.
    """
    contact = press.contact(depth_m)
    inside = np.flatnonzero(material.r_m[:MARKERS_N] < contact.radius_m)
    r_m, z_m = material.r_m[inside], material.z_m[inside]
    radii_m = contact.radius_m * np.arange(1, PRESSURES_N + 1) / PRESSURES_N
    parts = [contact_of_radius(a_m, **asdict(press)) for a_m in radii_m]
    pressures = [waves(part, press.thickness_m, press.base) for part in parts]
    displaced = [displacement(r_m, z_m, pressure) for pressure in pressures]
    height_m = np.sqrt(press.tip_radius_m**2 - r_m**2)
    towards = np.stack([u.z_m - r_m / height_m * u.r_m for u in displaced], axis=1) / [part.depth_m for part in parts]
    missing_m = press.thickness_m - contact.depth_m + press.tip_radius_m - height_m - z_m
    damping = DAMPING * np.linalg.norm(towards, 2) * np.eye(PRESSURES_N)
    share = np.linalg.lstsq(np.vstack([towards, damping]), np.append(missing_m, np.zeros(PRESSURES_N)))[0]
    amplitudes = np.stack(
        [pressure.amplitude_m / part.depth_m for pressure, part in zip(pressures, parts, strict=True)]
    )
    return Waves(pressures[0].k_per_m, share @ amplitudes, press.thickness_m, press.base)


def displace(material: Material, change: Waves, depth_m: float, press: IndentedLayer) -> Material:
    """Displace points of the material by a change of the pressure, and update their deformation gradients F.

    The displacement is integrated by the midpoint rule. F is updated by the chain rule at the midpoint. `depth_m` is
    the depth after the change and is used only in an error message.
    """
    first = displacement(material.r_m, material.z_m, change)
    half_r_m, half_z_m = material.r_m + first.r_m / 2, material.z_m + first.z_m / 2
    second = displacement(half_r_m, half_z_m, change)
    half = (np.eye(2) + _gradient(first) / 2) @ material.f
    hoop = material.hoop * (1 + second.hoop * (1 + first.hoop / 2))
    moved = Material(material.r_m + second.r_m, material.z_m + second.z_m, material.f + _gradient(second) @ half, hoop)
    if not moved.z_m.max() < RIM_MAX * press.thickness_m:
        rule = f"so small that the rim around the tip is lower than {RIM_MAX} times the skin's thickness"
        got = f"{depth_m / press.thickness_m:.3g} of the thickness"
        raise ParamsError("poke", "depth", rule, got, "Reduce the depth of the indentation.")
    return moved


def _gradient(u: Displacement) -> Float[np.ndarray, "s 2 2"]:
    return np.stack([np.stack([u.r_r, u.r_z], axis=-1), np.stack([u.z_r, u.z_z], axis=-1)], axis=-2)


def rotation_angle(f: Float[np.ndarray, "s 2 2"]) -> Float[np.ndarray, " s"]:
    """Return the angle of the rotation R in the polar decomposition F = R U of the deformation gradient.

    The angle is positive for a rotation from z towards r.
    """
    return np.arctan2(f[:, 0, 1] - f[:, 1, 0], f[:, 0, 0] + f[:, 1, 1])


# Distance in thicknesses by which the tables extend beyond the contact radius. Farther away, material on a bonded base
# does not move, and material on a slipping base moves outward by the same distance at all heights, apart from waves
# that decay as exp(-pi r / h). If the tables ended at 4 thicknesses from the axis, the error of dB would be up to 17 %.
REACH = 5.0
SIZE_STEP = 0.2  # step of ln(R/h) between tables; the interpolation error of dB is below 0.3 % (test_skin)
STENCIL_N = 4  # number of points for cubic interpolation, both between tables and between depths
# Largest accepted relative error of the volume of the material. The material is incompressible, so that the determinant
# of F should be 1.
DET_F_ERROR_MAX = 0.1
COARSE_R = np.linspace(0, 1, 56) ** 1.5  # radii at which displacements are computed, relative to `reach`
# Radii at which displacements are tabulated, relative to `reach`. They are so dense that linear interpolation suffices.
FINE_R = np.linspace(0, 1, 512)
# The cache of the tables depends on the source files in this folder: if they change, the tables are computed again.
PACKAGE = Path(__file__).parent


@dataclass(frozen=True)
class DeformationMap:
    """A table of the displacement and the rotation of the material, as a function of depth, height and radius.

    The table has d depths, l heights and i radii. The radii are equally spaced from 0 to `reach_m`.
    """

    thickness_m: float
    reach_m: float
    depth_m: Float[np.ndarray, " d"]  # starts with 0
    # The last axis has three values: the outward displacement in thicknesses, the upward displacement in thicknesses,
    # and tan(angle / 2), where `angle` is the angle of the rotation from z towards r.
    moved: Float[np.ndarray, "d l i 3"]
    base: layer.Base


@dataclass(frozen=True)
class RestingDipoles:
    """The dipoles of a skin without contact, grouped by their heights."""

    nodes_m: Float[np.ndarray, "s 3"]  # positions
    moments_A_m2: Float[np.ndarray, "s 3"]
    height_i: Int[np.ndarray, " s"]  # index of each dipole's height in `heights`
    heights: tuple[float, ...]  # distinct heights of the dipoles, in thicknesses


@dataclass(frozen=True)
class MovedDipoles:
    """The m dipoles of a skin that an indentation moves."""

    i: Int[np.ndarray, " m"]  # indices of these dipoles among all dipoles of the skin
    before: Dipoles  # positions and moments before the indentation
    after: Dipoles  # positions and moments during the indentation


def group_by_height(
    nodes_m: Float[np.ndarray, "s 3"], moments_A_m2: Float[np.ndarray, "s 3"], thickness_m: float
) -> RestingDipoles:
    """Group the dipoles of a skin by height.

    The dipoles are at the nodes of a quadrature rule. Because many nodes have the same height, there are only few
    different heights.
    """
    # The heights are rounded, so that the same quadrature rule has exactly the same relative heights in all skins.
    heights, height_i = np.unique(np.round(nodes_m[:, 2] / thickness_m, 12), return_inverse=True)
    return RestingDipoles(
        np.asfortranarray(nodes_m), np.asfortranarray(moments_A_m2), height_i, tuple(heights.tolist())
    )


def reach(size: float, base: layer.Base) -> float:
    """Return the largest radius of the tables for R/h = `size`, in thicknesses.

    Material that is farther away from the axis of the tip keeps its height and is not rotated.
    """
    depth = layer.VERIFIED_DEPTH * depth_scale(size)
    return REACH + IndentedLayer(1.0, size, base).contact(depth).radius_m


def tabulate(
    thickness_m: float, tip_radius_m: float, deepest_m: float, *, heights: tuple[float, ...], base: layer.Base
) -> DeformationMap:
    """Tabulate the displacement and the rotation of the material for all depths up to `deepest_m`.

    The result is interpolated between tables for values of ln(R/h) that are multiples of `SIZE_STEP`. The depths in the
    table are the depths of `LADDER`, so the last depth is slightly greater than `deepest_m`. The values at one depth do
    not depend on `deepest_m`.

    Parameters
    ----------
    thickness_m, tip_radius_m : sizes of the skin and the tip
    deepest_m : greatest depth for which the table is needed
    heights : heights of the material in thicknesses, as in `RestingDipoles`
    base : whether the skin is bonded to its base or slips on it

    Raises
    ------
    ParamsError
        If the thickness or the tip radius is invalid, or if `deepest_m` cannot be computed (see `depth_scale`).
    """
    layer.check_layer(np.array([deepest_m]), thickness_m, tip_radius_m)
    size = tip_radius_m / thickness_m
    depth_m = thickness_m * depth_scale(size) * LADDER
    if not 0 < deepest_m <= depth_m[-1]:
        rule = f"above 0 mm and at most {1e3 * depth_m[-1]:.3g} mm, the greatest depth that can be computed"
        raise ParamsError(
            "poke", "deepest depth", rule, f"{1e3 * deepest_m:.3g} mm", "Reduce the depth of the indentations."
        )
    rungs_n = 1 + max(int(np.searchsorted(depth_m, deepest_m)), STENCIL_N - 1)
    return _tabulate(thickness_m, tip_radius_m, rungs_n, heights, base)


@lru_cache(maxsize=16)
def _tabulate(
    thickness_m: float, tip_radius_m: float, rungs_n: int, heights: tuple[float, ...], base: layer.Base
) -> DeformationMap:
    size = tip_radius_m / thickness_m
    depth_m = thickness_m * depth_scale(size) * LADDER[:rungs_n]
    position = np.log(size) / SIZE_STEP
    tables_i = int(np.floor(position)) - 1 + np.arange(STENCIL_N)
    weights = _lagrange(tables_i.astype(float), position)
    parts = [_displaced(int(table_i), heights, rungs_n, base) for table_i in tables_i]
    coarse = sum(weight * part for weight, part in zip(weights, parts, strict=True))
    # The array is made contiguous here, because otherwise `at_depth` would have to copy a part of the array for each
    # indentation.
    moved = np.ascontiguousarray(CubicSpline(COARSE_R, coarse, axis=2)(FINE_R))
    # Material at height 0 stays on the base and, on a bonded base, does not move sideways. It may rotate.
    moved[:, np.array(heights) == 0, :, 1 if base == "slipping" else slice(2)] = 0.0
    return DeformationMap(thickness_m, thickness_m * reach(size, base), depth_m, moved, base)


def at_depth(table: DeformationMap, depth_m: float) -> Float[np.ndarray, "l i 3"]:
    """Interpolate the table between depths; return displacements and rotation for each height and radius.

    The interpolation uses cubic polynomials in the square root of the depth. This is accurate because the displacement
    of distant material is almost proportional to depth^1.5, which is the cube of the square root. Between 0 and the
    first tabulated depth (about 10 um for a skin with a thickness of 2 mm), all displacements are assumed to be
    proportional to depth^1.5, like the force of a light touch.
    """
    if not -np.inf < depth_m <= table.depth_m[-1]:
        rule = f"finite and at most {1e3 * table.depth_m[-1]:.4g} mm, the greatest tabulated depth"
        raise ParamsError("poke", "depth", rule, f"{1e3 * depth_m:.4g} mm", "Tabulate up to a larger deepest_m.")
    if depth_m <= 0:
        return table.moved[0]
    if depth_m < table.depth_m[1]:
        return table.moved[1] * (depth_m / table.depth_m[1]) ** 1.5
    first = max(int(np.searchsorted(table.depth_m, depth_m)) + 1, STENCIL_N) - STENCIL_N
    near = slice(first, first + STENCIL_N)
    weights = _lagrange(np.sqrt(table.depth_m[near]), np.sqrt(depth_m))
    return np.dot(weights[None], table.moved[near].reshape(STENCIL_N, -1)).reshape(table.moved.shape[1:])


def move_dipoles(table: DeformationMap, rest: RestingDipoles, indentation_m: Float[np.ndarray, "3"]) -> MovedDipoles:
    """Move and rotate the dipoles of a skin for an indentation, which is given by x, y and the depth of the tip.

    On a bonded base, only the dipoles within `reach_m` of the tip are moved. On a slipping base, all dipoles are moved.
    The deformation gradient is F = R U, where R is a rotation and U is a stretch. A moment m becomes R m and not F m,
    because a stretch does not change the magnetisation (Danas & Reis 2024).
    """
    result = np.empty(0, np.intp), np.empty((6, 0)), np.empty((6, 0))
    moved = at_depth(table, float(indentation_m[2]))
    if indentation_m[2] > 0:
        # On a slipping base, the material beyond `reach_m` moves outward. Because the volume of the material is
        # conserved, r^2 grows by the same amount at all of these places.
        edge_m = table.reach_m + table.thickness_m * moved[:, -1, 0].mean()
        grown_m2 = float(edge_m**2 - table.reach_m**2) if table.base == "slipping" else 0.0
        tip = np.append(indentation_m[:2], (table.reach_m, table.thickness_m, grown_m2))
        result = _move(rest.nodes_m.T, rest.moments_A_m2.T, rest.height_i, moved, tip)
    i, before, after = result
    return MovedDipoles(i, (before[:3].T, before[3:].T), (after[:3].T, after[3:].T))


@lru_cache(maxsize=256)
def _displaced(
    table_i: int, heights: tuple[float, ...], rungs_n: int, base: layer.Base
) -> Float[np.ndarray, "d l p 3"]:
    """Return the table with the number `table_i`, which is for ln(R/h) = SIZE_STEP * table_i.

    If the cache contains the table, it is loaded. Otherwise, it is computed and added to the cache. The last axis of
    the table has the same three values as `DeformationMap.moved`.
    """
    name = f"flow {table_i} {heights} {base}"
    table = io.load_cached_array(PACKAGE, name)
    if table is None or len(table) < rungs_n:
        table = _follow_ladder(table_i, heights, rungs_n, base)
        io.save_cached_array(PACKAGE, name, table)
    return table[:rungs_n]


def _follow_ladder(
    table_i: int, heights: tuple[float, ...], rungs_n: int, base: layer.Base
) -> Float[np.ndarray, "d l p 3"]:
    # Compute the table with the number `table_i` for the first `rungs_n` depths of `LADDER`. All lengths are in
    # thicknesses.
    size = _size(table_i)
    material = rest = undeformed(*(part.ravel() for part in np.meshgrid(reach(size, base) * COARSE_R, heights)))
    parts = np.zeros((rungs_n, 3, len(rest.r_m)))
    for rung_i in range(1, rungs_n):
        depth = depth_scale(size) * float(LADDER[rung_i])
        material = displace(material, _pressure_change(table_i, rung_i, base), depth, IndentedLayer(1.0, size, base))
        if not np.abs(np.linalg.det(material.f) * material.hoop - 1).max() <= DET_F_ERROR_MAX:
            rule = f"so small that the computed volume of the material changes by at most {DET_F_ERROR_MAX:.0%}"
            got = f"{depth:.3g} of the thickness"
            raise ParamsError("poke", "depth", rule, got, "Reduce the depth of the indentation.")
        parts[rung_i] = material.r_m - rest.r_m, material.z_m - rest.z_m, np.tan(rotation_angle(material.f) / 2)
    return np.moveaxis(parts, 1, 2).reshape(rungs_n, len(heights), len(COARSE_R), 3)


@lru_cache(maxsize=1024)
def _pressure_change(table_i: int, rung_i: int, base: layer.Base) -> Waves:
    # Return the change of the pressure in the step that ends at depth `rung_i` of `LADDER`. The result is cached,
    # because it does not depend on the heights of the material.
    size = _size(table_i)
    depth = depth_scale(size) * float(LADDER[rung_i])
    return pressure_change(_markers(table_i, rung_i - 1, base), depth, IndentedLayer(1.0, size, base))


@lru_cache(maxsize=1024)
def _markers(table_i: int, rung_i: int, base: layer.Base) -> Material:
    press, empty = IndentedLayer(1.0, _size(table_i), base), np.empty(0)
    if rung_i == 0:
        return with_markers(empty, empty, press)
    depth = depth_scale(press.tip_radius_m) * float(LADDER[rung_i])
    return displace(_markers(table_i, rung_i - 1, base), _pressure_change(table_i, rung_i, base), depth, press)


def _size(table_i: int) -> float:
    return float(np.exp(SIZE_STEP * table_i))


def _lagrange(nodes: Float[np.ndarray, " p"], at: float) -> Float[np.ndarray, " p"]:
    """Return the weights of the nodes for Lagrange interpolation at position `at`."""
    positions, weights = nodes.tolist(), np.ones(len(nodes))
    for j, node in enumerate(positions):
        for i, other in enumerate(positions):
            if i != j:
                weights[j] *= (at - other) / (node - other)
    return weights


@njit(cache=True, error_model="numpy")
@no_type_check
def _move(nodes, moments, height_i, table, tip):
    x, y, reach_m, thickness_m, grown_m2 = tip
    steps_n = table.shape[1] - 1
    i = np.empty(nodes.shape[1], np.intp)
    n = 0
    for s in range(nodes.shape[1]):
        i[n] = s
        n += grown_m2 > 0 or (nodes[0, s] - x) ** 2 + (nodes[1, s] - y) ** 2 < reach_m * reach_m
    before, after = np.empty((6, n)), np.empty((6, n))
    for m in range(n):
        s = i[m]
        dx, dy = nodes[0, s] - x, nodes[1, s] - y
        r = sqrt(dx * dx + dy * dy)
        # Material on the axis neither moves sideways nor rotates, so it needs no direction.
        over_r = 1 / r if r > 0 else 0.0
        cos, sin = dx * over_r, dy * over_r
        outward, up, tan = sqrt(r * r + grown_m2) - r, 0.0, 0.0
        if r < reach_m:
            position = r / reach_m * steps_n
            low = min(int(position), steps_n - 1)
            near, far, share = table[height_i[s], low], table[height_i[s], low + 1], position - low
            outward = thickness_m * (near[0] + share * (far[0] - near[0]))
            up = thickness_m * (near[1] + share * (far[1] - near[1]))
            tan = near[2] + share * (far[2] - near[2])  # tangent of half the angle
        mx, my, mz = moments[0, s], moments[1, s], moments[2, s]
        radial = cos * mx + sin * my
        sine = 2 * tan / (1 + tan * tan)  # 1 - cosine = tan * sine
        change = sine * (mz - tan * radial)
        before[0, m], before[1, m], before[2, m] = nodes[0, s], nodes[1, s], nodes[2, s]
        before[3, m], before[4, m], before[5, m] = mx, my, mz
        after[0, m], after[1, m] = nodes[0, s] + outward * cos, nodes[1, s] + outward * sin
        after[2, m] = nodes[2, s] + up
        after[3, m], after[4, m] = mx + change * cos, my + change * sin
        after[5, m] = mz - sine * (radial + tan * mz)
    return i[:n], before, after
