"""How a model ages with its skin: scores of test windows under each no-load policy. In: answers. Out: plain numbers.

Refuses to know networks, captures and pages.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int, Int64, Shaped

from pipeline.report.statistics import board_means, summarise, with_seeds
from reskin.data.baseline import rank, subtract
from reskin.metrics import METRICS, score
from reskin.schema import Readings

LATE_CONTACTS_N = 45_000  # paper figure 5b: "after 45,000 interactions"
FORCE = 2  # column of a target
POINTS_MAX_N = 2000
DECIMALS = 3  # of a newton or millimetre


@dataclass(frozen=True)
class Answers:
    """What one network said of the readings of one test window of one skin, and what was true."""

    policy: str
    board: str
    skin: str
    seed_i: int
    window_i: int
    contacts_n: int  # that the skin had felt when the window began
    noload_off_uT: float  # rms over rows and channels: the policy's no-load field less that read before the contact
    indentation: Int[np.ndarray, " f"]
    true: Float[np.ndarray, "f 3"]
    predicted: Float[np.ndarray, "f 3"]


@dataclass(frozen=True)
class Contacts:
    """One point an indentation: the means of its readings; where no force is known there is none."""

    skin: Shaped[np.ndarray, " n"]
    true_N: Float[np.ndarray, " n"]
    predicted_N: Float[np.ndarray, " n"]


def score_window(one: Answers) -> dict[str, float]:
    """Score a window, and give the mean of predicted less true force where it is known."""
    numbers = score(one.true, one.predicted)
    error_N = (one.predicted.astype(float) - one.true)[:, FORCE]
    if not np.isnan(error_N).all():
        numbers["bias_f_N"] = float(np.nanmean(error_N))
    return numbers


def over_windows(answers: Sequence[Answers], policy: str) -> list[dict[str, Any]]:
    """Give a row for each window: means over skins and seeds, and their sd where there are several."""
    rows = []
    for window_i in sorted({one.window_i for one in answers}):
        own = [one for one in answers if (one.window_i, one.policy) == (window_i, policy)]
        scores = [score_window(one) for one in own]
        values = {name: np.array([one[name] for one in scores]) for name in (*METRICS, "bias_f_N") if name in scores[0]}
        row: dict[str, Any] = {"contacts_n": round(float(np.mean([one.contacts_n for one in own])))}
        row |= {name: float(of.mean()) for name, of in values.items()}
        row["noload_off_uT"] = float(np.mean([one.noload_off_uT for one in own]))
        row["spread"] = {name: float(of.std(ddof=1)) for name, of in values.items() if len(of) > 1}
        rows.append(row)
    return rows


def of_networks(answers: Sequence[Answers], policy: str) -> dict[str, Float[np.ndarray, "u w"]]:
    """Give the scores of each network, a row for each skin and seed, in each window: rows of two policies are pairs."""
    own = {(one.skin, one.seed_i, one.window_i): score_window(one) for one in answers if one.policy == policy}
    units = sorted({(skin, seed_i) for skin, seed_i, _ in own})
    windows = sorted({window_i for _, _, window_i in own})
    named = [name for name in METRICS if all(name in scores for scores in own.values())]
    return {name: np.array([[own[(*unit, i)][name] for i in windows] for unit in units]) for name in named}


def boards_of(answers: Sequence[Answers], policy: str) -> list[str]:
    """Give the board of each network, in the order of `of_networks`."""
    units = {(one.skin, one.seed_i): one.board for one in answers if one.policy == policy}
    return [units[unit] for unit in sorted(units)]


def last_window(answers: Sequence[Answers], policy: str) -> dict[str, Any]:
    """Summarise the scores of the last window over boards; `sd_seeds` is over the networks of one skin."""
    last_i = max(one.window_i for one in answers)
    own = [one for one in answers if (one.policy, one.window_i) == (policy, last_i)]
    contacts_n = round(float(np.mean([one.contacts_n for one in own])))
    rows = pd.DataFrame([{"board": one.board, "skin": one.skin, **score_window(one)} for one in own])
    return {"contacts_n": contacts_n, **with_seeds(summarise(board_means(rows), boards=True), rows, "board", "skin")}


def late_window(rows: Sequence[dict[str, Any]]) -> int:
    """Find the first window after the paper's 45,000 contacts, or else the last one."""
    late = [i for i, row in enumerate(rows) if row["contacts_n"] >= LATE_CONTACTS_N]
    return late[0] if late else len(rows) - 1


def by_contact(answers: Sequence[Answers]) -> Contacts:
    """Take the readings of an indentation together: they are not independent.

    All answers are of one window, each of one skin and one network.
    """
    skin = np.concatenate([np.full(len(one.indentation), one.skin) for one in answers])
    indentation = np.concatenate([one.indentation for one in answers])
    true_N, predicted_N = (
        np.concatenate([getattr(one, side)[:, FORCE].astype(float) for one in answers])
        for side in ("true", "predicted")
    )
    known = ~np.isnan(true_N)
    skins, skin_i = np.unique(skin[known], return_inverse=True)
    pairs, which = np.unique(np.stack([skin_i, indentation[known]], axis=1), axis=0, return_inverse=True)
    n = np.bincount(which.ravel(), minlength=len(pairs))
    means = [np.bincount(which.ravel(), values[known], len(pairs)) / n for values in (true_N, predicted_N)]
    return Contacts(skins[pairs[:, 0]], *means)


def force_bias(contacts: Contacts) -> dict[str, Any]:
    """Give the mean of predicted less true force, its standard error over contacts, and the least-squares slope."""
    error_N = contacts.predicted_N - contacts.true_N
    away_N = contacts.true_N - contacts.true_N.mean()
    return {
        "bias_N": float(error_N.mean()),
        "bias_pct": float(100 * error_N.mean() / contacts.true_N.mean()),
        "bias_se_N": float(error_N.std(ddof=1) / np.sqrt(len(error_N))),
        "slope": float(away_N @ contacts.predicted_N / (away_N @ away_N)),
        "indentations_n": len(error_N),
    }


def force_left(early: Readings, late: Readings) -> float | None:
    """Give late force over early force at equal places and depths, in %: what softening leaves.

    None where no place and depth with a known force was met both early and late.
    """
    sides = []
    for one in (early, late):
        stop = np.stack([one.x_mm, one.y_mm, one.depth_mm], axis=1).round(DECIMALS)
        known = ~np.isnan(stop).any(axis=1) & ~np.isnan(one.Fz_N)
        sides.append((stop[known], one.Fz_N[known].astype(float)))
    stops, where = np.unique(np.concatenate([stop for stop, _ in sides]), axis=0, return_inverse=True)
    at = np.split(where.ravel(), [len(sides[0][0])])
    n = [np.bincount(own, minlength=len(stops)) for own in at]
    both = (n[0] > 0) & (n[1] > 0)
    if not both.any():
        return None
    sums_N = [np.bincount(own, force_N, len(stops)) for own, (_, force_N) in zip(at, sides, strict=True)]
    early_N, late_N = (total_N[both] / own_n[both] for total_N, own_n in zip(sums_N, n, strict=True))
    return float(100 * late_N.sum() / early_N.sum())


def late_force(
    answers: Sequence[Answers], policy: str, window_i: int
) -> tuple[dict[str, Any], dict[str, list[float]]] | None:
    """Give the force bias of one window, mean over seeds, that of each network, and the first seed's points to draw.

    None if fewer than two contacts have a known force.
    """
    own = [one for one in answers if (one.policy, one.window_i) == (policy, window_i)]
    seeds = sorted({one.seed_i for one in own})
    contacts = [by_contact([one for one in own if one.seed_i == seed_i]) for seed_i in seeds]
    if len(contacts[0].true_N) < 2:
        return None
    biases = [force_bias(one) for one in contacts]
    # The indentations are the same for every seed, so that their standard error is not less for several.
    means = {name: float(np.mean([one[name] for one in biases])) for name in biases[0]}
    means["indentations_n"] = biases[0]["indentations_n"]
    each_N = [force_bias(by_contact([one]))["bias_N"] for one in own]
    networks = {"network_bias_N": each_N, "network_board": [one.board for one in own]}
    return means | networks, points(contacts[0])


def points(contacts: Contacts) -> dict[str, list[float]]:
    """Give true and predicted forces to draw, to 1 mN; of very many every second, third, ..."""
    every_n = ceil(len(contacts.true_N) / POINTS_MAX_N)
    sides = {"true_N": contacts.true_N, "predicted_N": contacts.predicted_N}
    return {name: np.round(values[::every_n], DECIMALS).tolist() for name, values in sides.items()}


def field_sizes(captures: Sequence[Readings]) -> dict[str, float]:
    """Give, rms over channels, the change that a contact makes, and the noise of a no-load reading.

    The change is against the no-load reading before that contact, whatever policy is tried. Noise is taken from each
    no-load reading to the next, where drift is small.
    """
    changes_uT = [subtract(one.b_uT, one.noload_uT)[~np.isnan(one.x_mm)] for one in captures]
    steps_uT = [np.diff(one.noload_uT[_first_i(one)].astype(float), axis=0) for one in captures]
    pairs_n = sum(len(own) for own in steps_uT)
    noise_uT = rms(np.concatenate(steps_uT)) / float(np.sqrt(2)) if pairs_n else 0.0
    return {"contact_uT": rms(np.concatenate(changes_uT)), "noload_noise_uT": noise_uT}


def pace(captures: Sequence[Readings]) -> dict[str, float]:
    """Give the median time from one indentation to the next, and how long the longest capture lasts.

    Nothing is given where a recording knows no time, or has one indentation.
    """
    timed = [one for one in captures if np.isfinite(one.t_s).all()]
    steps_s = [step_s for one in timed for step_s in np.diff(one.t_s[_first_i(one)])]
    if not steps_s:
        return {}
    return {
        "contact_every_s": float(np.median(steps_s)),
        "lasts_s": max(float(one.t_s[-1] - one.t_s[0]) for one in timed),
    }


def _first_i(readings: Readings) -> Int64[np.ndarray, " n"]:
    """Find the first row of each indentation."""
    return np.unique(rank(readings.indentation), return_index=True)[1]


def rms(values: Float[np.ndarray, "..."]) -> float:
    """Give the root of the mean square."""
    return float(np.sqrt(np.mean(values.astype(float) ** 2)))
