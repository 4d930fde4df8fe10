"""What the paper found about drift (section 4), and whether it shows here. In: numbers of a run. Out: sentences.

Every number in a sentence is one of the run's. Refuses to know networks, captures and pages.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from pipeline.report.statistics import (  # fmt: skip
    BOARDS_MIN,
    FEW_BOARDS,
    INCONCLUSIVE,
    NO,
    YES,
    Stat,
    all_of,
    interval,
    statistic,
    verdict,
)

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
