"""Stage report: models' cards, predictions and accounts -> numbers.json, tables, figures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline import io
from pipeline.evaluation.choice import choose, to_record
from pipeline.learning.executors import device as trained_on
from pipeline.learning.recipe import HEADLINE
from pipeline.params import Scene, check_planned, described_in, modelled, read_params, read_scene, swept
from pipeline.provenance import SECONDS, code_version, device, read_costs
from pipeline.reporting.figures import error_grids
from pipeline.reporting.learned import timed_learning
from pipeline.reporting.numbers import answered, compose, rounded, runtime
from pipeline.reporting.sweeps import learning_figures, learning_pages
from pipeline.reporting.tables import table_texts
from pipeline.reporting.work_precision import pages
from pipeline.stages._run import COSTS, run, say


def report(
    scene: str,
    params: Path,
    settings: Path,
    indentations: Path,
    folds: Path,
    models: Path,
    answers: Path,
    reports: Path,
) -> None:
    """Write the numbers, tables and figures of a scene."""
    asked = read_scene(settings)
    check_planned(scene, asked, read_params(params), str(settings))
    arms, words = modelled(asked), io.read_json(folds)
    cards = [io.read_json(file) for arm in arms for file in sorted((models / arm).glob("*.json"))]
    accounts = [io.read_account(indentations / f"{name}.parquet") for name in words["captures"]]
    numbers: dict[str, Any] = {"provenance": _provenance(scene, asked, cards)}
    points = {question: io.read_json(answers / f"{file}.json") for question, file in swept(asked).items()}
    numbers |= compose(cards, points, accounts, words["dropped"], headline=HEADLINE)
    numbers |= {"audit": io.read_json(answers / "audit.json")} if "audit" in asked.questions else {}
    if "choice" in asked.questions:
        numbers["chosen"] = choose(cards)
        io.write_json(
            reports / "choice.json", to_record(numbers["chosen"], cards, source=asked.source, seed=asked.seed)
        )
    numbers["described"] = {name: io.read_json(answers / f"described/{name}.json") for name in described_in(asked)}
    studied = {question: io.read_json(answers / f"{question}.json") for question in asked.studied}
    took = _seconds(scene)
    numbers |= answered(studied, runtime(cards, read_costs(COSTS / scene)), took)
    numbers["runtime"] |= timed_learning(numbers, took)
    numbers = rounded(numbers)
    io.write_json(reports / "numbers.json", numbers)
    io.write_texts(reports / "tables", table_texts(numbers))
    predictions = [io.read_table(models / arm / "predictions.parquet") for arm in arms]
    drawn = dict(error_grids(predictions, HEADLINE, f"{scene} ({asked.source})"))
    io.write_texts(reports / "figures", drawn | dict(learning_figures(numbers, asked.source)))
    # Seconds differ between identical runs, so what shows them is no DVC output.
    costs = pages(numbers["runtime"], source=asked.source) | learning_pages(numbers["runtime"], asked.source)
    io.write_texts(reports / "runtime", costs)
    say(f"{scene}: {reports}/numbers.json, tables, figures")


def _provenance(scene: str, asked: Scene, cards: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    known = {"scene": scene, "source": asked.source, "git": code_version(), "seed": asked.seed}
    known |= {"trained": ", ".join(sorted({card["git"] for card in cards}))}
    known |= {"device": f"{device()}, networks on {trained_on()}"}
    return known | {"seconds": round(sum(cost["seconds"] for cost in read_costs(COSTS / scene).values()), 1)}


def _seconds(scene: str) -> dict[str, list[dict[str, Any]]]:
    """Read what was timed here, by stage; what was not timed here is absent."""
    return {file.stem: io.read_json(file) for file in sorted((SECONDS / scene).glob("*.json"))}


if __name__ == "__main__":
    run(report)
