"""Networks before and after they are adapted to a skin: their answers on its rows by arm, and scores over boards.

An arm is one way to treat the same networks: left as they were, adapted, adapted without the skin's pokes, ...
Refuses to know pokes and files.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from pipeline import statistics
from pipeline.training.jobs import (
    PretrainedNetworks,
    SceneData,
    collapse_record,
    select_pretrained,
    train_jobs,
    write_timings,
)
from reskin.data.splits import Fold
from reskin.metrics import METRICS, score
from reskin.models.inputs import VIEW
from reskin.models.job import TrainingJob
from reskin.models.recipe import AdaptationWithBase
from reskin.numerics import device

FORCE = 2  # column
BEFORE, AFTER, CONTROL = "before", "after", "control"  # arms: as it was, adapted, as long without the skin's pokes
Judge = Callable[[np.ndarray, np.ndarray], dict[str, float]]  # of true and predicted x_mm, y_mm, F_N


@dataclass(frozen=True)
class VariantPrediction:
    """What one network answers on one skin's tested rows, axes x_mm, y_mm, F_N."""

    arm: str
    board: str
    skin: str
    seed_i: int
    true: Float[np.ndarray, "b 3"]
    predicted: Float[np.ndarray, "b 3"]


def predict_before(
    data: SceneData, fold: Fold, settings: AdaptationWithBase, starts: PretrainedNetworks, skin: str
) -> Iterator[VariantPrediction]:
    """Answer on a skin's tested rows as the networks do before they are adapted."""
    from reskin.models.network import Predictor  # torch, late: only a stage that answers pays for it

    recipe = data.settings.training("train_triplet").recipes[settings.base]
    test = fold.test[data.rows.skin[fold.test] == skin]
    view = VIEW[recipe.inputs](data.rows.db_uT[test])
    for seed_i, start in select_pretrained(starts, settings.base, fold).items():
        predict = Predictor(start.weights, recipe.architecture, device())
        predicted = start.scaler.decode(predict(start.scaler.encode(view)))
        yield VariantPrediction(BEFORE, str(data.rows.board[test[0]]), skin, seed_i, data.rows.target[test], predicted)


def adapt_and_predict(
    data: SceneData, jobs: Sequence[tuple[str, TrainingJob]], stage: str
) -> tuple[list[VariantPrediction], dict[str, int]]:
    """Adapt by (arm, job), and answer on each job's tested rows; count what collapsed."""
    adapted = [job for _, job in jobs]
    trained = train_jobs(data, adapted, stage)
    write_timings(data.scene, stage, adapted, trained)
    answered = []
    for (arm, job), done in zip(jobs, trained, strict=True):
        board, true = str(data.rows.board[job.test[0]]), data.rows.target[job.test]
        answered.append(VariantPrediction(arm, board, job.skin, job.seed_i, true, done.predicted))
    return answered, statistics.tally(map(collapse_record, trained))


def bias(true: Float[np.ndarray, "b 3"], predicted: Float[np.ndarray, "b 3"]) -> dict[str, float]:
    """By how much force is over-estimated, in newtons and as a part of the mean force; negative is too little."""
    true_N = true[:, FORCE].astype(float)
    over_N = float((predicted[:, FORCE].astype(float) - true_N).mean())
    return {"bias_f_N": over_N, "bias_f_pct": 100 * over_N / float(true_N.mean())}


def summarise_variants(answers: Sequence[VariantPrediction], judge: Judge = score) -> dict[str, dict[str, Any]]:
    """Summarise every metric over boards, each the mean of its skins, each of these of its seeds; by arm.

    `sd_seeds` is the standard deviation over the networks of one skin, mean over skins.
    """
    arms = _tidy(answers, judge).groupby("method", sort=False)
    return {
        str(arm): statistics.with_seeds(
            statistics.summarise(statistics.board_means(rows), boards=True), rows, "board", "skin"
        )
        for arm, rows in arms
    }


def biases(answers: Sequence[VariantPrediction]) -> dict[str, dict[str, Any]]:
    """Both ways to say the force bias, each by arm, over boards."""
    by_arm = summarise_variants(answers, bias)
    return {name: {arm: found[name] for arm, found in by_arm.items()} for name in ("bias_f_N", "bias_f_pct")}


def compare_variants(answers: Sequence[VariantPrediction], of: str, over: str) -> dict[str, Any]:
    """Compare two arms skin by skin, `of` less `over`: over boards, and `by_board`.

    `sd_seeds` is that of the differences: networks of equal seeds started from the same weights.
    """
    rows = _tidy(answers, score)
    sides = [statistics.select(rows, method=arm) for arm in (of, over)]
    compared = statistics.paired(*sides)
    network = ["board", "skin", "seed"]
    metrics = [name for name in METRICS if name in rows]
    each = sides[0].set_index(network)[metrics] - sides[1].set_index(network)[metrics]
    by_board = compared.pop("by_board")
    return statistics.with_seeds(compared, each, "board", "skin") | {"by_board": by_board}


def _tidy(answers: Sequence[VariantPrediction], judge: Judge) -> pd.DataFrame:
    rows = (
        {"method": answer.arm, "board": answer.board, "skin": answer.skin, "seed": answer.seed_i}
        | judge(answer.true, answer.predicted)
        for answer in answers
    )
    return pd.DataFrame(rows)
