"""Laws of the fields of magnets and dipoles, against magpylib and Maxwell. In: sizes, a seed. Out: checks.

magpylib's objects share no code with ours. Refuses to know pokes (`poke`) and chips (`electronics`).
"""

from itertools import product

import magpylib
import numpy as np
from jaxtyping import Float
from magpylib.core import dipole_Hfield
from scipy.constants import milli, mu_0

from pipeline.experiments.verification.checks import Check, worst
from reskin.physics import magnet
from reskin.physics import magnet as dipole
from reskin.physics.magnet import Quadrature, change_of_field, place_nodes
from reskin.physics.skin import Dipoles, SkinDesign
from reskin.seeds import rng_for

NEAR_CELLS, FAR_CELLS = 0.6, 50.0  # distances, in sizes of a cell (PHYSICS 9)
COARSE = Quadrature(cell_m=1.5e-3, layers_n=3)
MU_0_DIGITS = 1e-8  # between CODATA years mu_0 differs by 1e-10 to 1e-9
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # a quarter turn about z


def check_field(skin: SkinDesign, seed: int) -> list[Check]:
    """Check boxes, the magnetising array and dipoles, at rest and moved."""
    return [*boxes(seed), octupole(), *array(skin.polarity, skin.thickness_mm * milli, seed), *dipoles(seed)]


def boxes(seed: int, side_m: float = 0.5 * milli) -> list[Check]:
    rng = rng_for(seed, "verification", "box")
    away = rng.standard_normal((2000, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    places_m = side_m * away * np.geomspace(NEAR_CELLS, FAR_CELLS, len(away))[:, None]
    inside_m = side_m * rng.uniform(-0.49, 0.49, (500, 3))
    found_T, truth_T = magnet.cuboid_field(places_m, 1.0, sides_m=(side_m,) * 3), cuboid(side_m).getB(places_m)
    relative = np.linalg.norm(found_T - truth_T, axis=1) / np.linalg.norm(truth_T, axis=1)
    return [
        Check("field of a box", f"outside, {NEAR_CELLS:g}-{FAR_CELLS:g} sides away", "magpylib Cuboid",
              float(relative.max()), "1", 1e-8,
              "they cancel to (side / r)^3 of J: rounding grows 1e5-fold on the way to 50 sides"),
        Check("field of a box", "inside, J included", "magpylib Cuboid", inside_a_box(inside_m, side_m), "1", 1e-11,
              "logarithms cancel as (side / distance to an edge)^2: eps grows 2e4-fold at 1 % of a side"),
    ]  # fmt: skip


def inside_a_box(places_m: Float[np.ndarray, "o 3"], side_m: float) -> float:
    """Give the relative error of the field inside a cube."""
    return worst(magnet.cuboid_field(places_m, 1.0, sides_m=(side_m,) * 3), cuboid(side_m).getB(places_m))


def cuboid(side_m: float, j_T: float = 1.0, place_m: tuple[float, ...] = (0, 0, 0)) -> magpylib.magnet.Cuboid:
    """Make a cube of magpylib's that is magnetised along z."""
    return magpylib.magnet.Cuboid(polarization=(0, 0, j_T), dimension=(side_m,) * 3, position=place_m)


def octupole() -> Check:
    place, moment = np.array([[0.3, -0.4, np.sqrt(0.75)]]), np.array([[0.0, 0.0, 1 / mu_0]])
    near, far = (
        worst(dipole.field(np.zeros((1, 3)), moment, sides * place),
              magnet.cuboid_field(sides * place, 1.0, sides_m=(1.0, 1.0, 1.0)))
        for sides in (8.0, 16.0)
    )  # fmt: skip
    return Check("dipole for a cube", "error falls with (side / r)^4", "ratio 16 for twice the distance",
                 abs(near / far / 16 - 1), "1", 0.02, "next term: (side / r)^6, 1 % between 8 and 16 sides"
                 )  # fmt: skip


def cuboids(polarity: magnet.Polarity, thickness_m: float, cubes_n: tuple[int, int]) -> list[magpylib.magnet.Cuboid]:
    """Lay out the magnetising array of magpylib's cubes."""
    side_m, swaps = magnet.CUBE_SIDE_M, -1 if polarity == "checkerboard" else 1
    heights_m = (-magnet.ARRAY_BELOW_M - side_m / 2, thickness_m + magnet.ARRAY_ABOVE_M + side_m / 2)
    return [
        cuboid(side_m, magnet.ARRAY_REMANENCE_T * swaps ** (i + j),
               ((i - (cubes_n[0] - 1) / 2) * side_m, (j - (cubes_n[1] - 1) / 2) * side_m, z_m))
        for i, j, z_m in product(*map(range, cubes_n), heights_m)
    ]  # fmt: skip


def array(polarity: magnet.Polarity, thickness_m: float, seed: int) -> list[Check]:
    nodes_m = place_nodes(thickness_m, COARSE).nodes_m
    here_T, turned_T = (magnet.array_field(places_m, thickness_m, polarity) for places_m in (nodes_m, nodes_m @ TURN.T))
    swaps = -1 if polarity == "checkerboard" else 1
    theirs_T = magpylib.getB(cuboids(polarity, thickness_m, magnet.CUBES_N), nodes_m, sumup=True)
    divergence, curl = _slopes(rng_for(seed, "verification", "array"), thickness_m, polarity)
    differences = "central differences over 1 um, 0.25 mm and more from an edge: (1/250)^2"
    name = f"magnetising array, {polarity}"
    return [
        Check(name, "field in the skin", "32 magpylib Cuboids", worst(here_T, theirs_T), "1", 1e-12,
              "rounding, 32 boxes that nearly cancel at the seams"),
        Check(name, "div B = 0", "central differences", divergence, "1", 1e-4, differences),
        Check(name, "curl B = 0", "central differences", curl, "1", 1e-4, differences),
        Check(name, "a quarter turn turns the field" + (", and swaps the poles" if swaps < 0 else ""),
              "itself, turned", worst(turned_T, swaps * here_T @ TURN.T), "1", 1e-12, "rounding, as above"),
    ]  # fmt: skip


def _slopes(rng: np.random.Generator, thickness_m: float, polarity: magnet.Polarity) -> tuple[float, float]:
    """Give the worst divergence and curl relative to the steepest slope of the field there."""
    step_m = 1e-6
    low, high = np.array([-9e-3, -9e-3, 0.05 * thickness_m]), np.array([9e-3, 9e-3, 0.95 * thickness_m])
    places_m = rng.uniform(low, high, (200, 3))
    steps_m = (np.eye(3)[:, None] * np.array([step_m, -step_m])[:, None]).reshape(6, 3)
    around_m = (places_m[:, None] + steps_m).reshape(-1, 3)
    b_T = magnet.array_field(around_m, thickness_m, polarity).reshape(-1, 3, 2, 3)
    slope = (b_T[:, :, 0] - b_T[:, :, 1]) / (2 * step_m)
    size = np.abs(slope).max(axis=(1, 2))
    divergence = np.abs(np.trace(slope, axis1=1, axis2=2)) / size
    curl = np.abs(slope - slope.transpose(0, 2, 1)).max(axis=(1, 2)) / size
    return float(divergence.max()), float(curl.max())


def dipoles(seed: int, factor: float = 2.5) -> list[Check]:
    rng = rng_for(seed, "verification", "dipoles")
    # Off the origin, or a wrong sign of a separation could hide.
    nodes_m = rng.uniform((2e-3, -9e-3, 1e-3), (9e-3, 4e-3, 3e-3), (60, 3))
    moments = 1e-5 * rng.standard_normal((60, 3))
    moved_m, turned = nodes_m + 1e-4 * rng.standard_normal((60, 3)), moments + 1e-6 * rng.standard_normal((60, 3))
    observers_m = rng.uniform((-3e-3, -3e-3, -2e-3), (3e-3, 3e-3, -1e-3), (5, 3))
    before_T, after_T = (
        magpylib.getB([magpylib.misc.Dipole(moment=m, position=x) for x, m in zip(places_m, those, strict=True)],
                      observers_m, sumup=True)
        for places_m, those in ((nodes_m, moments), (moved_m, turned))
    )  # fmt: skip
    change_T = change_of_field((nodes_m, moments), (moved_m, turned), observers_m)
    scaled_T = change_of_field((nodes_m, factor * moments), (moved_m, factor * turned), observers_m)
    year = "rounding; a magpylib of another CODATA year has another mu_0"
    return [
        Check("field of dipoles", "at rest", "magpylib Dipole", worst(dipole.field(nodes_m, moments, observers_m),
              before_T), "1", MU_0_DIGITS, year),
        Check("change of field", "dipoles that move and turn", "magpylib Dipole, after less before",
              worst(change_T, after_T - before_T), "1", 10 * MU_0_DIGITS,
              f"{year}, and the difference is a tenth of the sums"),
        Check("change of field", "linear in the moments", f"itself, {factor:g} times",
              worst(scaled_T, factor * change_T), "1", 1e-12, "rounding of a few thousand operations"),
    ]  # fmt: skip


def field_of(of: Dipoles, observers_m: Float[np.ndarray, "o 3"]) -> Float[np.ndarray, "o 3"]:
    """Sum magpylib.core's field of dipoles at observers, in tesla: one call over every pair."""
    places_m, moments = of
    separation_m = (observers_m[:, None] - places_m).reshape(-1, 3)
    h_A_m = dipole_Hfield(observers=separation_m, moments=np.tile(moments, (len(observers_m), 1)))
    return mu_0 * h_A_m.reshape(len(observers_m), -1, 3).sum(axis=1)
