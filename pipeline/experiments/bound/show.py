"""Bound and network, told: numbers -> one table. Sees no physics, no models and no path."""

from collections.abc import Mapping
from typing import Any

import pandas as pd

from pipeline.report.formatting import COLUMNS, n_of, show, tabulate

SIDES = {"signal": "bound", "with_label_errors": "bound, labels' errors added"}
NONE = "–"


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Show the bound depth by depth, and in all beside the network, which is scored on all depths together."""
    lines = [_line(f"{row['depth_mm']:g}", row, {}, source) for row in numbers["by_depth"]]
    lines.append(_line("all", numbers["all"], numbers["network"], source))
    return {"bound": tabulate(lines, meaning=_meaning(numbers), spread="± is the sd over n folds of the network.")}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Nothing: a table says it all."""
    return {}


def _line(depth: str, row: Mapping[str, Any], network: Mapping[str, Any], source: str) -> dict[str, str]:
    line = {"depth, mm": depth, "source": source}
    for metric, title in COLUMNS.items():
        if metric in row[next(iter(SIDES))]:  # R^2 is bounded by nothing here
            line |= {f"{title} ({words})": f"{row[side][metric]:.3g}" for side, words in SIDES.items()}
        line[f"{title} (network)"] = show(network.get(metric)) if network else NONE
    return line | {"n": n_of(network) if network else NONE}


def _meaning(numbers: Mapping[str, Any]) -> str:
    labels, above_n = numbers["labels"], numbers["above_the_skin_n"]
    left_out = f" {above_n} pokes that do not touch the skin are left out." if above_n else ""
    return (
        f"Bound (Cramér-Rao): the least error of an unbiased estimate from the change of field of one row, "
        f"{numbers['readings_n']} reading less the mean of {numbers['noload_frames_n']} no-load ones, at the "
        f"{numbers['places_n']} places of skin {numbers['skin']}; its accuracy is that of normal errors. Only the "
        "chips' noise and steps count: the skin, its board and what earlier pokes left are taken as known. Labels' "
        f"errors: the robot's place, {labels['place_sd_mm']:g} mm an axis, and the force sensor, "
        f"{labels['force_sd_N']:.2g} N, which reads the true depth's force.{left_out} Network: random passes of the "
        "same skin held out. Places lie on a grid; a network that learns the grid is biased towards it and may have "
        "less error than the bound."
    )
