"""The gripper: numbers -> one table and one figure. Sees no readings, no models and no path."""

from collections.abc import Mapping
from typing import Any

import pandas as pd

from pipeline.report.drawing import COLOURS, drawing, svg

MEANING = (
    "One line of a controller closes a gripper until the estimated force is the aimed one, "
    "`closed_mm += {gain_mm_N:g} * (aim_N - estimate_N)`, {rate_hz:g} times a second, while the object stiffens "
    "threefold, gives way ninefold and stiffens again: {objects_n} objects of {soft:g} to {hard:g} N/mm on each of "
    "{skins_n} skins, one a board, pressed at its middle. Networks never saw the board; the map comes with the project "
    "and answers from 0.55 N on. The known press is one of the aimed force at the place where the object is then held: "
    "as a factor it scales all estimates, as a label the map learns from it. Judged is the true force from one second "
    "on: held is a run whose mean force lies within {within_pct:g} % of the aim, always one that never leaves that "
    "band; an error is the mean of a run's. [low, high]: 95 % interval over boards. Each of {seeds_n} networks a board "
    "holds by itself; ± (seeds): standard deviation over {seeds_n} network seeds on one board, mean over boards."
)
PRESSES = {"none": "no", "factor": "as a factor", "label": "as a label"}


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Show how often, and how nearly, each force was held with each feedback."""
    table = pd.DataFrame(
        {
            "aim, N": f"{row['aim_N']:g}",
            "force estimated by": row["feedback"],
            "one known press": PRESSES[row["press"]],
            "held, % of runs": f"{row['held_pct']:.0f}",
            "always, % of runs": f"{row['always_pct']:.0f}",
            "median error, %": f"{row['median_error_pct']:.1f}",
            "worst run's error, %": f"{row['worst_error_pct']:.0f}",
            "error, % (boards)": _interval(row["error_pct"]),
            "runs": row["runs_n"],
            "source": source,
        }
        for row in numbers["rows"]
    )
    objects = numbers["stiffness_N_mm"]
    words = {"soft": min(objects), "hard": max(objects), "objects_n": len(objects)}
    table.attrs["meaning"] = MEANING.format(**{**numbers, **words})
    return {"gripper": table}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw by how much each run's mean force missed the aim."""
    aims_N = list(numbers["aims_N"])
    with drawing(7.6, 3.8) as figure:
        panels = figure.subplots(1, len(aims_N), sharey=True, squeeze=False)[0]
        for axes, aim_N in zip(panels, aims_N, strict=True):
            rows = [row for row in drawn["rows"] if row["aim_N"] == aim_N]
            axes.axhspan(-numbers["within_pct"], numbers["within_pct"], color=COLOURS[6], alpha=0.35, linewidth=0)
            for i, row in enumerate(rows):
                runs_n = len(row["off_pct"])
                x = [i + 0.5 * (j + 0.5) / runs_n - 0.25 for j in range(runs_n)]
                axes.plot(x, row["off_pct"], "o", color=COLOURS[1 + (row["press"] != "none")], markersize=3)
            labels = [f"{row['feedback']}\n{PRESSES[row['press']]}" for row in rows]
            axes.set_xticks(range(len(rows)), labels, fontsize=8, rotation=45)
            axes.set_title(f"{aim_N:g} N", fontsize=10)
        panels[0].set_ylabel("mean force off the aim / %")
        words = f"A force is held by its estimate; below, who estimates, and the known press ({source})"
        figure.suptitle(words, x=0.01, ha="left", fontsize=11)
        return {"gripper.svg": svg(figure)}


def _interval(stat: Mapping[str, Any]) -> str:
    low_high = f" [{stat['ci95'][0]:.1f}, {stat['ci95'][1]:.1f}]" if "ci95" in stat else ""
    seeds = f" ± {stat['sd_seeds']:.1f} (seeds)" if "sd_seeds" in stat else ""
    return f"{stat['mean']:.1f}{low_high}{seeds}"
