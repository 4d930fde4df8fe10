"""Magnetisation of a skin by an array of magnets, and the field of the magnetised skin.

All values are in SI units. For the computation of its field, a skin is divided into cells. Each cell is represented by
a point dipole at a node of a quadrature rule.
"""

from dataclasses import dataclass
from itertools import pairwise, product
from math import ceil, sqrt
from typing import Annotated, Literal, no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit
from pydantic import Field
from scipy.constants import milli, mu_0

from reskin.config import Strict
from reskin.errors import ParamsError

# The magnetising array consists of magnet cubes below and above the skin. "CAD" refers to the drawings of the authors
# of the paper.
CUBE_SIDE_M = 6.35e-3  # the cubes have a side of 0.25 in
CUBES_N = (4, 4)  # number of magnet cubes along x and y, for the authors' skin of 20 x 20 mm
ARRAY_BELOW_M = 0.50e-3  # gap between the skin's base and the lower cubes, from the authors' CAD
ARRAY_ABOVE_M = 0.25e-3  # gap between the skin's top and the upper cubes, from the authors' CAD
ARRAY_REMANENCE_T = 1.32  # remanence of magnets of grade N42; the grade is assumed

# Polarity of the cubes, which the paper does not specify: adjacent cubes are magnetised in opposite directions
# (checkerboard) or in the same direction. In both cases, each upper cube attracts the lower cube that is opposite to
# it.
Polarity = Literal["checkerboard", "same"]


def cuboid_field(
    observers_m: Float[np.ndarray, "o 3"], polarization_T: float, *, sides_m: tuple[float, float, float]
) -> Float[np.ndarray, "o 3"]:
    """Return the field in T of a cuboid that is centred at the origin and magnetised along z.

    Outside the cuboid, the field is the same as that of two rectangles with magnetic charges, which are the upper and
    the lower face (Engel-Herbert & Hesjedal, J. Appl. Phys. 97:074504, 2005). Inside, the polarization J is added to
    this field. The formula is singular on the lines through the edges of the cuboid.
    """
    half_m = np.array(sides_m) / 2
    b_T = np.zeros_like(observers_m)
    for signs in product((1, -1), repeat=3):
        b_T += np.prod(signs) * _corner(observers_m - half_m * signs)
    b_T *= polarization_T / (4 * np.pi)
    b_T[:, 2] += polarization_T * (np.abs(observers_m) < half_m).all(axis=1)
    return b_T


def _corner(from_m: Float[np.ndarray, "o 3"]) -> Float[np.ndarray, "o 3"]:
    """Return the term of one corner of a cuboid in the formula for the field of the cuboid, times 4 pi / J.

    `from_m` are the vectors from the corner to the observers.
    """
    x, y, z = from_m.T
    xx, yy, zz = x * x, y * y, z * z
    # The published formula contains log(y + r), which is inaccurate for y < 0. It is replaced here by
    # asinh(y / hypot(x, z)). The two functions differ by a term that cancels in the sum over the corners.
    along_x, along_y = -np.arcsinh(y / np.sqrt(xx + zz)), -np.arcsinh(x / np.sqrt(yy + zz))
    return np.stack([along_x, along_y, np.arctan(x * y / (z * np.sqrt(xx + yy + zz)))], axis=1)


def cubes_along(side_m: float) -> int:
    """Return the smallest number of magnet cubes in a row that cover a side of a skin.

    The result is 4 for the authors' skin. Skins of other sizes are assumed to be magnetised with cubes of the same
    size.
    """
    return ceil(side_m / CUBE_SIDE_M - 1e-9)


def seams_m(side_m: float) -> tuple[float, ...]:
    """Return the coordinates of the seams along a side of a skin.

    A seam is the boundary between two adjacent cubes. The magnetisation of the skin has a kink at each seam.
    """
    n = cubes_along(side_m)
    return tuple(CUBE_SIDE_M * (i - n / 2) for i in range(1, n))


def array_field(
    nodes_m: Float[np.ndarray, "s 3"], thickness_m: float, polarity: Polarity, *, cubes_n: tuple[int, int] = CUBES_N
) -> Float[np.ndarray, "s 3"]:
    """Return the field in T of the magnetising array at nodes inside the skin.

    The array has `cubes_n` cubes (along x, along y) below the skin, and the same number above the skin. The field of a
    cube is a sum of eight terms, one for each corner of the cube. Each term has a sign, which depends on the position
    of the corner in the cube and on the polarity of the cube. Adjacent cubes share corners. To save time, the term of
    each corner is computed only once, and multiplied by the sum of the signs that it has in all cubes that share the
    corner.
    """
    if not (nodes_m[:, 2].min() >= 0 and nodes_m[:, 2].max() <= thickness_m):
        rule = f"from 0 to {thickness_m:.3g} m, inside the skin"
        got = f"{nodes_m[:, 2].min():.3g} to {nodes_m[:, 2].max():.3g} m"
        remedy = "Pass the places of the nodes before the skin is deformed."
        raise ParamsError("magnet array", "height of the nodes", rule, got, remedy)
    signs = np.ones(cubes_n) if polarity == "same" else (-1.0) ** np.add.outer(*map(np.arange, cubes_n))
    # The sign of a corner is the product of three signs, for x, y and z. Each is positive if the corner is at the upper
    # end of the cube along this axis, and negative at the lower end. The differences sum these signs over the cubes.
    weights = -np.diff(-np.diff(np.pad(signs, 1), axis=0), axis=1)
    below_m, above_m = -ARRAY_BELOW_M, thickness_m + ARRAY_ABOVE_M
    faces_m = {below_m: 1, below_m - CUBE_SIDE_M: -1, above_m + CUBE_SIDE_M: 1, above_m: -1}
    b_T = np.zeros_like(nodes_m)
    for i, j in zip(*np.nonzero(weights), strict=True):
        x_m, y_m = (CUBE_SIDE_M * (at - n / 2) for at, n in zip((i, j), cubes_n, strict=True))
        for z_m, top in faces_m.items():
            b_T += weights[i, j] * top * _corner(nodes_m - (x_m, y_m, z_m))
    return b_T * ARRAY_REMANENCE_T / (4 * np.pi)


def magnetise(b_T: Float[np.ndarray, "s 3"], *, saturation_T: float, half_field_T: float) -> Float[np.ndarray, "s 3"]:
    """Return the polarization J in T that remains in the powder after it was magnetised by the field B.

    J has the direction of B and the magnitude `saturation_T` u^3 / (1 + u^3), where u = |B| / `half_field_T`.
    """
    u = np.linalg.norm(b_T, axis=1, keepdims=True) / half_field_T
    # The formula contains u^3 / |B|. The equal expression u^2 / half_field_T is used, because it is finite even where
    # the field is zero. This happens where four cubes meet.
    return saturation_T * b_T * u**2 / half_field_T / (1 + u**3)


def moments(j_T: Float[np.ndarray, "s 3"], volumes_m3: Float[np.ndarray, " s"]) -> Float[np.ndarray, "s 3"]:
    """Return the dipole moment in A m^2 of each cell, given the polarization and the volume of each cell."""
    return j_T * (volumes_m3 / mu_0)[:, None]


SKIN_SIDE_M = 20e-3  # from the authors' CAD
SKIN_SIDES_M = (SKIN_SIDE_M, SKIN_SIDE_M)
SEAMS_M = seams_m(SKIN_SIDE_M)  # for the authors' skin, which is magnetised by 4 x 4 cubes


class QuadratureSettings(Strict):
    """Section `quadrature` of a board's settings: the rule by which a skin is divided into cells.

    The closer the chips are to the skin, the smaller the cells must be. The experiment `accuracy_and_cost` measures the
    error and the computing time for several rules.
    """

    cell_mm: Annotated[float, Field(gt=0, le=20)]  # largest width of a cell along x and y
    layers_n: Annotated[int, Field(ge=1, le=100)]  # number of nodes over the thickness

    def in_si(self) -> "Quadrature":
        """Convert to SI units."""
        return Quadrature(self.cell_mm * milli, self.layers_n)


@dataclass(frozen=True)
class Quadrature:
    """The rule by which a skin is divided into cells, each of which is represented by a dipole at a node."""

    cell_m: float  # largest width of a cell along x and y
    layers_n: int  # number of Gauss nodes over the thickness


# This rule places 42 x 42 x 6 nodes in the authors' skin. With half the cell width, the field change dB differs by less
# than 2 % (test_skin).
DEFAULT_QUADRATURE = Quadrature(cell_m=0.5e-3, layers_n=6)


@dataclass(frozen=True)
class Nodes:
    """The s quadrature nodes of an undeformed skin."""

    nodes_m: Float[np.ndarray, "s 3"]  # x and y relative to the skin's centre, and z relative to the skin's base
    volumes_m3: Float[np.ndarray, " s"]  # volume of the cell that each node represents


def place_nodes(
    thickness_m: float, rule: Quadrature = DEFAULT_QUADRATURE, *, sides_m: tuple[float, float] = SKIN_SIDES_M
) -> Nodes:
    """Place the quadrature nodes of a skin: at the midpoints of cells along x and y, and at Gauss nodes along z.

    The cells are chosen such that no cell crosses a seam between magnet cubes, where the magnetisation has a kink.
    """
    if not (thickness_m > 0 and rule.cell_m > 0 and rule.layers_n > 0):
        got = f"{thickness_m:.3g} m, {rule.cell_m:.3g} m and {rule.layers_n}"
        raise ParamsError(
            "quadrature",
            "thickness, cell and layers",
            "above 0",
            got,
            "Correct the skin's thickness or the quadrature.",
        )
    (along_x_m, widths_x_m), (along_y_m, widths_y_m) = (_cells(side_m, rule) for side_m in sides_m)
    gauss, weights = np.polynomial.legendre.leggauss(rule.layers_n)
    x_m, y_m, z_m = np.meshgrid(along_x_m, along_y_m, (1 + gauss) / 2 * thickness_m, indexing="ij")
    volumes_m3 = np.einsum("i,j,k->ijk", widths_x_m, widths_y_m, weights / 2 * thickness_m)
    return Nodes(np.stack([x_m, y_m, z_m], axis=-1).reshape(-1, 3), volumes_m3.ravel())


def _cells(side_m: float, rule: Quadrature) -> tuple[Float[np.ndarray, " i"], Float[np.ndarray, " i"]]:
    """Return the centres and widths in m of the cells along one side of a skin."""
    marks_m = (-side_m / 2, *seams_m(side_m), side_m / 2)
    spans = [np.linspace(a, b, ceil((b - a) / rule.cell_m - 1e-9) + 1) for a, b in pairwise(marks_m)]
    centres_m = np.concatenate([(edges[1:] + edges[:-1]) / 2 for edges in spans])
    return centres_m, np.concatenate([np.diff(edges) for edges in spans])


Dipoles = tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]]  # positions in m, and moments in A m^2
# mu0 / (4 pi) in T m / A, from CODATA. Since the SI was revised in 2019, this value is not exactly 1e-7.
MU0_4PI = mu_0 / (4 * np.pi)


def field(
    positions_m: Float[np.ndarray, "s 3"], moments_A_m2: Float[np.ndarray, "s 3"], observers_m: Float[np.ndarray, "o 3"]
) -> Float[np.ndarray, "o 3"]:
    """Return the total field in T of all dipoles at each observer."""
    return field_of_each(positions_m, moments_A_m2, observers_m).sum(axis=1)


def field_of_each(
    positions_m: Float[np.ndarray, "s 3"], moments_A_m2: Float[np.ndarray, "s 3"], observers_m: Float[np.ndarray, "o 3"]
) -> Float[np.ndarray, "o s 3"]:
    """Return the field in T of each dipole at each observer.

    The field is mu0/4pi (3 (m.r) r / |r|^5 - m / |r|^3), where m is the moment of the dipole and r is the vector from
    the dipole to the observer.
    """
    # The components x, y and z are along the first axis of the arrays. The products are faster in this order, because
    # they are over long contiguous rows.
    separation = observers_m.T[:, :, None] - positions_m.T[:, None, :]
    moment = moments_A_m2.T[:, None, :]
    r2 = (separation * separation).sum(axis=0)
    if r2.size and not r2.min() > 0:
        raise ParamsError(
            "dipole field", "distance to a chip", "above 0 m", "0 or NaN", "Move the chip out of the skin."
        )
    along = 3 * (moment * separation).sum(axis=0) / r2
    each = (along * separation - moment) * (MU0_4PI / (r2 * np.sqrt(r2)))
    return np.moveaxis(each, 0, 2)


def change_of_field(rest: Dipoles, moved: Dipoles, observers_m: Float[np.ndarray, "o 3"]) -> Float[np.ndarray, "o 3"]:
    """Return the field change in T at each observer due to dipoles that move and rotate from `rest` to `moved`.

    The field changes of the single dipoles are computed first and then summed. The difference of the two total fields
    would be less accurate, because nearly equal numbers would be subtracted. Arrays in Fortran order are not copied.
    The arrays from `deformation.move_dipoles` have this order.
    """
    rows = [np.ascontiguousarray(part.T) for part in (*rest, *moved)]
    change_T = MU0_4PI * _sum_of_changes(*rows, np.ascontiguousarray(observers_m))
    if not np.isfinite(change_T).all():
        raise ParamsError(
            "change of field", "distance to a chip", "above 0 m", "0 or NaN", "Move the chip out of the skin."
        )
    return change_T


# The loop over the dipoles stores the field change of each dipole instead of adding it to a sum, so that the compiler
# can vectorise the loop without fastmath. The field change of a dipole that does not move is exactly 0. Because of
# error_model="numpy", a division by zero results in infinity, which the caller detects.
@njit(cache=True, error_model="numpy")
@no_type_check
def _sum_of_changes(nodes, moments, moved, moved_moments, observers):
    u, v, w, p, q, t = nodes[0], nodes[1], nodes[2], moments[0], moments[1], moments[2]
    a, b, c, f, g, h = moved[0], moved[1], moved[2], moved_moments[0], moved_moments[1], moved_moments[2]
    change_x, change_y, change_z = np.empty(len(u)), np.empty(len(u)), np.empty(len(u))
    total = np.zeros_like(observers)
    for o in range(len(observers)):
        x, y, z = observers[o]
        for i in range(len(u)):
            dx, dy, dz = x - a[i], y - b[i], z - c[i]
            over_r2 = 1 / (dx * dx + dy * dy + dz * dz)
            over_r3 = over_r2 * sqrt(over_r2)
            along = 3 * over_r2 * (f[i] * dx + g[i] * dy + h[i] * dz)
            ex, ey, ez = x - u[i], y - v[i], z - w[i]
            over_q2 = 1 / (ex * ex + ey * ey + ez * ez)
            over_q3 = over_q2 * sqrt(over_q2)
            before = 3 * over_q2 * (p[i] * ex + q[i] * ey + t[i] * ez)
            change_x[i] = (along * dx - f[i]) * over_r3 - (before * ex - p[i]) * over_q3
            change_y[i] = (along * dy - g[i]) * over_r3 - (before * ey - q[i]) * over_q3
            change_z[i] = (along * dz - h[i]) * over_r3 - (before * ez - t[i]) * over_q3
        total[o, 0], total[o, 1], total[o, 2] = _total(change_x), _total(change_y), _total(change_z)
    return total


# The option `reassoc` allows the compiler to compute several partial sums in parallel. Unlike full fastmath, this
# option does not assume that all numbers are finite, so that `change_of_field` can detect infinities and NaN.
@njit(cache=True, fastmath={"reassoc"})
@no_type_check
def _total(parts):
    total = 0.0
    for i in range(len(parts)):
        total += parts[i]
    return total
