"""`numbers.json`: every number that any text shows, nested by question. In: scores, accounts, costs. Out: plain words.

`scores.json` holds a few of them, for `dvc metrics`. `provenance.json` holds what differs between equal runs: commit,
machine, versions, seconds. A question that was not asked is absent. Refuses to know how a number is shown.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pandas as pd
import pyarrow as pa

from pipeline.evaluation.metrics import METRICS
from pipeline.evaluation.scores import statistic, tally
from pipeline.questions import QUESTIONS
from pipeline.reporting.learned import learned
from pipeline.reporting.order import control_of

SINGLE = {
    "by_reading": "single_random", "by_indentation": "single_indentation", "by_pass": "single_pass",
    "by_time": "single_temporal",
}  # fmt: skip
POLICIES = ("initial", "regular", "each")
HOVER = ("hover", "hover_network")  # what tells the place of a tip that does not touch
LENGTHS, PLACE = ("hover_uT", "touch_uT"), ("accuracy_pct", "mse_xy_mm2")
SEEN_PCT = 25.0  # assumed: chips see a tip itself that is placed so often without touching
OF_DRIFT = ("accuracy_pct", "mse_f_N2")
OF_TOUCHES = ("single_touches_pct", "mean_left_over_pct")
SETTINGS = ("scene", "source", "seed")  # of the provenance: equal between equal runs
TIMES = ("median_s", "repeats_n", "train_s", "inference_us", "seconds")  # of a row below `runtime`
ROW_KEYS = ("study", "method", "inputs", "setting", "pokes_n")  # name a row below `runtime`
OF_SHEAR = ("mse_xy_mm2", "mse_fxy_N2", "mse_fz_N2")

Row = Mapping[str, Any]


def compose(
    table: pd.DataFrame, accounts: Iterable[Mapping[str, int]], dropped: Mapping[str, int], *, headline: str
) -> dict[str, Any]:
    """Compose what follows from the data alone; `headline` names the recipe that stands beside the paper's numbers."""
    return {"capture": add_up(accounts) | {"left_out": dict(dropped)}, **learned(table, headline=headline)}


def add_up(accounts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Add the counts of all captures; a quality of one capture's clock is no count."""
    total = Counter({"captures_n": 0})
    for account in accounts:
        total.update({"captures_n": 1} | {name: count for name, count in account.items() if name.endswith("_n")})
    skipped = [count for name, count in total.items() if name.startswith("skipped_") and name.endswith("_bytes_n")]
    return {**total, "lost_bytes_n": sum(skipped)} if skipped else dict(total)


def foretold(tables: Iterable[pa.Table]) -> dict[str, Any]:
    """Summarise over folds how well places are told before their touch: by question, and by what tells them."""
    found: dict[str, dict[str, Any]] = {}
    hover: dict[str, dict[str, Any]] = {}
    for table in tables:
        for (question, told_by), rows in table.to_pandas().groupby(["question", "told_by"], sort=False):
            if told_by not in HOVER:
                scored = {name: statistic(rows[name].to_list()) for name in METRICS if name in rows}
                found.setdefault(question, {})[told_by] = scored
                continue
            for row in rows.to_dict("records"):
                own = hover.setdefault(str(row["fold"]), {name: row[name] for name in LENGTHS})
                own[told_by] = {name: row[name] for name in PLACE}
                if told_by == "hover":
                    own["seen"] = bool(row["accuracy_pct"] >= SEEN_PCT)
    return ({"before_touch": found} if found else {}) | ({"hover": hover} if hover else {})


def count_trainings(
    cards: Sequence[Row], points: Mapping[str, Sequence[Row]], experiments: Mapping[str, Row]
) -> dict[str, dict[str, int]]:
    """Count networks by question: trainings in all, those that collapsed, and those of them that had to be kept."""
    trainings: dict[str, list[Row]] = {}
    for card in cards:
        trainings.setdefault(card["question"], []).append(card)
    for question, swept in points.items():
        trainings[question] = [point for point in swept if "collapsed" in point]
    counted = {question: tally(trained) for question, trained in trainings.items() if trained}
    return counted | {name: dict(answer["trainings"]) for name, answer in experiments.items() if "trainings" in answer}


def lost_by_protocol(losses: Mapping[str, Row]) -> dict[str, dict[str, Any]]:
    """Add the counts of each further protocol's captures, and what questions of it left out of their rows."""
    found: dict[str, dict[str, Any]] = {}
    for question, lost in losses.items():
        protocol = QUESTIONS[question].protocol
        if protocol is None or not lost["accounts"]:
            continue
        left_out = found.get(protocol, {"left_out": {}})["left_out"]
        found[protocol] = add_up(lost["accounts"]) | {"left_out": left_out | dict(lost["left_out"])}
    return found


def runtime(trainings_n: int, costs: Mapping[str, Row]) -> dict[str, Any]:
    """What it cost, where it ran here: seconds and memory a stage, and networks trained."""
    return {"stages": {stage: _cost(cost) for stage, cost in costs.items()}, "trainings_n": trainings_n}


def _cost(cost: Row) -> dict[str, float]:
    """Tell what a stage cost when it was computed, its trainings added up, from what its last run took."""
    trainings_s = cost["trainings_s"].values()
    return {
        "computed_s": cost["other_s"] + sum(trainings_s),
        "trainings_n": len(trainings_s),
        **{name: cost[name] for name in ("seconds", "cpu_s", "reused_n", "peak_process_memory_MB") if name in cost},
    }


def answered(studied: Mapping[str, Any], cost: Row, seconds: Mapping[str, Sequence[Row]]) -> dict[str, Any]:
    """Put the answers to questions about physics beside each other; those about run time stand with what all cost."""
    others = {question: answer for question, answer in studied.items() if question != "runtime"}
    studies = timed(studied["runtime"], seconds.get("runtime", [])) if "runtime" in studied else {}
    return others | {"runtime": {**cost, **studies}}


def timed(answer: Row, seconds: Sequence[Row]) -> dict[str, Any]:
    """Put what was timed here beside the errors of the studies of run time; what was not timed has no time."""

    def key(row: Row) -> tuple[Any, ...]:
        return row["study"], row["method"], row["setting"]

    times = {key(took): took for took in seconds}
    studies = ("quadratures", "integrators")
    joined = {study: [row | times.get(key(row), {}) for row in answer[study]] for study in studies}
    return {"choice": answer["choice"], **joined}


def split(numbers: Row) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split the numbers of a run into numbers.json, which equal runs share, and provenance.json, of this run alone."""
    own = {name: value for name, value in numbers["provenance"].items() if name not in SETTINGS}
    costs: dict[str, Any] = {"stages": numbers["runtime"]["stages"]}
    studies: dict[str, Any] = {}
    for name, value in numbers["runtime"].items():
        if isinstance(value, list):
            costs[name] = [{key: row[key] for key in (*ROW_KEYS, *TIMES) if key in row} for row in value]
            studies[name] = [{key: row[key] for key in row if key not in TIMES} for row in value]
        elif name != "stages":
            studies[name] = value
    settings = {name: numbers["provenance"][name] for name in SETTINGS}
    return {**numbers, "provenance": settings, "runtime": studies}, {**own, "runtime": costs}


def join(numbers: Row, provenance: Row) -> dict[str, Any]:
    """Put numbers.json and provenance.json of a run together again: the inverse of `split`."""
    own = {name: value for name, value in provenance.items() if name != "runtime"}
    return {
        **numbers,
        "provenance": {**numbers["provenance"], **own},
        "runtime": _overlay(numbers["runtime"], provenance["runtime"]),
    }


def _overlay(numbers: Row, costs: Row) -> dict[str, Any]:
    joined = {**numbers, **costs}
    for name in joined:
        if isinstance(joined[name], list):
            joined[name] = [row | times for row, times in zip(numbers[name], costs[name], strict=True)]
    return joined


def headline_scores(numbers: Row) -> dict[str, Any]:
    """Take a scene's headline scores, nested by question: means, a place's and a force's, with units in their names.

    Nothing that differs between identical runs: no seconds, no commit, no machine.
    """
    recorded = {
        name for name in ("lobo", "labels") if name in numbers and numbers["provenance"]["source"] == "recorded"
    }
    table2 = numbers.get("table2", {}) | control_of(numbers)
    parts = {
        "table2": {name: _means(row) for name, row in table2.items()},
        "lobo": {"registered": _means(numbers["lobo"]["registered"])} if "lobo" in recorded else {},
        "labels": _best_of_labels(numbers["labels"]) if "labels" in recorded else {},
        "single_sensor": {name: _means(numbers[question]) for name, question in SINGLE.items() if question in numbers},
        "drift_end": _drift_end(numbers.get("drift", {})),
        "shear": _means(numbers["shear"], OF_SHEAR) if "shear" in numbers else {},
        "touches": _means(numbers.get("touches", {}).get("superposition", {}), OF_TOUCHES),
    }
    return {name: part for name, part in parts.items() if part}


def _means(row: Row, names: Sequence[str] = METRICS) -> dict[str, float]:
    return {name: row[name]["mean"] for name in names if name in row}


def _drift_end(drift: Row) -> dict[str, Any]:
    """Take the last window of each policy, which is a mean over networks already."""
    last = {policy: drift[policy][-1] for policy in POLICIES if policy in drift}
    return {policy: {name: row[name] for name in OF_DRIFT if name in row} for policy, row in last.items()}


def _best_of_labels(rows: Sequence[Row]) -> dict[str, Any]:
    """Take the most accurate method without labels of the new board, and with the most of them."""
    found = {}
    counts = [row["labels_n"] for row in rows]
    for labels_n in sorted({min(counts), max(counts)}):
        best = max(
            (row for row in rows if row["labels_n"] == labels_n),
            key=lambda row: row["as_labelled"]["accuracy_pct"]["mean"],
        )
        method = f"{best['method']} ({best['inputs']})"
        found[f"best_of_{labels_n}_labels"] = {"method": method} | _means(best["as_labelled"])
    return found
