"""Stages that present results: table2, report (numbers, tables, figures, pages) and publish (MLflow)."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from pipeline import PLAN, SCENES
from pipeline.catalogue import EXPERIMENTS, stages
from pipeline.executors import make_executor
from pipeline.experiments import accuracy_and_cost
from pipeline.formatting import rounded, to_markdown
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
from pipeline.report.experiments import experiment_figures, experiment_numbers
from pipeline.report.figures import HEADLINE as HEADLINE_FIGURE
from pipeline.report.figures import Outline, error_grids, headline_figures, learning_figures
from pipeline.report.numbers import (
    add_up,
    before_touch_numbers,
    count_trainings,
    headline_scores,
    learning_numbers,
    lost_by_protocol,
    split,
    stage_costs,
    sweep_curves,
    timed_rows,
)
from pipeline.report.page import about_scene, index, page, run_page
from pipeline.report.summary import summarise
from pipeline.report.tables import make_tables, run_tables, table_2_summary, table_texts
from pipeline.scenes import TABLE_2, Scene, parse_scene
from pipeline.scores import read_scores, to_csv
from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.statistics import as_json
from pipeline.tracking import Curves, Results, TrackingUnavailable, metrics_of, publishing, read_times, scores_link
from pipeline.tracking import publish as write_runs
from pipeline.training.choice import choose, fingerprint, to_record
from pipeline.training.final import EXPERIMENT as FINAL_EXPERIMENT
from pipeline.training.final import FILE as FINAL_FILE
from pipeline.training.final import final_numbers
from reskin import io
from reskin.config import read_yaml
from reskin.errors import ParamsError
from reskin.models.recipe import HEADLINE
from reskin.numerics import device as trained_on


def table2(settings: Settings, scores: Path, tables: Path) -> None:
    """Write our version of the paper's table 2 and its figure, as soon as the networks are trained.

    The stage report writes both again, with the other results.
    """
    source, name = settings["source"], settings.scene
    table = read_scores(scores / f"{stage}.parquet" for stage in stages(TABLE_2.values(), "models"))
    numbers = {"provenance": {"scene": name, "source": source}, **learning_numbers(table, headline=HEADLINE)}
    numbers = rounded(numbers)
    text = to_markdown(table_2_summary(numbers))
    io.write_texts(tables, {"table2.md": text, **headline_figures(numbers, source)})
    say(f"{name} ({source})\n{text}\n{name}: {', '.join(str(file) for file in sorted(tables.iterdir()))}")


def report(
    settings: Settings, indentations: Path, folds: Path, models: Path, scores: Path, results: Path, reports: Path
) -> None:
    """Write the numbers, tables, figures and the page of a scene."""
    name, scene = settings.scene, planned_scene(settings)
    source, inputs = scene.source, read_inputs(name, scene, indentations, folds, models, results)
    table = read_scores(scores / f"{stage}.parquet" for stage in scene.scored_stages)
    numbers = rounded(compute_numbers(settings, scene, inputs, table))
    plot_data = {name: result["drawn"] for name, result in inputs.analyses.items()}
    if "choice" in scene.experiments:
        physics = fingerprint(settings.shared)
        record = to_record(numbers["chosen"], inputs.cards, source=source, seed=settings.seed, physics=physics)
        io.write_json(reports / "choice.json", record)
    shared, of_this_run = split(numbers)
    io.write_json(reports / "numbers.json", shared)
    io.write_json(reports / "provenance.json", of_this_run)
    io.write_json(reports / "scores.json", headline_scores(numbers))
    with make_executor(
        imports="pipeline.report.experiments"
    ) as executor:  # figures are drawn in parallel, because drawing takes most of the time
        figures_future = executor.submit(experiment_figures, numbers, plot_data, source)
        tables = make_tables(numbers)
        io.write_texts(reports / "tables", table_texts(tables) | {"scores.csv": to_csv(table)})
        predictions = [io.read_table(models / stage / "predictions.parquet") for stage in scene.model_stages]
        of_layout = plot_data.get("compare", {}).get("outline")  # None unless the scene has the layout of its boards
        outline = None if of_layout is None else Outline(**of_layout)
        figures = dict(error_grids(predictions, HEADLINE, f"{name} ({source})", outline))
        figures |= headline_figures(numbers, source) | dict(learning_figures(numbers, source))
        figures |= figures_future.result()
    io.write_texts(reports / "figures", figures)
    # Seconds, commit and machine differ between equal runs, so this folder is not an output of the DVC stage.
    timed = accuracy_and_cost.figures({"rows": timed_rows(numbers)}, {}, source)
    of_run = table_texts(run_tables(numbers, source)) | timed
    io.write_texts(reports / "runtime", of_run | {"index.html": run_page(numbers, timed)})
    io.write_text(reports / "index.html", page(shared, tables, figures))
    write_index(reports.parent)
    for line in (
        *summarise(numbers),
        f"{name}: open {reports}/index.html in a browser; numbers and tables are beside it",
    ):
        say(line)


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
    runtime: dict[str, Any] = {"stages": stage_costs(costs)}
    seconds = SECONDS / settings.scene / "accuracy_and_cost.json"
    if "accuracy_and_cost" in scene.experiments and seconds.exists():
        runtime["accuracy_and_cost"] = io.read_json(seconds)
    experiments = experiment_numbers(inputs.analyses, table)
    numbers = {
        "provenance": {
            "scene": settings.scene, "source": scene.source, "git": code_version(), "seed": settings.seed,
            "trained": ", ".join(sorted({card["git"] for card in inputs.cards})), "versions": versions(),
            "device": f"{machine()}, networks on {trained_on()}", "seconds": round(total_cost_s(costs.values()), 1),
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
    results = [io.read_json(file) for file in sorted(reports.glob("*/numbers.json"))]
    files = reports.glob(f"*/figures/{HEADLINE_FIGURE}")
    headlines = {file.parents[1].name: io.read_bytes(file).decode() for file in files}
    settings = (Path(SCENES) / f"{numbers['provenance']['scene']}.yaml" for numbers in results)
    about = {file.stem: about_scene(file.read_text(encoding="utf-8")) for file in settings if file.exists()}
    folders = [file.parent for file in reports.glob("*/numbers.json")]
    shown = {
        folder.name: [
            *(file.stem for file in folder.glob("tables/*.csv")),
            *(file.name for file in folder.glob("figures/*.svg")),
        ]
        for folder in folders
    }
    listed = [numbers for numbers in results if "described" in numbers]
    io.write_text(reports / "index.html", index(listed, headlines, about, shown))


def publish(settings: Settings, indentations: Path, models: Path, scores: Path, results: Path, reports: Path) -> None:
    """Write missing training runs and the report of a scene to MLflow; warn if MLflow cannot be reached."""
    if not publishing():
        return
    scene, name = planned_scene(settings), settings.scene
    # Results of `dvc exp` and results of the checkout are in different MLflow experiments.
    experiment = f"{name} (dvc exp)" if is_experiment() else name
    try:
        found = published_results(scene, name, indentations, models, scores, results, reports)
        say(write_scene(found, experiment, home(), register=not is_experiment()))
    except TrackingUnavailable as error:
        say(f"warning: the results of scene {name} were not written to MLflow: {error}")


def published_results(
    scene: Scene, name: str, indentations: Path, models: Path, scores: Path, results: Path, reports: Path
) -> Results:
    """Collect what the stages of a scene wrote, for MLflow."""
    scores_file = reports / "scores.json"
    table_2 = io.read_json(scores_file).get("table2", {}) if scores_file.exists() else {}
    return Results(
        models={stage: models / stage for stage in scene.model_stages},
        curves=read_curves(scene, scores, results),
        reports=reports,
        scores={EXPERIMENTS[TABLE_2[row]].stage: means for row, means in table_2.items() if row in TABLE_2},
        final=models / FINAL_EXPERIMENT / FINAL_FILE,
        readings=sorted(indentations.glob("*.parquet")),
        times=read_times(name),
    )


def write_scene(results: Results, experiment: str, root: Path, *, register: bool = True) -> str:
    """Write the runs of a scene that MLflow lacks; return a sentence with their number and their address."""
    counts = write_runs(results, scene=experiment, root=root, register=register)
    return f"{experiment}: MLflow runs {counts}; scores of all training runs: {scores_link(experiment, root)}"


def read_curves(scene: Scene, scores: Path, results: Path) -> Curves:
    """Read the results that MLflow shows as curves: the points of every sweep, and the numbers of every analysis.

    The keys of the result are the names of the stages that computed the curves.
    """
    table = read_scores(scores / f"{stage}.parquet" for stage in scene.scored_stages)
    curves: dict[str, list[tuple[str, int, dict[str, float]]]]
    curves = {scene.curves[experiment]: rows for experiment, rows in sweep_curves(table).items()}
    analyses = {experiment: io.read_json(results / f"{experiment}.json") for experiment in scene.analyses}
    for experiment, numbers in as_json(experiment_numbers(analyses, table)).items():
        named_values = [(name.rpartition("."), value, step) for name, value, step in metrics_of({experiment: numbers})]
        curves[experiment] = [(head, step, {tail: value}) for (head, _, tail), value, step in named_values]
    return curves


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
