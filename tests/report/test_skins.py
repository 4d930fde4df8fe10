"""Descriptions side by side: what is alike, what is not, and what nobody knows."""

import pytest

from pipeline.report.tables import skins_table


def described(source, **means):
    return {
        "source": source,
        "over_skins": {name: {"mean": m, "least": m / 2, "most": 2 * m, "n": 3} for name, m in means.items()},
    }


SIMULATED = described("simulated", noise_xy_uT=3.3, force_max_N=40.0, step_z_uT=0.3227)
RECORDED = described("recorded", noise_xy_uT=3.1, force_max_N=4.0)


def test_each_quantity_shows_mean_range_and_number_of_skins():
    table = skins_table({"quick (simulated)": SIMULATED})
    assert table["quick (simulated)"].tolist() == [
        "3.3 [1.65 … 6.6] (3)",
        "0.323 [0.161 … 0.645] (3)",
        "40 [20 … 80] (3)",
    ]
    assert "simulated against recorded" not in table


def test_simulated_and_recorded_skins_are_compared_row_by_row():
    table = skins_table({"quick (simulated)": SIMULATED, "lab (recorded)": RECORDED})
    words = dict(zip(table["quantity"], table["simulated against recorded"], strict=True))
    assert words["noise of one reading, x and y, µT"] == "alike"
    assert words["force, largest, N"] == "differs: 10 times the nearest recorded"
    assert words["step of a chip, z, µT"] == "–"


@pytest.mark.parametrize("factor", [0.45, 0.55, 1.9, 2.1])
def test_alike_is_within_a_factor_of_two(factor):
    table = skins_table({"a": described("simulated", noise_z_uT=factor), "b": described("recorded", noise_z_uT=1.0)})
    assert (table["simulated against recorded"][0] == "alike") == (0.5 <= factor <= 2)
