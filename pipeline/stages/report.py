"""Stage report: numbers, tables, figures and pages of a scene."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from pipeline import PLAN
from pipeline.catalogue import ANALYSES, module_of
from pipeline.experiments import accuracy_and_cost
from pipeline.formatting import rounded
from pipeline.provenance import (
    COSTS,
    SECONDS,
    code_version,
    machine,
    read_costs,
    versions,
)
from pipeline.report.figures import Outline, error_grids, score_figures
from pipeline.report.numbers import (
    add_up,
    before_touch_numbers,
    count_trainings,
    experiment_numbers,
    headline_scores,
    learning_numbers,
    lost_by_protocol,
    split,
    timed_rows,
)
from pipeline.report.page import index_page, run_page, scene_page
from pipeline.report.tables import make_tables, run_tables, table_texts
from pipeline.scenes import Scene, parse_scene
from pipeline.scores import read_scores, to_csv
from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.training.choice import choose, to_record
from pipeline.training.final import final_numbers
from reskin import io
from reskin.config import read_yaml
from reskin.errors import ParamsError, SchemaError
from reskin.models.recipe import HEADLINE
from reskin.numerics import device as trained_on


def report(
    settings: Settings, indentations: Path, folds: Path, models: Path, scores: Path, results: Path, reports: Path,
    figures: Path,
) -> None:  # fmt: skip
    """Write the numbers, tables, figures and the page of a scene."""
    name, scene = settings.scene, planned_scene(settings)
    inputs = read_inputs(name, scene, indentations, folds, models, results)
    table = read_scores(scores / f"{stage}.parquet" for stage in scene.scored_stages)
    numbers = rounded(compute_numbers(settings, scene, inputs, table))
    if "choice" in scene.experiments:
        record = to_record(numbers["chosen"], inputs.cards, source=scene.source, seed=settings.seed)
        io.write_json(reports / "choice.json", record)
    shared, of_this_run = split(numbers)
    io.write_json(reports / "numbers.json", shared)
    io.write_json(reports / "provenance.json", of_this_run)
    io.write_json(reports / "scores.json", headline_scores(numbers))
    plot_data = {name: result["drawn"] for name, result in inputs.analyses.items()}
    predictions = [io.read_table(models / stage / "predictions.parquet") for stage in scene.model_stages]
    drawn = draw(numbers, plot_data, predictions)
    io.write_texts(figures, drawn)
    tables = make_tables(numbers)
    io.write_texts(reports / "tables", table_texts(tables) | {"scores.csv": to_csv(table)})
    io.write_text(reports / "index.html", scene_page(shared, tables, drawn))
    # Seconds, commit and machine differ between equal runs, so this page is not an output of the DVC stage.
    timed = accuracy_and_cost.figures({"rows": timed_rows(numbers)}, {}, scene.source)
    io.write_text(reports / "run.html", run_page(numbers, run_tables(numbers), timed))
    write_index(reports.parent)
    say(f"{name}: {accuracies(numbers)}open {reports}/index.html in a browser; training runs: make ui")


def accuracies(numbers: Mapping[str, Any]) -> str:
    """Return the accuracies of table 2 as words for a message; an empty string if the scene does not have the table."""
    means = [f"{name} {row['accuracy_pct']['mean']:.0f} %" for name, row in numbers.get("table2", {}).items()]
    return f"places within 1 mm on boards not seen in training: {', '.join(means)}; " if means else ""


def draw(numbers: dict[str, Any], plot_data: dict[str, Any], predictions: list[Any]) -> dict[str, str]:
    """Draw all figures of a scene: SVG text by file name.

    plot_data: data that only figures need, by key of numbers.json. predictions: predictions of networks, by stage.
    """
    source = numbers["provenance"]["source"]
    of_layout = plot_data.get("compare", {}).get("outline")  # None unless the scene has the layout of its boards
    outline = None if of_layout is None else Outline(**of_layout)
    figures = dict(error_grids(predictions, HEADLINE, source, outline))
    figures |= score_figures(numbers, source)
    for name in [name for name in ANALYSES if name in numbers]:
        module = module_of(name)
        if hasattr(module, "figures"):
            figures |= module.figures(numbers[name], plot_data[name], source)
    return figures


@dataclass(frozen=True)
class Inputs:
    """Inputs of stage report, which are the results of other stages.

    - cards: model cards (JSON descriptions) of all trained networks.
    - curves, analyses: results of sweeps and of other experiments, by name.
    - described: descriptions of the captures' fields, noise and forces.
    - final_model: numbers on the final model.
    - ingest_counts: counts of read and lost readings of each capture.
    - dropped: numbers of rows that were left out, by reason.
    """

    cards: list[dict[str, Any]]
    curves: dict[str, Any]
    analyses: dict[str, Any]
    described: dict[str, Any]
    final_model: dict[str, Any]
    ingest_counts: list[dict[str, Any]]
    dropped: dict[str, int]


def read_inputs(scene_name: str, scene: Scene, indentations: Path, folds: Path, models: Path, results: Path) -> Inputs:
    """Read the results of all stages that the scene runs."""
    split_of_scene = io.read_json(folds)
    return Inputs(
        cards=read_cards(models, scene.model_stages),
        curves={experiment: io.read_json(results / f"{stage}.json") for experiment, stage in scene.curves.items()},
        analyses={name: io.read_json(results / f"{name}.json") for name in scene.analyses},
        described={scene.described: io.read_json(results / "described.json")},
        final_model=final_numbers(models, scene_name) if "lobo" in scene.experiments else {},
        ingest_counts=[io.read_ingest_counts(indentations / f"{name}.parquet") for name in split_of_scene["captures"]],
        dropped=split_of_scene["dropped"],
    )


def compute_numbers(settings: Settings, scene: Scene, inputs: Inputs, table: pd.DataFrame) -> dict[str, Any]:
    """Compute the content of numbers.json and provenance.json."""
    costs = {unit: cost for unit, cost in read_costs(COSTS / settings.scene).items() if scene.runs(unit)}
    runtime: dict[str, Any] = {"stages": costs}
    seconds = SECONDS / settings.scene / "accuracy_and_cost.json"
    if "accuracy_and_cost" in scene.experiments and seconds.exists():
        runtime["accuracy_and_cost"] = io.read_json(seconds)
    experiments = experiment_numbers(inputs.analyses, table)
    numbers = {
        "provenance": {
            "scene": settings.scene, "source": scene.source, "git": code_version(), "seed": settings.seed,
            "trained": ", ".join(sorted({card["git"] for card in inputs.cards})), "versions": versions(),
            "device": f"{machine()}, networks on {trained_on()}",
        },
        "capture": add_up(inputs.ingest_counts) | {"left_out": dict(inputs.dropped)},
        **learning_numbers(table, headline=HEADLINE),
        **inputs.final_model,
        **before_touch_numbers(table),
        "trainings": count_trainings(inputs.cards, inputs.curves | inputs.analyses),
        "described": inputs.described,
        **{entry.name: experiments[entry.name] for entry in scene.entries if entry.name in experiments},
        "runtime": runtime,
    }  # fmt: skip
    if scene.simulate is not None:
        losses = {name: result["losses"] for name, result in inputs.analyses.items()}
        numbers["capture_by_protocol"] = lost_by_protocol(losses)
    if "choice" in scene.experiments:
        numbers["chosen"] = choose(inputs.cards)
    return numbers


def write_index(reports: Path) -> None:
    """Write the page that lists all scenes with reports."""
    results = []
    for file in sorted(reports.glob("*/numbers.json")):
        numbers = io.read_json(file)
        if not isinstance(numbers, dict):
            raise SchemaError(f"{file}: the file has no numbers by name. Restore it: git restore {file.parent}")
        results += [numbers] if "described" in numbers else []
    io.write_text(reports / "index.html", index_page(results))


def planned_scene(settings: Settings) -> Scene:
    """Parse the scene; raise `ParamsError` if its experiments differ from those in the plan."""
    scene = parse_scene(settings.of_scene, settings.where)
    planned = read_yaml(Path(PLAN))["scenes"].get(settings.scene, [])
    if list(scene.experiments) != list(planned):
        in_one_only = ", ".join(sorted(set(scene.experiments) ^ set(planned)))
        difference = f"{in_one_only} only in one of them" if in_one_only else "their order"
        remedy = f"Try: reskin scenes use {settings.scene}, followed by the names of the other scenes in the plan."
        raise ParamsError(
            f"{settings.where}: the experiments of the scene differ from those in {PLAN}: {difference}. {remedy}"
        )
    return scene


def read_cards(models: Path, stages: Iterable[str]) -> list[dict[str, Any]]:
    """Read the model cards of these stages."""
    return [io.read_json(file) for stage in stages for file in sorted((models / stage).glob("*.json"))]
