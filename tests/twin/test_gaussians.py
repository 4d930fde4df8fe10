"""Many Gaussians weigh readings as NumPy does one by one, however many fill the last row of lanes."""

import numpy as np
import pytest

from pipeline.core.seeds import rng_for
from pipeline.twin.gaussians import LANES_N, products, quadratic


@pytest.mark.parametrize("h", [1, LANES_N, LANES_N + 3])
def test_rows_times_products_are_mahalanobis_distances(h):
    rng = rng_for(0, "gaussians", h)
    mean, spread = rng.normal(0, 300, (h, 6)), rng.normal(0, 60, (h, 6, 4))
    var, root = rng.uniform(10, 100, h), rng.standard_normal((6, 6))
    shape = root @ root.T
    read = mean[0] + rng.normal(0, 50, (5, 6))
    single = (part.astype(np.float32) for part in (mean, spread, var, shape))
    row, log_det = quadratic(*single, 20.0)
    cov = spread @ spread.transpose(0, 2, 1) + var[:, None, None] * shape + 20.0 * np.eye(6)
    off = read[:, None] - mean
    expected = np.einsum("nhi,hij,nhj->nh", off, np.linalg.inv(cov), off)
    np.testing.assert_allclose(products(read.astype(np.float32)) @ row.T, expected, rtol=1e-4, atol=0.02)  # single
    np.testing.assert_allclose(log_det, np.linalg.slogdet(cov)[1], atol=1e-3)
