"""Fill the generated blocks of README.md and docs/results.md, its figure, and the live page's expected scores."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from pipeline.report.figures import score_figures, unseen_rows
from pipeline.report.numbers import join
from pipeline.report.page import Page, pick
from reskin import io
from reskin.errors import ParamsError, SchemaError

# The template of each block, which is between the markers <!-- name --> and <!-- /name --> of a page.
BLOCKS = {
    "README.md": {"recorded": "readme_recorded.md", "simulated": "readme_simulated.md", "time": "readme_time.md"},
    "docs/results.md": {"results": "results.md"},
}
SHOWN = ("quick", "paper", "lab", "ini", "eflesh")  # scenes whose results the blocks show
TIMES = "reports/time.json"  # times of fresh clones, measured by `python -m tools.benchmarks repro`
SHIPPED_FILE = "reskin/universal/universal.safetensors"
MEASURED = "reskin/universal/measured.json"  # results of the shipped model that the live page shows
FIGURE = "docs/images/headline.svg"  # shows the shipped model, and a model that was made with recordings


def fill_pages(root: Path, *, write: bool) -> list[str]:
    """Fill the generated blocks and files from `reports/`; return the files that change, written only if `write`."""
    try:
        texts = texts_of(root)
    except (AttributeError, KeyError, TypeError) as error:
        what = f"numbers.json or provenance.json of a scene lacks a value, or has one of another kind ({error!r})"
        raise SchemaError(f"{root / 'reports'}: {what}. Restore them: git restore reports") from None
    changed = [name for name, text in texts.items() if not (root / name).exists() or _read(root / name) != text]
    for name in changed if write else ():
        io.write_text(root / name, texts[name])
    return changed


def texts_of(root: Path) -> dict[str, str]:
    """Return the generated files, with the results of `reports/`, by name."""
    scenes = {name: read_results(root, name) for name in SHOWN}
    times = io.read_json(root / TIMES)
    texts = {name: fill_blocks(name, _read(root / name), scenes, times) for name in BLOCKS}
    lab = scenes["lab"]
    figure = score_figures(lab, lab["provenance"]["source"])["headline.svg"]
    measured = json.dumps(measured_of(lab, io.sha256(root / SHIPPED_FILE)), indent=2, allow_nan=False)
    return texts | {FIGURE: figure, MEASURED: measured + "\n"}


def read_results(root: Path, name: str) -> dict[str, Any]:
    """Return the numbers of a scene, their provenance, and the number of claims with each verdict (key `claims`)."""
    folder = root / "reports" / name
    if not (folder / "numbers.json").exists():
        raise ParamsError(
            f"{folder}/numbers.json is missing, but README.md shows its results. Restore it: git restore reports/{name}"
        )
    numbers = join(io.read_json(folder / "numbers.json"), io.read_json(folder / "provenance.json"))
    claims = folder / "tables/claims.csv"  # scenes that test no claim have none
    verdicts = pd.read_csv(claims)["verdict"].value_counts().to_dict() if claims.exists() else {}
    return {**numbers, "claims": verdicts}


def fill_blocks(name: str, text: str, scenes: Mapping[str, Any], times: Mapping[str, Any]) -> str:
    """Put each block of a page between its markers."""
    for block, template in BLOCKS[name].items():
        if len(re.findall(rf"<!-- {block} -->\n.*?<!-- /{block} -->", text, re.DOTALL)) != 1:
            raise SchemaError(f"{name}: the markers <!-- {block} --> and <!-- /{block} --> must be in this page once.")
        filled = Page({}).fill(template, scenes=scenes, times=times, unseen=_unseen).strip()
        opening, closing = f"<!-- {block} -->\n", f"<!-- /{block} -->"
        text = text[: text.index(opening)] + opening + filled + "\n" + text[text.index(closing) :]
    return text


def _unseen(numbers: Mapping[str, Any], method: str, labels_n: int) -> Mapping[str, Any]:
    return pick(unseen_rows(numbers, (method,)), labels_n=labels_n)


def _read(file: Path) -> str:
    return file.read_text(encoding="utf-8")


def measured_of(numbers: Mapping[str, Any], model_sha256: str) -> dict[str, Any]:
    """Return the results of the shipped model that the live page shows (`reskin.live.models`).

    Places are for presses at random places, with labels and tests on different colours of a checkerboard.
    """

    def by_board(row: Mapping[str, Any], metric: str) -> list[float]:
        return list(row[metric]["by_board"].values())

    rows = [row for row in numbers["new_board"] if (row["method"], row["split"]) == ("shipped", "checkerboard")]
    places = [
        {"presses_n": row["pokes_n"], "labels_n": row["labels_n"]}
        | {name: by_board(row, name) for name in ("accuracy_pct", "median_mm", "mse_xy_mm2")}
        for row in rows
        if row["labels_n"] != 1
    ]
    touch = pick(numbers["new_board"], method="contact", split="each")
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
