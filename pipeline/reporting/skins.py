"""Descriptions of skins, scene beside scene -> one table. Sees numbers, never readings."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

QUANTITIES = {
    "field_at_rest_chip_median_uT": "field at rest, median chip, µT",
    "field_at_rest_channel_max_uT": "field at rest, largest channel, µT",
    "change_at_0.5_N_uT": "change of field at 0.5 N, µT",
    "change_at_1_N_uT": "change of field at 1 N, µT",
    "change_at_2_N_uT": "change of field at 2 N, µT",
    "change_at_3_N_uT": "change of field at 3 N, µT",
    "change_at_3_N_over_1_N": "change of field at 3 N over that at 1 N",
    "weakest_over_strongest_chip": "change at the weakest chip over the strongest",
    "rest_changes_in_1_uT": "field at rest, rms change from one contact to the next, µT",
    "rest_changes_in_10_uT": "field at rest, rms change over 10 contacts, µT",
    "rest_changes_in_100_uT": "field at rest, rms change over 100 contacts, µT",
    "rest_changes_in_1000_uT": "field at rest, rms change over 1,000 contacts, µT",
    "noise_xy_uT": "noise of one reading, x and y, µT",
    "noise_z_uT": "noise of one reading, z, µT",
    "step_xy_uT": "step of a chip, x and y, µT",
    "step_z_uT": "step of a chip, z, µT",
    "rate_hz": "readings a second at one stop",
    "force_median_N": "force, median, N",
    "force_max_N": "force, largest, N",
}
ALIKE = 2.0  # assumed: means within this factor count as alike
MEANING = (
    "Mean over skins [least … most] (number of skins); a change of field is the length of the vector of all channels, "
    "the median over readings within 20 % of the force. – : too few readings."
)
COMPARED = f" Alike: the means are within a factor of {ALIKE:g} of a recorded one."


def skins_table(columns: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """Put descriptions side by side by title; compare simulated with recorded ones where there are both."""
    both = {described["source"] for described in columns.values()} == {"simulated", "recorded"}
    lines = []
    for name, title in QUANTITIES.items():
        values = {column: described["over_skins"].get(name) for column, described in columns.items()}
        if not any(values.values()):
            continue
        line = {"quantity": title} | {column: _show(value) for column, value in values.items()}
        if both:
            means = [(columns[column]["source"], value["mean"]) for column, value in values.items() if value]
            line["simulated against recorded"] = _compare(means)
        lines.append(line)
    table = pd.DataFrame(lines)
    table.attrs["meaning"] = MEANING + COMPARED * both
    return table


def _show(value: Mapping[str, float] | None) -> str:
    if value is None:
        return "–"
    return f"{value['mean']:.3g} [{value['least']:.3g} … {value['most']:.3g}] ({value['n']})"


def _compare(means: Sequence[tuple[str, float]]) -> str:
    """Compare simulated with recorded means by the ratio that is nearest to 1."""
    ratios = [a / b for side, a in means if side == "simulated" for of, b in means if of == "recorded"]
    if not ratios:
        return "–"
    nearest = min(ratios, key=lambda ratio: abs(np.log(ratio)))
    if 1 / ALIKE <= nearest <= ALIKE:
        return "alike"
    return f"differs: {nearest:.2g} times the nearest recorded"
