"""The smallest weight difference that readings resolve (paper section 6)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Float32, Float64
from scipy.special import ndtr, ndtri

from pipeline import paper
from pipeline.experiments.results import group_by_level, only, read_captures, read_losses, write_results
from pipeline.plot import COLOURS, drawing, svg
from pipeline.settings import Settings
from pipeline.simulation import load_protocol
from pipeline.stage import say
from reskin.simulation.protocols import load_steps_N

# A weight difference is resolved if, in at least this fraction of pairs of readings, the reading under the larger
# weight has the larger response.
RESOLVED_SHARE = 0.95
WATER_N_PER_ML = 9.81e-3  # weight of 1 mL (1 g) of water at 9.81 m/s^2


def analyse_levels(
    db_uT: Float32[np.ndarray, "n p r ch"], weight_N: Float64[np.ndarray, " p"]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Analyse readings under weights that increase in equal steps; return the numbers, and the data for the figures."""
    fitted, held_out = np.split(db_uT.astype(np.float64), [len(db_uT) // 2])
    along_uT = held_out @ direction(fitted)
    response_uT, step_N = along_uT.mean(axis=(0, 2)), float(weight_N[1] - weight_N[0])
    by_direction = {
        "one_reading": ordered_share(along_uT),
        "five_readings": ordered_share(along_uT.mean(axis=2, keepdims=True)),
    }
    by_length = {
        "one_reading": ordered_share(np.linalg.norm(held_out, axis=3)),
        "five_readings": ordered_share(np.linalg.norm(held_out.mean(axis=2, keepdims=True), axis=3)),
    }
    steps_N = _known({name: smallest_step_N(share, step_N) for name, share in by_direction.items()})
    numbers = {
        "levels_n": len(weight_N),
        "fillings_n": len(db_uT),
        "step_N": step_N,
        "told_pct": 100 * RESOLVED_SHARE,
        "range_N": float(weight_N[-1]),
        "smallest_step_N": steps_N,
        "smallest_step_mL": {name: value_N / WATER_N_PER_ML for name, value_N in steps_N.items()},
        "by_length_N": _known({name: smallest_step_N(share, step_N) for name, share in by_length.items()}),
        "monotonic": monotonic(along_uT.mean(axis=2), weight_N),
        "noise_uT": float(np.sqrt(along_uT.var(axis=2, ddof=1).mean())),
        "gain_uT_per_N": float(np.polyfit(weight_N, response_uT, 1)[0]),
    }
    plot_data: dict[str, Any] = {
        "weight_N": np.round(weight_N, 4).tolist(),
        "response_uT": np.round(response_uT, 2).tolist(),
        "sd_uT": np.round(along_uT.std(axis=(0, 2), ddof=1), 2).tolist(),
    }
    plot_data["by_direction"] = {name: np.round(share, 4).tolist() for name, share in by_direction.items()}
    return numbers, plot_data


def _known(steps_N: dict[str, float | None]) -> dict[str, float]:
    return {name: value_N for name, value_N in steps_N.items() if value_N is not None}


def direction(db_uT: Float64[np.ndarray, "n p r ch"]) -> Float64[np.ndarray, " ch"]:
    """Return the unit vector in the direction of the mean dB."""
    mean_uT = db_uT.mean(axis=(0, 1, 2))
    return mean_uT / np.linalg.norm(mean_uT)


def ordered_share(response_uT: Float64[np.ndarray, "n p r"]) -> Float64[np.ndarray, " d"]:
    """Return the fraction of correctly ordered pairs of readings, for weight differences of 1 step, 2 steps, ...

    A pair is correctly ordered if the reading under the larger weight has the larger response; equal responses count
    half. Both readings of a pair are of the same filling of the glass, and therefore have the same no-load reading.
    """
    levels_n = response_uT.shape[1]
    shares = []
    for steps_n in range(1, levels_n):
        heavier, lighter = response_uT[:, steps_n:, :, None], response_uT[:, :-steps_n, None, :]
        shares.append(float((heavier > lighter).mean() + 0.5 * (heavier == lighter).mean()))
    return np.array(shares)


def smallest_step_N(share: Float[np.ndarray, " d"], step_N: float) -> float | None:
    """Return the smallest weight difference at and above which all differences are resolved.

    `share` is the fraction of correctly ordered pairs by difference (see `ordered_share`). Returns None if even the
    largest difference is not resolved.
    """
    unresolved_i = np.flatnonzero(share < RESOLVED_SHARE)  # index 0 is a difference of one step
    last_i = int(unresolved_i.max(initial=-1))
    return None if last_i == len(share) - 1 else step_N * (last_i + 2)


def monotonic(response_uT: Float64[np.ndarray, "n p"], weight_N: Float64[np.ndarray, " p"]) -> dict[str, Any]:
    """Test whether the mean response over fillings increases from every weight to the weight that is `step_N` larger.

    `step_N` is the smallest multiple of the step between weights at which the mean rise exceeds the noise of one
    filling in 95 % of cases. With smaller steps, noise alone would make the response fall. `step_N` is computed from
    noise and gain rather than from the observed responses, because an observed fall would otherwise increase `step_N`
    until the fall disappears. If no step is large enough, the result has no `step_N`.
    """
    mean_uT, rise_uT = response_uT.mean(axis=0), np.diff(response_uT, axis=1)
    # `noise_uT` is the noise of the rise between two weights in one filling.
    noise_uT = float(np.sqrt(rise_uT.var(axis=0, ddof=1).mean())) if len(rise_uT) > 1 else np.nan
    gain_uT = float(np.polyfit(np.arange(len(mean_uT)), mean_uT, 1)[0])  # mean rise per step between weights
    result: dict[str, Any] = {
        "holds": False,
        "falls_n": 0,
        "pairs_n": 0,
        "spearman": float(np.corrcoef(weight_N, pd.Series(mean_uT).rank())[0, 1]),
        "neighbours": {"falls_n": int((np.diff(mean_uT) <= 0).sum())},
    }
    needed = ndtri(RESOLVED_SHARE) * noise_uT / gain_uT if gain_uT > 0 else np.inf
    if needed <= len(mean_uT) - 1:
        steps_n = max(int(np.ceil(needed)), 1)
        falls_n, pairs_n = int((mean_uT[steps_n:] <= mean_uT[:-steps_n]).sum()), len(mean_uT) - steps_n
        step_N = steps_n * float(weight_N[1] - weight_N[0])
        result |= {"holds": falls_n == 0, "falls_n": falls_n, "pairs_n": pairs_n, "step_N": step_N}
    if noise_uT > 0:  # number of falls that noise causes in a linear response, from the standard error of the mean
        z = -gain_uT / (noise_uT / np.sqrt(len(rise_uT)))
        result["neighbours"]["expected_falls_n"] = float(rise_uT.shape[1] * ndtr(z))
    return result


def sensitivity(settings: Settings, indentations: Path, results: Path) -> None:
    """Find the smallest weight difference that readings of the loaded skin resolve."""
    load = load_protocol(settings, "glass")
    capture = only(read_captures(indentations), indentations)
    weight_N = load_steps_N(load.force_max_N, load.step_N)
    change_uT = capture.db_uT
    levels_uT = group_by_level(
        change_uT, capture.indentation, capture.Fz_N, levels_n=len(weight_N), where=capture.capture
    )
    numbers, plot_data = analyse_levels(levels_uT, weight_N)
    write_results(results, numbers, plot_data, read_losses(indentations, {}))
    resolved = ", ".join(f"{step_N:.3g} N ({READINGS[name]})" for name, step_N in numbers["smallest_step_N"].items())
    fillings = f"{numbers['fillings_n']} fillings of the glass"
    say(f"{settings.scene}: smallest resolved weight difference: {resolved or 'none'}, from {fillings}")


READINGS = {"one_reading": "one reading", "five_readings": "mean of a stop's readings"}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Plot the response against weight, and the fraction of correctly ordered pairs against the weight difference."""
    with drawing(5.0, f"Response while a glass on the skin is filled ({source})") as figure:
        upper, lower = figure.subplots(2, 1)
        weight_N, response_uT, sd_uT = (np.array(drawn[name]) for name in ("weight_N", "response_uT", "sd_uT"))
        upper.fill_between(weight_N, response_uT - sd_uT, response_uT + sd_uT, color=COLOURS[6], linewidth=0)
        upper.plot(weight_N, response_uT, color=COLOURS[1], marker="")
        upper.set(xlabel="weight / N", ylabel="response / µT (mean, sd)")
        difference_N = numbers["step_N"] * np.arange(1, len(weight_N))
        for colour, (name, title) in zip(COLOURS[1:], READINGS.items(), strict=False):
            share_pct = 100 * np.array(drawn["by_direction"][name])
            lower.plot(difference_N, share_pct, color=colour, marker="o", markersize=3, label=title)
        told_pct = numbers["told_pct"]
        lower.axhline(told_pct, color="0.3", linestyle="--", label=f"{told_pct:g} %")
        lower.axvline(paper.SENSITIVITY_N, color="0.6", linestyle=":", label="upper bound stated in the paper")
        # 50 % is chance level.
        lower.set(xscale="log", xlabel="weight difference / N", ylabel="correctly ordered pairs / %", ylim=(48, 102))
        lower.legend(loc="lower right", frameon=True, framealpha=1, edgecolor="none")
        return {"sensitivity.svg": svg(figure)}
