"""What a field at rest that wanders faster would do to a trained model. In: captures, trained networks. Out: rows.

A random walk is added to every channel of contact and no-load readings alike, from the contact on at which training
ended: figure 5 as a function of it. Simulated captures only. Refuses to know how networks are trained.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from scipy.constants import micro

from pipeline.report.statistics import summarise
from reskin.data.baseline import rank
from reskin.data.windows import Part
from reskin.metrics import METRICS, score
from reskin.models.inputs import VIEW
from reskin.models.trial import Trained, Trial
from reskin.numerics import device
from reskin.physics.aging import wandering
from reskin.schema import Readings
from reskin.seeds import rng_for


def walked(readings: Readings, step_uT: float, *, after_n: int, seed: int) -> Readings:
    """Add a walk of so many uT a contact and channel (sd) to what is read after `after_n` contacts."""
    since_n = np.maximum(rank(readings.indentation) + 1 - after_n, 0)
    rng = rng_for(seed, "drift", "wander", readings.skin)  # the same walk at every step size, scaled
    walk_T = wandering(since_n, readings.b_uT.shape[1], step_T=step_uT * micro, rng=rng)
    walk_uT = (walk_T / micro).astype(np.float32)
    return replace(readings, b_uT=readings.b_uT + walk_uT, noload_uT=readings.noload_uT + walk_uT)


def over_steps(
    networks: Sequence[tuple[Trial, Trained, int]], steps_uT: Sequence[float], parts_at: Callable[[float], list[Part]]
) -> dict[str, list[dict[str, Any]]]:
    """Give for each policy a row for each step: scores of the last window, mean and sd (`spread`) over skins and seeds.

    `networks` stand beside the index of the part that each was last tested on; `parts_at` lays the parts anew.
    """
    rows: dict[str, list[dict[str, Any]]] = {}
    for step_uT in steps_uT:
        parts = parts_at(step_uT)
        scores: dict[str, list[dict[str, float]]] = {}
        off_uT: dict[str, list[float]] = {}
        for trial, trained, part_i in networks:
            part = parts[part_i]
            scores.setdefault(part.policy, []).append(score(part.rows.target, _answer(trial, trained, part)))
            off_uT.setdefault(part.policy, []).append(part.noload_off_uT)
        for policy, own in scores.items():
            stats = summarise(pd.DataFrame(own)[[name for name in METRICS if name in own[0]]])
            means = {name: stat["mean"] for name, stat in stats.items()}
            row = {"step_uT": step_uT, "noload_off_uT": float(np.mean(off_uT[policy])), "n": len(own), **means}
            row["spread"] = {name: stat["sd"] for name, stat in stats.items() if "sd" in stat}
            rows.setdefault(policy, []).append(row)
    return rows


def _answer(trial: Trial, trained: Trained, part: Part) -> np.ndarray:
    from reskin.models.network import Predictor  # torch, late

    predict = Predictor(trained.weights, trial.recipe.architecture, device())
    return trained.scaler.decode(predict(trained.scaler.encode(VIEW[trial.recipe.inputs](part.rows.db_uT))))
