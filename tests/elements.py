"""Finite-element solutions (scikit-fem) of a layer and of a plate: references for the deformation of the skin.

The elements are Taylor-Hood elements: displacement of order 2, pressure of order 1. For axisymmetric loads and for
loads along x, the solution in the (r, z) plane suffices. The shear modulus is 1.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementQuad1, ElementQuad2, ElementVector, LinearForm, MeshQuad, asm
from skfem.helpers import ddot, dot, sym_grad, trace

# If the slip is below this fraction of the largest slip, friction is proportional to the slip. This is a smoothed form
# of Coulomb's law.
SLIP_SHARE = 1e-3


@dataclass(frozen=True)
class Motion:
    """The displacement and its gradient at the integration points of finite elements.

    The displacement is an array [component, element, point], and the gradient [component, axis, element, point].
    """

    r_m: np.ndarray
    z_m: np.ndarray
    parts_m: np.ndarray
    gradient: np.ndarray
    pressure: np.ndarray


@dataclass(frozen=True)
class Solution:
    """A finite-element solution: the motion inside the layer, at its base and at its top.

    It includes the mean displacement along the load, weighted by the load.
    """

    inside: Motion
    base: Motion
    top: Motion
    under_load_m: float


def axisymmetric_strains(u, r):
    """Return the normal strains and the shear strains of an axisymmetric displacement (u_r, u_z)."""
    (r_r, r_z), (z_r, z_z) = u.grad
    return (r_r, u[0] / r, z_z), (r_z + z_r,)


def along_x_strains(u, r):
    """Return normal and shear strains of u_r = (A + B) cos f, u_f = (B - A) sin f, u_z = C cos f (see `ShearMap`)."""
    (a_r, a_z), (b_r, b_z), (c_r, c_z) = u.grad
    return (a_r + b_r, 2 * u[1] / r, c_z), (b_r - a_r - 2 * u[1] / r, a_z + b_z + c_r, b_z - a_z - u[2] / r)


@dataclass(frozen=True)
class Layer:
    """A layer that is meshed in the (r, z) plane.

    Cells are uniform up to the radius `fine_m`, and grow from there up to `end_m`.
    """

    thickness_m: float
    fine_m: float
    end_m: float
    cells_n: int  # The number of cells over the thickness.
    strains: Callable = axisymmetric_strains

    @cached_property
    def basis(self) -> Basis:
        step_m, r_m = self.thickness_m / self.cells_n, [0.0]
        while r_m[-1] < self.end_m:
            r_m.append(r_m[-1] + np.clip(0.25 * (r_m[-1] - self.fine_m), step_m, self.thickness_m / 2))
        r_m = np.array(r_m) * self.end_m / r_m[-1]
        mesh = MeshQuad.init_tensor(r_m, np.linspace(0, self.thickness_m, self.cells_n + 1))
        edges = {"axis": lambda x: x[0] == 0, "far": lambda x: x[0] == r_m[-1]}
        edges |= {"base": lambda x: x[1] == 0, "top": lambda x: np.isclose(x[1], self.thickness_m)}
        parts_n = 2 if self.strains is axisymmetric_strains else 3
        return Basis(mesh.with_boundaries(edges), ElementVector(ElementQuad2(), parts_n), intorder=5)

    @cached_property
    def matrices(self) -> tuple[sp.csr_matrix, sp.csr_matrix]:
        def work(u, v, w):
            (normal, shear), (normal_v, shear_v) = self.strains(u, w.x[0]), self.strains(v, w.x[0])
            return (2 * sum(map(np.multiply, normal, normal_v)) + sum(map(np.multiply, shear, shear_v))) * w.x[0]

        def dilation(u, q, w):
            return -sum(self.strains(u, w.x[0])[0]) * q * w.x[0]

        coupling = asm(BilinearForm(dilation), self.basis, self.basis.with_element(ElementQuad1()))
        return asm(BilinearForm(work), self.basis), coupling

    def solve(self, part_i: int, load: Callable, held: dict[str, list[int]], drag: dict[str, Callable]) -> Solution:
        """Solve for a traction load(r) on the top, along component `part_i` of the displacement.

        `held` lists the fixed components of each edge; `drag` has the stiffness springs(r) that acts on u_r at an edge.
        """
        (work, dilation), basis = self.matrices, self.basis
        load_vector = asm(LinearForm(lambda v, w: load(w.x[0]) * v[part_i] * w.x[0]), basis.boundary("top"))
        for edge, springs in drag.items():
            work = work + asm(
                BilinearForm(lambda u, v, w, springs=springs: springs(w.x[0]) * u[0] * v[0] * w.x[0]),
                basis.boundary(edge),
            )
        fixed = np.concatenate(
            [basis.get_dofs(edge).all([f"u^{i + 1}"]) for edge, parts in held.items() for i in parts]
        )
        matrix = sp.bmat([[work, dilation.T], [dilation, None]], format="csc")
        right_side = np.append(load_vector, np.zeros(dilation.shape[0]))
        free, solution = np.setdiff1d(np.arange(len(right_side)), fixed), np.zeros(len(right_side))
        solution[free] = splu(matrix[free][:, free], permc_spec="MMD_ATA").solve(right_side[free])
        total = asm(
            LinearForm(lambda v, w: load(w.x[0]) * v * w.x[0]), basis.boundary("top").with_element(ElementQuad1())
        )
        parts = solution[: basis.N], solution[basis.N :]
        motions = (_motion(where, *parts) for where in (basis, basis.boundary("base"), basis.boundary("top")))
        return Solution(*motions, load_vector @ parts[0] / total.sum())

    def with_friction(self, load: Callable, friction: float, *, steps_n: int = 4, **edges) -> Solution:
        """Solve for the pressure load(r) at the top and Coulomb friction at the base, by fixed-point iteration.

        The traction is t = -friction p u / (|u| + u0), where p and u are the pressure and the displacement at the base
        in the previous iteration, and u0 is a small displacement. The layer sticks where p is large and slides
        elsewhere.
        """
        solution = self.solve(1, load, edges["held"], edges["drag"])
        small_m = SLIP_SHARE * np.abs(solution.base.parts_m[0]).max()
        for _ in range(steps_n):
            stress = solution.base.pressure - 2 * solution.base.gradient[1, 1]
            per_m = friction * np.maximum(stress, 0) / (np.abs(solution.base.parts_m[0]) + small_m)
            solution = self.solve(1, load, edges["held"], edges["drag"] | {"base": lambda _r, per_m=per_m: per_m})
        return solution


def _motion(basis: Basis, displacement: np.ndarray, pressure: np.ndarray) -> Motion:
    u, p = basis.interpolate(displacement), basis.with_element(ElementQuad1()).interpolate(pressure)
    return Motion(*basis.global_coordinates(), np.asarray(u), u.grad, np.asarray(p))


def plate(sides_m, place_m, patch_motion_m, stiffness, *, cells_n=12, patch_m=1.5e-3):
    """Solve for a plate in plane stress on a uniform bed of springs, in which one patch is displaced.

    `stiffness` is Young's modulus times thickness, divided by the spring stiffness per area and by the area of the
    plate. Returns the centre of the patch, and the mean displacement and the mean rotation of the plate.
    """
    area_m2, (nu, young) = np.prod(sides_m), (0.5, stiffness * np.prod(sides_m))
    mesh = MeshQuad.init_tensor(*(np.linspace(-side_m / 2, side_m / 2, cells_n + 1) for side_m in sides_m))
    basis = Basis(mesh, ElementVector(ElementQuad2()), intorder=5)

    def work(u, v, _w):
        e, e_v = sym_grad(u), sym_grad(v)
        return young / (1 - nu**2) * ((1 - nu) * ddot(e, e_v) + nu * trace(e) * trace(e_v)) + dot(u, v)

    def mean(form, weight=lambda x: 1.0):
        return asm(LinearForm(lambda v, w: weight(w.x) * form(v, w.x)), basis)

    def bump(x):
        return np.exp(-((x[0] - place_m[0]) ** 2 + (x[1] - place_m[1]) ** 2) / (2 * patch_m**2))

    ones = basis.project(lambda x: np.stack([np.ones_like(x[0]), np.zeros_like(x[0])]))
    patch = np.stack([mean(lambda v, _x, i=i: v[i], bump) for i in (0, 1)])
    patch /= patch[0] @ ones
    middle_m = np.array([mean(lambda v, x, i=i: x[i] * v[0], bump) @ ones for i in (0, 1)])
    middle_m /= mean(lambda v, _x: v[0], bump) @ ones
    matrix = sp.bmat([[asm(BilinearForm(work), basis), patch.T], [patch, None]], format="csc")
    solution = splu(matrix).solve(np.append(np.zeros(basis.N), patch_motion_m))[: basis.N]
    move_m = np.array([mean(lambda v, _x, i=i: v[i]) @ solution for i in (0, 1)]) / area_m2
    spin = mean(lambda v, x: x[0] * v[1] - x[1] * v[0]) @ solution
    return middle_m, move_m, spin / (area_m2 * (sides_m[0] ** 2 + sides_m[1] ** 2) / 12)
