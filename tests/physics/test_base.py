"""Tests of the deformation of the skin against finite elements: pressed and dragged layers, sliding, friction."""

import numpy as np
import pytest
from numpy.polynomial import Polynomial

from reskin.physics import layer, shear
from tests.elements import Layer, along_x_strains

H_M, WIDTH_M, TIP_M, DEPTH_M = 2e-3, 0.8e-3, 2e-3, 1.2e-3
DRAG_M = 0.9e-3  # This is the greatest depth of a dragged tip in the scenes.
DEEPEST_RADIUS_H = 0.75  # At depth DRAG_M, the contact radius is at most this fraction of the thickness of the layer.
HELD = {
    # Beyond the outer edge of the elements, u_r falls as 1 / r. Springs of stiffness 2 / r at the edge have the same
    # effect as the layer beyond it.
    "slipping": {"held": {"axis": [0], "base": [1]}, "drag": {"far": lambda r: 2 / r}},
    "bonded": {"held": {"axis": [0], "base": [0, 1], "far": [0]}, "drag": {}},
}
PARTS = ("r_m", "z_m", "r_r", "r_z", "z_r", "z_z")


def gaussian(r_m):
    return -np.exp(-(r_m**2) / (2 * WIDTH_M**2))


def finite_elements(cells_n):
    return Layer(H_M, 3 * H_M, 8 * H_M, cells_n)


def sum_of_waves(motion, waves):
    found = layer.displacement(motion.r_m.ravel(), motion.z_m.ravel(), waves)
    return np.stack([getattr(found, name).reshape(motion.r_m.shape) for name in PARTS])


def errors_of(motion, truth):
    """Return two rms errors: that of the displacement and that of its gradient.

    Each is divided by the rms of the true values.
    """
    near, parts_n = motion.r_m < 4 * H_M, len(motion.parts_m)
    found = np.concatenate([motion.parts_m, motion.gradient.reshape(-1, *motion.r_m.shape)])[:, near]
    miss, size = ((values**2).sum(axis=1) for values in (found - truth[:, near], truth[:, near]))
    return np.sqrt([miss[part].sum() / size[part].sum() for part in (slice(parts_n), slice(parts_n, None))])


@pytest.mark.parametrize("base", ["slipping", "bonded"])
def test_finite_elements_converge_to_the_solution_for_a_pressed_layer(base):
    k_per_m = layer.WAVES_KH / H_M
    amplitude_m = WIDTH_M**2 * np.exp(-((k_per_m * WIDTH_M) ** 2) / 2) / 2 * layer.WAVES_W / H_M
    waves = layer.Waves(k_per_m, amplitude_m, H_M, base)
    solved = [finite_elements(cells_n).solve(1, gaussian, **HELD[base]) for cells_n in (4, 8)]
    errors = np.array([errors_of(solution.inside, sum_of_waves(solution.inside, waves)) for solution in solved])
    assert (errors[1] < [1e-3, 2e-2]).all()  # Measured errors with 8 cells are 3e-4 and 9e-3.
    # For Taylor-Hood elements, displacements converge with order 3 and gradients with order 2.
    assert (errors[0] / errors[1] > 2 ** np.array([2.7, 1.7])).all()
    slip_m, truth_m = solved[1].base.parts_m[0], sum_of_waves(solved[1].base, waves)[0]
    np.testing.assert_allclose(slip_m, truth_m, atol=5e-4 * np.abs(truth_m).max())


@pytest.mark.parametrize("base", ["slipping", "bonded"])
def test_contact_pressure_deforms_the_surface_to_the_shape_of_the_tip(base):
    contact = layer.contact_of_depth(DEPTH_M, thickness_m=H_M, tip_radius_m=TIP_M, base=base)
    # The Hankel transform of the pressure p is 2 G times the integral of chi(x) cos(kx) dx (G: shear modulus). Its
    # inverse is p(r) / 2G = -integral of chi'(x) / sqrt(x^2 - r^2) dx. The code substitutes x^2 = r^2 + y^2.
    chi = Polynomial.fit(contact.x_m**2, contact.weights_m2 / (contact.radius_m * layer.CONTACT_W), 12)

    def load(r_m):
        top_m = np.sqrt(np.maximum(contact.radius_m**2 - r_m**2, 0))
        x2_m2 = r_m[..., None] ** 2 + (top_m[..., None] * layer.CONTACT_X) ** 2
        return 4 * top_m * (chi.deriv()(x2_m2) @ layer.CONTACT_W)

    top = finite_elements(8).solve(1, load, **HELD[base]).top
    r_m, up_m = (values[top.r_m < contact.radius_m] for values in (top.r_m, top.parts_m[1]))
    # The tolerance is 1 % of the depth, because the edge of the contact is inside a cell. Measured errors are 0.4 % and
    # 0.7 % of the depth.
    np.testing.assert_allclose(up_m, TIP_M - np.sqrt(TIP_M**2 - r_m**2) - DEPTH_M, atol=1e-2 * DEPTH_M)


def half_curl(motion):
    """Return the rotation of the material, as the functions D, E and S of `ShearMap`.

    They follow from the displacement (functions A, B, C) and its gradients by the chain rule.
    """
    ((a_r, a_z), (b_r, b_z), (c_r, _)), (_, b, c) = motion.gradient, motion.parts_m
    in_line, across = (a_z + b_z - c_r) / 2, (a_z - b_z - c / motion.r_m) / 2
    return np.stack([(in_line + across) / 2, (in_line - across) / 2, b / motion.r_m + (b_r - a_r) / 2])


# The first contact is the contact of the deepest drag on the skin. The second contact is on a thin layer. It covers
# many cells, so finite elements are more accurate. Measured errors are 0.8 % and 0.05 %.
@pytest.mark.parametrize(("radius_h", "tolerance"), [(DEEPEST_RADIUS_H, 0.012), (2.5, 1e-3)])
def test_shear_of_a_dragged_layer_equals_finite_elements(radius_h, tolerance):
    radius_m, chi = radius_h * H_M, layer.CONTACT_W * (1 - layer.CONTACT_X**2) ** 2.5
    traction = shear.Traction(radius_m, radius_m * layer.CONTACT_X, chi / chi.sum())

    # The traction is q = 3 Q / pi a^2 (1 - r^2 / a^2)^2. Its components q cos f along r and -q sin f across r do the
    # work 2 q A.
    def load(r_m):
        return 6 / np.pi / radius_m**2 * np.maximum(1 - (r_m / radius_m) ** 2, 0) ** 2

    elements = Layer(H_M, radius_m + H_M, radius_m + 8 * H_M, 6, along_x_strains)
    solved = elements.solve(0, load, {"axis": [1, 2], "base": [0, 1, 2], "far": [0, 1, 2]}, {})
    motion, table = solved.inside, shear.tabulate(traction, H_M, traction.radius_m + 5 * H_M)
    (r_m, r_i), (z_m, z_i) = (np.unique(part.round(12), return_inverse=True) for part in (motion.r_m, motion.z_m))
    truth = np.moveaxis(shear.evaluate_map(traction, r_m, z_m, thickness_m=H_M), 2, 0)[:, r_i, z_i]
    near = motion.r_m < radius_m + 3 * H_M
    found = [*motion.parts_m[:, near], *half_curl(motion)[:, near]]
    errors = [np.linalg.norm(f - t) / np.linalg.norm(t) for f, t in zip(found, truth[:, near], strict=True)]
    assert max(errors[:3]) < tolerance
    # Gradients converge with an order that is lower by one, so their errors are larger.
    assert max(errors[3:]) < 4 * tolerance
    assert 1 / solved.under_load_m == pytest.approx(table.stiffness_m, rel=5e-4)
    d, e, s = half_curl(solved.top)
    # The tolerance is 5 %. For the two contacts, finite elements give 4 % and 0.4 % less than the table beside the edge
    # of the contact.
    assert max(np.abs(d + e).max(), np.hypot(d - e, s).max()) == pytest.approx(table.steepest_per_m2, rel=0.05)
