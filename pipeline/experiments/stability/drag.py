"""A tip dragged without friction, and with more than any skin has (PHYSICS 10). In: a skin's design. Out: cases.

Refuses to know fields: they follow the force (`synthesis.contact`).
"""

import numpy as np
from scipy.constants import kilo, milli

from pipeline.experiments.stability.cases import Case, measured, told
from pipeline.physics import friction, layer, shear
from pipeline.physics.skin import SkinDesign

DEPTH = 0.3  # of the thickness
PATH_MM = (0.0, 0.1, 0.5, 4.0)
STICKY = 1e6


def survey_drag(skin: SkinDesign) -> list[Case]:
    """Drag the tip along a line without friction, and with a friction that never lets go."""
    thickness_m, tip_m = skin.thickness_mm * milli, skin.tip_radius_mm * milli
    depth_m, modulus_Pa = DEPTH * thickness_m, skin.modulus_kPa * kilo
    of = shear.tabulate_depth(depth_m, thickness_m=thickness_m, tip_radius_m=tip_m, base=skin.base)
    stiffness = modulus_Pa / 3 * of.stiffness_m
    depths_m = np.full(len(PATH_MM), depth_m)
    normal_N = layer.force(depths_m, thickness_m=thickness_m, tip_radius_m=tip_m, modulus_Pa=modulus_Pa, base=skin.base)
    path_m = np.column_stack([np.array(PATH_MM) * milli, np.zeros(len(PATH_MM))])
    smooth, sticky = (
        friction.drag(path_m, normal_N, stiffness_N_per_m=stiffness, friction=mu).force_N for mu in (0.0, STICKY)
    )
    error = float(np.abs(sticky[:, 0] - stiffness * path_m[:, 0]).max() / sticky.max())
    return [
        told("physics", "a drag without friction", should="no force sideways at all",
             happened=f"at most {np.abs(smooth).max():g} N over {PATH_MM[-1]:g} mm", holds=not smooth.any()),
        measured("physics", f"a drag with friction {STICKY:g}", should="sticks: force is stiffness times the way",
                 happened=f"{sticky.max():.3g} N over {PATH_MM[-1]:g} mm, relative error {error:.1e}",
                 error=error, limit=1e-12),
    ]  # fmt: skip
