"""A few trainings of equal settings, side by side. In: rows and trials. Out: a finished training each, and how it went.

Refuses to know files, processes and which trials there are.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from pipeline.core.errors import TrainingError
from pipeline.learning.executors import device
from pipeline.learning.inputs import VIEW
from pipeline.learning.standardise import Scaler
from pipeline.learning.stopwatch import median_s
from pipeline.learning.trial import Measured, Trained, Trial, make_job

JUDGED_STEPS_N = 200  # a shorter training from drawn weights may not have left its start
JUDGED_ROWS_N = 2000  # of the training rows, evenly spaced


def train_stack(trials: Sequence[Trial], rows: Measured) -> list[Trained]:
    """Train trials of equal settings side by side, and predict their test rows."""
    import torch  # late: only a process that trains pays for it

    from pipeline.learning.model import Predictor
    from pipeline.learning.train import train

    torch.set_num_threads(1)  # the same sums in the same order, however many processes run beside this one
    start_s, on, first = time.monotonic(), device(), trials[0]
    if on == "cuda" and not torch.cuda.is_available():
        raise TrainingError("RESKIN_DEVICE", "cuda", "there", "none that torch finds", "Unset it for cpu.")
    jobs, scalers = zip(*(make_job(trial, rows) for trial in trials), strict=True)
    architecture = first.recipe.architecture
    outcomes = train(jobs, architecture, first.schedule, first.terms, on)
    seconds = (time.monotonic() - start_s) / len(trials)
    trained = []
    for trial, scaler, outcome in zip(trials, scalers, outcomes, strict=True):
        view = VIEW[trial.recipe.inputs](rows.db_uT[trial.test])
        predict = Predictor(outcome.weights, architecture, on)
        trained.append(
            Trained(
                key="", weights=outcome.weights, scaler=scaler, curve=outcome.curve,
                predicted=_answer(scaler, predict, view), stopped_step=outcome.stopped_step, seconds=seconds,
                explained_min=_explained(trial, rows, scaler, predict),
                one_reading_s=median_s(partial(_answer, scaler, predict, view[:1])),
            )
        )  # fmt: skip
    return trained


def _explained(
    trial: Trial, rows: Measured, scaler: Scaler, predict: Callable[[np.ndarray], np.ndarray]
) -> float | None:
    """Give the least part of a known target's variance over the training rows that the answers explain."""
    if trial.schedule.steps_n < JUDGED_STEPS_N:
        return None
    some = trial.train[:: -(-len(trial.train) // JUDGED_ROWS_N)]
    target = rows.target[some].astype(np.float64)
    off = _answer(scaler, predict, VIEW[trial.recipe.inputs](rows.db_uT[some])) - target
    known = np.flatnonzero(~np.isnan(target).all(axis=0))
    told = [i for i in known if np.nanvar(target[:, i]) > 0]
    return min((float(1 - np.nanmean(off[:, i] ** 2) / np.nanvar(target[:, i])) for i in told), default=None)


def _answer(scaler: Scaler, predict: Callable[[np.ndarray], np.ndarray], view: np.ndarray) -> np.ndarray:
    return scaler.decode(predict(scaler.encode(view)))
