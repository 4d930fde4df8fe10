"""Logs: force and place over time from a log on an SD card, such as a log of a dog shoe or a glove (paper section 6).

Networks that were trained without the log's board estimate the contacts in the log. A simulated log is also scored.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from pipeline.experiments.results import only, write_results
from pipeline.plot import COLOURS, drawing, svg
from pipeline.settings import Settings
from pipeline.stage import say
from reskin.logs import ContactDetector, LogSummary, contacts_n, quiet_start, step_s
from reskin.metrics import score
from reskin.models.trained import networks_held_out
from reskin.recordings import probe
from reskin.recordings.header import LOG_FILE, PROBE_FILE
from reskin.recordings.ingest import read_header
from reskin.recordings.readers import sd_card

POINTS_MAX_N = 1500  # largest number of points that a curve in a figure has

# A network: a function that estimates x_mm, y_mm and F_N from field changes in uT.
Estimator = Callable[[Float32[np.ndarray, "f ch"]], Float32[np.ndarray, "f 3"]]


def logs(settings: Settings, raw: Path, models: Path, results: Path) -> None:
    """Estimate the contacts of a log with networks trained without the log's board.

    The estimates are scored if the true contacts are known.
    """
    folder = only(sorted(child for child in raw.iterdir() if child.is_dir()), raw)
    t_s, b_uT, _, account = sd_card.read_log(folder / LOG_FILE)
    networks = networks_held_out(models, read_header(folder).board)
    quiet_n = quiet_start(t_s, b_uT, where=str(folder / LOG_FILE))
    estimated = estimate(quiet_n, t_s, b_uT, networks)
    numbers, true = describe(estimated) | {"networks_n": len(networks), "account": account}, None
    if (folder / PROBE_FILE).is_file():
        log = probe.parse(folder / PROBE_FILE, str(folder / PROBE_FILE))
        known = np.stack([log.x_mm, log.y_mm, log.Fz_N], axis=1)
        known[~log.contact] = np.nan
        true = truth_at(t_s, log.t_start_s, log.t_end_s, known)
        numbers |= score_contacts(estimated, true)
    losses = {"accounts": [numbers["account"]], "left_out": {}}
    write_results(results, numbers, thin(estimated, true), losses)
    say(f"{settings.scene}: {numbers['contacts_n']} contacts found in a log of {numbers['duration_s']:.1f} s")


@dataclass(frozen=True)
class LogEstimates:
    """The estimates for all f readings of a log.

    t_s: the time of each reading.
    targets: the estimated places and forces. They are meaningful only for readings in contact.
    contact: whether each reading is in contact.
    quiet_n: the number of readings in the quiet start.
    noise_uT: the rms of the field change over all readings and channels of the quiet start.
    """

    t_s: Float64[np.ndarray, " f"]
    targets: Float64[np.ndarray, "m f 3"]  # x_mm, y_mm and F_N, as estimated by each of m networks
    contact: Bool[np.ndarray, " f"]
    quiet_n: int
    noise_uT: float


def estimate(
    quiet_n: int, t_s: Float64[np.ndarray, " f"], b_uT: Float32[np.ndarray, "f ch"], networks: Sequence[Estimator]
) -> LogEstimates:
    """Estimate the contacts in a log, and the place and the force of each reading.

    The mean field of the quiet start, which consists of the first `quiet_n` readings, is subtracted from all readings.
    """
    detector = ContactDetector(b_uT[:quiet_n])
    db_uT = detector.change_uT(b_uT)
    targets = np.stack([network(db_uT) for network in networks]).astype(np.float64)
    return LogEstimates(t_s, targets, detector.contact(db_uT), quiet_n, detector.noise_uT)


def describe(log: LogEstimates) -> dict[str, Any]:
    """Summarise a log (see `LogSummary`)."""
    summary = LogSummary(step_s(log.t_s), log.quiet_n, log.noise_uT)
    summary.feed(log.t_s, log.contact, log.targets[:, log.contact, 2])
    return summary.counts()


def score_contacts(log: LogEstimates, true: Float64[np.ndarray, "f 3"]) -> dict[str, Any]:
    """Score the estimates of a log against true values.

    `true` contains the true x_mm, y_mm and F_N of each reading. Readings without contact have NaN. Places and forces
    are scored for the readings that are in contact and in which a contact was detected. The result also contains the
    numbers of readings in which a contact was missed or falsely detected.

    Each network is scored separately. The result contains the means of the scores over the networks. With several
    networks, its entry `spread` contains their standard deviations.
    """
    truly_touched = np.isfinite(true[:, 2])
    both_touched = log.contact & truly_touched
    counts: dict[str, Any] = {
        "contacts_true_n": contacts_n(truly_touched),
        "missed_readings_n": int((truly_touched & ~log.contact).sum()),
        "false_readings_n": int((log.contact & ~truly_touched).sum()),
        "force_true_max_N": float(np.nanmax(true[:, 2])),
    }
    if counts["missed_readings_n"]:
        counts["missed_force_max_N"] = float(true[truly_touched & ~log.contact, 2].max())
    if not both_touched.any():
        return counts
    scores = [score(true[both_touched], target[both_touched]) for target in log.targets]
    by_name = {name: np.array([one[name] for one in scores]) for name in scores[0]}
    spread = {name: float(values.std(ddof=1)) for name, values in by_name.items()} if len(scores) > 1 else {}
    return (
        counts
        | {name: float(values.mean()) for name, values in by_name.items()}
        | ({"spread": spread} if spread else {})
    )


def truth_at(
    t_s: Float64[np.ndarray, " f"],
    start_s: Float64[np.ndarray, " d"],
    end_s: Float64[np.ndarray, " d"],
    true: Float[np.ndarray, "d 3"],
) -> Float64[np.ndarray, "f 3"]:
    """Return the true x_mm, y_mm and F_N of each reading of a recording that a robot made.

    A dwell is a stop of the robot at one place; it lasts from `start_s` to `end_s`. The true values of a reading are
    the values of the dwell during which the reading was taken. Readings between dwells have NaN.
    """
    dwell_i = np.searchsorted(start_s, t_s, "right") - 1
    inside = (dwell_i >= 0) & (t_s <= end_s[dwell_i])
    return np.where(inside[:, None], true[dwell_i].astype(np.float64), np.nan)


def thin(log: LogEstimates, true: Float64[np.ndarray, "f 3"] | None) -> dict[str, Any]:
    """Reduce a log to the data of a figure: the estimates of at most 1,500 evenly spaced readings.

    The entry `estimated` contains the estimates of the first network. With several networks, the entries `low` and
    `high` contain the smallest and the largest estimates of all networks. For readings without contact, the estimates
    are None.
    """
    kept = np.unique(np.linspace(0, len(log.t_s) - 1, POINTS_MAX_N).astype(int))
    targets = np.where(log.contact[:, None], log.targets, np.nan)[:, kept]
    plot_data: dict[str, Any] = {"t_s": np.round(log.t_s[kept], 3).tolist(), "estimated": _columns(targets[0])}
    if len(targets) > 1:
        plot_data |= {"low": _columns(targets.min(axis=0)), "high": _columns(targets.max(axis=0))}
    return plot_data if true is None else plot_data | {"true": _columns(true[kept])}


def _columns(rows: Float64[np.ndarray, "f 3"]) -> dict[str, list[float | None]]:
    names = ("x_mm", "y_mm", "F_N")
    return {
        name: [None if np.isnan(value) else round(float(value), 2) for value in column]
        for name, column in zip(names, rows.T, strict=True)
    }


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Plot the estimated and the true force, x and y over time, during contacts only."""
    t_s = np.array(drawn["t_s"])
    with drawing(4.6, f"Estimates from a log at {numbers['rate_hz']:.0f} Hz ({source})") as figure:
        panels = figure.subplots(3, 1, sharex=True, height_ratios=(2, 1, 1))
        for axes, name, quantity in zip(panels, ("F_N", "x_mm", "y_mm"), ("F / N", "x / mm", "y / mm"), strict=True):
            for which, colour, width in (("estimated", COLOURS[1], 1.8), ("true", COLOURS[2], 0.9)):
                if which in drawn:
                    values = np.array(drawn[which][name], float)
                    axes.plot(t_s, values, color=colour, linewidth=width, marker="", label=which)
            if "low" in drawn:
                low, high = (np.array(drawn[which][name], float) for which in ("low", "high"))
                label = f"range over {numbers['networks_n']} network seeds"
                axes.fill_between(t_s, low, high, color=COLOURS[1], alpha=0.3, linewidth=0, label=label)
            axes.set(ylabel=quantity, ylim=(0, None) if name == "F_N" else (-2, 18))  # the grid is 16 mm wide
        panels[2].set_xlabel("time / s")
        figure.align_ylabels()
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower left", ncols=3)
        return {"logs.svg": svg(figure)}
