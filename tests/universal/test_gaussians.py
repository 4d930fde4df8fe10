"""Many Gaussians weigh readings as NumPy does one by one, however many fill the last block of lanes."""

import numpy as np
import pytest

from reskin.seeds import rng_for
from reskin.universal.gaussians import LANES_N, side_by_side, whiten


@pytest.mark.parametrize("h", [1, LANES_N, LANES_N + 3])
def test_readings_are_weighed_by_mahalanobis_distances(h):
    rng = rng_for(0, "gaussians", h)
    mean, slope = rng.normal(0, 300, (h, 6)), rng.normal(0, 60, (h, 6, 4))
    number, root = rng.standard_normal(4), np.linalg.cholesky(np.cov(rng.standard_normal((4, 20))))
    missed, left, shape = 0.1 * rng.standard_normal((h, 6)), rng.uniform(0.5, 1, h), np.cov(rng.normal(0, 0.1, (6, 20)))
    expected = mean + slope @ number
    length = np.linalg.norm(expected, axis=1, keepdims=True)
    expected, spread = expected + length * missed, slope @ root
    read = expected[0] + rng.normal(0, 50, (5, 6))
    mean, slope, number, root, missed, left, shape, read = (
        part.astype(np.float32) for part in (mean, slope, number, root, missed, left, shape, read)
    )
    chi2, total = whiten(side_by_side(mean, slope), (number, root), missed, left, shape, 20.0).weigh(read)
    cov = spread @ spread.transpose(0, 2, 1) + (length[:, 0] ** 2 * left)[:, None, None] * shape + 20.0 * np.eye(6)
    off = read[:, None] - expected
    np.testing.assert_allclose(chi2, np.einsum("nhi,hij,nhj->nh", off, np.linalg.inv(cov), off), rtol=1e-4, atol=0.01)
    np.testing.assert_allclose(total - chi2, np.tile(np.linalg.slogdet(cov)[1], (5, 1)), atol=1e-3)  # single precision
