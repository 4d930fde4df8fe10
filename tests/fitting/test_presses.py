"""Tests of recorded presses and of the statistics that compare them with a simulation."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.fitting.presses import cosines, explained, growth, pool
from reskin.errors import ParamsError, SchemaError
from tests.data.tables import readings
from tests.fitting.recorded import AXES, simulated_presses


def test_measures_of_agreement_have_the_expected_values_for_simple_fields():
    one_uT = np.array([[[3.0, 0.0, 0.0]], [[0.0, 4.0, 0.0]]])
    assert cosines(one_uT, 2 * one_uT).tolist() == [1.0, 1.0]
    assert cosines(one_uT, one_uT[:, :, [1, 0, 2]]).tolist() == [0.0, 0.0]
    assert explained(0.5 * one_uT, one_uT).tolist() == [0.75, 0.75]
    pokes = simulated_presses(noise_uT=0.0)
    power_uT = np.ones((50, 5, 3)) * pokes.force_N[:, None, None] ** 0.3
    assert growth(pokes, power_uT) == pytest.approx(0.3)
    assert growth(replace(pokes, force_N=np.ones(50)), power_uT) is None


def test_presses_are_means_of_the_readings_with_a_force():
    one = readings(f=6, indentation=np.array([0, 0, 0, 1, 1, 2], np.int32), x_mm=np.zeros(6, np.float32),
                   Fz_N=np.array([1, 2, 3, 4, 4, np.nan], np.float32))  # fmt: skip
    pokes = pool([one])
    assert pokes.force_N.tolist() == [2.0, 4.0]
    # The first press is the mean of rows 0 to 2, the second one the mean of rows 3 and 4. Row 5 has no force.
    assert pokes.db_uT[:, 0, 0].tolist() == [1.0, 3.5]
    assert pokes.groups == ("c0 1 mm",)
    with pytest.raises(SchemaError, match="experiment compare: board .* has no press with a known place and force"):
        pool([readings(Fz_N=np.full(6, np.nan, np.float32))])
    with pytest.raises(ParamsError, match="1 chips were recorded, but compare.layout has 5"):
        AXES.align(pokes)


def test_presses_of_many_different_depths_are_grouped_by_thirds_of_depth():
    depths_mm = np.arange(60, 0, -5, np.float32) / 100
    one = readings(
        f=12, indentation=np.arange(12, dtype=np.int32), depth_mm=np.append(depths_mm[:-1], np.float32(np.nan))
    )
    pokes = pool([one])
    assert pokes.groups == ("c0", "c0 0.1 to 0.267 mm", "c0 0.267 to 0.433 mm", "c0 0.433 to 0.6 mm")
    assert pokes.group_i.tolist() == [3] * 4 + [2] * 3 + [1] * 4 + [0]
    ten = replace(one, depth_mm=np.append(depths_mm[:-2], depths_mm[:2]))
    assert len(pool([ten]).groups) == 10  # With ten different depths, each depth is a group.
