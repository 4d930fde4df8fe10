"""What the paper found about drift (section 4), and whether it shows here. In: numbers of a run. Out: sentences.

Every number in a sentence is one of the run's. Refuses to know networks, captures and pages.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.stats import t

HIGHER_AND_FASTER = (
    '"prediction errors are higher and increase faster when we only make a single no-load measurement at the start"'
)
OFFSET = 'drift "can be offset to a certain extent by more frequent no-load measurements"'
EACH_IS_WORSE = '"errors are also higher when no-load measurements are updated before every contact"'
OVERESTIMATES = (
    '"the model, on average, overestimates the applied force"; "attributed to the softening of the elastomer"'
)

YES, NO, UNTOLD = "yes", "no", "not told apart"
CONFIDENCE = 0.95  # convention
INDENTATION_SES = 2.0  # about that confidence for the many indentations of a window
ERRORS = {"mse_xy_mm2": ("MSE_xy", "mm²"), "mse_f_N2": ("MSE_F", "N²")}  # force last; absent where it is unknown
OTHERWISE = {"regular": "regular ones", "each": "one before every contact"}  # no-load readings
PER_CONTACTS_N = 10_000
Row = Mapping[str, Any]
Found = dict[str, Any]
Networks = Mapping[str, Float[np.ndarray, "u w"]]  # errors by metric; rows: skins and seeds; columns: windows


@dataclass(frozen=True)
class Gap:
    """A mean over networks, positive where it is as the paper says, and its error bar."""

    word: str
    unit: str
    mean: float
    reach: float | None  # half an error bar; None: one network alone has none

    @property
    def verdict(self) -> str:
        """Tell which side of 0 it is on, if its error bar leaves 0 out."""
        if self.reach is None or abs(self.mean) <= self.reach:
            return UNTOLD
        return YES if self.mean > 0 else NO

    def __str__(self) -> str:
        return f"{self.mean:+.2g}" + ("" if self.reach is None else f" ± {self.reach:.2g}") + f" {self.unit}"


def findings(
    rows: Mapping[str, Sequence[Row]], networks: Mapping[str, Networks], *, field: Mapping[str, float], late: Row | None
) -> list[Found]:
    """Test each finding that the policies and the known quantities allow.

    `rows` are the windows of each policy, `networks` the errors of each of its networks there: equal rows of two
    policies are a pair. `field` holds rms values over channels in uT: `contact_uT`, the change that a contact makes,
    and `noload_noise_uT`, the noise of one no-load reading.
    """
    frequent = [policy for policy in ("regular", "each") if policy in rows]
    found = []
    if "initial" in rows and frequent and len(rows["initial"]) > 1:
        found.append(_higher_and_faster(rows["initial"], networks, frequent[0], field))
    if "initial" in rows and frequent:
        found.append(_offset(rows["initial"], networks, frequent[0], field))
    if len(frequent) == 2:
        found.append(_each_is_worse(rows["regular"], networks, field))
    if late is not None:
        found.append(_overestimates(late))
    return found


def reach_of(values: Float[np.ndarray, " u"]) -> float | None:
    """Give half the 95 % interval of a mean over networks, by Student's t; None for one network."""
    if len(values) < 2:
        return None
    return float(t.ppf((1 + CONFIDENCE) / 2, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)))


def rates(contacts_n: Sequence[int], errors: Float[np.ndarray, "u w"]) -> Float[np.ndarray, " u"]:
    """Give each network's least-squares slope of errors against contacts, linear, for 10,000 of them."""
    tens = np.array(contacts_n, float) / PER_CONTACTS_N
    away = tens - tens.mean()
    return errors @ away / (away @ away)


def _higher_and_faster(initial: Sequence[Row], networks: Mapping[str, Networks], name: str, field: Row) -> Found:
    parts, gaps = [], []
    contacts_n = [row["contacts_n"] for row in initial]
    for metric, (word, unit) in _known(networks["initial"]).items():
        single, other = networks["initial"][metric], networks[name][metric]
        higher = _gap(word, unit, single.mean(axis=1), other.mean(axis=1))
        rate, other_rate = rates(contacts_n, single), rates(contacts_n, other)
        faster = _gap(f"the growth of {word}", unit, rate, other_rate)
        parts.append(
            f"{word} is {single.mean():.3g} against {other.mean():.3g} {unit} with {OTHERWISE[name]}, mean over "
            f"windows (difference {higher}), and changes by {rate.mean():.2g} against {other_rate.mean():.2g} {unit} "
            f"in {PER_CONTACTS_N:,} contacts, linear fit (difference {faster})"
        )
        gaps += [higher, faster]
    measured = "; ".join(parts) + _bars(single)
    return _finding(HIGHER_AND_FASTER, gaps, measured, lambda: _off(initial, field))


def _offset(initial: Sequence[Row], networks: Mapping[str, Networks], name: str, field: Row) -> Found:
    parts, gaps = [], []
    for metric, (word, unit) in _known(networks["initial"]).items():
        single, more = networks["initial"][metric], networks[name][metric]
        gaps.append(_gap(word, unit, single.mean(axis=1), more.mean(axis=1)))
        parts.append(
            f"{word} is {more.mean():.3g} {unit} with {OTHERWISE[name]}, {single.mean():.3g} with a single no-load "
            f"reading (gain {gaps[-1]})"
        )
    measured = "mean over windows: " + "; ".join(parts) + _bars(single)
    return _finding(OFFSET, gaps, measured, lambda: _off(initial, field))


def _each_is_worse(regular: Sequence[Row], networks: Mapping[str, Networks], field: Row) -> Found:
    parts, gaps = [], []
    for metric, (word, unit) in _known(networks["each"]).items():
        own, other = networks["each"][metric], networks["regular"][metric]
        gaps.append(_gap(word, unit, own.mean(axis=1), other.mean(axis=1)))
        parts.append(
            f"{word} is {own.mean():.3g} against {other.mean():.3g} {unit} with regular ones, mean over windows "
            f"(difference {gaps[-1]})"
        )
    shows = [gap.word for gap in gaps if gap.verdict == YES]

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

    return _finding(EACH_IS_WORSE, gaps, "; ".join(parts) + _bars(own), why)


def _overestimates(late: Row) -> Found:
    """Ask that the bias be clear of both what indentations and what trainings vary by: one network cannot tell."""
    biases_N = np.array(late["network_bias_N"])
    among_N = reach_of(biases_N)
    reach_N = None if among_N is None else max(INDENTATION_SES * late["bias_se_N"], among_N)
    measured = (
        f"policy {late['policy']} after {late['contacts_n']:,} contacts: bias {late['bias_N']:+.3g} ± "
        f"{late['bias_se_N']:.2g} N ({late['bias_pct']:+.2g} %), standard error over {late['indentations_n']} "
        f"indentations of the mean over {len(biases_N)} network(s)"
    )
    measured += "" if among_N is None else f"; ± {among_N:.2g} N from network to network (95 %, Student's t)"
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

    return _finding(OVERESTIMATES, [Gap("the bias", "N", late["bias_N"], reach_N)], measured, why)


def _gap(word: str, unit: str, own: Float[np.ndarray, " u"], other: Float[np.ndarray, " u"]) -> Gap:
    return Gap(word, unit, float((own - other).mean()), reach_of(own - other))


def _bars(errors: Float[np.ndarray, "u w"]) -> str:
    pairs_n = len(errors)
    return f" (±: 95 %, Student's t over {pairs_n} pairs of networks)" if pairs_n > 1 else " (one network each)"


def _off(initial: Sequence[Row], field: Row) -> str:
    return (
        f"After {initial[-1]['contacts_n']:,} contacts the single no-load reading is off by "
        f"{initial[-1]['noload_off_uT']:.2g} µT rms, where a contact changes the field by {field['contact_uT']:.3g} µT "
        f"and a no-load reading has a noise of {field['noload_noise_uT']:.2g} µT: no more than that could be mended"
    )


def _known(networks: Networks) -> dict[str, tuple[str, str]]:
    return {metric: words for metric, words in ERRORS.items() if metric in networks}


def _finding(finding: str, gaps: Sequence[Gap], measured: str, why: Callable[[], str]) -> Found:
    """Say yes if every gap is clear of 0 on the paper's side, no if one is clear on the other, else not told apart."""
    told = {gap.verdict for gap in gaps}
    verdict = NO if NO in told else UNTOLD if UNTOLD in told else YES
    row = {
        "finding": finding, "holds": verdict == YES, "verdict": verdict,
        "measured": measured[0].upper() + measured[1:] + ".",
    }  # fmt: skip
    return row if verdict == YES else row | {"why": f"{_untold(gaps) if verdict == UNTOLD else ''}{why()}."}


def _untold(gaps: Sequence[Gap]) -> str:
    if any(gap.reach is None for gap in gaps):
        return "Not told apart: one network each, and another training might answer otherwise. "
    covered = "; ".join(f"{gap.word}, {gap}" for gap in gaps if gap.verdict == UNTOLD)
    return f"Not told apart: the error bar covers 0 ({covered}). "
