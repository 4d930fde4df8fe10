"""A scene's cards, answers and accounts -> numbers, and what only figures show. Refuses to know how they are shown."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from pipeline.provenance import COSTS, SECONDS, add_up_costs, code_version, device, read_costs, versions
from pipeline.report.choice import choose
from pipeline.report.formatting import rounded
from pipeline.report.numbers import (
    answered,
    compose,
    count_trainings,
    foretold,
    lost_by_protocol,
    runtime,
    timed_learning,
)
from pipeline.report.statistics import tidy
from pipeline.scenes import Asking
from reskin import io
from reskin.config import Settings, parse
from reskin.data.rows import SCORED
from reskin.errors import ParamsError
from reskin.models.recipe import HEADLINE
from reskin.numerics import device as trained_on


@dataclass(frozen=True)
class Places:
    """Where a scene's results lie."""

    indentations: Path
    folds: Path
    models: Path
    answers: Path


def asking(settings: Settings) -> Asking:
    """Read what the scene asks; raise if the plan was made for other questions: the scene was edited since."""
    asked, planned = settings.words("questions"), settings.plan("questions")
    if list(asked) != list(planned):
        differing = ", ".join(sorted(set(asked) ^ set(planned))) or "another order"
        remedy = f"Try: reskin scenes use {settings.scene}, beside the others that run."
        rule, got = "those of pipeline/plan.yaml", f"{differing} only in one"
        raise ParamsError(settings.where, "questions", rule, got, remedy)
    return parse(Asking, {name: settings.words(name) for name in ("source", "questions")}, settings.where)


def read_cards(asked: Asking, models: Path) -> list[dict[str, Any]]:
    """Read the cards of all models that the scene keeps."""
    return [io.read_json(file) for arm in asked.modelled for file in sorted((models / arm).glob("*.json"))]


def read_numbers(settings: Settings, asked: Asking, at: Places) -> tuple[dict[str, Any], dict[str, Any], pd.DataFrame]:
    """Read what numbers.json says, by experiment what only its figures show, and the table of scores."""
    folds, cards = io.read_json(at.folds), read_cards(asked, at.models)
    accounts = [io.read_account(at.indentations / f"{name}.parquet") for name in folds["captures"]]

    def answers(names: Sequence[str]) -> dict[str, Any]:
        return {name: io.read_json(at.answers / f"{name}.json") for name in names}

    points = {question: answers([stage])[stage] for question, stage in asked.curves.items()}
    experiments, table = answers(asked.experiments), tidy(cards, points)
    costs = {unit: cost for unit, cost in read_costs(COSTS / settings.scene).items() if asked.runs(unit)}
    took = {file.stem: io.read_json(file) for file in sorted((SECONDS / settings.scene).glob("*.json"))}
    numbers = {
        "provenance": _provenance(settings, asked, cards, costs),
        **compose(table, accounts, folds["dropped"], headline=HEADLINE),
        **foretold([io.read_table(at.models / arm / SCORED) for arm in asked.modelled if arm == "train_single"]),
        "trainings": count_trainings(cards, points, experiments),
        "described": {asked.described: io.read_json(at.answers / f"described/{asked.described}.json")},
        **answers([question for question in ("audit",) if question in asked.questions]),
        **{question: answer["numbers"] for question, answer in experiments.items()},
        **answered(answers(asked.studied), runtime(len(cards), costs), took),
    }
    if asked.source == "simulated":
        losses = {question: answer["losses"] for question, answer in experiments.items()}
        numbers["capture_by_protocol"] = lost_by_protocol(losses)
    if "choice" in asked.questions:
        numbers["chosen"] = choose(cards)
    numbers["runtime"] |= timed_learning(numbers, took)
    return rounded(numbers), {question: answer["drawn"] for question, answer in experiments.items()}, table


def _provenance(
    settings: Settings, asked: Asking, cards: Sequence[Mapping[str, Any]], costs: Mapping[str, Any]
) -> dict[str, Any]:
    """Say where a result came from; a stage whose question was switched off costs nothing any more."""
    return {
        "scene": settings.scene, "source": asked.source, "git": code_version(), "seed": settings.seed,
        "trained": ", ".join(sorted({card["git"] for card in cards})), "versions": versions(),
        "device": f"{device()}, networks on {trained_on()}", "seconds": round(add_up_costs(costs.values()), 1),
    }  # fmt: skip
