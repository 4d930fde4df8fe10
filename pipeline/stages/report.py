"""Stage report: models' cards, predictions, answers and accounts -> numbers, scores, tables, figures, index.html.

Refuses to know readings, and to train.
"""

from pathlib import Path

from pipeline.executors import make_executor
from pipeline.report.choice import to_record
from pipeline.report.figures import error_grids, learning_figures, learning_pages, pages
from pipeline.report.formatting import to_markdown
from pipeline.report.headline import FILE, headline_figures, short_table
from pipeline.report.numbers import headline_scores, split
from pipeline.report.page import index, page, run_page
from pipeline.report.parts import experiment_figures
from pipeline.report.statistics import to_csv
from pipeline.report.tables import make_tables, table_texts
from pipeline.stage import run, say
from pipeline.stages._report import Places, asking, read_cards, read_numbers
from reskin import io
from reskin.config import Files, read_settings
from reskin.models.recipe import HEADLINE
from reskin.simulation.fingerprint import fingerprint


def report(
    scene: str, files: Files, indentations: Path, folds: Path, models: Path, answers: Path, reports: Path
) -> None:
    """Write the numbers, tables, figures and the page of a scene."""
    settings = read_settings("report", scene, files)
    asked = asking(settings)
    numbers, drawn, scores = read_numbers(settings, asked, Places(indentations, folds, models, answers))
    if "choice" in asked.questions:
        record = to_record(
            numbers["chosen"], read_cards(asked, models), source=asked.source, seed=settings.seed,
            physics=fingerprint(settings),
        )  # fmt: skip
        io.write_json(reports / "choice.json", record)
    shared, of_this_run = split(numbers)
    files_of = {"numbers": shared, "provenance": of_this_run, "scores": headline_scores(numbers)}
    for name, content in files_of.items():
        io.write_json(reports / f"{name}.json", content)
    with make_executor(imports="pipeline.report.parts") as executor:  # to draw takes most of the time
        of_experiments = executor.submit(experiment_figures, numbers, drawn, asked.source)
        timed = executor.submit(pages, numbers["runtime"], source=asked.source)
        tables = make_tables(numbers)
        io.write_texts(reports / "tables", table_texts(tables) | {"scores.csv": to_csv(scores)})
        predictions = [io.read_table(models / arm / "predictions.parquet") for arm in asked.modelled]
        figures = dict(error_grids(predictions, HEADLINE, f"{scene} ({asked.source})"))
        figures |= headline_figures(numbers, asked.source) | dict(learning_figures(numbers, asked.source))
        costs = timed.result() | learning_pages(numbers["runtime"], asked.source)
        figures |= of_experiments.result()
    io.write_texts(reports / "figures", figures)
    # Seconds, commit and machine differ between equal runs: what shows them is in one folder, and no DVC output.
    io.write_texts(reports / "runtime", costs | {"index.html": run_page(numbers, costs)})
    io.write_text(reports / "index.html", page(shared, tables, figures))
    results = (io.read_json(file) for file in sorted(reports.parent.glob("*/numbers.json")))
    headlines = {
        file.parent.parent.name: io.read_bytes(file).decode() for file in reports.parent.glob(f"*/figures/{FILE}")
    }
    described = [result for result in results if "described" in result]
    io.write_text(reports.parent / "index.html", index(described, headlines))
    if numbers.get("table2"):
        say(f"{scene} ({asked.source})\n{to_markdown(short_table(numbers))}")
    say(f"{scene}: {reports}/index.html, numbers.json, provenance.json, scores.json, tables, figures, runtime")


if __name__ == "__main__":
    run(report)
