"""Tables of a scene: numbers.json -> rows, as Markdown for people and CSV for programs. Sees no model.

Every table says whether its rows are simulated or recorded.
"""

from collections.abc import Callable, Mapping
from typing import Any

import pandas as pd

from pipeline.experiments.left_out.show import left_out_table
from pipeline.reporting.checklist import checklist
from pipeline.reporting.checks import stability_table, verification_table
from pipeline.reporting.learning import learning_tables
from pipeline.reporting.order import models
from pipeline.reporting.paper import SINGLE_SENSOR, Number
from pipeline.reporting.parts import experiment_tables
from pipeline.reporting.shown import COLUMNS, INTERVAL, scores, show_both, tabulate, to_markdown
from pipeline.reporting.skins import skins_table
from pipeline.reporting.table1 import measured, read_table1, table1

SPLIT_WORDS = {
    "single_random": "random readings held out (the paper's way: readings of one indentation on both sides)",
    "single_indentation": "random indentations held out (all readings of one on the same side)",
    "single_pass": "random passes held out (each visits every place and depth again)",
    "single_temporal": "first passes → last passes",
}
TABLE_2_SPREAD = (
    "± is the sd, as in the paper: over n boards held out, or over n pairs of a training and a test skin for one skin "
    f"on others. {INTERVAL} (for one skin on others: those that it was tested on)."
)
TARGET = (
    "The row of one skin on others was a calibration target: the simulated spreads were set with it in view, so its "
    "agreement with the paper is no evidence."
)


COLLAPSED_MEANING = (
    "Collapsed: a network that explains next to nothing of some target on its own training rows, as it answers nearly "
    "the same to any input. It is trained again with other draws, at most twice; what collapses every time is kept in "
    "all means; those of train_* and adapt are also named in the audit. Trainings too short to have left their start "
    "are not judged."
)


def make_tables(numbers: Mapping[str, Any]) -> dict[str, pd.DataFrame]:
    """Make every table that the numbers can fill, by name."""
    source = numbers["provenance"]["source"]
    tables = {}
    if "table2" in numbers:
        tables["table2"] = _beside_paper(_table_2_rows(numbers), source)
        words = [TARGET] * (source == "simulated") + _dead(numbers.get("trainings", {}))
        tables["table2"].attrs |= {"spread": TABLE_2_SPREAD} | ({"meaning": " ".join(words)} if words else {})
    tables |= learning_tables(numbers, source)
    single = {SPLIT_WORDS[name]: (numbers[name], SINGLE_SENSOR) for name in SPLIT_WORDS if name in numbers}
    if single:
        tables["single_sensor"] = _beside_paper(single, source)
    if "lobo" in numbers:
        tables["lobo_boards"] = _boards(numbers["lobo"]["by_board"], source)
    tables |= experiment_tables(numbers, source)
    makers: dict[str, Callable[[Any, str], pd.DataFrame]] = {
        "verification": verification_table, "stability": stability_table, "left_out": left_out_table,
        "trainings": _trainings,
    }  # fmt: skip
    tables |= {name: make(numbers[name], source) for name, make in makers.items() if name in numbers}
    if "described" in numbers:
        titled = {f"{protocol} ({one['source']})": one for protocol, one in numbers["described"].items()}
        tables["skins"] = skins_table(titled)
    tables["variants"] = _variants(numbers["variants"], source)
    tables["captures"] = _captures(numbers, source)
    tables["table1"] = table1(read_table1(), measured(numbers))
    tables["checklist"] = checklist(numbers)
    return tables


def table_texts(tables: Mapping[str, pd.DataFrame]) -> dict[str, str]:
    """Write every table twice, by file name: as Markdown for people and as CSV for programs."""
    texts = {f"{name}.md": to_markdown(table) for name, table in tables.items()}
    return texts | {f"{name}.csv": table.to_csv(index=False) for name, table in tables.items()}


def _table_2_rows(numbers: Mapping[str, Any]) -> dict[str, tuple[Mapping[str, Any], Mapping[str, Number]]]:
    """Put each row beside the paper's row of the same kind, in the paper's order; the control is ours."""
    ours = dict(numbers["table2"])
    if "adapt" in numbers:
        ours["control"] = numbers["adapt"]["control"]
    return {model.title: (ours[row], model.paper) for row, model in models(numbers).items() if row in ours}


def _beside_paper(rows: Mapping[str, tuple[Mapping[str, Any], Mapping[str, Number]]], source: str) -> pd.DataFrame:
    lines = []
    for name, (ours, paper) in rows.items():
        line = {"model": name, "source": source}
        for metric, title in COLUMNS.items():
            line[f"{title} (ours)"] = show_both(ours.get(metric))
            line[f"{title} (paper)"] = "{:g} ± {:g}".format(*paper[metric]) if metric in paper else "–"
        line["n"] = str(ours["accuracy_pct"]["n"])
        lines.append(line)
    return pd.DataFrame(lines)


def _boards(by_board: Mapping[str, Any], source: str) -> pd.DataFrame:
    words = {"as_labelled": "as labelled", "registered": "after one offset a board (uses its labels: a diagnosis)"}
    lines = []
    for board, parts in by_board.items():
        for part in words:
            metrics = parts[part]
            skins_n = str(parts["trained_on_skins_n"])
            line = {"held-out board": board, "trained on skins": skins_n, "places": words[part], "source": source}
            lines.append(line | {title: f"{metrics[m]:.3g}" for m, title in COLUMNS.items() if m in metrics})
    return pd.DataFrame(lines)


def _dead(trainings: Mapping[str, Mapping[str, int]]) -> list[str]:
    """Say how many networks behind table 2 answer nearly the same to any input, if any does."""
    kept_n = sum(
        trainings[name]["kept_collapsed_n"] for name in ("transfer", "lobo", "triplet", "adapt") if name in trainings
    )
    return [f"{kept_n} networks collapsed every time that they were trained, and are in these means."] * (kept_n > 0)


def _trainings(counts: Mapping[str, Mapping[str, int]], source: str) -> pd.DataFrame:
    """List how many networks were trained, how many of those collapsed, and how many of them had to be kept."""
    lines = [
        {
            "question": question, "source": source, "trainings": str(own["trainings_n"]),
            "collapsed": str(own["collapsed_n"]), "collapsed every time, kept": str(own["kept_collapsed_n"]),
        }
        for question, own in counts.items()
    ]  # fmt: skip
    return tabulate(lines, meaning=COLLAPSED_MEANING)


def _variants(variants: Mapping[str, Any], source: str) -> pd.DataFrame:
    lines = []
    for question, recipes in variants.items():
        for recipe, metrics in recipes.items():
            line = {"question": question, "recipe": recipe, "source": source} | scores(metrics)
            lines.append(line | {"n": str(metrics["accuracy_pct"]["n"])})
    return pd.DataFrame(lines)


def _captures(numbers: Mapping[str, Any], source: str) -> pd.DataFrame:
    further = numbers.get("capture_by_protocol", {})
    lines = _counts("main", numbers["capture"], source)
    for protocol, account in further.items():
        lines += [line for line in _counts(protocol, account, source) if line["count"] != "0"]
    table = pd.DataFrame(lines)
    if further:
        table.attrs["meaning"] = "Main: the captures that folds are drawn on. Of other protocols no 0 is listed."
    return table


def _counts(protocol: str, account: Mapping[str, Any], source: str) -> list[dict[str, str]]:
    flat = {**account, **{f"left out of training: {key}": n for key, n in account["left_out"].items()}}
    return [
        {"protocol": protocol, "what": key, "count": str(value), "source": source}
        for key, value in flat.items()
        if key != "left_out"
    ]
