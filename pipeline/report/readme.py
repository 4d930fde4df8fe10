"""Fill in the generated blocks of README.md and docs, and what the live page shows, from the results in `reports/`."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import pandas as pd

from pipeline import FLOW
from pipeline.benchmark import entries
from pipeline.report.formatting import tabulate, to_markdown
from pipeline.report.numbers import join
from pipeline.report.tables import make_tables, skins_table, summary_table
from pipeline.scenes import ANALYSES
from pipeline.stages import module_name
from reskin import io
from reskin.code import ROOT, file_of
from reskin.config import read_yaml
from reskin.errors import ParamsError, SchemaError

TABLES = ("table2", "claims", "manual", "flexible", "single_sensor")  # shown in docs/results.md for simulated scenes
COMPARED = ("compare", "compare_parameters", "compare_frames")
MOVING = ("moving_hand", "moving_hand_places", "moving_hand_simulated", "moving_hand_places_simulated")
NONE_YET = "None yet."
COSTS_MEANING = (
    "The time to compute everything from scratch, as if the training runs ran one after another. By default, two of "
    "them run side by side, so less time passes."
)
BENCHMARK = "benchmark"
TIMES = "reports/time.json"  # written by `make time-repro`
FULL_SIZE, HEADLINE = "paper", "quick"  # the simulated scenes that the pages show; README.md shows HEADLINE
# The scene in which the shipped universal model is tested, and its name there.
SHIPPED_SCENE, SHIPPED_NAME = "lab", "universal, simulated alone"
MEASURED = "reskin/universal/measured.json"  # what the live page shows of this model
Numbers = Mapping[str, Any]  # the joined numbers.json and provenance.json of one scene


def fill_pages(root: Path, *, write: bool) -> tuple[list[str], list[str]]:
    """Fill in all pages and, if `write`, write them; return the pages that changed and the scenes that they show.

    The pages show the simulated scenes `paper` and `quick`, and every recorded scene with results in `reports/`.
    """
    files = sorted((root / "reports").glob("*/numbers.json"))
    numbers = {
        file.parent.name: join(io.read_json(file), io.read_json(file.with_name("provenance.json"))) for file in files
    }
    for name in (FULL_SIZE, HEADLINE):
        if name not in numbers:
            raise ParamsError(
                f"reports/{name}/numbers.json is missing, but README.md and docs show its results. "
                f"Restore it: git restore reports/{name}"
            )
    recorded = [result for result in numbers.values() if result["provenance"]["source"] == "recorded"]
    results = [numbers[name] for name in (FULL_SIZE, HEADLINE)]
    times = io.read_json(root / TIMES) if (root / TIMES).exists() else None
    pages = [root / "README.md", *sorted((root / "docs").glob("*.md"))]
    before = {str(page): page.read_text(encoding="utf-8") for page in pages}
    blocks = blocks_of(results, recorded, read_yaml(root / FLOW)["stages"], times)
    blocks |= entries.blocks(entries.read_entries(root / BENCHMARK), numbers.get("lab", {}))
    after = fill(before, blocks)
    changed = [page for page in after if after[page] != before[page]]
    for page in changed if write else ():
        io.write_text(Path(page), after[page])
    if SHIPPED_SCENE in numbers:
        file, measured = root / MEASURED, measured_of(numbers[SHIPPED_SCENE])
        if not file.exists() or io.read_json(file) != measured:
            changed.append(str(file))
            if write:
                io.write_json(file, measured)
    return changed, [result["provenance"]["scene"] for result in (*results, *recorded)]


def measured_of(numbers: Numbers) -> dict[str, Any]:
    """Return the results of the shipped universal model that the live page shows (`reskin.live.used_model.Measured`).

    The places are those of presses at random places, tested on the other colour of a checkerboard of places.
    """

    def by_board(row: Numbers) -> dict[str, list[float]]:
        return {name: row[name]["values"] for name in ("accuracy_pct", "median_mm", "mse_xy_mm2")}

    limits = numbers["recorded_limits"]
    places = [
        {"presses_n": 0, "labels_n": 0} | by_board(row)
        for row in limits["registration"]["rows"]
        if (row["method"], row["presses_n"], row["known"]) == (SHIPPED_NAME, 0, "not used")
    ] + [
        {"presses_n": row["presses_n"], "labels_n": int(row["labels"])} | by_board(row)
        for row in numbers["random_presses"]["rows"]
        if (row["method"], row["tested"]) == (SHIPPED_NAME, "other colour of a checkerboard")
        and row["labels"].isdecimal()
    ]
    detection = [
        row
        for row in limits["detection"]["rows"]
        if (row["baseline"], row["rule"]) == ("before each press", "as in reskin live")
    ]
    columns = {"lightest_N": "smallest_N", "detected_pct": "detected_pct", "false_alarm_pct": "false_alarm_pct"}
    return {
        "scene": numbers["provenance"]["scene"],
        "source": numbers["provenance"]["source"],
        "places": sorted(places, key=lambda row: (row["presses_n"], row["labels_n"])),
        "detection": {name: [row[column] for row in detection] for name, column in columns.items()},
    }


def fill(texts: Mapping[str, str], blocks: Mapping[str, str]) -> dict[str, str]:
    """Put each block between its markers `<!-- name -->` and `<!-- /name -->`, in the only page that has them."""
    filled = dict(texts)
    for name, content in blocks.items():
        markers = re.compile(rf"(<!-- {name} -->\n)(.*?)(<!-- /{name} -->)", re.DOTALL)
        pages = [page for page, text in filled.items() if markers.search(text)]
        if len(pages) != 1:
            raise SchemaError(
                f"README.md and docs: block {name} must be in one page; it is in {', '.join(pages) or 'no page'}. "
                f"Restore its markers <!-- {name} --> and <!-- /{name} -->."
            )
        before, opening, _, closing, after = markers.split(filled[pages[0]])
        filled[pages[0]] = f"{before}{opening}{content.strip()}\n{closing}{after}"
    return filled


def blocks_of(
    results: Sequence[Numbers], recorded: Sequence[Numbers], stages: Mapping[str, Any], times: Numbers | None
) -> dict[str, str]:
    """Make the generated blocks of the pages; return them by name.

    The last of `results` is the headline scene: README shows its scores, and the table of skins compares its simulated
    skins with recorded ones.
    """
    labelled = [numbers for numbers in recorded if "labels" in numbers]
    compared = [numbers for numbers in recorded if "compare" in numbers]
    moving = [numbers for numbers in recorded if "moving_hand" in numbers]
    skins = {
        f"{numbers['provenance']['scene']} ({numbers['provenance']['source']})": next(
            iter(numbers["described"].values())
        )
        for numbers in (results[-1], *recorded)
        if numbers not in moving  # their presses are those of another scene
    }
    return {
        "headline": _summary(results[-1]),
        "recorded": "\n\n".join(map(_summary, labelled)) or NONE_YET,
        "results": "\n\n".join(_tables(numbers, TABLES) for numbers in results),
        "time": "Not timed yet. Run `make time-repro`." if times is None else _time(times),
        "costs": to_markdown(costs_table([*results, *recorded])),
        "labels": "\n\n".join(_tables(numbers, ("labels",)) for numbers in labelled) or NONE_YET,
        "compare": "\n\n".join(_tables(numbers, COMPARED) for numbers in compared) or NONE_YET,
        "moving_hand": "\n\n".join(_tables(numbers, MOVING) for numbers in moving) or NONE_YET,
        "skins": to_markdown(skins_table(skins)),
        "stages": _stages(stages),
    }


def _summary(numbers: Numbers) -> str:
    provenance, table = numbers["provenance"], summary_table(numbers)
    heading = f"Scene `{provenance['scene']}`, **{provenance['source']}**, code {provenance['trained']}:"
    return heading if table is None else f"{heading}\n\n{to_markdown(table)}"


def _tables(numbers: Numbers, names: Sequence[str]) -> str:
    """Write the named tables of a scene below a heading with its provenance."""
    provenance = numbers["provenance"]
    # Tables are made only for the experiments that are shown, because the current code may be unable to read the
    # committed results of other experiments.
    tables = make_tables({name: part for name, part in numbers.items() if name not in ANALYSES or name in names})
    trained = provenance["trained"]  # empty if the scene trains no networks
    code = f"trained by code {trained}" if trained else f"code {provenance['git']}"
    heading = (
        f"Scene `{provenance['scene']}`, **{provenance['source']}**; {code}, "
        f"seed {provenance['seed']}, {provenance['device']}:"
    )
    return "\n\n".join([heading] + [to_markdown(tables[name]) for name in names if name in tables])


def _time(times: Numbers) -> str:
    """Write the time and disk space that fresh clones needed, as medians over clones."""
    runs = times["runs"]
    environment_min, stages_min = (
        median(run[part]["wall_s"] for run in runs) / 60 for part in ("environment", "stages")
    )
    cpu_min = median(run["stages"]["cpu_s"] for run in runs) / 60
    all_GB, environment_GB = (median(run[part] for run in runs) / 1e3 for part in ("all_MB", "environment_MB"))
    return (
        f"Environment {environment_min:.1f} min, stages {stages_min:.1f} min ({cpu_min:.1f} CPU min); {all_GB:.1f} GB, "
        f"of which {environment_GB:.1f} GB are the environment. Median of {len(runs)} fresh clones on "
        f"{times['machine']} (`make time-repro`, code {times['git']})."
    )


def costs_table(scenes: Sequence[Numbers]) -> pd.DataFrame:
    """Tabulate the time to compute each scene from scratch and the number of its training runs."""
    lines = [
        {
            "scene": f"`{numbers['provenance']['scene']}`",
            "computed, min": f"{numbers['provenance']['seconds'] / 60:.2g}",
            "training runs": f"{sum(count['trainings_n'] for count in numbers['trainings'].values()):,}",
            "collapsed": str(sum(count["collapsed_n"] for count in numbers["trainings"].values())),
            "machine": numbers["provenance"]["device"],
        }
        for numbers in scenes
    ]
    return tabulate(lines, meaning=COSTS_MEANING)


def _stages(stages: Mapping[str, Any]) -> str:
    """Tabulate the stages of dvc.yaml with code and outputs; cells are not padded, so that an edit changes one line."""
    lines = ["| stage | code | writes |", "|---|---|---|"]
    for name, stage in stages.items():
        outs = [
            out if isinstance(out, str) else next(iter(out))
            for key in ("outs", "metrics", "plots")
            for out in stage.get("do", stage).get(key, [])
        ]
        code = file_of(module_name(name) if name != "code" else "pipeline.stages.code").relative_to(ROOT)
        written = ", ".join(f"`{re.sub(r'[$]{[^}]*}', '…', out)}`" for out in outs) or "MLflow runs"
        lines.append(f"| {name} | [{code}](../{code}) | {written} |")
    return "\n".join(lines)
