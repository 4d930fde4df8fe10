"""Manual: networks are adapted with pokes by hand, whose places are unknown (paper section 5).

The networks are tested on pokes of the same skin by the robot, which are on a grid. They are compared with networks
that were adapted with the same number of robot pokes, and with a control: networks that were trained further for the
same number of steps, but without pokes of the skin.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pipeline.experiments.results import read_captures, read_losses, write_results
from pipeline.scores import write_scores
from pipeline.settings import Adaptations, Settings
from pipeline.training.jobs import (
    AdaptationPokes,
    PretrainedNetworks,
    SceneData,
    adaptation_job,
    pool_lines,
    preload_training,
    read_data,
    read_pretrained,
    select_pretrained,
)
from pipeline.training.variants import (  # fmt: skip
    AFTER,
    BEFORE,
    CONTROL,
    VariantPrediction,
    adapt_and_predict,
    compare_variants,
    predict_before,
    score_variants,
    summarise_variants,
)
from reskin.data.lines import Lines, hand_lines
from reskin.data.rows import TARGETS, Rows, stack
from reskin.data.splits import Fold
from reskin.errors import ParamsError, SchemaError
from reskin.models.job import TrainingJob
from reskin.models.recipe import HEADLINE
from reskin.schema import Readings

GRID = "grid"  # name of the variant that is adapted with equally many robot pokes instead of hand pokes


def manual(
    settings: Settings, folds: Path, main: Path, indentations: Path, pretrained: Path, scores: Path, results: Path
) -> None:
    """Adapt networks to every skin with its hand pokes, or with equally many robot pokes; test on the robot's grid."""
    preload_training()
    data = read_data(settings, main, folds)
    starts = read_pretrained(pretrained)
    adapting = data.settings.section(Adaptations, "adapt")
    captures = read_captures(indentations)
    rows, lines = add_hand_pokes(data.rows, captures)
    data = replace(data, rows=rows)
    jobs: list[tuple[str, TrainingJob]] = []
    predictions: list[VariantPrediction] = []
    for capture in captures:
        skin, skin_lines, fold = capture.skin, lines[capture.skin], fold_without(data, capture.board)
        predictions += predict_before(data, fold, adapting.recipes[HEADLINE], starts, skin)
        jobs += make_jobs(data, fold, adapting, starts, skin, skin_lines)
    after, trainings = adapt_and_predict(data, jobs, "manual")
    pokes_n = [count_pokes(data, skin_lines) for skin_lines in lines.values()]
    lines_n = [len(np.unique(skin_lines.line_i)) for skin_lines in lines.values()]
    write_scores(scores, score_variants("manual", [*predictions, *after]))
    numbers = {"pokes_n": round(np.mean(pokes_n)), "lines_n": round(np.mean(lines_n))}
    write_results(results, numbers, {}, read_losses(indentations, {}), trainings)


def add_hand_pokes(rows: Rows, captures: Sequence[Readings]) -> tuple[Rows, dict[str, Lines]]:
    """Append the readings of captures of hand pokes to rows, and return them with the lines of each skin.

    The places and forces of the appended rows are unknown (NaN).
    """
    lines: dict[str, Lines] = {}
    for readings in captures:
        if readings.skin in lines:
            what = f"skin {readings.skin} also has manual pokes in another capture"
            raise ParamsError(f"capture {readings.capture}: {what}. Remove one of the two captures from the scene.")
        in_capture, f = hand_lines(readings.pass_i, readings.indentation), len(readings)
        lines[readings.skin] = replace(in_capture, row=in_capture.row + len(rows))
        poked = Rows(
            capture=np.repeat(readings.capture, f),
            board=np.repeat(readings.board, f),
            skin=np.repeat(readings.skin, f),
            db_uT=readings.db_uT,
            target=np.full((f, len(TARGETS)), np.nan, np.float32),
            pass_i=readings.pass_i,
            indentation=readings.indentation.astype(np.int64),
            dropped={},
        )
        rows = stack(rows, poked)
    return rows, lines


def make_jobs(
    data: SceneData, fold: Fold, adapting: Adaptations, starts: PretrainedNetworks, skin: str, by_hand: Lines
) -> Iterator[tuple[str, TrainingJob]]:
    """Yield the adaptation jobs of one skin, each with the name of its variant.

    There are jobs with hand pokes, with robot pokes and, if the scene has the control's recipe, without pokes.
    """
    headline = HEADLINE, adapting.recipes[HEADLINE]
    for seed_i in select_pretrained(starts, headline[1].base, fold):
        by_robot = pool_lines(data, fold, skin, pokes_n=count_pokes(data, by_hand), seed_i=seed_i)
        pokes = AdaptationPokes("manual", skin, seed_i, "hand", by_hand)
        yield AFTER, adaptation_job(data, fold, headline, starts, pokes)
        yield GRID, adaptation_job(data, fold, headline, starts, replace(pokes, what="grid", lines=by_robot))
        if CONTROL in adapting.recipes:
            yield CONTROL, adaptation_job(data, fold, (CONTROL, adapting.recipes[CONTROL]), starts, pokes)


def count_pokes(data: SceneData, lines: Lines) -> int:
    """Return the number of pokes along these lines."""
    return len(np.unique(data.rows.indentation[lines.row]))


def fold_without(data: SceneData, board: str) -> Fold:
    """Return the fold of experiment `lobo` (leave one board out) that holds out `board`."""
    folds = {fold.name: fold for fold in data.folds_of("lobo")}
    if board not in folds:
        what = (
            f"no fold of experiment lobo (leave one board out) holds out board {board}, only {', '.join(sorted(folds))}"
        )
        raise SchemaError(
            f"experiment manual: {what}. Record hand pokes on skins that also occur in other captures of the scene."
        )
    return folds[board]


def summarise(scores: pd.DataFrame, measured: Mapping[str, Any]) -> dict[str, Any]:
    """Summarise the scores of each variant over boards, and the differences between variants on the same skins."""
    variants = summarise_variants(scores)
    counts = {f"{name}s_n": scores[name].nunique() for name in ("skin", "board", "seed")}
    differences = {
        f"{AFTER}_minus_{other}": compare_variants(scores, AFTER, other)
        for other in (BEFORE, CONTROL, GRID)
        if other in variants
    }
    return {**measured, **counts, **variants, "paired": differences}
