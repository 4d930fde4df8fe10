"""The page of what time_growth measured: docs/measured/growth.json -> docs/growth.md and its figure.

python -m tests.benchmarks.show_growth. Two exponents: the slope in the log-log figure, in which a fixed start counts,
and that of what grows beside it.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from math import log
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure
from scipy.optimize import brentq

from pipeline.report.drawing import COLOURS, MARKERS, STYLE, svg
from reskin import io
from tests.benchmarks.pages import MEASURED, ROOT, short, table, write_block

FIGURE = "docs/img/growth.svg"
MANY_N = 100_000
TOLD = 1.25  # growth from a count to the next that is more than the noise of a busy machine
# What makes a stage's exponent what it is; a stage that is not named here fails.
CAUSES = {
    "ingest_simulated": "one capture after another, each by itself: bytes, Parquet",
    "describe": "one skin after another; medians over skins sort them",
    "split": "reads and stacks all rows; names of skins stand in each fold",
    "train_multi": "steps are as many whatever the rows: reading and stacking them, and scoring each tested skin, grow",
    "report": "an account and a row of tables a capture",
    "dvc": "hashes what each stage reads and writes, a file at a time",
    "dvc, raw captures": "hashes and stores the files of each capture",
    "dvc, nothing to do": "looks at the time and size of every file",
    "whole": "the sum",
    "add one": "DVC parses the .dvc file of every capture; the registry and the plan are written anew",
    "ingest and split all": "one capture after another in one stage, DVC's files",
    "nothing to do": "DVC parses the .dvc file of every capture, and looks at its files",
    "ingest one more, split": "as nothing to do; DVC hashes and stores the folder of readings anew, split reads it",
}
Points = list[tuple[int, float]]


def points_of(rows: Sequence[Mapping[str, Any]], count: str, part: str, what: str) -> dict[str, Points]:
    """Collect a quantity of each stage by count."""
    found: dict[str, Points] = {}
    for row in rows:
        for name, values in row[part].items():
            if what in values:
                found.setdefault(name, []).append((row[count], values[what]))
    return found


def memory_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, Points]:
    """Take the stages' own: that of a program started here begins with what this process held."""
    found = points_of(rows, "skins_n", "stages", "peak_MB")
    return {name: points for name, points in found.items() if not name.startswith("dvc") and name != "whole"}


def slopes(points: Points) -> list[float]:
    """Give the slope in the figure from each count to the next."""
    steps = pairwise(points)
    return [log(after / before) / log(n / m) for (m, before), (n, after) in steps if before > 0 and after > 0]


def exponent(points: Points) -> float | None:
    """Solve the last three points for p in a + b n^p; None where what grows is not told from what is fixed."""
    if len(points) < 3:
        return None
    (k, first), (m, second), (n, third) = points[-3:]
    if second <= TOLD * first or third <= second:
        return None
    ratio = (third - second) / (second - first)
    return float(brentq(lambda p: (n**p - m**p) / (m**p - k**p) - ratio, 0.01, 6.0))


def rows_of(points: Mapping[str, Points]) -> Iterable[dict[str, str]]:
    for name, own in points.items():
        (m, before), (n, last) = own[-2:]
        power, each = exponent(own), max(last - before, 0.0) / (n - m)
        yield {
            "what": name,
            **{f"{count:,}": short(value) for count, value in own},
            "slope, last step": f"{slopes(own)[-1]:.2f}",
            "exponent beyond the fixed start": "–" if power is None else f"{power:.2f}",
            f"at {MANY_N:,}": short(last + each * (MANY_N - n)),
            "why": CAUSES[name],
        }


def draw(panels: Mapping[str, tuple[str, Mapping[str, Points]]]) -> str:
    """Draw quantities against counts, log-log: a panel a quantity, a colour and a marker a stage."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.6, 3.1 * len(panels)), layout="constrained")
        for axes, (title, (count, points)) in zip(
            figure.subplots(len(panels), 1, squeeze=False).flat, panels.items(), strict=True
        ):
            for i, (name, own) in enumerate(points.items()):
                ns, values = zip(*own, strict=True)
                style = {"color": COLOURS[i % len(COLOURS)], "marker": MARKERS[i % len(MARKERS)]}
                axes.plot(ns, values, label=name, linewidth=1, markersize=4, **style)
            axes.set(xscale="log", yscale="log", xlabel=count)
            axes.grid(alpha=0.25)
            axes.set_title(title, loc="left", fontsize=9)
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
        return svg(figure)


def main() -> None:
    found = json.loads((MEASURED / "growth.json").read_text())
    of = {
        "CPU seconds, simulated skins": ("simulated skins", points_of(found["skins"], "skins_n", "stages", "cpu_s")),
        "peak memory of a process, MB": ("simulated skins", memory_of(found["skins"])),
        "CPU seconds, recorded captures": (
            "recorded captures", points_of(found["captures"], "captures_n", "steps", "cpu_s"),
        ),
    }  # fmt: skip
    io.write_text(ROOT / FIGURE, draw(of))
    parts = [
        f"Code {found['git']}, {found['machine']}.",
        f"![Cost against size, log-log]({FIGURE.removeprefix('docs/')})",
    ]
    for title, (_, points) in of.items():
        parts += [f"**{title}**", table(list(rows_of(points)))]
    before = points_of(found["stage_each"], "captures_n", "steps", "cpu_s")
    parts += ["**CPU seconds, recorded captures, a stage each**", table(list(rows_of(before)))]
    write_block("growth.md", "growth", parts)


if __name__ == "__main__":
    main()
