"""Fields of magnets and dipoles against magpylib and Maxwell. In: a design of skins. Out: checks.

magpylib's objects share no code with ours. Refuses to know pokes (`poke`) and chips (`electronics`).
"""

from itertools import product

import numpy as np
from jaxtyping import Float
from scipy.constants import milli, mu_0

from pipeline.core.seeds import rng_for
from pipeline.experiments.verification.checks import Check, worst
from pipeline.physics import dipole, magnet
from pipeline.physics.change import change_of_field
from pipeline.physics.nodes import Quadrature, place_nodes
from pipeline.physics.skin import SkinDesign

NEAR_CELLS, FAR_CELLS = 0.6, 50.0  # distances, in sizes of a cell (PHYSICS 9)
COARSE = Quadrature(cell_m=1.5e-3, layers_n=3)
MU_0_DIGITS = 1e-8  # between CODATA years mu_0 differs by 1e-10 to 1e-9


def check_field(skin: SkinDesign, seed: int) -> list[Check]:
    """Check boxes, the magnetising array and dipoles, at rest and moved."""
    return [*_boxes(seed), *_array(skin, seed), *_dipoles(seed)]


def _boxes(seed: int) -> list[Check]:
    from magpylib.magnet import Cuboid

    side_m = 0.5 * milli
    rng = rng_for(seed, "verification", "box")
    away = rng.standard_normal((2000, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    places_m = side_m * away * np.geomspace(NEAR_CELLS, FAR_CELLS, len(away))[:, None]
    inside_m = side_m * rng.uniform(-0.5, 0.5, (500, 3))
    theirs = Cuboid(polarization=(0, 0, 1.0), dimension=(side_m,) * 3)
    found_T, inside_T = (magnet.cuboid_field(p, 1.0, sides_m=(side_m,) * 3) for p in (places_m, inside_m))
    truth_T = theirs.getB(places_m)
    relative = np.linalg.norm(found_T - truth_T, axis=1) / np.linalg.norm(truth_T, axis=1)
    rounding = "rounding of 24 logarithms and arcus tangents of the size of J"
    return [
        Check("field of a box", f"outside, {NEAR_CELLS:g}-{FAR_CELLS:g} sides away", "magpylib Cuboid",
              float(relative.max()), "1", 1e-8,
              "they cancel to (side / r)^3 of J: rounding grows 1e5-fold on the way to 50 sides"),
        Check("field of a box", "inside, J included", "magpylib Cuboid", worst(inside_T, theirs.getB(inside_m)), "1",
              1e-12, rounding),
        Check("dipole for a cube", "error falls with (side / r)^4", "ratio 16 for twice the distance", _octupole(), "1",
              0.02, "next term: (side / r)^6, 1 % between 8 and 16 sides"),
    ]  # fmt: skip


def _octupole() -> float:
    # A cube has no quadrupole, and its octupole vanishes with equal sides: next is (side / r)^4.
    place = np.array([[0.3, -0.4, np.sqrt(0.75)]])
    moment = np.array([[0.0, 0.0, 1 / mu_0]])

    def error(sides: float) -> float:
        exact_T = magnet.cuboid_field(sides * place, 1.0, sides_m=(1.0, 1.0, 1.0))
        return worst(dipole.field(np.zeros((1, 3)), moment, sides * place), exact_T)

    return abs(error(8.0) / error(16.0) / 16 - 1)


def _array(skin: SkinDesign, seed: int) -> list[Check]:
    import magpylib

    thickness_m, side_m = skin.thickness_mm * milli, magnet.CUBE_SIDE_M
    nodes_m = place_nodes(thickness_m, COARSE).nodes_m
    heights_m = (-magnet.ARRAY_BELOW_M - side_m / 2, thickness_m + magnet.ARRAY_ABOVE_M + side_m / 2)
    swaps = -1 if skin.polarity == "checkerboard" else 1
    cubes = [
        magpylib.magnet.Cuboid(
            polarization=(0, 0, magnet.ARRAY_REMANENCE_T * swaps ** (i + j)),
            dimension=(side_m,) * 3,
            position=((i - 1.5) * side_m, (j - 1.5) * side_m, z_m),
        )
        for i, j, z_m in product(range(4), range(4), heights_m)
    ]
    here_T = magnet.array_field(nodes_m, thickness_m, skin.polarity)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned_T = magnet.array_field(nodes_m @ turn.T, thickness_m, skin.polarity)
    divergence, curl = _slopes(rng_for(seed, "verification", "array"), thickness_m, skin)
    differences = "central differences over 1 um, 0.25 mm and more from an edge: (1/250)^2"
    name = f"magnetising array, {skin.polarity}"
    return [
        Check(name, "field in the skin", "32 magpylib Cuboids",
              worst(here_T, magpylib.getB(cubes, nodes_m, sumup=True)), "1", 1e-12,
              "rounding, 32 boxes that nearly cancel at the seams"),
        Check(name, "div B = 0", "central differences", divergence, "1", 1e-4, differences),
        Check(name, "curl B = 0", "central differences", curl, "1", 1e-4, differences),
        Check(name, "a quarter turn turns the field" + (", and swaps the poles" if swaps < 0 else ""),
              "itself, turned", worst(turned_T, swaps * here_T @ turn.T), "1", 1e-12, "rounding, as above"),
    ]  # fmt: skip


def _slopes(rng: np.random.Generator, thickness_m: float, skin: SkinDesign) -> tuple[float, float]:
    """Give the worst divergence and curl relative to the steepest slope of the field there."""
    step_m = 1e-6
    low, high = np.array([-9e-3, -9e-3, 0.05 * thickness_m]), np.array([9e-3, 9e-3, 0.95 * thickness_m])
    places_m = rng.uniform(low, high, (200, 3))
    steps_m = (np.eye(3)[:, None] * np.array([step_m, -step_m])[:, None]).reshape(6, 3)
    around_m = (places_m[:, None] + steps_m).reshape(-1, 3)
    b_T = magnet.array_field(around_m, thickness_m, skin.polarity).reshape(-1, 3, 2, 3)
    slope = (b_T[:, :, 0] - b_T[:, :, 1]) / (2 * step_m)
    size = np.abs(slope).max(axis=(1, 2))
    divergence = np.abs(np.trace(slope, axis1=1, axis2=2)) / size
    curl = np.abs(slope - slope.transpose(0, 2, 1)).max(axis=(1, 2)) / size
    return float(divergence.max()), float(curl.max())


def _dipoles(seed: int) -> list[Check]:
    rng = rng_for(seed, "verification", "dipoles")
    # Off the origin, or a wrong sign of a separation could hide.
    nodes_m = rng.uniform((2e-3, -9e-3, 1e-3), (9e-3, 4e-3, 3e-3), (60, 3))
    moments = 1e-5 * rng.standard_normal((60, 3))
    moved_m, turned = nodes_m + 1e-4 * rng.standard_normal((60, 3)), moments + 1e-6 * rng.standard_normal((60, 3))
    observers_m = rng.uniform((-3e-3, -3e-3, -2e-3), (3e-3, 3e-3, -1e-3), (5, 3))
    before_T, after_T = _their_dipoles(nodes_m, moments, observers_m), _their_dipoles(moved_m, turned, observers_m)
    change_T = change_of_field((nodes_m, moments), (moved_m, turned), observers_m)
    scaled_T = change_of_field((nodes_m, 2.5 * moments), (moved_m, 2.5 * turned), observers_m)
    year = "rounding; a magpylib of another CODATA year has another mu_0"
    return [
        Check("field of dipoles", "at rest", "magpylib Dipole", worst(dipole.field(nodes_m, moments, observers_m),
              before_T), "1", MU_0_DIGITS, year),
        Check("change of field", "dipoles that move and turn", "magpylib Dipole, after less before",
              worst(change_T, after_T - before_T), "1", 10 * MU_0_DIGITS,
              f"{year}, and the difference is a tenth of the sums"),
        Check("change of field", "linear in the moments", "itself, 2.5 times", worst(scaled_T, 2.5 * change_T), "1",
              1e-12, "rounding of a few thousand operations"),
    ]  # fmt: skip


def _their_dipoles(
    places_m: Float[np.ndarray, "s 3"], moments: Float[np.ndarray, "s 3"], observers_m: Float[np.ndarray, "o 3"]
) -> Float[np.ndarray, "o 3"]:
    import magpylib

    dipoles = [magpylib.misc.Dipole(moment=m, position=x) for x, m in zip(places_m, moments, strict=True)]
    return magpylib.getB(dipoles, observers_m, sumup=True)
