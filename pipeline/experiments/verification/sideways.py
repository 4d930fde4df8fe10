"""A tip that pushes sideways against closed forms. In: a design of skins. Out: checks.

Refuses to know magnets, and the pressing (`contact`).
"""

import numpy as np
from scipy.constants import kilo, milli

from pipeline.experiments.verification.checks import Check
from pipeline.physics import friction, layer, shear
from pipeline.physics.skin import SkinDesign

HALF_SPACE_M = 100.0  # a layer that a tip of millimetres does not feel the base of
FRICTION = 0.8


def check_sideways(skin: SkinDesign) -> list[Check]:
    """Check the stiffness of a thick layer and the friction along a straight drag."""
    tip_m, modulus_Pa = skin.tip_radius_mm * milli, skin.modulus_kPa * kilo
    radius_m = 0.1 * tip_m
    sticking = shear.stiffness_m(shear.stick(radius_m, HALF_SPACE_M), HALF_SPACE_M) / radius_m
    contact = layer.contact_of_radius(radius_m, thickness_m=HALF_SPACE_M, tip_radius_m=tip_m, base=skin.base)
    sliding = shear.stiffness_m(shear.slip(contact), HALF_SPACE_M) / radius_m
    path_m, stiffness, limit_N = np.linspace(0, 3e-3, 31), modulus_Pa * radius_m, FRICTION * modulus_Pa * radius_m**2
    places_m = np.column_stack([path_m, np.zeros_like(path_m)])
    normal_N = np.full_like(path_m, limit_N / FRICTION)
    found_N = friction.drag(places_m, normal_N, stiffness_N_per_m=stiffness, friction=FRICTION).force_N[:, 0]
    truth_N = np.minimum(stiffness * path_m, limit_N)
    return [
        Check("sideways stiffness, thick layer", "a tip that sticks: 16/3 G a", "Mindlin 1949, nu = 1/2",
              abs(sticking / (16 / 3) - 1), "1", 1e-3, "the base is felt as a / h, 3e-6; sums over the contact"),
        Check("sideways stiffness, thick layer", "q = mu p of Hertz: 40/9 G a", "Cerruti's integral in closed form",
              abs(sliding / (40 / 9) - 1), "1", 2e-3, "contact radius R / 10: a sphere is no paraboloid"),
        Check("friction", "Q = min(k s, mu F) along a straight drag", "itself, by hand",
              float(np.abs(found_N - truth_N).max() / limit_N), "1", 1e-12, "rounding of 30 steps"),
    ]  # fmt: skip
