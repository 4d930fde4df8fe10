"""Write the generated blocks of README.md and docs, and the figure of README.md.

Everything is made from the results in `reports/`.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import pandas as pd

from pipeline import FLOW
from pipeline.catalogue import ANALYSES, module_name
from pipeline.formatting import tabulate, to_markdown
from pipeline.paper import TABLE_2, TABLE_2_ROWS
from pipeline.report.figures import constant_force, score_figures, unseen_rows
from pipeline.report.numbers import join
from pipeline.report.tables import NOLOAD_AGES, make_tables, skins_table
from pipeline.statistics import Stat
from reskin import io
from reskin.code import ROOT, file_of
from reskin.config import read_yaml
from reskin.errors import ParamsError, SchemaError

TABLES = (
    "table2",
    "claims",
    "manual",
    "flexible",
    "single_sensor",
)  # tables of simulated scenes that docs/results.md shows
COMPARED = ("compare",)
NEW_BOARD = ("new_board", "new_board_contact")
INTERFERENCE = ("interference_contacts", "interference_places")
NONE_YET = "None yet."
COSTS_MEANING = (
    "Column computed is the time that it takes to compute everything from scratch if the training runs run one after "
    "another. By default, two training runs run at the same time, so less time passes. Column collapsed counts the "
    "training runs whose network had a nearly constant output; they were repeated."
)
TIMES = "reports/time.json"  # written by `make time-repro`
FULL_SIZE, HEADLINE = "paper", "quick"  # simulated scenes on the pages; README.md shows only HEADLINE
SHIPPED_SCENE, SHIPPED_FILE = "lab", "reskin/universal/universal.safetensors"  # scene that tests the shipped model
MEASURED = "reskin/universal/measured.json"  # results of this model that the live page shows
# What README.md shows of the paper's table 2, and of presses at random places of recorded boards (scene lab). Each
# metric has a title and a number of decimals.
SIMULATED_METRICS = {"accuracy_pct": ("within 1 mm, %", 0), "mse_f_N2": ("MSE_F, N²", 2)}
SIZES = {"quick": "`quick`", "paper": "full protocol"}
SIMULATED_MEANING = (
    "[low, high] is the 95 % interval over six held-out boards. ± is the standard deviation over pairs of "
    "skins. An earlier simulation was tuned to the paper's "
    "*Single-sensor*, so this row proves nothing. The paper does not state its forces, so MSE_F may not be comparable."
)
TRAINED_ON = {"shipped": "simulation (shipped model)", "rig": "simulation and the rig's other board"}
SHORT_NAMES = {"shipped": "shipped model", "rig": "model trained with the other board"}
LABELS = {0: "no label", 1: "one known weight, mid-skin", 10: "10 labels", 40: "40 labels"}
RECORDED_METRICS = {
    "accuracy_pct": ("within 1 mm in x and y, %", 0), "rms_f_N": ("force error (rms), N", 1),
    "r2_f": ("R² of force", 2),
}  # fmt: skip
RECORDED_MEANING = (
    "Scene `{scene}`, code {code}. Cells have the mean of both boards (board 1; board 2), over draws of "
    "presses and labels. In all columns, the model is first calibrated to {presses_n} presses without labels. {halves} "
    "The mean force as estimate would give an R² of 0 and an error of {constant} N.\n\n{touch}"
)
FIGURE = "docs/img/headline.svg"  # shows the shipped model, and a model that was trained with recordings
Numbers = Mapping[str, Any]  # the joined numbers.json and provenance.json of one scene


def fill_pages(root: Path, *, write: bool) -> tuple[list[str], list[str]]:
    """Generate the variable parts of all pages. Return the names of pages that change, and of the scenes shown.

    Changed pages are written only if `write` is True.

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
                f"Restore the committed results: git restore reports/{name}"
            )
    recorded = [result for result in numbers.values() if result["provenance"]["source"] == "recorded"]
    results = [numbers[name] for name in (FULL_SIZE, HEADLINE)]
    times = io.read_json(root / TIMES) if (root / TIMES).exists() else None
    pages = [root / "README.md", *sorted((root / "docs").glob("*.md"))]
    before = {str(page): page.read_text(encoding="utf-8") for page in pages}
    blocks = blocks_of(results, recorded, read_yaml(root / FLOW)["stages"], times)
    after = fill(before, blocks)
    changed = [page for page in after if after[page] != before[page]]
    for page in changed if write else ():
        io.write_text(Path(page), after[page])
    if SHIPPED_SCENE in numbers:
        shipped = numbers[SHIPPED_SCENE]
        file, measured = root / MEASURED, measured_of(shipped, io.sha256(root / SHIPPED_FILE))
        if not file.exists() or io.read_json(file) != measured:
            changed.append(str(file))
            if write:
                io.write_json(file, measured)
        file, figure = root / FIGURE, score_figures(shipped, shipped["provenance"]["source"])["headline.svg"]
        if not file.exists() or file.read_text(encoding="utf-8") != figure:
            changed.append(str(file))
            if write:
                io.write_text(file, figure)
    return changed, [result["provenance"]["scene"] for result in (*results, *recorded)]


def measured_of(numbers: Numbers, model_sha256: str) -> dict[str, Any]:
    """Return the results of the shipped model that the live page shows (`reskin.live.used_model.Measured`).

    Places are for presses at random places, with labels and tests on different colours of a checkerboard.
    """

    def by_board(row: Numbers, metric: str) -> list[float]:
        return list(row[metric]["by_board"].values())

    rows = [row for row in numbers["new_board"] if (row["method"], row["split"]) == ("shipped", "checkerboard")]
    places = [
        {"presses_n": row["pokes_n"], "labels_n": row["labels_n"]}
        | {name: by_board(row, name) for name in ("accuracy_pct", "median_mm", "mse_xy_mm2")}
        for row in rows
        if row["labels_n"] != 1
    ]
    touch = next(row for row in numbers["new_board"] if (row["method"], row["split"]) == ("contact", "each"))
    return {
        "scene": numbers["provenance"]["scene"],
        "source": numbers["provenance"]["source"],
        "model_sha256": model_sha256,
        "places": sorted(places, key=lambda row: (row["presses_n"], row["labels_n"])),
        "detection": {
            "lightest_N": by_board(touch, "force_min_N"),
            "detected_pct": [100 - missed for missed in by_board(touch, "missed_pct")],
            "false_alarm_pct": by_board(touch, "false_pct"),
        },
    }


def fill(texts: Mapping[str, str], blocks: Mapping[str, str]) -> dict[str, str]:
    """Put each block between its markers `<!-- name -->` and `<!-- /name -->`, in the only page that has them."""
    filled = dict(texts)
    for name, content in blocks.items():
        markers = re.compile(rf"(<!-- {name} -->\n)(.*?)(<!-- /{name} -->)", re.DOTALL)
        pages = [page for page, text in filled.items() if markers.search(text)]
        if len(pages) != 1:
            raise SchemaError(
                f"README.md and docs: the generated block {name} must be in exactly one page; it is in "
                f"{', '.join(pages) or 'no page'}. Write its markers <!-- {name} --> and <!-- /{name} --> into a "
                "single page."
            )
        before, opening, _, closing, after = markers.split(filled[pages[0]])
        filled[pages[0]] = f"{before}{opening}{content.strip()}\n{closing}{after}"
    return filled


def blocks_of(
    results: Sequence[Numbers], recorded: Sequence[Numbers], stages: Mapping[str, Any], times: Numbers | None
) -> dict[str, str]:
    """Make the generated blocks of the pages; return them by name.

    The last scene in `results` is the headline scene. README.md shows its scores, and the table of skins compares its
    simulated skins with recorded skins.
    """
    compared = [numbers for numbers in recorded if "compare" in numbers]
    on_hand = [numbers for numbers in recorded if "interference" in numbers]
    skins = {
        f"{numbers['provenance']['scene']} ({numbers['provenance']['source']})": next(
            iter(numbers["described"].values())
        )
        for numbers in (results[-1], *recorded)
        if numbers not in on_hand  # scene hand uses the presses of another scene
    }
    return {
        "headline": _simulated(list(reversed(results))),
        "recorded": "\n\n".join(_recorded(numbers) for numbers in recorded if "new_board" in numbers) or NONE_YET,
        "results": "\n\n".join(_tables(numbers, TABLES) for numbers in results),
        "time": "Not timed yet. Run `make time-repro`." if times is None else _time(times),
        "costs": to_markdown(costs_table([*results, *recorded])),
        "new_board": "\n\n".join(_tables(each, NEW_BOARD) for each in recorded if "new_board" in each) or NONE_YET,
        "compare": "\n\n".join(_tables(numbers, COMPARED) for numbers in compared) or NONE_YET,
        "interference": "\n\n".join(_tables(numbers, INTERFERENCE) for numbers in on_hand) or NONE_YET,
        "skins": to_markdown(skins_table(skins)),
        "stages": _stages(stages),
    }


def _simulated(scenes: Sequence[Numbers]) -> str:
    """Tabulate place and force on held-out boards, for simulated scenes and the paper."""
    lines = []
    for key, (title, paper) in {row: (TABLE_2_ROWS[row], TABLE_2[row]) for row in TABLE_2_ROWS}.items():
        line = {"model": title}
        for metric, (name, digits) in SIMULATED_METRICS.items():
            for numbers in scenes:
                scene = numbers["provenance"]["scene"]
                size = SIZES.get(scene, f"`{scene}`")
                line[f"{name}: {size}"] = _compact(numbers["table2"].get(key, {}).get(metric), digits)
            line[f"{name}: the paper"] = f"{paper[metric][0]:g}" if digits else f"{paper[metric][0]:.0f}"
        lines.append(line)
    commits = ", ".join(f"`{one['provenance']['scene']}` {one['provenance']['trained']}" for one in scenes)
    return f"{_unpadded(to_markdown(tabulate(lines)))}\n\n{SIMULATED_MEANING} Code: {commits}."


def _recorded(numbers: Numbers) -> str:
    """Tabulate place and force scores of the universal model, by labels, on recorded boards never seen in training."""
    unseen = unseen_rows(numbers, tuple(TRAINED_ON))
    rows = {(row["method"], row["labels_n"]): row for row in unseen}
    lines = [
        {"trained on": trained_on, "on new boards": title}
        | {name: _compact(rows.get((method, labels), {}).get(metric), digits) for labels, name in LABELS.items()}
        for method, trained_on in TRAINED_ON.items()
        if any(method == row["method"] for row in unseen)
        for metric, (title, digits) in RECORDED_METRICS.items()
    ]
    provenance = numbers["provenance"]
    meaning = RECORDED_MEANING.format(
        scene=provenance["scene"], code=provenance["trained"], presses_n=unseen[0]["pokes_n"],
        halves=_halves(numbers), constant=_compact(constant_force(numbers), 1), touch=_touches(numbers),
    )  # fmt: skip
    return f"{_unpadded(to_markdown(tabulate(lines)))}\n\n{meaning}"


def _halves(numbers: Numbers) -> str:
    """State the accuracy of each model on one half of the skin if all labels are on the other half."""
    scores = {
        row["method"]: f"{row['accuracy_pct']['mean']:.0f} %"
        for row in numbers["new_board"]
        if (row["split"], row.get("labels_n")) == ("halves", 40)
    }
    shown = [f"{scores[method]} ({name})" for method, name in SHORT_NAMES.items() if method in scores]
    if not shown:
        return ""
    of_presses = f"{' and '.join(shown)} of the presses on the other half are within 1 mm"
    return f"With all 40 labels on one half of the skin, {of_presses}."


def _touches(numbers: Numbers) -> str:
    """State the range of forces, and how many touches are missed or false, by age of the no-load reading."""
    rows = {row["split"]: row for row in numbers["new_board"] if row["method"] == "contact"}
    if not rows:
        return ""
    missed = max(value for row in rows.values() for value in row["missed_pct"]["by_board"].values())
    false = []
    for age, row in rows.items():
        rates = [f"{value:.0f}" for value in row["false_pct"]["by_board"].values()]
        false.append(f"{NOLOAD_AGES[age]}, {rates[0] if len(set(rates)) == 1 else ' and '.join(rates)} %")
    ends = zip(*(rows["each"][f"force_{end}_N"]["by_board"].values() for end in ("min", "max")), strict=True)
    ranges = " and ".join(f"{low:.1f} to {high:.1f} N" for low, high in ends)
    share = f"at most {missed:.2g} %" if missed else "none"
    return (
        f"Forces of the presses: {ranges}. With the threshold of the live page, {share} of these presses are "
        f"missed. False touches depend on when the no-load reading was taken: {'; '.join(false)}. So take a new "
        "no-load reading often (key z on the live page)."
    )


def _unpadded(table: str) -> str:
    """Remove the spaces and dashes that align the columns of a Markdown table."""
    return re.sub(r"-{2,}", "--", re.sub(r" {2,}", " ", table)).strip()


def _compact(value: Numbers | None, digits: int) -> str:
    """Write a mean with `digits` decimals, and the interval over boards or the values of the boards."""
    if value is None:
        return "–"
    stat = Stat.of(value)
    mean, *others = [f"{number:.{digits}f}" for number in (stat.mean, *stat.ends)]
    if others:
        return f"{mean} ({'; '.join(others)})" if stat.few else f"{mean} [{', '.join(others)}]"
    return mean if stat.sd is None else f"{mean} ± {stat.sd:.{digits}f}"


def _tables(numbers: Numbers, names: Sequence[str]) -> str:
    """Write the named tables of a scene below a heading with its provenance."""
    provenance = numbers["provenance"]
    # Only the results of the experiments that are shown are passed to `make_tables`, because the current code may be
    # unable to read the committed results of other experiments.
    tables = make_tables({name: part for name, part in numbers.items() if name not in ANALYSES or name in names})
    trained = provenance["trained"]  # empty if the scene trains no networks
    code = f"trained by code {trained}" if trained else f"code {provenance['git']}"
    heading = (
        f"Scene `{provenance['scene']}`, **{provenance['source']}**; {code}, "
        f"seed {provenance['seed']}, {provenance['device']}:"
    )
    return "\n\n".join([heading] + [to_markdown(tables[name]) for name in names if name in tables])


def _time(times: Numbers) -> str:
    """Write the time and the disk space that fresh clones needed, as medians over the clones."""
    runs = times["runs"]
    environment_min, stages_min = (
        median(run[part]["wall_s"] for run in runs) / 60 for part in ("environment", "stages")
    )
    cpu_min = median(run["stages"]["cpu_s"] for run in runs) / 60
    all_GB, environment_GB = (median(run[part] for run in runs) / 1e3 for part in ("all_MB", "environment_MB"))
    return (
        f"This takes {environment_min:.1f} min for the environment, {stages_min:.1f} min for the stages "
        f"({cpu_min:.1f} CPU min), and needs {all_GB:.1f} GB ({environment_GB:.1f} GB for the environment, with "
        f"PyTorch's CPU build). Medians of {len(runs)} fresh clones on {times['machine']} "
        f"(`make time-repro`, code {times['git']})."
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
