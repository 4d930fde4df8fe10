"""What the paper found about drift (section 4), and whether it shows here. In: numbers of a run. Out: sentences.

Every number in a sentence is one of the run's. Refuses to know networks, captures and pages.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

HIGHER_AND_FASTER = (
    '"prediction errors are higher and increase faster when we only make a single no-load measurement at the start"'
)
OFFSET = 'drift "can be offset to a certain extent by more frequent no-load measurements"'
EACH_IS_WORSE = '"errors are also higher when no-load measurements are updated before every contact"'
OVERESTIMATES = (
    '"the model, on average, overestimates the applied force"; "attributed to the softening of the elastomer"'
)

ERRORS = {"mse_xy_mm2": ("MSE_xy", "mm²"), "mse_f_N2": ("MSE_F", "N²")}  # force last; absent where it is unknown
OTHERWISE = {"regular": "regular ones", "each": "one before every contact"}  # no-load readings
PER_CONTACTS_N = 10_000
Row = Mapping[str, Any]


def findings(rows: Mapping[str, Sequence[Row]], field: Mapping[str, float], late: Row | None) -> list[dict[str, Any]]:
    """Test each finding that the policies and the known quantities allow.

    `rows` are the windows of each policy; `field` holds rms values over channels in uT: `contact_uT`, the change that a
    contact makes, and `noload_noise_uT`, the noise of one no-load reading.
    """
    frequent = [policy for policy in ("regular", "each") if policy in rows]
    found = []
    if "initial" in rows and frequent and len(rows["initial"]) > 1:
        found.append(_higher_and_faster(rows["initial"], rows[frequent[0]], frequent[0], field))
    if "initial" in rows and frequent:
        found.append(_offset(rows["initial"], rows[frequent[0]], frequent[0], field))
    if len(frequent) == 2:
        found.append(_each_is_worse(rows, field))
    if late is not None:
        found.append(_overestimates(late))
    return found


def rate(rows: Sequence[Row], metric: str) -> float:
    """Give the least-squares slope of an error against contacts, linear, for 10,000 of them."""
    contacts_n = np.array([row["contacts_n"] for row in rows], float) / PER_CONTACTS_N
    away = contacts_n - contacts_n.mean()
    return float(away @ np.array([row[metric] for row in rows]) / (away @ away))


def mean(rows: Sequence[Row], metric: str) -> float:
    """Give the mean of an error over the windows."""
    return float(np.mean([row[metric] for row in rows]))


def _higher_and_faster(initial: Sequence[Row], other: Sequence[Row], name: str, field: Row) -> dict[str, Any]:
    parts, holds = [], True
    for metric, (word, unit) in _known(initial).items():
        high, fast = ([measure(rows, metric) for rows in (initial, other)] for measure in (mean, rate))
        holds &= high[0] > high[1] and fast[0] > fast[1]
        parts.append(
            f"{word} is {high[0]:.3g} against {high[1]:.3g} {unit} with {OTHERWISE[name]}, mean over windows, "
            f"and changes by {fast[0]:.2g} against {fast[1]:.2g} {unit} in {PER_CONTACTS_N:,} contacts (linear fit)"
        )
    return _finding(HIGHER_AND_FASTER, holds, "; ".join(parts), lambda: _off(initial, field))


def _offset(initial: Sequence[Row], other: Sequence[Row], name: str, field: Row) -> dict[str, Any]:
    parts, holds = [], True
    for metric, (word, unit) in _known(initial).items():
        single, more = initial[-1][metric], other[-1][metric]
        holds &= more < single
        parts.append(f"{word} is {more:.3g} {unit} with {OTHERWISE[name]}, {single:.3g} with a single no-load reading")
    measured = f"after {initial[-1]['contacts_n']:,} contacts " + "; ".join(parts)
    return _finding(OFFSET, holds, measured, lambda: _off(initial, field))


def _each_is_worse(rows: Mapping[str, Sequence[Row]], field: Row) -> dict[str, Any]:
    parts, shows = [], list[str]()
    for metric, (word, unit) in _known(rows["each"]).items():
        own, regular = mean(rows["each"], metric), mean(rows["regular"], metric)
        more = np.array([one[metric] - other[metric] for one, other in zip(rows["each"], rows["regular"], strict=True)])
        shows += [word] if own > regular else []
        parts.append(
            f"{word} is {own:.3g} against {regular:.3g} {unit} with regular ones, mean over windows{_se(more)}"
        )

    def why() -> str:
        noise_uT = field["noload_noise_uT"]
        stale_uT = np.sqrt(max(0.0, mean(rows["regular"], "noload_off_uT") ** 2 - 2 * noise_uT**2))
        alone = f"It shows in {', '.join(shows)} alone. " if shows else ""
        return (
            f"{alone}A no-load reading has the same noise under both policies, {noise_uT:.2g} µT rms over channels. "
            f"One right before the contact is never stale, a regular one is off by {stale_uT:.2g} µT of drift; a "
            f"contact changes the field by {field['contact_uT']:.3g} µT. The paper suspects overfitting to training "
            "data, and saw later experiments gain from a reading before every contact"
        )

    return _finding(EACH_IS_WORSE, len(shows) == len(parts), "; ".join(parts), why)


def _se(differences: Float[np.ndarray, " w"]) -> str:
    """Say a mean difference with its standard error over windows, if there are several."""
    if len(differences) < 2:
        return ""
    se = differences.std(ddof=1) / np.sqrt(len(differences))
    return f" (difference {differences.mean():+.2g}, standard error over windows {se:.1g})"


def _overestimates(late: Row) -> dict[str, Any]:
    measured = (
        f"policy {late['policy']} after {late['contacts_n']:,} contacts: bias {late['bias_N']:+.3g} ± "
        f"{late['bias_se_N']:.2g} N ({late['bias_pct']:+.2g} %), standard error over {late['indentations_n']} "
        f"indentations; slope {late['slope']:.3g}"
    )
    if "force_left_pct" in late:
        measured += f"; at equal places and depths the skin gives {late['force_left_pct']:.4g} % of its early force"

    def why() -> str:
        if "force_left_pct" not in late:
            return "No depth is known, so it cannot be told whether the skin softened"
        return (
            f"At equal places and depths the skin gives {late['force_left_pct']:.4g} % of the force of the training "
            f"contacts, so softening explains a bias of {100 - late['force_left_pct']:+.2g} % of force and no more; "
            f"what the network adds by itself, {late['bias_pct']:+.2g} % in all, outweighs it"
        )

    return _finding(OVERESTIMATES, late["bias_N"] > 0, measured, why)


def _off(initial: Sequence[Row], field: Row) -> str:
    return (
        f"After {initial[-1]['contacts_n']:,} contacts the single no-load reading is off by "
        f"{initial[-1]['noload_off_uT']:.2g} µT rms, where a contact changes the field by {field['contact_uT']:.3g} µT "
        f"and a no-load reading has a noise of {field['noload_noise_uT']:.2g} µT: no more than that could be mended"
    )


def _known(rows: Sequence[Row]) -> dict[str, tuple[str, str]]:
    return {metric: words for metric, words in ERRORS.items() if metric in rows[0]}


def _finding(finding: str, holds: bool, measured: str, why: Callable[[], str]) -> dict[str, Any]:
    row = {"finding": finding, "holds": bool(holds), "measured": measured[0].upper() + measured[1:] + "."}
    return row if holds else row | {"why": f"{why()}."}
