"""Entries of the benchmark: the committed files of scores, and the tables of docs/benchmark.md."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.benchmark.folds import ENTRIES, FOLDER, read_folds
from pipeline.benchmark.scoring import MEANING, METRICS, About, Entry, score_file, table_of
from pipeline.formatting import show, tabulate, to_markdown
from reskin import io
from reskin.config import parse
from reskin.errors import ParamsError, SchemaError

NOT_STATED = "not stated"
NETWORK = "network of the paper"  # name of the entry that corresponds to method `network` of experiment labels
UNLABELLED_N = 65  # unlabelled presses of dataset lab
# Tested places in those rows of experiment random_presses whose labels and tests are divided as in dataset lab.
CHECKERBOARD = "places without labels (checkerboard)"
NONE_YET = "No entries yet."


def entry_file(dataset: str, method: str, folder: Path | None = None) -> Path:
    """Return the path of an entry in a folder of a benchmark; the file name consists of dataset and method.

    >>> entry_file("lab", "nearest label").name
    'lab.nearest-label.json'
    """
    words = re.sub(r"[^a-z0-9]+", "-", method.lower()).strip("-")
    return (folder or FOLDER) / ENTRIES / f"{dataset}.{words}.json"


def score_and_write(
    predictions: Path, about: Mapping[str, str | None], data: Path | None = None, *, enter: bool
) -> tuple[Entry, Path]:
    """Score a file of predictions; write the scores beside it or, if `enter`, to benchmark/entries; return the path.

    about: values of the fields of `About`; None for a field that is not given. An entry needs all fields.
    """
    missing = [name.replace("_", "-") for name, text in about.items() if not text]
    if enter and missing:
        raise ParamsError(f"reskin score --enter: --{missing[0]} is missing. An entry must state {', '.join(about)}.")
    defaults = {"method": predictions.stem} | {name: text for name, text in about.items() if text}
    entry = score_file(predictions, parse(About, dict.fromkeys(about, NOT_STATED) | defaults, "reskin score"), data)
    return entry, write_entry(entry, None if enter else predictions.with_suffix(".scores.json"))


def write_entry(entry: Entry, file: Path | None = None) -> Path:
    """Write an entry to `file`, or by default to benchmark/entries under its own name; return the path."""
    file = file or entry_file(entry.dataset, entry.about.method)
    io.write_json(file, entry.model_dump(mode="json"))
    return file


def read_entries(folder: Path) -> list[Entry]:
    """Read all entries; raise `ReskinError` if an entry is incomplete, misnamed, or for an unknown dataset."""
    entries = []
    for file in sorted((folder / ENTRIES).glob("*.json")):
        entry = parse(Entry, io.read_json(file), str(file))
        folds = read_folds(entry.dataset, entry.version)
        if folds.source != entry.source:
            raise SchemaError(file, "source", folds.source, entry.source, "Run `reskin score --enter` again.")
        name = entry_file(entry.dataset, entry.about.method, folder).name
        if file.name != name:
            raise SchemaError(f"{file}: an entry of this dataset and method must be called {name}. Rename the file.")
        entries.append(entry)
    return entries


def blocks(entries: Sequence[Entry], lab: Mapping[str, Any]) -> dict[str, str]:
    """Make the generated blocks of docs/benchmark.md, with recorded and simulated datasets in separate blocks.

    lab: numbers.json of scene lab, or an empty dict.
    """
    tables = {f"benchmark-{source}": _tables(entries, source) for source in ("recorded", "simulated")}
    return tables | {"benchmark-agreement": compare_with_experiments(entries, lab)}


def compare_with_experiments(entries: Sequence[Entry], numbers: Mapping[str, Any]) -> str:
    """Tabulate entries of dataset lab beside the results of the same methods in the experiments of scene lab."""
    experiments = {
        (row["method"], row["labels"]): ("random_presses", row)
        for row in numbers.get("random_presses", {}).get("rows", ())
        if row["tested"] == CHECKERBOARD and row["presses_n"] == UNLABELLED_N
    }
    experiments |= {
        (NETWORK, str(row["labels_n"])): ("labels", row["as_labelled"])
        for row in numbers.get("labels", ())
        if (row["method"], row["inputs"]) == ("network", "raw")
    }
    lines = []
    for entry in entries:
        for task in entry.tasks if (entry.dataset, entry.version) == ("lab", "v1") else ():
            experiment, row = experiments.get((entry.about.method, str(task.labels_n)), ("", {}))
            if not experiment:
                continue
            sd = [f"{board['accuracy_pct']['sd']:.2g}" for board in task.by_board.values()]
            line = {"method": entry.about.method, "labels": str(task.labels_n), "experiment": f"`{experiment}`"}
            for name in ("accuracy_pct", "r2_f"):
                title = METRICS[name]
                line |= {f"{title}, entry": show(task.scores[name]), f"{title}, experiment": show(row[name])}
            lines.append(line | {"standard deviation over draws, %": f"({'; '.join(sd)})"})
    return to_markdown(tabulate(lines)) if lines else NONE_YET


def _tables(entries: Sequence[Entry], source: str) -> str:
    own = [entry for entry in entries if entry.source == source]
    datasets = sorted({(entry.dataset, entry.version) for entry in own}, reverse=True)
    parts = []
    for dataset, version in datasets:
        of_dataset = [entry for entry in own if (entry.dataset, entry.version) == (dataset, version)]
        folds = read_folds(dataset, version)
        boards_n, draws_n = len({draw.board for draw in folds.draws}), len({draw.draw for draw in folds.draws})
        size = f"{boards_n} tested board{'s' * (boards_n > 1)}, {draws_n} draw{'s' * (draws_n > 1)} of presses on each"
        heading = f"Dataset `{dataset}` ({version}), **{source}**, {size}:"
        parts += [heading, to_markdown(table_of(of_dataset)).strip()]
    return "\n\n".join([*parts, MEANING]) if parts else NONE_YET
