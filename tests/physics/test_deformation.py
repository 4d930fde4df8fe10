"""Tests of the deformation of the skin under a tip, which is computed in small steps of depth.

The tests check the laws of experiment extremes, the limit of small depths and the convergence of the steps.
"""

from itertools import pairwise

import numpy as np
import pytest

from pipeline.experiments.extremes import physics as laws
from reskin.physics import deformation, layer
from tests.laws import LIMITS

H_M, TIP_M = 2e-3, 3e-3
BASES = ("bonded", "slipping")


def nodes(r_n=25, z_n=11, r_max_m=5e-3):
    r_m, z_m = np.meshgrid(np.linspace(0.07e-3, r_max_m, r_n), np.linspace(0.03, 0.97, z_n) * H_M, indexing="ij")
    return r_m.ravel(), z_m.ravel()


def depth_steps(to_m, press):
    """Return the depths of the ladder below `to_m`, and `to_m`."""
    ladder_m = press.thickness_m * deformation.depth_scale(press.tip_radius_m / press.thickness_m) * deformation.LADDER
    return np.append(ladder_m[ladder_m < to_m], to_m)


def follow(r_m, z_m, to_m=1.2e-3, base="bonded"):
    press = layer.IndentedLayer(H_M, TIP_M, base)
    return deformation.follow(r_m, z_m, depth_steps(to_m, press), press=press)[-1]


def det_f(deformed):
    return np.linalg.det(deformed.f) * deformed.hoop


@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("depth_m", [0.2e-3, 0.6e-3, 1.2e-3])
def test_surface_under_the_tip_follows_its_shape(depth_m, base):
    # If the deformation were computed in one step, the surface would miss the tip by 27 % of the depth at 1.2 mm.
    assert laws.surface(layer.IndentedLayer(H_M, TIP_M, base), depth_m) <= LIMITS["surface_bonded"]


@pytest.mark.parametrize("base", BASES)
def test_volume_is_conserved_and_the_base_does_not_move(base):
    volume, gradient = laws.finite_steps(layer.IndentedLayer(H_M, TIP_M, base), 1.2e-3)
    assert volume <= LIMITS["volume_bonded"]
    assert gradient <= LIMITS["gradient_bonded"]
    base_m = np.linspace(0, 4 * H_M, 40)
    end = follow(base_m, np.zeros(40), base=base)
    np.testing.assert_allclose(end.z_m, 0, atol=1e-16)
    if base == "bonded":
        np.testing.assert_allclose(end.r_m, base_m, atol=1e-16)


def test_rotation_angle_equals_that_of_the_polar_decomposition():
    f = follow(*nodes(14, 7)).f
    # Polar decomposition: F = R U with the rotation R = u vt, from the singular value decomposition of F.
    u, _, vt = np.linalg.svd(f)
    np.testing.assert_allclose((u @ vt)[:, 0, 1], np.sin(deformation.rotation_angle(f)), atol=1e-12)


def test_material_under_the_dent_flows_outward_on_a_slipping_base():
    press = layer.IndentedLayer(H_M, TIP_M, "slipping")
    assert laws.far_field(press, 1.2e-3) <= LIMITS["far_field"]


def test_errors_of_the_steps_converge_quadratically(monkeypatch):
    r_m, z_m = nodes(12, 6)
    found = []
    for step in (0.1, 0.05, 0.025):
        ladder = np.array([0.0, step / 4, step / 2, *np.arange(step, 1.01, step)])
        monkeypatch.setattr(deformation, "LADDER", ladder)
        # This depth is a whole number of steps, so that halving the step halves every step.
        found.append(follow(r_m, z_m, 0.6 * H_M * deformation.depth_scale(TIP_M / H_M)))
    loss = [np.abs(det_f(deformed) - 1).max() for deformed in found]
    assert loss[1] < loss[0] / 2.5
    assert loss[2] < loss[1] / 2.5
    apart_m = [np.hypot(b.r_m - a.r_m, b.z_m - a.z_m).max() for a, b in pairwise(found)]
    assert apart_m[1] < apart_m[0] / 2
    assert apart_m[1] < 0.03 * 1.2e-3  # The last difference is between the default step and half the step.
