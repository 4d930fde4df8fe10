"""Write docs/growth.md and its figure from docs/measured/growth.json, which time_growth.py measures.

Run `python -m tests.benchmarks.show_growth`. The page has two exponents of the growth of cost with size. The first is
the slope of the curve in the log-log figure, which includes fixed costs. The second is the exponent p of a fit of
a + b n^p, which separates the fixed costs a.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from math import log
from typing import Any

from scipy.optimize import brentq

from pipeline.plot import drawing, svg
from reskin import io
from tests.benchmarks.pages import MEASURED, ROOT, short, table, write_block

FIGURE = "docs/img/growth.svg"
MANY_N = 100_000
GROWTH_MIN = 1.25  # cost ratio of two successive counts above which growth is distinguished from timing noise
# For each stage, the work that explains its exponent (column `reason`). Every stage must be listed here.
CAUSES = {
    "ingest_simulated": "captures are converted to Parquet files one after another, independently of each other",
    "describe": "skins are described one after another; medians over skins sort their values",
    "split": "the stage reads and stacks all rows; each fold lists the names of its skins",
    "train_multi": "the number of steps is fixed, but the stage reads and stacks all rows and scores each tested skin",
    "report": "the report has byte counts and a table row for each capture",
    "dvc": "DVC hashes the inputs and outputs of each stage, file by file",
    "dvc, raw captures": "DVC hashes and stores the files of each capture",
    "dvc, nothing to do": "DVC checks the time and size of every file",
    "whole": "this row is the sum of all stages and of DVC",
    "add one": "DVC parses the .dvc file of every capture; the registry and the plan are rewritten",
    "ingest and split all": "one stage reads the captures one after another; DVC hashes and stores files",
    "nothing to do": "DVC parses the .dvc file of every capture and checks its files",
    "ingest one more, split": "like `nothing to do`; DVC also hashes and stores all readings, and split reads them",
}
Points = list[tuple[int, float]]


def points_of(rows: Sequence[Mapping[str, Any]], count: str, part: str, what: str) -> dict[str, Points]:
    """Return the cost curve of each stage in `row[part]`. Each row gives one point: (row[count], cost `what`)."""
    found: dict[str, Points] = {}
    for row in rows:
        for name, values in row[part].items():
            if what in values:
                found.setdefault(name, []).append((row[count], values[what]))
    return found


def memory_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, Points]:
    """Return the points (number of skins, peak MB) of each stage.

    DVC commands are omitted: their measured peak memory includes memory of the measuring process.
    """
    found = points_of(rows, "skins_n", "stages", "peak_MB")
    return {name: points for name, points in found.items() if not name.startswith("dvc") and name != "whole"}


def slopes(points: Points) -> list[float]:
    """Return the slope of the log-log curve between each pair of successive points."""
    steps = pairwise(points)
    return [log(after / before) / log(n / m) for (m, before), (n, after) in steps if before > 0 and after > 0]


def exponent(points: Points) -> float | None:
    """Return the p with which a + b n^p passes through the last three points; None if the cost hardly grows."""
    if len(points) < 3:
        return None
    (k, first), (m, second), (n, third) = points[-3:]
    if second <= GROWTH_MIN * first or third <= second:
        return None
    ratio = (third - second) / (second - first)
    return float(brentq(lambda p: (n**p - m**p) / (m**p - k**p) - ratio, 0.01, 6.0))


def rows_of(points: Mapping[str, Points]) -> Iterable[dict[str, str]]:
    for name, stage_points in points.items():
        (m, before), (n, last) = stage_points[-2:]
        power, per_item = exponent(stage_points), max(last - before, 0.0) / (n - m)
        yield {
            "stage or command": name,
            **{f"{count:,}": short(value) for count, value in stage_points},
            "slope between the last two": f"{slopes(stage_points)[-1]:.2f}",
            "exponent p of a + b n^p": "–" if power is None else f"{power:.2f}",
            f"at {MANY_N:,}": short(last + per_item * (MANY_N - n)),
            "reason": CAUSES[name],
        }


def draw(panels: Mapping[str, tuple[str, Mapping[str, Points]]]) -> str:
    """Return a log-log figure (SVG) of cost against count: a panel per quantity, a colour and marker per stage."""
    with drawing(5.0 * len(panels), "Cost against size") as figure:
        for axes, (title, (count, points)) in zip(
            figure.subplots(len(panels), 1, squeeze=False).flat, panels.items(), strict=True
        ):
            for name, stage_points in points.items():
                axes.plot(*zip(*stage_points, strict=True), label=name)
            axes.set(xscale="log", yscale="log", xlabel=count, title=title)
            axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.15), ncols=2)
        return svg(figure)


def main() -> None:
    found = json.loads((MEASURED / "growth.json").read_text())
    panels = {
        "CPU seconds, simulated skins": ("simulated skins", points_of(found["skins"], "skins_n", "stages", "cpu_s")),
        "peak memory of a process, MB": ("simulated skins", memory_of(found["skins"])),
        "CPU seconds, recorded captures": (
            "recorded captures", points_of(found["captures"], "captures_n", "steps", "cpu_s"),
        ),
    }  # fmt: skip
    io.write_text(ROOT / FIGURE, draw(panels))
    parts = [
        f"Code {found['git']}, {found['machine']}.",
        f"![Cost against size, log-log]({FIGURE.removeprefix('docs/')})",
    ]
    for title, (_, points) in panels.items():
        parts += [f"**{title}**", table(list(rows_of(points)))]
    before = points_of(found["stage_each"], "captures_n", "steps", "cpu_s")
    parts += ["**CPU seconds, recorded captures, one stage per capture**", table(list(rows_of(before)))]
    write_block("growth.md", "growth", parts)


if __name__ == "__main__":
    main()
