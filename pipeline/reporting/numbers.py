"""`numbers.json`: every number that any text shows, nested by question. In: scores, accounts, costs. Out: plain words.

A question that was not asked is absent. Refuses to know how a number is shown.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from pipeline.evaluation.scores import tally
from pipeline.questions import QUESTIONS
from pipeline.reporting.learned import learned

Cards = Sequence[dict[str, Any]]


def compose(
    table: pd.DataFrame, accounts: Iterable[Mapping[str, int]], dropped: Mapping[str, int], *, headline: str
) -> dict[str, Any]:
    """Compose what follows from the data alone; `headline` names the recipe that stands beside the paper's numbers."""
    return {"capture": add_up(accounts) | {"left_out": dict(dropped)}, **learned(table, headline=headline)}


def add_up(accounts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Add the counts of all captures."""
    total: dict[str, int] = {"captures_n": 0}
    for account in accounts:
        total["captures_n"] += 1
        for name, count in account.items():
            if not name.endswith("_n"):
                continue  # a quality of one capture's clock is no count
            total[name] = total.get(name, 0) + count
    skipped = [count for name, count in total.items() if name.startswith("skipped_") and name.endswith("_bytes_n")]
    if skipped:
        total["lost_bytes_n"] = sum(skipped)
    return total


def count_trainings(
    cards: Cards, points: Mapping[str, Cards], experiments: Mapping[str, Mapping[str, Any]]
) -> dict[str, dict[str, int]]:
    """Count networks by question: trainings in all, those that collapsed, and those of them that had to be kept."""
    told: dict[str, list[Mapping[str, Any]]] = {}
    for question, own in [(card["question"], card) for card in cards] + [
        (question, point) for question, all_ in points.items() for point in all_ if "collapsed" in point
    ]:
        told.setdefault(question, []).append(own)
    counted = {question: tally(own) for question, own in told.items()}
    return counted | {name: dict(answer["trainings"]) for name, answer in experiments.items() if "trainings" in answer}


def lost_by_protocol(losses: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Add the counts of each further protocol's captures, and what questions of it left out of their rows."""
    found: dict[str, dict[str, Any]] = {}
    for question, own in losses.items():
        protocol = QUESTIONS[question].protocol
        if protocol is None or not own["accounts"]:
            continue
        left_out = found.get(protocol, {"left_out": {}})["left_out"]
        found[protocol] = add_up(own["accounts"]) | {"left_out": left_out | dict(own["left_out"])}
    return found


def runtime(cards: Cards, costs: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """What it cost, where it ran here: seconds and memory a stage, and networks trained."""
    return {"stages": {stage: _cost(own) for stage, own in costs.items()}, "trainings_n": len(cards)}


def _cost(own: Mapping[str, Any]) -> dict[str, float]:
    """Tell what a stage cost when it was computed, its trainings added up, from what its last run took."""
    trainings_s = own["trainings_s"].values()
    return {
        "computed_s": own["other_s"] + sum(trainings_s),
        "seconds": own["seconds"],
        "trainings_n": len(trainings_s),
        "reused_n": own["reused_n"],
        "peak_process_memory_MB": own["peak_process_memory_MB"],
    }


def answered(
    studied: Mapping[str, Any], cost: Mapping[str, Any], seconds: Mapping[str, Sequence[Mapping[str, Any]]]
) -> dict[str, Any]:
    """Put the answers to questions about physics beside each other; those about run time stand with what all cost."""
    others = {question: answer for question, answer in studied.items() if question != "runtime"}
    own = timed(studied["runtime"], seconds.get("runtime", [])) if "runtime" in studied else {}
    return others | {"runtime": {**cost, **own}}


def timed(answer: Mapping[str, Any], seconds: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Put what was timed here beside the errors of the studies of run time; what was not timed has no time."""
    key = ("study", "method", "setting")
    times = {tuple(one[part] for part in key): one for one in seconds}
    joined: dict[str, Any] = {"choice": answer["choice"]}
    for study in ("quadratures", "integrators"):
        rows = [(row, tuple(row[part] for part in key)) for row in answer[study]]
        joined[study] = [row | times[own] if own in times else row for row, own in rows]
    return joined


def rounded(value: Any, digits: int = 6) -> Any:
    """Round every float to significant digits, so that committed numbers do not change with the last bit."""
    if isinstance(value, dict):
        return {key: rounded(item, digits) for key, item in value.items()}
    if isinstance(value, list):
        return [rounded(item, digits) for item in value]
    if isinstance(value, float):
        return float(np.format_float_positional(value, digits, unique=False, fractional=False, trim="-"))
    return value
