"""A skin over its contacts, by no-load policy (paper section 4, figure 5)."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from math import ceil
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from jaxtyping import Float, Int, Int64, Shaped
from pydantic import Field, model_validator
from scipy.constants import micro

from pipeline.experiments.results import read_folder, read_losses, write_results
from pipeline.report.drawing import COLOURS, MARKERS, drawing, svg
from pipeline.report.formatting import COLUMNS, show, tabulate
from pipeline.report.paper import FIGURE_5
from pipeline.settings import Settings, Training
from pipeline.statistics import (
    BOARDS_MIN,
    FEW_BOARDS,
    INCONCLUSIVE,
    NO,
    VERDICTS,
    YES,
    Stat,
    all_of,
    board_means,
    interval,
    statistic,
    summarise,
    tally,
    verdict,
    with_seeds,
)
from pipeline.training.trainings import SceneData, collapse_record, prepare_training, train_all
from reskin.config import Strict
from reskin.data import baseline
from reskin.data.baseline import rank, subtract
from reskin.data.rows import Selection
from reskin.data.windows import TRAIN, Part, Policy, Windows, check_one_each, lay_parts, lay_windows, stack
from reskin.errors import ParamsError
from reskin.metrics import METRICS, score
from reskin.models.inputs import VIEW
from reskin.models.recipe import HEADLINE
from reskin.models.trial import Trained, Trial
from reskin.numerics import device
from reskin.physics.aging import wandering
from reskin.schema import Readings
from reskin.seeds import rng_for

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


HIGHER_AND_FASTER = (
    '"prediction errors are higher and increase faster when we only make a single no-load measurement at the start"'
)
OFFSET = 'drift "can be offset to a certain extent by more frequent no-load measurements"'
EACH_IS_WORSE = '"errors are also higher when no-load measurements are updated before every contact"'
OVERESTIMATES = (
    '"the model, on average, overestimates the applied force"; "attributed to the softening of the elastomer"'
)

INDENTATION_SES = 2.0  # about 95 % confidence for the many indentations of a window
ERRORS = {"mse_xy_mm2": ("MSE_xy", "mm²"), "mse_f_N2": ("MSE_F", "N²")}  # force last; absent where it is unknown
OTHERWISE = {"regular": "regular ones", "each": "one before every contact"}  # no-load readings
PER_CONTACTS_N = 10_000
Row = Mapping[str, Any]
Found = dict[str, Any]
Networks = Mapping[str, Float[np.ndarray, "u w"]]  # errors by metric; rows: skins and seeds; columns: windows


@dataclass(frozen=True)
class Gap:
    """A mean over networks, positive where it is as the paper says: over boards, and over trainings on these boards."""

    word: str
    unit: str
    boards: Stat
    trainings: list[float] | None  # 95 % interval over networks; None: one network alone has none

    @property
    def verdict(self) -> str:
        """Judge over boards which side of 0 it is on."""
        return verdict(self.boards)

    @property
    def of_trainings(self) -> str:
        """Judge by the interval over all networks: on one board, how much trainings vary; on several, boards too."""
        if self.trainings is None:
            return INCONCLUSIVE
        return verdict({"ci95": self.trainings})

    def __str__(self) -> str:
        ends = self.boards["ci95"] if "ci95" in self.boards else self.trainings
        shown = "" if ends is None else f" [{ends[0]:+.2g}, {ends[1]:+.2g}]"
        return f"{self.boards['mean']:+.2g}{shown} {self.unit}"


def findings(
    rows: Mapping[str, Sequence[Row]],
    networks: Mapping[str, Networks],
    *,
    boards: Sequence[str],
    field: Mapping[str, float],
    late: Row | None,
) -> list[Found]:
    """Test each finding that the policies and the known quantities allow.

    `rows` are the windows of each policy, `networks` the errors of each of its networks there: equal rows of two
    policies are a pair, `boards` their boards. `field` holds rms values over channels in uT: `contact_uT`, the change
    that a contact makes, and `noload_noise_uT`, the noise of one no-load reading.
    """
    frequent = [policy for policy in ("regular", "each") if policy in rows]
    found = []
    pairs = Pairs(networks, boards)
    if "initial" in rows and frequent and len(rows["initial"]) > 1:
        found.append(_higher_and_faster(rows["initial"], pairs, frequent[0], field))
    if "initial" in rows and frequent:
        found.append(_offset(rows["initial"], pairs, frequent[0], field))
    if len(frequent) == 2:
        found.append(_each_is_worse(rows["regular"], pairs, field))
    if late is not None:
        found.append(_overestimates(late))
    return found


@dataclass(frozen=True)
class Pairs:
    """Errors of networks by policy and metric: equal rows of two policies are a pair, on the board of that row."""

    networks: Mapping[str, Networks]
    boards: Sequence[str]

    def gap(self, words: tuple[str, str], own: Float[np.ndarray, " u"], other: Float[np.ndarray, " u"]) -> Gap:
        """Compare values of networks in pairs."""
        return _gap(words, own - other, self.boards)

    @property
    def bars(self) -> str:
        """Say what brackets are."""
        boards_n = len(set(self.boards))
        if boards_n >= BOARDS_MIN:
            return f" ([low, high]: 95 %, Student's t over {boards_n} boards)"
        pairs_n, of = len(self.boards), "one board" if boards_n == 1 else f"{boards_n} boards"
        return f" ([low, high]: 95 %, over {pairs_n} networks of {of})" if pairs_n > 1 else " (one network)"


def rates(contacts_n: Sequence[int], errors: Float[np.ndarray, "u w"]) -> Float[np.ndarray, " u"]:
    """Give each network's least-squares slope of errors against contacts, linear, for 10,000 of them."""
    tens = np.array(contacts_n, float) / PER_CONTACTS_N
    away = tens - tens.mean()
    return errors @ away / (away @ away)


def _higher_and_faster(initial: Sequence[Row], pairs: Pairs, name: str, field: Row) -> Found:
    parts, gaps = [], []
    contacts_n = [row["contacts_n"] for row in initial]
    for metric, (word, unit) in _known(pairs.networks["initial"]).items():
        single, other = pairs.networks["initial"][metric], pairs.networks[name][metric]
        higher = pairs.gap((word, unit), single.mean(axis=1), other.mean(axis=1))
        rate, other_rate = rates(contacts_n, single), rates(contacts_n, other)
        faster = pairs.gap((f"the growth of {word}", unit), rate, other_rate)
        parts.append(
            f"{word} is {single.mean():.3g} against {other.mean():.3g} {unit} with {OTHERWISE[name]}, mean over "
            f"windows (difference {higher}), and changes by {rate.mean():.2g} against {other_rate.mean():.2g} {unit} "
            f"in {PER_CONTACTS_N:,} contacts, linear fit (difference {faster})"
        )
        gaps += [higher, faster]
    measured = "; ".join(parts) + pairs.bars
    return _finding("higher_and_faster", HIGHER_AND_FASTER, gaps, measured, lambda: _off(initial, field))


def _offset(initial: Sequence[Row], pairs: Pairs, name: str, field: Row) -> Found:
    parts, gaps = [], []
    for metric, (word, unit) in _known(pairs.networks["initial"]).items():
        single, more = pairs.networks["initial"][metric], pairs.networks[name][metric]
        gaps.append(pairs.gap((word, unit), single.mean(axis=1), more.mean(axis=1)))
        parts.append(
            f"{word} is {more.mean():.3g} {unit} with {OTHERWISE[name]}, {single.mean():.3g} with a single no-load "
            f"reading (gain {gaps[-1]})"
        )
    measured = "mean over windows: " + "; ".join(parts) + pairs.bars
    return _finding("offset", OFFSET, gaps, measured, lambda: _off(initial, field))


def _each_is_worse(regular: Sequence[Row], pairs: Pairs, field: Row) -> Found:
    parts, gaps = [], []
    for metric, (word, unit) in _known(pairs.networks["each"]).items():
        own, other = pairs.networks["each"][metric], pairs.networks["regular"][metric]
        gaps.append(pairs.gap((word, unit), own.mean(axis=1), other.mean(axis=1)))
        parts.append(
            f"{word} is {own.mean():.3g} against {other.mean():.3g} {unit} with regular ones, mean over windows "
            f"(difference {gaps[-1]})"
        )
    shows = [gap.word for gap in gaps if gap.of_trainings == YES]

    def why() -> str:
        noise_uT = field["noload_noise_uT"]
        off_uT = np.mean([row["noload_off_uT"] for row in regular])
        stale_uT = np.sqrt(max(0.0, off_uT**2 - 2 * noise_uT**2))
        alone = f"It shows in {', '.join(shows)} alone. " if shows else ""
        return (
            f"{alone}A no-load reading has the same noise under both policies, {noise_uT:.2g} µT rms over channels. "
            f"One right before the contact is never stale, a regular one is off by {stale_uT:.2g} µT of drift; a "
            f"contact changes the field by {field['contact_uT']:.3g} µT. The paper suspects overfitting to training "
            "data, and saw later experiments gain from a reading before every contact"
        )

    return _finding("each_is_worse", EACH_IS_WORSE, gaps, "; ".join(parts) + pairs.bars, why)


def _overestimates(late: Row) -> Found:
    """Ask that the bias be clear of both what indentations and what trainings vary by: one network cannot tell."""
    biases_N = np.array(late["network_bias_N"])
    gap = _gap(("the bias", "N"), biases_N, late["network_board"])
    if gap.trainings is not None:
        reach_N = INDENTATION_SES * late["bias_se_N"]
        ends_N = [min(gap.trainings[0], late["bias_N"] - reach_N), max(gap.trainings[1], late["bias_N"] + reach_N)]
        gap = replace(gap, trainings=ends_N)
    measured = (
        f"policy {late['policy']} after {late['contacts_n']:,} contacts: bias {late['bias_N']:+.3g} ± "
        f"{late['bias_se_N']:.2g} N ({late['bias_pct']:+.2g} %), standard error over {late['indentations_n']} "
        f"indentations, mean over {len(biases_N)} network(s); {gap}{Pairs({}, late['network_board']).bars}"
    )
    measured += f"; slope {late['slope']:.3g}"
    left_pct = late.get("force_left_pct")
    if left_pct is not None:
        measured += f"; at equal places and depths the skin gives {left_pct:.4g} % of its early force"

    def why() -> str:
        if left_pct is None:
            return "No depth is known, so it cannot be told whether the skin softened"
        return (
            f"At equal places and depths the skin gives {left_pct:.4g} % of the force of the training contacts, so "
            f"softening explains a bias of {100 - left_pct:+.2g} % of force and no more; what the network adds by "
            f"itself makes it {late['bias_pct']:+.2g} % in all"
        )

    return _finding("overestimates", OVERESTIMATES, [gap], measured, why)


def _gap(words: tuple[str, str], values: Float[np.ndarray, " u"], boards: Sequence[str]) -> Gap:
    """Summarise values of networks, each on its board."""
    word, unit = words
    of_boards = pd.Series(values, dtype=float).groupby(list(boards)).mean()
    return Gap(word, unit, statistic(of_boards, boards=True), interval(values.astype(float)))


def _off(initial: Sequence[Row], field: Row) -> str:
    return (
        f"After {initial[-1]['contacts_n']:,} contacts the single no-load reading is off by "
        f"{initial[-1]['noload_off_uT']:.2g} µT rms, where a contact changes the field by {field['contact_uT']:.3g} µT "
        f"and a no-load reading has a noise of {field['noload_noise_uT']:.2g} µT: no more than that could be mended"
    )


def _known(networks: Networks) -> dict[str, tuple[str, str]]:
    return {metric: words for metric, words in ERRORS.items() if metric in networks}


def _finding(name: str, finding: str, gaps: Sequence[Gap], measured: str, why: Callable[[], str]) -> Found:
    """Judge a finding by all of its parts, over boards; and of trainings, by the networks of these boards alone."""
    judged = all_of([gap.verdict for gap in gaps])
    row = {
        "id": name, "finding": finding, "holds": judged == YES, "verdict": judged,
        "of_trainings": all_of([gap.of_trainings for gap in gaps]),
        "measured": measured[0].upper() + measured[1:] + ".",
    }  # fmt: skip
    return row if judged == YES else row | {"why": f"{_inconclusive(judged, gaps)}{why()}."}


def _inconclusive(judged: str, gaps: Sequence[Gap]) -> str:
    """Say of which parts nothing can be concluded."""
    if judged == NO:
        return ""
    if judged == FEW_BOARDS:
        return f"Not judged: fewer than {BOARDS_MIN} boards say little of others. "
    covered = "; ".join(f"{gap.word}, {gap}" for gap in gaps if gap.verdict == INCONCLUSIVE)
    return f"Undecided: the 95 % interval over boards includes 0 ({covered}). "


Count = Annotated[int, Field(ge=1)]
# No-load reading: once, every so often, before each contact, or whenever a reading is judged free of contact.
PolicyName = Literal["initial", "regular", "each", "free"]


class Drift(Strict):
    """Train on the first of a skin's contacts, test on those after every so many (paper section 4, figure 5)."""

    unit: Literal["indentation", "pass"]  # what the numbers below count
    train_n: Count
    test_n: Count
    every_n: Count
    policies: Annotated[tuple[PolicyName, ...], Field(min_length=1)]
    regular_n: Count | None = None  # indentations from one no-load reading of policy `regular` to its next
    wander_uT: tuple[
        Annotated[float, Field(ge=0, le=1000)], ...
    ] = ()  # added after training, sd a contact; simulated only
    training: Training

    @model_validator(mode="after")
    def _windows_follow_each_other(self) -> "Drift":
        if self.test_n > self.every_n:
            raise ValueError(f"test_n is at most every_n, {self.every_n}, so that windows do not overlap")
        if self.train_n > self.every_n:
            raise ValueError(f"train_n is at most every_n, {self.every_n}, after which the first test follows")
        if ("regular" in self.policies) != (self.regular_n is not None):
            raise ValueError("regular_n stands there if and only if policies holds regular")
        if len(set(self.policies)) < len(self.policies):
            raise ValueError(f"policies names each policy once, not {list(self.policies)}")
        return self


UNIT = {"indentation": "indentation", "pass": "pass_i"}


def cut(captures: Sequence[Readings], section: Drift, selection: Selection) -> tuple[Windows, list[Part]]:
    """Lay the windows that all captures have, and their rows under every policy."""
    check_one_each(captures)
    units = [baseline.rank(getattr(one, UNIT[section.unit])) for one in captures]
    units_n = [1 + int(own.max()) for own in units]
    windows = lay_windows(units_n, train_n=section.train_n, test_n=section.test_n, every_n=section.every_n)
    policies: dict[str, Policy] = {policy: partial(_choose, policy, section) for policy in section.policies}
    laid = lay_parts(list(zip(captures, units, strict=True)), policies, windows=windows, selection=selection)
    return windows, laid


def _choose(policy: PolicyName, section: Drift, readings: Readings) -> np.ndarray:
    fields = readings.noload_uT, readings.indentation
    if policy == "regular":
        assert section.regular_n is not None
        return baseline.regular(*fields, regular_n=section.regular_n)
    if policy == "free":
        trained_on = baseline.rank(getattr(readings, UNIT[section.unit])) < section.train_n
        within_uT = baseline.alike_within_uT(*(of[trained_on] for of in fields))
        return baseline.free(readings.b_uT, *fields, within_uT=within_uT)
    return (baseline.initial if policy == "initial" else baseline.each)(*fields)


def trials(parts: Sequence[Part], section: Drift, seed: int) -> Iterator[tuple[Trial, list[Part]]]:
    """Make a trial of every recipe, skin, policy and seed, beside its test windows."""
    starts = [i for i, part in enumerate(parts) if part.window_i == TRAIN]
    for start, end in pairwise([*starts, len(parts)]):
        train, tests = parts[start], list(parts[start + 1 : end])
        fold, test = f"{train.readings.skin}-{train.policy}", np.concatenate([part.row_i for part in tests])
        for name, recipe in section.training.recipes.items():
            for seed_i in range(section.training.seeds_n):
                yield Trial("drift", name, recipe, fold, seed, seed_i, train.row_i, test), tests


def answers(trial: Trial, trained: Trained, tests: Sequence[Part]) -> Iterator[Answers]:
    """Cut a network's answers into its windows."""
    cuts = np.cumsum([len(part.rows) for part in tests])[:-1]
    for part, predicted in zip(tests, np.split(trained.predicted, cuts), strict=True):
        yield Answers(
            part.policy, part.readings.board, part.readings.skin, trial.seed_i, part.window_i,
            int(part.readings.n_contacts[0]), part.noload_off_uT, part.rows.indentation, part.rows.target, predicted,
        )  # fmt: skip


def force_left_pct(parts: Sequence[Part], policy: str, window_i: int) -> float | None:
    """Give force in a window over that in training, at equal places and depths, mean over skins; None if unknown."""
    own = {(part.readings.skin, part.window_i): part.readings for part in parts if part.policy == policy}
    left = [force_left(own[skin, TRAIN], late) for (skin, i), late in own.items() if i == window_i]
    return None if None in left else float(np.mean([one for one in left if one is not None]))


def read(settings: Settings) -> Drift:
    """Read section drift."""
    return settings.with_training(Drift, "drift")


def drift(settings: Settings, indentations: Path, results: Path) -> None:
    """Train and test under every no-load policy, on every capture of a folder."""
    prepare_training()
    section, selection = read(settings), settings.section(Selection, "selection")
    captures = read_folder(indentations, tuple(settings.captures_in(indentations)))
    windows, parts = cut(captures, section, selection)
    if section.wander_uT and captures[0].source != "simulated":
        rule = "none in a recorded scene: a walk would be added to what was recorded"
        raise ParamsError(settings.where, "drift.wander_uT", rule, list(section.wander_uT), "Take it out.")
    pairs = list(trials(parts, section, settings.seed))
    data = SceneData(settings.scene, settings, stack(parts), [])
    answered: dict[str, list[Answers]] = {}
    trained = train_all(data, [trial for trial, _ in pairs], "drift")
    for (trial, tests), one in zip(pairs, trained, strict=True):
        answered.setdefault(trial.recipe_name, []).extend(answers(trial, one, tests))
    rows: dict[str, dict[str, Any]] = {
        name: {policy: over_windows(own, policy) for policy in section.policies} for name, own in answered.items()
    }
    found, drawn = _tell(section, answered[HEADLINE], rows[HEADLINE], parts, field_sizes(captures))
    counts = {"skins_n": len(captures), "seeds_n": section.training.seeds_n, "dropped": data.rows.dropped}
    words = section.model_dump(mode="json", include={"unit", "train_n", "test_n", "every_n", "regular_n"})
    numbers = {name: value for name, value in words.items() if value is not None} | counts | pace(captures)
    if section.wander_uT:
        numbers["wander"] = _wander(
            section, selection, captures, parts, list(zip(pairs, trained, strict=True)), settings.seed
        )
    variants = {name: own for name, own in rows.items() if name != HEADLINE}
    numbers |= {"left_out_units_n": windows.left_out_units_n} | found | ({"variants": variants} if variants else {})
    write_results(
        results, numbers, drawn, read_losses(indentations, numbers["dropped"]), tally(map(collapse_record, trained))
    )


def _wander(
    section: Drift,
    selection: Selection,
    captures: Sequence[Readings],
    parts: Sequence[Part],
    trained: Sequence[tuple[tuple[Trial, list[Part]], Trained]],
    seed: int,
) -> dict[str, Any]:
    """Test the networks of the headline's recipe again on their last window, of captures that wander further."""
    at = {part.first_row_i: i for i, part in enumerate(parts)}
    last = [(trial, one, at[tests[-1].first_row_i]) for (trial, tests), one in trained if trial.recipe_name == HEADLINE]
    trained_on = baseline.rank(getattr(captures[0], UNIT[section.unit])) < section.train_n
    after_n = 1 + int(baseline.rank(captures[0].indentation)[trained_on].max())

    def parts_at(step_uT: float) -> list[Part]:
        return cut([walked(one, step_uT, after_n=after_n, seed=seed) for one in captures], section, selection)[1]

    return over_steps(last, section.wander_uT, parts_at)


def _tell(
    section: Drift, answered: Sequence[Answers], rows: dict[str, Any], parts: Sequence[Part], field: dict[str, float]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Put the windows together with late forces and findings; the paper does not say of which policy figure 5b is."""
    policy = "regular" if "regular" in rows else section.policies[0]
    window_i = late_window(rows[policy])
    numbers, drawn, late = rows | {"field": field}, {}, late_force(answered, policy, window_i)
    if late is not None:
        left_pct = force_left_pct(parts, policy, window_i)
        where = {"policy": policy, "contacts_n": rows[policy][window_i]["contacts_n"]}
        numbers["late"] = where | late[0] | ({} if left_pct is None else {"force_left_pct": left_pct})
        drawn = {"late": late[1]}
    networks: dict[str, Any] = {name: of_networks(answered, name) for name in section.policies}
    boards = boards_of(answered, policy)
    found = findings(rows, networks, boards=boards, field=field, late=numbers.get("late"))
    last = {name: last_window(answered, name) for name in section.policies}
    return numbers | {"findings": found, "last_window": last}, drawn


POLICIES = ("initial", "regular", "each", "free")
WALKED = (
    "The networks of figure 5a on their last window again, of captures to which a random walk was added: one normal "
    "step a contact and channel, from the end of training on, in contact and no-load readings alike. The first row is "
    "that of figure 5a. How far fields at rest really go is in the table of skins: rms change over 1 to 1,000 contacts."
)
MARGIN = 0.05  # of the largest force
JUDGED = (
    f"{VERDICTS} A finding of several parts: no, if one part is no; yes, if all are. Of these trainings: judged in the "
    "same words by the 95 % interval over pairs of networks (policies trained from the same seed on the same skin), "
    "each network's value the mean over its windows; for the bias of the force also by two standard errors over "
    "indentations. Several trainings on one skin say how much trainings vary, not how much boards do."
)


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Make a table of scores against contacts, and one of the paper's findings."""
    named, error = _policies(numbers), _error(numbers)
    lines = []
    for i, first in enumerate(next(iter(named.values()))[1]):
        line = {"contacts": f"{first['contacts_n']:,}", "source": source}
        for words, rows in named.values():
            for metric in ("accuracy_pct", error):
                line[f"{COLUMNS[metric]} ({words})"] = show(_stat(rows[i], metric))
        lines.append(line)
    spread = _spread(numbers)
    found = [
        {
            "finding (paper)": one["finding"], "holds": one["verdict"], **_of_trainings(one),
            "measured": one["measured"], "why not": one.get("why", "–"), "source": source,
        }
        for one in numbers["findings"]
    ]  # fmt: skip
    shown = {
        "drift": tabulate(lines, meaning=f"{_protocol(numbers)} {say_pace(numbers, source)} {FIGURE_5}", spread=spread),
        "drift_findings": tabulate(found, meaning=JUDGED),
    }
    return shown | ({"drift_wander": _wander_table(numbers, source)} if "wander" in numbers else {})


def _wander_table(numbers: Mapping[str, Any], source: str) -> pd.DataFrame:
    named = _policies(numbers)
    lines = []
    for i, step_uT in enumerate(row["step_uT"] for row in next(iter(numbers["wander"].values()))):
        line = {"further walk, µT a contact": f"{step_uT:g}", "source": source}
        for policy, (words, _) in named.items():
            row = numbers["wander"][policy][i]
            line[f"no-load reading off by, µT ({words})"] = f"{row['noload_off_uT']:.3g}"
            line |= {f"{COLUMNS[name]} ({words})": show(_stat(row, name)) for name in ("accuracy_pct", _error(numbers))}
        lines.append(line)
    return tabulate(lines, meaning=WALKED, spread=_spread(numbers))


def _spread(numbers: Mapping[str, Any]) -> str:
    """Say over what ± is, which all rows of all policies share."""
    [(_, rows), *_] = _policies(numbers).values()
    seeds_n, skins_n = numbers["seeds_n"], numbers["skins_n"]
    if not rows[0]["spread"]:
        return "One network each."
    if skins_n == 1:
        return f"± is the sd over {seeds_n} network seeds, all tested on the same contacts."
    return f"± is the sd over {skins_n} skins with {seeds_n} network seeds each."


def _legend(numbers: Mapping[str, Any]) -> str:
    """Say what the lines of a figure differ in, and what their bars are."""
    spread = _spread(numbers)
    return (
        f"no-load reading; {spread.removesuffix('.').replace('± is', 'bars:')}" if "±" in spread else "no-load reading"
    )


def _of_trainings(one: Mapping[str, Any]) -> dict[str, str]:
    return {"of these trainings": one["of_trainings"]} if "of_trainings" in one else {}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw scores against contacts (figure 5a), and where force is known predicted against true force (figure 5b)."""
    texts = {"drift.svg": _scores(numbers, source)}
    texts |= {"drift_wander.svg": _wander_figure(numbers, source)} if "wander" in numbers else {}
    return texts | ({"drift_force.svg": _forces(numbers["late"], drawn["late"], source)} if "late" in numbers else {})


def say_pace(numbers: Mapping[str, Any], source: str) -> str:
    """Say how fast contacts follow each other by the capture's own clock, and what that does to a simulated one."""
    if "lasts_s" not in numbers:
        return "When the contacts were is not known."
    every = f"A contact follows the one before after {numbers['contact_every_s']:.3g} s (median)"
    said = f"{every}; the whole capture lasts {numbers['lasts_s']:,.0f} s."
    if source != "simulated":
        return said
    return f"{said} A real rig takes seconds a contact: temperature wanders here over many more contacts than there."


def _scores(numbers: Mapping[str, Any], source: str) -> str:
    with drawing(7.6, 4.0) as figure:
        error = _error(numbers)
        for axes, metric in zip(figure.subplots(1, 2), ("accuracy_pct", error), strict=True):
            for policy, (words, rows) in _policies(numbers).items():
                i = POLICIES.index(policy)
                contacts_n, values = ([row[name] for row in rows] for name in ("contacts_n", metric))
                bars = [row["spread"].get(metric, 0.0) for row in rows] if rows[0]["spread"] else None
                look = {"color": COLOURS[i], "marker": MARKERS[i], "markersize": 5, "linewidth": 1.2, "capsize": 2}
                axes.errorbar(contacts_n, values, bars, label=words, **look)
            axes.set(xlabel="contacts the skin has felt", ylabel=COLUMNS[metric].replace(", ", " / "))
            axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}k" if value else "0")
            axes.set_xlim(left=0)
            axes.grid(alpha=0.25)
        axes.set_yscale("log")
        figure.axes[0].set_ylim(0, 102)
        names = figure.axes[0].get_legend_handles_labels()
        figure.legend(*names, loc="outside lower center", ncols=3, frameon=False, title=_legend(numbers))
        figure.suptitle(f"Trained on first contacts, tested on later ones ({source})", x=0.01, ha="left", fontsize=11)
        return svg(figure)


def _wander_figure(numbers: Mapping[str, Any], source: str) -> str:
    with drawing(7.6, 4.0) as figure:
        error = _error(numbers)
        for axes, metric in zip(figure.subplots(1, 2), ("accuracy_pct", error), strict=True):
            for policy, (words, _) in _policies(numbers).items():
                i, rows = POLICIES.index(policy), numbers["wander"][policy]
                steps_uT = [row["step_uT"] for row in rows]
                bars = [row["spread"].get(metric, 0.0) for row in rows] if rows[0]["spread"] else None
                look = {"color": COLOURS[i], "marker": MARKERS[i], "markersize": 5, "linewidth": 1.2, "capsize": 2}
                axes.errorbar(steps_uT, [row[metric] for row in rows], bars, label=words, **look)
            least_uT = min((step for step in steps_uT if step > 0), default=1.0)
            axes.set_xscale("symlog", linthresh=least_uT)
            axes.set(xlabel="further random walk / µT a contact", ylabel=COLUMNS[metric].replace(", ", " / "))
            axes.set_xlim(left=0)
            axes.grid(alpha=0.25)
        axes.set_yscale("log")
        figure.axes[0].set_ylim(0, 102)
        names = figure.axes[0].get_legend_handles_labels()
        figure.legend(*names, loc="outside lower center", ncols=3, frameon=False, title=_legend(numbers))
        last_n = next(iter(_policies(numbers).values()))[1][-1]["contacts_n"]
        title = f"After {last_n:,} contacts, if the field at rest wandered more ({source})"
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        return svg(figure)


def _forces(late: Mapping[str, Any], points: Mapping[str, Sequence[float]], source: str) -> str:
    with drawing(5.2, 5.0) as figure:
        axes = figure.subplots()
        ends = min(0.0, *points["true_N"], *points["predicted_N"]), max(*points["true_N"], *points["predicted_N"])
        room = MARGIN * (ends[1] - ends[0])
        limits = (ends[0] - room, ends[1] + room)
        axes.plot(limits, limits, color="0.5", linewidth=1, linestyle="--", label="predicted = true")
        axes.scatter(points["true_N"], points["predicted_N"], s=9, color=COLOURS[1], alpha=0.5, linewidths=0)
        axes.set(xlabel="true force / N", ylabel="predicted force / N", xlim=limits, ylim=limits, aspect="equal")
        said = (
            f"bias {late['bias_N']:+.3g} ± {late['bias_se_N']:.1g} N ({late['bias_pct']:+.2g} %)\n"
            f"slope {late['slope']:.3g}, {late['indentations_n']:,} indentations\n"
            f"no-load reading: policy {late['policy']}\n"
            f"means over {len(late['network_bias_N'])} network(s)\n"
            "points: first seed"
        )
        axes.text(0.03, 0.97, said, transform=axes.transAxes, va="top", fontsize=10)
        axes.legend(loc="lower right", frameon=False)
        axes.grid(alpha=0.25)
        figure.suptitle(f"Force after {late['contacts_n']:,} contacts ({source})", x=0.01, ha="left", fontsize=11)
        return svg(figure)


def _policies(numbers: Mapping[str, Any]) -> dict[str, tuple[str, Sequence[Mapping[str, Any]]]]:
    """Name the policies that were tried in words, each with its rows."""
    words = {
        "initial": "once at the start",
        "regular": f"every {numbers.get('regular_n')} indentations",
        "each": "before every contact",
        "free": "whenever judged free of contact",
    }
    return {policy: (words[policy], numbers[policy]) for policy in POLICIES if policy in numbers}


def _error(numbers: Mapping[str, Any]) -> str:
    """Choose what is shown beside accuracy: places where no force is known."""
    [(_, rows), *_] = _policies(numbers).values()
    return "mse_f_N2" if "mse_f_N2" in rows[0] else "mse_xy_mm2"


def _stat(row: Mapping[str, Any], metric: str) -> dict[str, float]:
    return {"mean": row[metric]} | ({"sd": row["spread"][metric]} if metric in row["spread"] else {})


def _protocol(numbers: Mapping[str, Any]) -> str:
    train, test, every, left = (
        _count(numbers[name], numbers["unit"]) for name in ("train_n", "test_n", "every_n", "left_out_units_n")
    )
    said = (
        f"Trained on the first {train} of each skin, tested on {test} after every {every}; each policy of "
        "the no-load reading has networks of its own. Contacts: what the skin had felt before the test."
    )
    return said + (f" The last {left} fill no whole test, and are left out." if numbers["left_out_units_n"] else "")


def _count(n: int, unit: str) -> str:
    several = {"indentation": "indentations", "pass": "passes"}[unit]
    return f"{n:,} {unit if n == 1 else several}"
