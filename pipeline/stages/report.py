"""Stage report: models' cards, predictions and accounts -> numbers.json, tables, figures."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline import io
from pipeline.learning.recipe import HEADLINE
from pipeline.params import arms_of, read_scene
from pipeline.provenance import code_version, device, read_costs
from pipeline.reporting.figures import error_grid
from pipeline.reporting.numbers import compose, rounded, runtime
from pipeline.reporting.tables import make_tables, to_markdown
from pipeline.stages._run import COSTS, run, say


def report(scene: str, settings: Path, indentations: Path, folds: Path, models: Path, reports: Path) -> None:
    """Write the numbers, tables and figures of a scene."""
    asked = read_scene(settings)
    arms = arms_of(asked)
    words = io.read_json(folds)
    cards = [io.read_json(file) for arm in arms for file in sorted((models / arm).glob("*.json"))]
    accounts = [io.read_account(indentations / f"{name}.parquet") for name in words["captures"]]
    costs = read_costs(COSTS / scene)
    seconds = round(sum(cost["seconds"] for cost in costs.values()), 1)
    provenance = {"scene": scene, "source": asked.source, "git": code_version(), "seed": asked.seed}
    provenance |= {"device": device(), "seconds": seconds}
    numbers = {"provenance": provenance, **compose(cards, accounts, words["dropped"], headline=HEADLINE)}
    numbers["runtime"] = runtime(cards, costs)
    numbers = rounded(numbers)
    io.write_json(reports / "numbers.json", numbers)
    with io.replacing(reports / "tables") as folder:
        folder.mkdir()
        for name, table in make_tables(numbers).items():
            io.write_text(folder / f"{name}.md", to_markdown(table))
            io.write_text(folder / f"{name}.csv", table.to_csv(index=False))
    with io.replacing(reports / "figures") as folder:
        folder.mkdir()
        for arm in arms:
            _draw(folder, io.read_table(models / arm / "predictions.parquet"), f"{scene} ({asked.source})")
    say(f"{scene}: {reports}/numbers.json, tables, figures")


def _draw(folder: Path, predictions: pa.Table, scene: str) -> None:
    for question in predictions["question"].unique().to_pylist():
        chosen = pc.and_(pc.equal(predictions["question"], question), pc.equal(predictions["recipe"], HEADLINE))
        own = predictions.filter(chosen)
        true_mm, predicted_mm = (_places(own, side) for side in ("true", "predicted"))
        io.write_text(
            folder / f"error_grid_{question}.svg",
            error_grid(true_mm, predicted_mm, title=f"{scene}, {question}: place error on held-out readings"),
        )


def _places(table: pa.Table, side: str) -> Any:
    return np.stack([np.asarray(table[f"{side}_{axis}_mm"], np.float64) for axis in "xy"], axis=1)


if __name__ == "__main__":
    run(report)
