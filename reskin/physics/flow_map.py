"""The flow of `flow`, tabulated for many skins and pokes. In: thickness, tip, base, dipoles, poke. Out: moved dipoles.

The map is axisymmetric and, in units of the thickness, depends on R/h alone; so a few tables serve skins of any
thickness. Refuses to know chips and force.
"""

from dataclasses import dataclass
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
from reskin.physics.layer import LADDER, Material, Press, angle, carry, change, depth_unit, resting, with_marks

# In thicknesses, past the contact: what lies beyond does not move on a bonded base (4 from the axis costs up to 17 % of
# dB), and moves outward as one on a sliding one, up to waves that fade as exp(-pi r / h).
REACH = 5.0
SIZE_STEP = 0.2  # of ln(R/h) between tables; interpolating between them costs less than 0.3 % of dB (test_skin)
STENCIL_N = 4  # cubic, between tables and between depths
DET_F_ERROR_MAX = 0.1
Displaced = Float[np.ndarray, "d l p 3"]  # outward, up, tan(angle / 2): depth, height, place
COARSE_R = np.linspace(0, 1, 56) ** 1.5  # where the flow is computed, over the reach
PACKAGE = Path(__file__).parent  # its sources decide the tables, which are kept beside them
FINE_R = np.linspace(0, 1, 512)  # where it is tabulated, so that linear interpolation is enough


@dataclass(frozen=True)
class FlowMap:
    """Where material of given heights goes, at depths from 0 on, in units of the thickness; equal steps in r0."""

    thickness_m: float
    reach_m: float
    depth_m: Float[np.ndarray, " d"]
    moved: Float[np.ndarray, "d l i 3"]  # outward, up, tan(angle / 2) with the angle from z towards r
    base: layer.Base


@dataclass(frozen=True)
class Rest:
    """Dipoles at rest, and which of the few heights (in thicknesses) each of them has."""

    nodes_m: Float[np.ndarray, "s 3"]
    moments_A_m2: Float[np.ndarray, "s 3"]
    height_i: Int[np.ndarray, " s"]
    heights: tuple[float, ...]


@dataclass(frozen=True)
class Moved:
    """The dipoles within reach of a poke, by their index, before and after; positions in m, moments in A m^2."""

    i: Int[np.ndarray, " m"]
    before: tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]
    after: tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]


def at_rest(nodes_m: Float[np.ndarray, "s 3"], moments_A_m2: Float[np.ndarray, "s 3"], thickness_m: float) -> Rest:
    """Sort out the heights of a skin's nodes; a rule of quadrature has few, and the flow is tabulated for each."""
    # Rounded, so that skins of any thickness share the heights of their rule.
    heights, height_i = np.unique(np.round(nodes_m[:, 2] / thickness_m, 12), return_inverse=True)
    return Rest(np.asfortranarray(nodes_m), np.asfortranarray(moments_A_m2), height_i, tuple(heights.tolist()))


def tabulate(
    thickness_m: float, tip_radius_m: float, deepest_m: float, *, heights: tuple[float, ...], base: layer.Base
) -> FlowMap:
    """Interpolate between the tables of `SIZE_STEP`, down to the first of the `LADDER`'s depths that is deep enough.

    A depth's part of the map is the same whatever the deepest is.
    """
    layer.refuse_layer(np.array([deepest_m]), thickness_m, tip_radius_m)
    size = tip_radius_m / thickness_m
    depth_m = thickness_m * depth_unit(size) * LADDER
    if not 0 < deepest_m <= depth_m[-1]:
        rule = f"above 0 mm and at most {1e3 * depth_m[-1]:.3g} mm, the deepest that is followed"
        raise ParamsError("poke", "deepest depth", rule, f"{1e3 * deepest_m:.3g} mm", "Poke less deep.")
    rungs_n = 1 + max(int(np.searchsorted(depth_m, deepest_m)), STENCIL_N - 1)
    return _tabulate(thickness_m, tip_radius_m, rungs_n, heights, base)


@lru_cache(maxsize=16)
def _tabulate(
    thickness_m: float, tip_radius_m: float, rungs_n: int, heights: tuple[float, ...], base: layer.Base
) -> FlowMap:
    size = tip_radius_m / thickness_m
    depth_m = thickness_m * depth_unit(size) * LADDER[:rungs_n]
    at = np.log(size) / SIZE_STEP
    tables_i = int(np.floor(at)) - 1 + np.arange(STENCIL_N)
    share = _lagrange(tables_i.astype(float), at)
    parts = [_displaced(int(table_i), heights, rungs_n, base) for table_i in tables_i]
    coarse = sum(weight * part for weight, part in zip(share, parts, strict=True))
    moved = np.ascontiguousarray(CubicSpline(COARSE_R, coarse, axis=2)(FINE_R))  # else each poke copies its part
    # What lies on the base keeps its height and, where that is bonded, its place; it may turn.
    moved[:, np.array(heights) == 0, :, 1 if base == "slipping" else slice(2)] = 0.0
    return FlowMap(thickness_m, thickness_m * reach(size, base), depth_m, moved, base)


def move(flow: FlowMap, rest: Rest, poke_m: Float[np.ndarray, "3"]) -> Moved:
    """Move and turn the dipoles within reach of a poke (x, y, depth); on a sliding base that is all of them.

    Moments turn with the material (R m, not F m: magnetisation does not feel stretch, Danas & Reis 2024). A further
    displacement or rotation may be applied to `after`; `change.change_of_field(before, after, ...)` sums the two.
    """
    found = np.empty(0, np.intp), np.empty((6, 0)), np.empty((6, 0))
    here = at_depth(flow, float(poke_m[2]))
    if poke_m[2] > 0:
        nodes, moments = rest.nodes_m.T, rest.moments_A_m2.T
        poke = np.append(poke_m[:2], (flow.reach_m, flow.thickness_m, _grown_m2(flow, here)))
        found = _move(nodes, moments, rest.height_i, here, poke)
    i, before, after = found
    return Moved(i, (before[:3].T, before[3:].T), (after[:3].T, after[3:].T))


def at_depth(flow: FlowMap, depth_m: float) -> Float[np.ndarray, "l i 3"]:
    """Give the map at one depth: exact at its own depths, cubic in the root of the depth between them.

    In that root the tip's sinking is a square and a far point's displacement nearly a cube. Above the first depth
    (about 10 um on a skin of 2 mm) the map is in proportion to that cube, as the force of a light touch is.
    """
    if not -np.inf < depth_m <= flow.depth_m[-1]:
        rule = f"finite and at most {1e3 * flow.depth_m[-1]:.4g} mm, the deepest that is tabulated"
        raise ParamsError("poke", "depth", rule, f"{1e3 * depth_m:.4g} mm", "Tabulate deeper.")
    if depth_m <= 0:
        return flow.moved[0]
    if depth_m < flow.depth_m[1]:
        return flow.moved[1] * (depth_m / flow.depth_m[1]) ** 1.5
    first = max(int(np.searchsorted(flow.depth_m, depth_m)) + 1, STENCIL_N) - STENCIL_N
    near = slice(first, first + STENCIL_N)
    share = _lagrange(np.sqrt(flow.depth_m[near]), np.sqrt(depth_m))
    return np.dot(share[None], flow.moved[near].reshape(STENCIL_N, -1)).reshape(flow.moved.shape[1:])


def _grown_m2(flow: FlowMap, here: Float[np.ndarray, "l i 3"]) -> float:
    # By how much r^2 grows past the reach: nothing is lost, so by the same everywhere.
    edge_m = flow.reach_m + flow.thickness_m * here[:, -1, 0].mean()
    return float(edge_m**2 - flow.reach_m**2) if flow.base == "slipping" else 0.0


def reach(size: float, base: layer.Base) -> float:
    """Give, in thicknesses, how far from the axis a tip of R/h = `size` bends material, whatever the depth."""
    depth = layer.VERIFIED_DEPTH * depth_unit(size)
    return REACH + Press(1.0, size, base).contact(depth).radius_m


@lru_cache(maxsize=256)
def _displaced(
    table_i: int, heights: tuple[float, ...], rungs_n: int, base: layer.Base
) -> Float[np.ndarray, "d l p 3"]:
    name = f"flow {table_i} {heights} {base}"
    known = io.load(PACKAGE, name)
    if known is None or len(known) < rungs_n:
        known = _sunken(table_i, heights, rungs_n, base)
        io.save(PACKAGE, name, known)
    return known[:rungs_n]


def _sunken(table_i: int, heights: tuple[float, ...], rungs_n: int, base: layer.Base) -> Displaced:
    # Each depth from the one above it, so that a deeper poke later only adds to the ladder. In thicknesses.
    size = _size(table_i)
    at = rest = resting(*(part.ravel() for part in np.meshgrid(reach(size, base) * COARSE_R, heights)))
    parts = np.zeros((rungs_n, 3, len(rest.r_m)))
    for rung_i in range(1, rungs_n):
        depth = depth_unit(size) * float(LADDER[rung_i])
        at = carry(at, _waves(table_i, rung_i, base), depth, Press(1.0, size, base))
        if not np.abs(np.linalg.det(at.f) * at.hoop - 1).max() <= DET_F_ERROR_MAX:
            rule = f"such that material keeps its volume within {DET_F_ERROR_MAX:.0%}"
            raise ParamsError("poke", "depth", rule, f"{depth:.3g} of the thickness", "Poke less deep.")
        parts[rung_i] = at.r_m - rest.r_m, at.z_m - rest.z_m, np.tan(angle(at.f) / 2)
    return np.moveaxis(parts, 1, 2).reshape(rungs_n, len(heights), len(COARSE_R), 3)


@lru_cache(maxsize=1024)
def _waves(table_i: int, rung_i: int, base: layer.Base) -> layer.Waves:
    # What brings the surface from one depth to the next: the same for material of all heights.
    size = _size(table_i)
    return change(_marks(table_i, rung_i - 1, base), depth_unit(size) * float(LADDER[rung_i]), Press(1.0, size, base))


@lru_cache(maxsize=1024)
def _marks(table_i: int, rung_i: int, base: layer.Base) -> Material:
    press, none = Press(1.0, _size(table_i), base), np.empty(0)
    if rung_i == 0:
        return with_marks(none, none, press)
    depth = depth_unit(press.tip_radius_m) * float(LADDER[rung_i])
    return carry(_marks(table_i, rung_i - 1, base), _waves(table_i, rung_i, base), depth, press)


def _size(table_i: int) -> float:
    return float(np.exp(SIZE_STEP * table_i))


def _lagrange(nodes: Float[np.ndarray, " p"], at: float) -> Float[np.ndarray, " p"]:
    known, share = nodes.tolist(), np.ones(len(nodes))
    for j, node in enumerate(known):
        for i, other in enumerate(known):
            if i != j:
                share[j] *= (at - other) / (node - other)
    return share


@njit(cache=True, error_model="numpy")
@no_type_check
def _move(nodes, moments, height_i, table, poke):
    x, y, reach_m, thickness_m, grown_m2 = poke
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
        # On the axis nothing moves sideways or turns, so no direction will do there.
        over_r = 1 / r if r > 0 else 0.0
        cos, sin = dx * over_r, dy * over_r
        outward, up, tan = sqrt(r * r + grown_m2) - r, 0.0, 0.0
        if r < reach_m:
            at = r / reach_m * steps_n
            low = min(int(at), steps_n - 1)
            near, far, share = table[height_i[s], low], table[height_i[s], low + 1], at - low
            outward = thickness_m * (near[0] + share * (far[0] - near[0]))
            up = thickness_m * (near[1] + share * (far[1] - near[1]))
            tan = near[2] + share * (far[2] - near[2])  # of half the angle
        mx, my, mz = moments[0, s], moments[1, s], moments[2, s]
        radial = cos * mx + sin * my
        sine = 2 * tan / (1 + tan * tan)  # 1 - cosine is tan of the half times it
        change = sine * (mz - tan * radial)
        before[0, m], before[1, m], before[2, m] = nodes[0, s], nodes[1, s], nodes[2, s]
        before[3, m], before[4, m], before[5, m] = mx, my, mz
        after[0, m], after[1, m] = nodes[0, s] + outward * cos, nodes[1, s] + outward * sin
        after[2, m] = nodes[2, s] + up
        after[3, m], after[4, m] = mx + change * cos, my + change * sin
        after[5, m] = mz - sine * (radial + tan * mz)
    return i[:n], before, after
