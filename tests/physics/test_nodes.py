"""Tests of the nodes at which integrals over the skin are computed, each with a weight (quadrature).

The skin is divided into cells, which must fill it and end at the seams between the magnets.
"""

from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.errors import ParamsError
from reskin.physics.magnet import (
    CUBE_SIDE_M,
    DEFAULT_QUADRATURE,
    SEAMS_M,
    SKIN_SIDE_M,
    Quadrature,
    place_nodes,
    seams_m,
)

THICKNESS_M = 2e-3
rules = st.builds(Quadrature, cell_m=st.floats(0.3e-3, 5e-3), layers_n=st.integers(1, 8))


@given(rules)
def test_cells_end_at_seams_and_are_not_wider_than_the_given_width(rule):
    x_m = np.unique(place_nodes(THICKNESS_M, rule).nodes_m[:, 0])
    marks_m = np.array([-SKIN_SIDE_M / 2, *SEAMS_M, SKIN_SIDE_M / 2])
    for a_m, b_m in pairwise(marks_m):
        inside_m = x_m[(a_m < x_m) & (x_m < b_m)]
        width_m = (b_m - a_m) / len(inside_m)
        assert width_m <= rule.cell_m * (1 + 1e-6)
        np.testing.assert_allclose(inside_m, a_m + width_m * (0.5 + np.arange(len(inside_m))), atol=1e-12)


def test_seams_between_cells_are_those_of_the_magnet_array():
    np.testing.assert_allclose(SEAMS_M, CUBE_SIDE_M * np.array([-1, 0, 1]))


@given(st.floats(1e-3, 60e-3), st.floats(1e-3, 60e-3), rules)
def test_cells_fill_skins_of_any_size(x_m, y_m, rule):
    rest = place_nodes(THICKNESS_M, rule, sides_m=(x_m, y_m))
    np.testing.assert_allclose(rest.volumes_m3.sum(), x_m * y_m * THICKNESS_M, rtol=1e-12)
    for axis, side_m in enumerate((x_m, y_m)):
        marks_m = np.array([-side_m / 2, *seams_m(side_m), side_m / 2])
        along_m = np.unique(rest.nodes_m[:, axis])
        for a_m, b_m in pairwise(marks_m):
            inside_m = along_m[(a_m < along_m) & (along_m < b_m)]
            # The first node is half a cell away from the edge.
            cells_n = round((b_m - a_m) / (2 * (inside_m[0] - a_m)))
            assert cells_n == len(inside_m)
            assert (b_m - a_m) / cells_n <= rule.cell_m * (1 + 1e-6)


def test_nodes_of_the_papers_skin_equal_those_of_nested_loops():
    rest, marks_m = place_nodes(THICKNESS_M, DEFAULT_QUADRATURE), (-10e-3, -6.35e-3, 0.0, 6.35e-3, 10e-3)
    spans = [np.linspace(a, b, n + 1) for (a, b), n in zip(pairwise(marks_m), (8, 13, 13, 8), strict=True)]
    x_m = np.concatenate([(edges[1:] + edges[:-1]) / 2 for edges in spans])
    heights_m = (1 + np.polynomial.legendre.leggauss(6)[0]) / 2 * THICKNESS_M
    naive_m = [(x, y, z) for x in x_m for y in x_m for z in heights_m]
    np.testing.assert_array_equal(rest.nodes_m, naive_m)


def test_quadrature_error_falls_with_the_square_of_the_cell_size():
    def error(cell_m):
        rest = place_nodes(THICKNESS_M, Quadrature(cell_m, 1))
        wave = np.cos(300 * rest.nodes_m[:, 0]) * np.cos(200 * rest.nodes_m[:, 1])
        half_m = SKIN_SIDE_M / 2
        truth = 4 * np.sin(300 * half_m) / 300 * np.sin(200 * half_m) / 200 * THICKNESS_M
        return abs(rest.volumes_m3 @ wave / truth - 1)

    # Cell sizes are 6.35 mm and 3.65 mm divided by powers of two, so every step halves all cells. The tolerance of 5 %
    # allows for the error of next order.
    coarse, fine = error(6.35e-3 / 8), error(6.35e-3 / 16)
    assert coarse / fine == pytest.approx(4, rel=0.05)


@pytest.mark.parametrize(
    ("thickness_m", "cell_m", "layers_n"),
    [v for v in product((0.0, -1e-3, np.nan, 2e-3), (0.0, np.nan, 5e-4), (0, 6)) if v != (2e-3, 5e-4, 6)],
)
def test_skin_or_quadrature_of_size_zero_is_refused(thickness_m, cell_m, layers_n):
    with pytest.raises(ParamsError, match="thickness, cell and layers must be above 0"):
        place_nodes(thickness_m, Quadrature(cell_m, layers_n))
