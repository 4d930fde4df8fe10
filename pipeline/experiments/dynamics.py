"""Dynamic presses: readings at the full rate while the force keeps changing (paper section 7, future work).

Place and force are estimated in two ways: from each reading alone, and from the mean of the last five readings. The
paper averages five readings of a press at rest. While the force changes, such a mean has less noise than a single
reading, but it lags behind the force.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64

from pipeline import paper
from pipeline.experiments.results import only, read_captures, read_losses, write_results
from pipeline.formatting import show_difference
from pipeline.plot import COLOURS, MARKERS, drawing, svg
from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.statistics import VERDICTS, negate, paired, statistic, summarise, verdict
from reskin.data.baseline import subtract
from reskin.data.rows import TARGETS
from reskin.metrics import score
from reskin.models.trained import networks_held_out

WINDOW_N = 5  # number of readings that the paper averages for a press at rest (section 3)
FORCE_MIN_N = 0.2  # assumed: excludes the first and last readings of a press, from which places are hard to estimate
BINS_N = 5  # number of ranges of duration for which presses are scored separately
LAGS_MS = np.arange(-5.0, 20.05, 0.1)  # lags of the predicted force behind the true force that are tried
METHODS = ("one", "mean5", "mean5_of_middle")

Predict = Callable[[Float32[np.ndarray, "f ch"]], Float32[np.ndarray, "f 3"]]  # dB in uT -> x and y in mm, F in N


@dataclass(frozen=True)
class Presses:
    """Readings of all presses in order of time; each reading has the index and the duration of its press."""

    db_uT: Float32[np.ndarray, "f ch"]
    true: Float64[np.ndarray, "f 3"]  # x_mm, y_mm, F_N
    t_s: Float64[np.ndarray, " f"]
    press_i: Int64[np.ndarray, " f"]
    duration_s: Float64[np.ndarray, " f"]
    scored: Bool[np.ndarray, " f"]  # force of at least FORCE_MIN_N, and four earlier readings of the same press

    def __len__(self) -> int:
        return len(self.t_s)


def dynamics(settings: Settings, indentations: Path, models: Path, results: Path) -> None:
    """Score, on dynamic presses, the networks of stage train_multi that were trained without the pressed board."""
    capture = only(read_captures(indentations), indentations)
    true = np.stack([getattr(capture, name) for name in TARGETS], axis=1)
    presses = find_presses(subtract(capture.b_uT, capture.noload_uT), true, capture.t_s, capture.indentation)
    numbers = score_presses(presses, networks_held_out(models, capture.board), board=capture.board)
    write_results(results, numbers, {}, read_losses(indentations, {}))
    described = f"{numbers['presses_n']} presses at {numbers['rate_hz']:.0f} Hz"
    say(f"{settings.scene}: scored {numbers['readings_n']} readings of {described}")


def find_presses(
    db_uT: Float32[np.ndarray, "f ch"],
    true: Float[np.ndarray, "f 3"],
    t_s: Float64[np.ndarray, " f"],
    indentation: Int32[np.ndarray, " f"],
) -> Presses:
    """Group readings into presses by their indentation, and determine which readings are scored.

    A press lasts from half a frame before its first reading to half a frame after its last.
    """
    _, first_i, press_i, frames_n = np.unique(indentation, return_index=True, return_inverse=True, return_counts=True)
    duration_s = (t_s[first_i + frames_n - 1] - t_s[first_i]) + 1 / rate_of(t_s, press_i)
    position = np.arange(len(t_s)) - first_i[press_i]
    scored = (true[:, 2] >= FORCE_MIN_N) & (position >= WINDOW_N - 1)
    return Presses(db_uT, true.astype(np.float64), t_s, press_i, duration_s[press_i], scored)


def rate_of(t_s: Float64[np.ndarray, " f"], press_i: Int64[np.ndarray, " f"]) -> float:
    """Return the rate of the readings in Hz, from the median time between successive readings of a press."""
    return float(1 / np.median(np.diff(t_s)[np.diff(press_i) == 0]))


def running_mean(values: Float[np.ndarray, "f c"]) -> Float64[np.ndarray, "f c"]:
    """Average each row with the four rows before it, or with all rows before it if these are fewer than four."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0, dtype=np.float64)])
    end = np.arange(1, len(values) + 1)
    start = np.maximum(end - WINDOW_N, 0)
    return (total[end] - total[start]) / (end - start)[:, None]


def score_presses(presses: Presses, networks: Sequence[Predict], *, board: str) -> dict[str, Any]:
    """Score estimates from each reading alone and from the mean of the last five readings.

    The estimate from the mean is also compared with the true values at the middle one of its five readings. All presses
    are on one skin of `board`. Therefore `paired`, which compares the first two methods, has no confidence interval.
    """
    mean_uT = running_mean(presses.db_uT).astype(np.float32)
    single, averaged = ([network(inputs_uT) for network in networks] for inputs_uT in (presses.db_uT, mean_uT))
    predictions = {"one": single, "mean5": averaged, "mean5_of_middle": averaged}
    edges_s = np.geomspace(presses.duration_s.min(), presses.duration_s.max() * (1 + 1e-9), BINS_N + 1)
    by_duration = []
    for low_s, high_s in pairwise(edges_s):
        in_bin = presses.scored & (presses.duration_s >= low_s) & (presses.duration_s < high_s)
        if in_bin.any():
            presses_n = len(np.unique(presses.press_i[in_bin]))
            keys = {"duration_s": float(np.sqrt(low_s * high_s)), "n": int(in_bin.sum()), "presses_n": presses_n}
            by_duration.append(keys | _scores(presses, predictions, in_bin, board))
    return {
        "readings_n": int(presses.scored.sum()),
        "presses_n": len(np.unique(presses.press_i[presses.scored])),
        "rate_hz": rate_of(presses.t_s, presses.press_i),
        "window_n": WINDOW_N,
        "force_min_N": FORCE_MIN_N,
        "by_duration": by_duration,
        "all": _scores(presses, predictions, presses.scored, board),
        "lag_ms": {
            name: lags(presses, [predicted[:, 2] for predicted in predictions[name]]) for name in ("one", "mean5")
        },
    }


def _scores(
    presses: Presses, predictions: Mapping[str, Sequence[Any]], rows: Bool[np.ndarray, " f"], board: str
) -> dict[str, Any]:
    # The middle reading of the last five is two rows earlier. If a row is scored, this reading is of the same press.
    middle = np.flatnonzero(rows) - WINDOW_N // 2
    true = {"one": presses.true[rows], "mean5": presses.true[rows], "mean5_of_middle": presses.true[middle]}
    scores = {
        name: pd.DataFrame([score(true[name], predicted[rows]) for predicted in predictions[name]]) for name in METHODS
    }
    methods = (scores[name].assign(board=board, skin="") for name in ("mean5", "one"))
    summaries = {name: summarise(table) for name, table in scores.items()}
    return summaries | {"paired": {"mean5_minus_one": paired(*methods)}}


def lags(presses: Presses, force_N: Sequence[Float[np.ndarray, " f"]]) -> dict[str, float]:
    """Summarise, over presses and networks, the lag in ms of the predicted force behind the true force."""
    lags_ms = [
        lag_ms(presses.t_s[rows], predicted_N[rows], presses.t_s[in_press], presses.true[in_press, 2])
        for in_press in (presses.press_i == press_i for press_i in np.unique(presses.press_i[presses.scored]))
        for rows in [in_press & presses.scored]
        if rows.sum() > WINDOW_N
        for predicted_N in force_N
    ]
    return statistic(lags_ms) if lags_ms else {"n": 0}


def lag_ms(
    t_s: Float64[np.ndarray, " f"],
    predicted_N: Float[np.ndarray, " f"],
    true_t_s: Float64[np.ndarray, " g"],
    true_N: Float64[np.ndarray, " g"],
) -> float:
    """Return the delay in ms at which the delayed true force, times a constant, fits the predicted force best.

    The constant is fitted by least squares for each candidate delay in `LAGS_MS`.
    """
    delayed_N = np.interp(t_s[None] - LAGS_MS[:, None] / 1e3, true_t_s, true_N)
    explained = (delayed_N @ predicted_N) ** 2 / (delayed_N**2).sum(axis=1)
    return float(LAGS_MS[int(np.argmax(explained))])


MEANING = (
    "The presses are at random places of the grid, and are recorded at the full rate. During a press, the depth "
    "follows half a period of a sine. The model is the paper's network, trained on other boards with readings at rest. "
    "A reading is scored if four readings of the same press come before it and its force is at least "
    f"{FORCE_MIN_N:g} N. For presses at rest, the paper averages five readings; here, the last five readings are taken "
    "at different depths. The estimate from their mean is compared with the true place and force at the last of the "
    "five readings and, in the third method, at the middle reading, which is two frames earlier. The difference "
    "between these two errors is due to lag. Presses of different durations also differ in depth and place, so compare "
    "methods at the same duration. ± is the standard deviation over network seeds. All presses are on one board. "
    f"{VERDICTS}"
)
TITLES = {
    "one": "each reading alone",
    "mean5": "mean of the last five readings",
    "mean5_of_middle": "same mean, compared with middle reading",
}
LESS = "less force error than each reading alone, N²"  # title of a column
TICKS_S = (0.05, 0.1, 0.2, 0.5, 1.0)
METRICS = {"accuracy_pct": "accuracy / %", "mse_xy_mm2": "MSE_xy / mm²", "mse_f_N2": "MSE_F / N²"}


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate the errors of each method by duration of the press, and over all presses."""
    rows = [(f"{result['duration_s']:.2g}", result) for result in numbers["by_duration"]]
    rows.append(("all", numbers["all"] | {"n": numbers["readings_n"], "presses_n": numbers["presses_n"]}))
    table = pd.DataFrame(
        {
            "duration of the press (about), s": label,
            "presses": result["presses_n"],
            "readings": result["n"],
            "estimated from": title,
            **{column: _show(result[method].get(name)) for name, column in METRICS.items()},
            "lag / ms": _show(_lag(numbers, method)) if label == "all" else "",
            LESS: _less(result) if method == "mean5" else "",
            "paper": paper.DYNAMICS if label == "all" and method == "one" else "",
            "source": source,
        }
        for label, result in rows
        for method, title in TITLES.items()
    )
    table.attrs["meaning"] = MEANING
    return {"dynamics": table}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Plot the errors of force and place against the duration of the press."""
    with drawing(7.6, 3.8) as figure:
        panels = figure.subplots(1, 2)
        # The place does not change during a press, so the third method has the same place error as the second.
        for axes, name, methods_n in zip(panels, ("mse_f_N2", "mse_xy_mm2"), (3, 2), strict=True):
            for i, (method, title) in enumerate(list(TITLES.items())[:methods_n]):
                known = [row for row in numbers["by_duration"] if name in row[method]]
                duration_s = [row["duration_s"] for row in known]
                mean, sd = ([row[method][name].get(value, 0.0) for row in known] for value in ("mean", "sd"))
                axes.errorbar(
                    duration_s, mean, sd, color=COLOURS[i], marker=MARKERS[i], markersize=4.5, linewidth=1.2,
                    capsize=2, label=title,
                )  # fmt: skip
            axes.set(xscale="log", xlabel="duration of the press / s", ylabel=METRICS[name])
            axes.set_xticks(TICKS_S, [f"{tick_s:g}" for tick_s in TICKS_S])
            axes.minorticks_off()
            axes.set_ylim(bottom=0)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
        title = f"Errors during presses recorded at {numbers['rate_hz']:.0f} Hz ({source})"
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        return {"dynamics.svg": svg(figure)}


def _less(result: Mapping[str, Any]) -> str:
    """Format the verdict on whether the mean of the last five readings has less force error than single readings."""
    if "paired" not in result or "mse_f_N2" not in result["paired"]["mean5_minus_one"]:
        return "–"  # no force is known, or the results are from an older version
    difference = result["paired"]["mean5_minus_one"]["mse_f_N2"]
    return f"{verdict(negate(difference))}: {show_difference(difference)}"


def _lag(numbers: Mapping[str, Any], method: str) -> Mapping[str, float] | None:
    lag: Mapping[str, float] = numbers["lag_ms"].get(method, {})
    return lag if "mean" in lag else None


def _show(value: Mapping[str, float] | None) -> str:
    if value is None:
        return "–"
    return f"{value['mean']:.3g}" + (f" ± {value['sd']:.2g}" if "sd" in value else "")
