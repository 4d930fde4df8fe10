"""Shear: estimates of place and of all three force components along dragged lines (paper section 4).

The readings of every skin are split in two ways: random readings are held out, or whole lines are held out.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from pydantic import Field

from pipeline.experiments.results import read_captures, read_losses, write_results
from pipeline.plot import COLOURS, drawing, svg
from pipeline.scores import make_table, select, write_scores
from pipeline.settings import SectionWithTraining, Settings, Training
from pipeline.statistics import over_units, tally
from pipeline.training.jobs import SceneData, collapse_record, make_jobs, preload_training, train_jobs
from reskin.data.rows import SHEAR_TARGETS, Rows, Selection, gather
from reskin.data.splits import NO_POOL, Fold, draw_sides
from reskin.metrics import score_shear
from reskin.seeds import rng_for, seed_for

BY_READING, BY_LINE = "reading", "line"  # splits: random readings or whole lines are held out
DRAWN_N = 400  # number of points in a panel of the figure
FORCE_DECIMALS = 3  # forces in N are rounded to this many decimals for the figure


class Shear(SectionWithTraining):
    """Settings section `shear`: held-out fraction and number of the random splits, and the training settings."""

    test_fraction: Annotated[float, Field(gt=0, lt=1)]
    repeats_n: Annotated[int, Field(ge=1)]
    training: Training


def shear(settings: Settings, section: Shear, indentations: Path, scores: Path, results: Path) -> None:
    """Train networks with five targets on both splits of every skin, and score the held-out readings."""
    preload_training()
    rows = gather(read_captures(indentations), settings.section(Selection, "selection"), targets=SHEAR_TARGETS)
    by_reading = make_folds(rows, np.arange(len(rows)), "reading", section, settings.seed)
    by_line = make_folds(rows, rows.indentation, "line", section, settings.seed)
    data = SceneData(settings.scene, settings, rows, [*by_reading, *by_line])
    jobs = make_jobs(data, section.training, data.folds)
    trained = train_jobs(data, jobs, "shear")
    lines = {fold.name for fold in by_line}
    rows_of_jobs = [
        {"experiment": "shear", "split": BY_LINE if job.fold in lines else BY_READING, "recipe": job.recipe_name}
        | {"fold": job.fold, "seed": job.seed_i, **score_shear(rows.target[job.test], result.predicted)}
        for job, result in zip(jobs, trained, strict=True)
    ]
    write_scores(scores, make_table(rows_of_jobs))
    rms_N = np.sqrt((rows.target.astype(float) ** 2).mean(axis=0))
    numbers = {
        "readings_n": len(rows), "lines_n": len(np.unique(rows.indentation)), "passes_n": len(np.unique(rows.pass_i)),
        "fx_rms_N": float(rms_N[2]), "fy_rms_N": float(rms_N[3]), "fz_rms_N": float(rms_N[4]),
    }  # fmt: skip
    first_i = next(i for i, job in enumerate(jobs) if job.fold in lines)
    shown = rng_for(settings.seed, "shear", "drawn").permutation(len(jobs[first_i].test))[:DRAWN_N]
    true, predicted = rows.target[jobs[first_i].test], trained[first_i].predicted
    plot_data = {
        side: [np.round(forces[shown, i].astype(float), FORCE_DECIMALS).tolist() for i in range(2, 5)]
        for side, forces in (("true", true), ("predicted", predicted))
    }
    write_results(
        results, numbers, plot_data, read_losses(indentations, rows.dropped), tally(map(collapse_record, trained))
    )


def make_folds(rows: Rows, group: np.ndarray, by: str, section: Shear, seed: int) -> list[Fold]:
    """Draw the random splits of every skin; rows with equal values of `group` are on the same side of a split."""
    folds = []
    for skin in np.unique(rows.skin):
        skin_rows = np.flatnonzero(rows.skin == skin)
        splits = draw_sides(
            group[skin_rows], test_fraction=section.test_fraction, repeats_n=section.repeats_n,
            state=seed_for(seed, "shear", by, str(skin)), what=f"{by}s of skin {skin}", where="experiment shear",
        )  # fmt: skip
        folds += [
            Fold("shear", f"{skin}-{by}{i}", skin_rows[train], skin_rows[test], NO_POOL)
            for i, (train, test) in enumerate(splits)
        ]
    return folds


def summarise(scores: pd.DataFrame, measured: Mapping[str, Any]) -> dict[str, Any]:
    """Summarise the scores of both splits over folds; the score of a fold is the mean over its seeds.

    `sd_seeds` is the standard deviation over the networks of one fold, averaged over folds.
    """
    by_reading, by_line = (over_units(select(scores, split=name), "fold") for name in (BY_READING, BY_LINE))
    return {**by_reading, "by_line": by_line, "seeds_n": scores["seed"].nunique(), **measured}


FORCES = ("Fx", "Fy", "Fz")


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Plot predicted against true force for held-out lines, one panel per force component."""
    with drawing(4.6, f"Forces on held-out dragged lines ({source})") as figure:
        *panels, last = figure.subplots(2, 2).ravel()
        for axes, name, true_N, predicted_N in zip(panels, FORCES, drawn["true"], drawn["predicted"], strict=True):
            ends_N = min(*true_N, *predicted_N), max(*true_N, *predicted_N)
            axes.plot(ends_N, ends_N, color="0.3", marker="", linewidth=0.8)
            axes.scatter(true_N, predicted_N, s=7, color=COLOURS[1], alpha=0.6, linewidths=0)
            axes.set(xlabel=f"true {name} / N", ylabel=f"predicted {name} / N")
            axes.locator_params(nbins=4)
        explained = {part: _show_explained(numbers["by_line"][f"explained_{part}"]) for part in ("fxy", "fz")}
        text = f"explained variance\nsideways: {explained['fxy']}\nnormal: {explained['fz']}"
        last.text(0, 0.9, f"{text}\n\npoints: first of\n{numbers['seeds_n']} network seeds", va="top", fontsize=8.5)
        last.axis("off")
        return {"shear.svg": svg(figure)}


def _show_explained(stat: Mapping[str, float]) -> str:
    return f"{stat['mean']:.3f}" + (f" ± {stat['sd_seeds']:.3f} (seeds)" if "sd_seeds" in stat else "")
