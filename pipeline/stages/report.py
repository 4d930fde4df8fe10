"""Stages that show results: table2 (early), report (numbers, tables, figures, pages), publish (MLflow)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from pipeline import PLAN
from pipeline.executors import make_executor
from pipeline.provenance import (
    COSTS,
    SECONDS,
    code_version,
    home,
    is_experiment,
    machine,
    read_costs,
    total_cost_s,
    versions,
)
from pipeline.report.choice import choose, to_record
from pipeline.report.costs import cost_pages
from pipeline.report.experiments import experiment_figures
from pipeline.report.figures import HEADLINE as HEADLINE_FIGURE
from pipeline.report.figures import error_grids, headline_figures, learning_figures
from pipeline.report.formatting import rounded, to_markdown
from pipeline.report.numbers import (
    answered,
    compose,
    count_trainings,
    curves_of,
    foretold,
    headline_scores,
    learned,
    lost_by_protocol,
    runtime,
    split,
    timed_learning,
)
from pipeline.report.page import index, page, run_page
from pipeline.report.tables import make_tables, table_2_summary, table_texts
from pipeline.scenes import EXPERIMENTS, TABLE_2, Scene, parse_scene, stages
from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.statistics import tidy, to_csv
from pipeline.tracking import Curves, TrackingAway, metrics_of
from pipeline.tracking import publish as write_runs
from reskin import io
from reskin.config import read_yaml
from reskin.data.rows import SCORED
from reskin.errors import ParamsError
from reskin.models.recipe import HEADLINE
from reskin.numerics import device as trained_on
from reskin.simulation.fingerprint import fingerprint


def table2(settings: Settings, models: Path, tables: Path) -> None:
    """Write table 2 of the paper and its figure as soon as its networks are trained; the report shows them again."""
    source, scene = settings["source"], settings.scene
    variants = stages(TABLE_2.values(), "models")
    cards = [io.read_json(file) for variant in variants for file in sorted((models / variant).glob("*.json"))]
    numbers = rounded({"provenance": {"scene": scene, "source": source}, **learned(tidy(cards, {}), headline=HEADLINE)})
    table = to_markdown(table_2_summary(numbers))
    io.write_texts(tables, {"table2.md": table, **headline_figures(numbers, source)})
    say(f"{scene} ({source})\n{table}\n{scene}: {', '.join(str(file) for file in sorted(tables.iterdir()))}")


def report(settings: Settings, indentations: Path, folds: Path, models: Path, results: Path, reports: Path) -> None:
    """Write the numbers, tables, figures and the page of a scene."""
    scene = settings.scene
    asked = read_experiments(settings)
    numbers, drawn, scores = read_numbers(settings, asked, Places(indentations, folds, models, results))
    if "choice" in asked.experiments:
        record = to_record(
            numbers["chosen"], read_cards(asked, models), source=asked.source, seed=settings.seed,
            physics=fingerprint(settings.shared),
        )  # fmt: skip
        io.write_json(reports / "choice.json", record)
    shared, of_this_run = split(numbers)
    files_of = {"numbers": shared, "provenance": of_this_run, "scores": headline_scores(numbers)}
    for name, content in files_of.items():
        io.write_json(reports / f"{name}.json", content)
    with make_executor(imports="pipeline.report.experiments") as executor:  # to draw takes most of the time
        of_experiments = executor.submit(experiment_figures, numbers, drawn, asked.source)
        of_costs = executor.submit(cost_pages, numbers["runtime"], asked.source)
        tables = make_tables(numbers)
        io.write_texts(reports / "tables", table_texts(tables) | {"scores.csv": to_csv(scores)})
        predictions = [io.read_table(models / stage / "predictions.parquet") for stage in asked.model_stages]
        figures = dict(error_grids(predictions, HEADLINE, f"{scene} ({asked.source})"))
        figures |= headline_figures(numbers, asked.source) | dict(learning_figures(numbers, asked.source))
        figures |= of_experiments.result()
        costs = of_costs.result()
    io.write_texts(reports / "figures", figures)
    # Seconds, commit and machine differ between equal runs: they are in a folder that is no output of DVC.
    io.write_texts(reports / "runtime", costs | {"index.html": run_page(numbers, costs)})
    io.write_text(reports / "index.html", page(shared, tables, figures))
    of_scenes = (io.read_json(file) for file in sorted(reports.parent.glob("*/numbers.json")))
    files = reports.parent.glob(f"*/figures/{HEADLINE_FIGURE}")
    headlines = {file.parents[1].name: io.read_bytes(file).decode() for file in files}
    described = [numbers for numbers in of_scenes if "described" in numbers]
    io.write_text(reports.parent / "index.html", index(described, headlines))
    if numbers.get("table2"):
        say(f"{scene} ({asked.source})\n{to_markdown(table_2_summary(numbers))}")
    say(f"{scene}: {reports}/index.html, numbers.json, provenance.json, scores.json, tables, figures, runtime")


def publish(settings: Settings, models: Path, results: Path, reports: Path) -> None:
    """Write every training of a scene and its report to MLflow once; if the server is away, warn and go on."""
    asked, scene = read_experiments(settings), settings.scene
    variants = {variant: models / variant for variant in asked.model_stages}
    name = f"{scene} (dvc exp)" if is_experiment() else scene  # beside the checkout's own results, not in their place
    try:
        counts = write_runs(variants, read_curves(asked, results), reports, scene=name, root=home())
        say(f"{name}: MLflow runs {counts}")
    except TrackingAway as away:
        say(f"warning: {scene} is not in MLflow: {away}")


def read_curves(asked: Scene, results: Path) -> Curves:
    """Read the points of every sweep and the numbers of every experiment, as curves by stage."""
    stages = asked.curves
    points = {experiment: io.read_json(results / f"{stage}.json") for experiment, stage in stages.items()}
    curves: dict[str, list[tuple[str, int, dict[str, float]]]]
    curves = {stages[experiment]: rows for experiment, rows in curves_of(points).items()}
    for experiment in asked.analyses:
        numbers = io.read_json(results / f"{experiment}.json")["numbers"]
        named = [(name.rpartition("."), value, step) for name, value, step in metrics_of({experiment: numbers})]
        curves[experiment] = [(head, step, {tail: value}) for (head, _, tail), value, step in named]
    return curves


@dataclass(frozen=True)
class Places:
    """Where a scene's results lie."""

    indentations: Path
    folds: Path
    models: Path
    results: Path


def read_experiments(settings: Settings) -> Scene:
    """Read which experiments the scene runs; raise if it was edited since the plan was made."""
    asked = parse_scene(settings.of_scene, settings.where)
    planned = read_yaml(Path(PLAN))["scenes"].get(settings.scene, [])
    if list(asked.experiments) != list(planned):
        differing = ", ".join(sorted(set(asked.experiments) ^ set(planned))) or "another order"
        remedy = f"Try: reskin scenes use {settings.scene}, beside the others that run."
        raise ParamsError(settings.where, "experiments", f"those of {PLAN}", f"{differing} only in one", remedy)
    return asked


def read_cards(asked: Scene, models: Path) -> list[dict[str, Any]]:
    """Read the cards of all models that the scene keeps."""
    return [io.read_json(file) for arm in asked.model_stages for file in sorted((models / arm).glob("*.json"))]


def read_numbers(settings: Settings, asked: Scene, at: Places) -> tuple[dict[str, Any], dict[str, Any], pd.DataFrame]:
    """Read the content of numbers.json, what only figures show (by key in numbers.json), and the table of scores."""
    folds, cards = io.read_json(at.folds), read_cards(asked, at.models)
    accounts = [io.read_account(at.indentations / f"{name}.parquet") for name in folds["captures"]]

    def read(names: Sequence[str]) -> dict[str, Any]:
        return {name: io.read_json(at.results / f"{name}.json") for name in names}

    points = {experiment: read([stage])[stage] for experiment, stage in asked.curves.items()}
    results, table = read(asked.analyses), tidy(cards, points)
    by_key = {EXPERIMENTS[name].key: result for name, result in results.items()}
    studies = {EXPERIMENTS[name].key: result for name, result in read(asked.studies).items()}
    costs = {unit: cost for unit, cost in read_costs(COSTS / settings.scene).items() if asked.runs(unit)}
    took = {file.stem: io.read_json(file) for file in sorted((SECONDS / settings.scene).glob("*.json"))}
    numbers = {
        "provenance": _provenance(settings, asked, cards, costs),
        **compose(table, accounts, folds["dropped"], headline=HEADLINE),
        **foretold([io.read_table(at.models / arm / SCORED) for arm in asked.model_stages if arm == "train_single"]),
        "trainings": count_trainings(cards, points, by_key),
        "described": {asked.described: io.read_json(at.results / "described.json")},
        **read([experiment for experiment in ("audit",) if experiment in asked.experiments]),
        **{key: result["numbers"] for key, result in by_key.items()},
        **answered(studies, runtime(len(cards), costs), took),
    }
    if asked.source == "simulated":
        numbers["capture_by_protocol"] = lost_by_protocol({name: result["losses"] for name, result in results.items()})
    if "choice" in asked.experiments:
        numbers["chosen"] = choose(cards)
    numbers["runtime"] |= timed_learning(numbers, took)
    return rounded(numbers), {key: result["drawn"] for key, result in by_key.items()}, table


def _provenance(
    settings: Settings, asked: Scene, cards: Sequence[Mapping[str, Any]], costs: Mapping[str, Any]
) -> dict[str, Any]:
    """Say where a result came from; a stage whose experiment was switched off costs nothing any more."""
    return {
        "scene": settings.scene, "source": asked.source, "git": code_version(), "seed": settings.seed,
        "trained": ", ".join(sorted({card["git"] for card in cards})), "versions": versions(),
        "device": f"{machine()}, networks on {trained_on()}", "seconds": round(total_cost_s(costs.values()), 1),
    }  # fmt: skip
