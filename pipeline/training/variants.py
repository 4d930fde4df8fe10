"""Predict with networks on a new skin before and after they are adapted to it, and compare the scores.

There are three variants of a network: before adaptation, after adaptation, and the control. The control is trained for
as many further steps as the adapted network, but without pokes of the new skin. A difference between the control and
the adapted network is therefore due to the pokes, and not to longer training.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from pipeline import statistics
from pipeline.scores import make_table, select
from pipeline.settings import Training
from pipeline.training.jobs import (
    PretrainedNetworks,
    SceneData,
    collapse_record,
    select_pretrained,
    train_jobs,
)
from reskin.data.splits import Fold
from reskin.metrics import METRICS, score
from reskin.models.inputs import VIEW
from reskin.models.job import TrainingJob
from reskin.models.recipe import AdaptationWithBase
from reskin.numerics import device

FORCE = 2  # column of the force in true and predicted values
BEFORE, AFTER, CONTROL = "before", "after", "control"  # names of the variants
BIASES = ("bias_f_N", "bias_f_pct")


@dataclass(frozen=True)
class VariantPrediction:
    """The true values and the predictions of one network on the test rows of one skin.

    The columns of `true` and `predicted` are x_mm, y_mm and F_N.
    """

    variant: str
    board: str
    skin: str
    seed_i: int
    true: Float[np.ndarray, "b 3"]
    predicted: Float[np.ndarray, "b 3"]


def predict_before(
    data: SceneData, fold: Fold, settings: AdaptationWithBase, starts: PretrainedNetworks, skin: str
) -> Iterator[VariantPrediction]:
    """Predict the test rows of a skin with each pretrained network of a fold, before the network is adapted."""
    # This import is here, and not at the top of the file, because it imports torch, which only a stage that predicts
    # needs.
    from reskin.models.network import Predictor

    recipe = data.settings.section(Training, "train_triplet").recipes[settings.base]
    test = fold.test[data.rows.skin[fold.test] == skin]
    view = VIEW[recipe.inputs](data.rows.db_uT[test])
    for seed_i, start in select_pretrained(starts, settings.base, fold).items():
        predict = Predictor(start.weights, recipe.architecture, device())
        predicted = start.scaler.decode(predict(start.scaler.encode(view)))
        yield VariantPrediction(BEFORE, str(data.rows.board[test[0]]), skin, seed_i, data.rows.target[test], predicted)


def adapt_and_predict(
    data: SceneData, jobs: Sequence[tuple[str, TrainingJob]], stage: str
) -> tuple[list[VariantPrediction], dict[str, int]]:
    """Train networks, and return their predictions for the test rows of their jobs.

    `jobs` contains pairs of the name of a variant and a job. The second result counts all training runs, and those that
    collapsed, which means that a network predicts nearly the same value for all inputs.
    """
    adapted = [job for _, job in jobs]
    trained = train_jobs(data, adapted, stage)
    predictions = []
    for (variant, job), result in zip(jobs, trained, strict=True):
        board, true = str(data.rows.board[job.test[0]]), data.rows.target[job.test]
        predictions.append(VariantPrediction(variant, board, job.skin, job.seed_i, true, result.predicted))
    return predictions, statistics.tally(map(collapse_record, trained))


def score_variants(experiment: str, predictions: Sequence[VariantPrediction], **keys: str) -> pd.DataFrame:
    """Score the predictions: rows of the table of scores, whose method is the variant.

    Besides the metrics, the rows have the force bias, which is the mean of (predicted force - true force), in N and in
    percent of the mean true force. keys: values of further columns.
    """
    rows = []
    for prediction in predictions:
        row: dict[str, Any] = {"experiment": experiment, "method": prediction.variant, "board": prediction.board}
        row |= {"skin": prediction.skin, "seed": prediction.seed_i, "rows_n": len(prediction.true), **keys}
        true_N = prediction.true[:, FORCE].astype(float)
        bias_N = float((prediction.predicted[:, FORCE].astype(float) - true_N).mean())
        bias = {"bias_f_N": bias_N, "bias_f_pct": 100 * bias_N / float(true_N.mean())}
        rows.append(row | score(prediction.true, prediction.predicted) | bias)
    return make_table(rows)


def summarise_variants(rows: pd.DataFrame) -> dict[str, statistics.Summary]:
    """Summarise the metrics over boards, separately for each variant.

    The value of a board is the mean over its skins, and the value of a skin is the mean over its seeds. `sd_seeds` is
    the standard deviation over the networks of one skin, averaged over skins.
    """
    return {str(variant): _over_boards(group, METRICS) for variant, group in rows.groupby("method", sort=False)}


def force_biases(rows: pd.DataFrame) -> dict[str, statistics.Summary]:
    """Summarise the force bias over boards, for each variant, in N and in percent of the mean force."""
    by_variant = {str(variant): _over_boards(group, BIASES) for variant, group in rows.groupby("method", sort=False)}
    return {name: {variant: summary[name] for variant, summary in by_variant.items()} for name in BIASES}


def _over_boards(rows: pd.DataFrame, metrics: Sequence[str]) -> statistics.Summary:
    rows = rows[["board", "skin", *(name for name in metrics if rows[name].notna().all())]]
    summary = statistics.summarise(statistics.board_means(rows), boards=True)
    return statistics.add_seed_sd(summary, rows, "board", "skin")


def compare_variants(rows: pd.DataFrame, variant: str, reference: str) -> dict[str, Any]:
    """Compare two variants: summarise over boards the differences between their scores on the same skins.

    The differences are the scores of `variant` minus the scores of `reference`. The entry `by_board` contains the
    difference on each board. The entry `sd_seeds` is computed from the differences between networks with equal seeds,
    because these networks start from the same weights.
    """
    network, metrics = ["board", "skin", "seed"], [name for name in METRICS if rows[name].notna().all()]
    sides = [select(rows, method=name)[[*network, *metrics]] for name in (variant, reference)]
    compared = statistics.paired(*sides)
    by_network = sides[0].set_index(network)[metrics] - sides[1].set_index(network)[metrics]
    by_board = compared.pop("by_board")
    return statistics.add_seed_sd(compared, by_network, "board", "skin") | {"by_board": by_board}
