"""`numbers.json`: every number that any text shows, nested by question. In: cards, accounts, costs. Out: plain words.

A question that was not asked is absent. Refuses to know how a number is shown.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.evaluation.comparison import over_boards, over_pairs
from pipeline.evaluation.metrics import summarise
from pipeline.evaluation.summary import over_folds
from pipeline.evaluation.tally import tally
from pipeline.questions import QUESTIONS
from pipeline.reporting.learned import by_fold, learned

SINGLE = ("single_random", "single_temporal")  # the first of these stands beside the paper's numbers
HONEST = {"by_indentation": "single_indentation", "by_pass": "single_pass"}  # the same skin, more of it held out

Cards = Sequence[dict[str, Any]]


def compose(
    cards: Cards,
    points: Mapping[str, Cards],
    accounts: Iterable[Mapping[str, int]],
    dropped: Mapping[str, int],
    *,
    headline: str,
) -> dict[str, Any]:
    """Compose what follows from the data alone; `headline` names the recipe that stands beside the paper's numbers."""
    numbers: dict[str, Any] = {"capture": add_up(accounts) | {"left_out": dict(dropped)}}
    by_question: dict[str, list[dict[str, Any]]] = {}
    for card in cards:
        by_question.setdefault(card["question"], []).append(card)
    table2 = {}
    if "transfer" in by_question:
        table2["single"] = over_pairs(_of(by_question["transfer"], headline))
    if "lobo" in by_question:
        pooled = _of(by_question["lobo"], headline)
        table2["multi"] = over_boards(pooled)
        numbers["lobo"] = {
            "registered": over_boards(pooled, "registered"),
            "by_board": {
                board: {
                    "trained_on_skins_n": len(own[0]["train_skins"]),
                    "as_labelled": summarise_means(own, "all"),
                    "registered": summarise_means(own, "registered"),
                }
                for board, own in _group(pooled, "fold").items()
            },
        }
    further = learned(cards, points, headline=headline)
    if table2:
        numbers["table2"] = table2 | further.pop("table2", {})
    numbers |= further
    for question in (name for name in SINGLE if name in by_question):
        numbers[question] = over_folds(_of(by_question[question], headline))
        numbers.setdefault("single_sensor", {"split": question} | numbers[question])
    for name, question in HONEST.items():
        if question in by_question:
            numbers[question] = over_folds(_of(by_question[question], headline))
            numbers.setdefault("single_sensor", {})[name] = numbers[question]
    numbers["variants"] = {
        question: {recipe: _over(question)(by_fold(own)) for recipe, own in _group(all_, "recipe_name").items()}
        for question, all_ in by_question.items()
    }
    return numbers


def _over(question: str) -> Callable[[Cards], dict[str, dict[str, Any]]]:
    """Choose what a question's scores are summarised over: repeats on one skin are no boards."""
    if question == "transfer":
        return over_pairs
    return over_folds if question.startswith("single_") else over_boards


def summarise_means(cards: Cards, part: str) -> dict[str, float]:
    """Mean over seeds of each metric."""
    return {name: value["mean"] for name, value in summarise([card["scores"][part] for card in cards]).items()}


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


def _of(cards: Cards, recipe: str) -> list[dict[str, Any]]:
    return [card for card in cards if card["recipe_name"] == recipe]


def _group(cards: Cards, key: str) -> dict[str, list[dict[str, Any]]]:
    groups: dict[str, list[dict[str, Any]]] = {}
    for card in cards:
        groups.setdefault(card[key], []).append(card)
    return groups
