"""What stage report reads: cards, answers and accounts of a scene on disk -> numbers, and what only figures show."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.core import io
from pipeline.core.config import Settings, parse
from pipeline.core.errors import ParamsError
from pipeline.core.executors import device as trained_on
from pipeline.core.provenance import SECONDS, add_up_costs, code_version, device, read_costs
from pipeline.core.stage import COSTS
from pipeline.evaluation.choice import choose
from pipeline.learning.recipe import HEADLINE
from pipeline.params import Asking
from pipeline.reporting.learned import timed_learning
from pipeline.reporting.numbers import answered, compose, count_trainings, lost_by_protocol, rounded, runtime

Cards = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Places:
    """Where a scene's results lie."""

    indentations: Path
    folds: Path
    models: Path
    answers: Path


def asking(settings: Settings) -> Asking:
    """Read what the scene asks; raise if the plan was made for other questions: the scene was edited since."""
    asked, planned = (settings.words("questions"), settings.plan("questions"))
    if list(asked) != list(planned):
        differing = ", ".join(sorted(set(asked) ^ set(planned))) or "another order"
        remedy = f"Try: reskin scenes use {settings.scene}, beside the others that run."
        rule, got = "those of pipeline/plan.yaml", f"{differing} only in one"
        raise ParamsError(settings.where, "questions", rule, got, remedy)
    return parse(Asking, {name: settings.words(name) for name in ("source", "questions")}, settings.where)


def read_cards(asked: Asking, models: Path) -> list[dict[str, Any]]:
    """Read the cards of all models that the scene keeps."""
    return [io.read_json(file) for arm in asked.modelled for file in sorted((models / arm).glob("*.json"))]


def read_numbers(known: Settings, asked: Asking, at: Places) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read what numbers.json says, and by experiment what only its figures show."""
    scene = known.scene
    words, cards = io.read_json(at.folds), read_cards(asked, at.models)
    accounts = [io.read_account(at.indentations / f"{name}.parquet") for name in words["captures"]]
    points = {question: io.read_json(at.answers / f"{file}.json") for question, file in asked.curves.items()}
    numbers: dict[str, Any] = {"provenance": _provenance(known, asked, cards)}
    experiments = {question: io.read_json(at.answers / f"{question}.json") for question in asked.experiments}
    numbers |= compose(cards, points, accounts, words["dropped"], headline=HEADLINE)
    numbers |= {"trainings": count_trainings(cards, points, experiments)}
    losses = {question: answer["losses"] for question, answer in experiments.items()}
    numbers |= {"capture_by_protocol": lost_by_protocol(losses)} if asked.source == "simulated" else {}
    numbers |= {"audit": io.read_json(at.answers / "audit.json")} if "audit" in asked.questions else {}
    numbers |= {"chosen": choose(cards)} if "choice" in asked.questions else {}
    numbers["described"] = {name: io.read_json(at.answers / f"described/{name}.json") for name in [asked.described]}
    numbers |= {question: answer["numbers"] for question, answer in experiments.items()}
    studied = {question: io.read_json(at.answers / f"{question}.json") for question in asked.studied}
    took = _seconds(scene)
    numbers |= answered(studied, runtime(cards, _costs(scene, asked)), took)
    numbers["runtime"] |= timed_learning(numbers, took)
    return rounded(numbers), {question: answer["drawn"] for question, answer in experiments.items()}


def _provenance(of: Settings, asked: Asking, cards: Cards) -> dict[str, Any]:
    known = {"scene": of.scene, "source": asked.source, "git": code_version(), "seed": of.seed}
    known |= {"trained": ", ".join(sorted({card["git"] for card in cards}))}
    known |= {"device": f"{device()}, networks on {trained_on()}"}
    return known | {"seconds": round(add_up_costs(_costs(of.scene, asked).values()), 1)}


def _costs(scene: str, asked: Asking) -> dict[str, dict[str, Any]]:
    """Read what each stage cost here; one whose question was switched off costs nothing any more."""
    return {unit: cost for unit, cost in read_costs(COSTS / scene).items() if asked.runs(unit)}


def _seconds(scene: str) -> dict[str, list[dict[str, Any]]]:
    """Read what was timed here, by stage; what was not timed here is absent."""
    return {file.stem: io.read_json(file) for file in sorted((SECONDS / scene).glob("*.json"))}
