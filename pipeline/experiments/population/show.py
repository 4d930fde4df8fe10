"""What experts of simulated skins know of others: numbers -> three tables and a figure. Sees no skins and no path."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from pipeline.report.drawing import COLOURS, MARKERS, drawing, svg
from pipeline.report.formatting import n_of, scores, tabulate

NAMES = {
    "map": "universal map, skin as designed",
    "universal": "universal, skin as designed",
    "network": "universal network alone, skin as designed",
}
WAYS = {"map": "map", "network": "network", "universal": "both"}
WEIGHED, FACTOR = "MSE_F with one known weight / N²", "MSE_F after one factor a skin (diagnosis) / N²"
COVERAGE = "in 90 % intervals / %"
FURTHER = {"mse_f_weight_N2": WEIGHED, "mse_f_factor_N2": FACTOR, "coverage_pct": COVERAGE}


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Show errors by what is told of a skin, and by how many skins a network was taught."""
    told = [_line(row, source) for row in numbers["told"]]
    scaling = [_line(row, source, taught=row["skins_n"]) for row in numbers["scaling"]]
    shown = {
        "population": tabulate(told, meaning=_meaning(numbers)),
        "population_scaling": tabulate(scaling, meaning=_scaling(numbers)),
    }
    if "fresh" in numbers:  # committed results may be of before it was counted
        shown["population_fresh"] = tabulate(_fresh(numbers["fresh"], source), meaning=_of_fresh(numbers))
    return shown


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw the error against the number of skins that a network was taught."""
    rows = pd.DataFrame(numbers["scaling"])
    with drawing(6.0, 3.8) as figure:
        axes = figure.subplots()
        for i, way in enumerate(("network", "universal")):
            own = rows[rows["way"] == way]
            wrong_pct = [100 - one["mean"] for one in own["accuracy_pct"]]
            sd = [one.get("sd", 0.0) for one in own["accuracy_pct"]]
            style = {"color": COLOURS[i], "marker": MARKERS[i], "capsize": 3}
            axes.errorbar(own["skins_n"], wrong_pct, sd, label=NAMES[way], **style)
        axes.set(xscale="log", xlabel="simulated skins that the network was taught", ylim=(0, None))
        axes.set_ylabel("error above 1 mm / %")
        axes.legend(frameon=False)
        boards_n = rows["accuracy_pct"].iloc[0]["n"]
        axes.set_title(f"{numbers['steps_n']} steps each, skins of {boards_n} boards ({source})", fontsize=9)
        return {"population_scaling.svg": svg(figure)}


def _line(row: Mapping[str, Any], source: str, taught: int | None = None) -> dict[str, str]:
    line = {"method": NAMES[row["way"]]} | ({} if taught is None else {"skins taught": str(taught)})
    line |= {"unlabelled pokes": str(row["pokes_n"]), "labels": str(row["labels_n"]), "source": source}
    return line | scores(row) | scores(row, FURTHER) | {"n": n_of(row)}


def _fresh(rows: Sequence[Mapping[str, Any]], source: str) -> list[dict[str, str]]:
    lines: dict[tuple[int, int], dict[str, str]] = {}
    for row in rows:
        told = row["pokes_n"], row["labels_n"]
        first = {"unlabelled pokes": str(told[0]), "labels": str(told[1]), "source": source}
        line = lines.setdefault(told, first)
        line |= scores(row, {"coverage_pct": f"{WAYS[row['way']]}: {COVERAGE}"})
    skins_n = n_of(rows[0])
    return [line | {"n": skins_n} for line in lines.values()]


def _of_fresh(numbers: Mapping[str, Any]) -> str:
    return (
        "Fresh skins of the population: neither those that networks were taught nor those that tell how sure experts "
        "are. [low, high]: 95 % interval over n skins. The population is drawn wider than the scene's "
        f"{numbers['skins_asked_n']} skins."
    )


def _meaning(numbers: Mapping[str, Any]) -> str:
    coverage = ", ".join(f"{NAMES[way]} {pct:.3g} %" for way, pct in numbers["coverage_further_pct"].items())
    return (
        f"Experts that were taught simulated skins about the skin as designed, and none of the scene's "
        f"{numbers['skins_asked_n']}, of which {numbers['rows_asked_n']:,} rows of later passes are read. Unlabelled "
        f"pokes: one at each of the {numbers['pool_n']} places of the grid under any depth, or the first of these; "
        f"labels are among them. The weight: of one press in the middle, {numbers['weight_N']:g} N or what of the "
        f"first passes comes next to it, the force is known to {100 * numbers['weight_sd']:g} %; the factor uses all "
        "forces: no weight that moves them alike goes below it. How sure each "
        "way is, and how far a weight moves its forces, was told on further skins of the population; there 90 % "
        f"intervals hold {coverage}."
    )


def _scaling(numbers: Mapping[str, Any]) -> str:
    return (
        f"Networks of {numbers['steps_n']} steps each, from equal first weights, on the first so many skins of one "
        "population; the map beside them is the same, and so is how sure they are, told with the network of most skins."
    )
