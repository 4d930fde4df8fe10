"""Logs: force and place over time from a log on an SD card, such as a log of a dog shoe or a glove (paper section 6).

Networks that were trained without the log's board estimate the contacts in the log. A simulated log is also scored,
both as it is and as if its board rotated in the earth's field.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Float32, Float64
from scipy.constants import micro
from scipy.spatial.transform import Rotation

from pipeline import paper
from pipeline.experiments.results import only, write_results
from pipeline.plot import COLOURS, drawing, svg
from pipeline.settings import Settings
from pipeline.simulation import simulation_settings
from pipeline.stage import say
from reskin.logs import (
    Estimator,
    contacts_n,
    describe,
    estimate,
    estimate_after,
    score_contacts,
    thin,
    truth_at,
)
from reskin.models.trained import networks_held_out
from reskin.physics.ambient import EARTH_SIZE_T, EARTH_T, Instrument, draw_instrument, readings_uT, reference_uT
from reskin.recordings import probe
from reskin.recordings.header import LOG_FILE, PROBE_FILE
from reskin.recordings.ingest import read_header
from reskin.recordings.readers import sd_card
from reskin.seeds import rng_for

PITCHES_DEG = (0.0, 10.0, 20.0, 45.0)  # assumed amplitudes of a shoe's pitch angle during a step
PERIOD_S = 1.0  # assumed period of the steps for a log with fewer than two contacts
SCORES = ("false_readings_n", "missed_readings_n", "mse_f_N2", "accuracy_pct", "spread")


def logs(settings: Settings, raw: Path, models: Path, results: Path) -> None:
    """Estimate the contacts of a log with networks trained without the log's board.

    The estimates are scored if the true contacts are known.
    """
    folder = only(sorted(child for child in raw.iterdir() if child.is_dir()), raw)
    t_s, b_uT, _, account = sd_card.read_log(folder / LOG_FILE)
    board = read_header(folder).board
    networks = networks_held_out(models, board)
    estimated = estimate(t_s, b_uT, networks, where=str(folder / LOG_FILE))
    numbers, true = describe(estimated) | {"networks_n": len(networks), "account": account}, None
    if (folder / PROBE_FILE).is_file():
        log = probe.parse(folder / PROBE_FILE, str(folder / PROBE_FILE))
        known = np.stack([log.x_mm, log.y_mm, log.Fz_N], axis=1)
        known[~log.contact] = np.nan
        true = truth_at(t_s, log.t_start_s, log.t_end_s, known)
        numbers |= score_contacts(estimated, true)
        numbers |= score_turning(Log(t_s, b_uT, true, estimated.quiet_n), board, settings, networks)
    losses = {"accounts": [numbers["account"]], "left_out": {}}
    write_results(results, numbers, thin(estimated, true), losses)
    say(f"{settings.scene}: {numbers['contacts_n']} contacts found in a log of {numbers['duration_s']:.1f} s")


# --- A board that rotates in the earth's field ---


@dataclass(frozen=True)
class Log:
    """A log of a board that does not rotate, with its true contacts."""

    t_s: Float64[np.ndarray, " f"]
    b_uT: Float32[np.ndarray, "f ch"]
    true: Float64[np.ndarray, "f 3"]  # x_mm, y_mm, F_N; NaN without contact
    quiet_n: int  # number of rows without contact at the start of the log


def score_turning(log: Log, board: str, settings: Settings, networks: Sequence[Estimator]) -> dict[str, Any]:
    """Score the networks on the log as if its board rotated in the earth's field, without and with a reference chip."""
    simulation, seed = simulation_settings(settings), settings.seed
    design = simulation.main_boards.design
    instrument = draw_instrument(design, simulation.spreads, simulation.chip, seed=seed, name=board)
    return {
        "turning": score_pitches(log, instrument, networks, rng_for(seed, "logs", board, "aside")),
        "turning_period_s": step_period_s(log.t_s, np.isfinite(log.true[:, 2])),
        "earth_uT": EARTH_SIZE_T / micro,
    }


def score_pitches(
    log: Log, instrument: Instrument, networks: Sequence[Estimator], rng: np.random.Generator
) -> list[dict[str, Any]]:
    """Score the networks on a log whose board pitches in the earth's field after the quiet start.

    Returns one row per amplitude in `PITCHES_DEG`. A row contains the scores as logged and, under `reference_chip`, the
    scores after the reading of a reference chip was subtracted. `instrument.noise_uT` is the noise of one reading of
    that chip.
    """
    period_s = step_period_s(log.t_s, np.isfinite(log.true[:, 2]))
    rows = []
    for pitch_deg in PITCHES_DEG:
        swing_rad = np.radians(pitch_deg) * swing(log.t_s, start_s=float(log.t_s[log.quiet_n - 1]), period_s=period_s)
        field_T = earth_in_board_T(swing_rad)
        added_uT = readings_uT(instrument.board, np.repeat(field_T[:, None], len(instrument.turn), axis=1))
        corrected_uT = added_uT - reference_uT(instrument, field_T, rng)
        rows.append(
            {"pitch_deg": pitch_deg} | _score(log, added_uT, networks)
            | {"reference_chip": _score(log, corrected_uT, networks)}
        )  # fmt: skip
    return rows


def step_period_s(t_s: Float64[np.ndarray, " f"], touched: Bool[np.ndarray, " f"]) -> float:
    """Return the median time between the starts of successive contacts; `PERIOD_S` if there are fewer than two."""
    starts_s = t_s[np.flatnonzero(np.diff(touched.astype(int), prepend=0) == 1)]
    return float(np.median(np.diff(starts_s))) if len(starts_s) > 1 else PERIOD_S


def swing(t_s: Float64[np.ndarray, " f"], *, start_s: float, period_s: float) -> Float64[np.ndarray, " f"]:
    """Return a sine of amplitude 1 that begins at `start_s`, and 0 before that time."""
    return np.sin(2 * np.pi * np.maximum(t_s - start_s, 0) / period_s)


def earth_in_board_T(pitch_rad: Float64[np.ndarray, " f"]) -> Float[np.ndarray, "f 3"]:
    """Return the earth's field in the axes of a board that pitches about its y axis.

    At a pitch of 0, the board's x axis points north. This direction is the worst case, because the x axis then moves in
    the plane that contains the whole field.
    """
    return Rotation.from_euler("y", pitch_rad[:, None]).inv().apply(EARTH_T)


def _score(log: Log, added_uT: Float[np.ndarray, "f ch"], networks: Sequence[Estimator]) -> dict[str, Any]:
    estimated = estimate_after(log.quiet_n, log.t_s, (log.b_uT + added_uT).astype(np.float32), networks)
    scores = score_contacts(estimated, log.true)
    return {"contacts_n": contacts_n(estimated.contact)} | {name: scores[name] for name in SCORES if name in scores}


# --- Tables and figures ---

MEANING = (  # the experiment's numbers are inserted by `str.format`
    "The log has a rate of {rate_hz:.0f} Hz and contains only times and readings, as a board writes it to an SD card. "
    "It begins with a quiet time without contact, which is followed by footfalls at random places. The mean of the "
    "quiet readings is the no-load reading. A reading is detected as contact if the field has changed by much more "
    "than the noise of the quiet readings. Networks that were trained without this board predict places and forces. "
    "Each network is scored separately: ± is the standard deviation over {networks_n} network seeds. Errors are "
    "computed for the readings that are detected as contact, from the true values of the simulation. The board does "
    "not rotate, so the earth's field is constant and is subtracted with the no-load reading. In a dog's shoe or on a "
    "hand, the board would rotate."
)
TURNING = (
    "The same log, as if the board pitched in the earth's field of {earth_uT:.0f} µT. The pitch angle is a sine with "
    "the given amplitude and one period per step ({turning_period_s:.2g} s). The amplitudes are assumed. The wearer "
    "walks north, which is the worst direction. The field in the axes of the board changes with the pitch, and these "
    "changes are mistaken for contacts. As a remedy, an additional chip of the same type and noise, which is not under "
    "the skin, is read with every frame. Its reading is rotated to the axes of each chip and subtracted from the "
    "chip's reading. Errors are computed for the readings in contact that were detected as contact. The mean force "
    "error is therefore smaller if more weak contacts are detected. ± is the standard deviation over network seeds."
)
VARIANTS = {"as logged": None, "reference chip subtracted": "reference_chip"}


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate the contacts of the log, and scores if the true contacts are known.

    The paper shows its logs only as videos.
    """
    account = numbers["account"]
    rows = [
        ("rate, Hz", f"{numbers['rate_hz']:.0f}", f"{paper.LOG_RATE_HZ:.0f}"),
        ("duration, s", f"{numbers['duration_s']:.1f}", "–"),
        ("readings", f"{numbers['readings_n']}", "–"),
        ("readings lost to failed reads and stuck chips", f"{account['rows_read_n'] - account['rows_n']}", "–"),
        ("frames missing from gaps between times", f"{account['gap_frames_n']}", "–"),
        ("contacts found", f"{numbers['contacts_n']}", "–"),
        ("true contacts", _show(numbers, "contacts_true_n"), "–"),
        ("readings in contact", f"{numbers['contact_readings_n']}", "–"),
        ("readings in contact that were missed", _show(numbers, "missed_readings_n"), "–"),
        ("largest force of a missed reading, N", _show(numbers, "missed_force_max_N"), "–"),
        ("readings without contact detected as contact", _show(numbers, "false_readings_n"), "–"),
        ("largest estimated force, N", _show(numbers, "force_max_N"), "–"),
        ("largest true force, N", _show(numbers, "force_true_max_N"), "–"),
        ("accuracy, %", _show(numbers, "accuracy_pct"), "–"),
        ("MSE_xy, mm²", _show(numbers, "mse_xy_mm2"), "–"),
        ("MSE_F, N²", _show(numbers, "mse_f_N2"), "–"),
    ]
    table = pd.DataFrame(
        [{"what": what, "ours": ours, "paper": theirs, "source": source} for what, ours, theirs in rows]
    )
    table.attrs["meaning"] = MEANING.format(**{name: numbers[name] for name in ("rate_hz", "networks_n")})
    return {"logs": table} | ({"logs_turning": _turning(numbers, source)} if "turning" in numbers else {})


def _turning(numbers: Mapping[str, Any], source: str) -> pd.DataFrame:
    """Tabulate the scores for a board that pitches, by the amplitude of the pitch."""
    rows = []
    for row in numbers["turning"]:
        for title, name in VARIANTS.items():
            scores = row if name is None else row[name]
            rows.append(
                {
                    "pitch / °": f"± {row['pitch_deg']:g}",
                    "readings": title,
                    "contacts found": _show(scores, "contacts_n"),
                    "true contacts": _show(numbers, "contacts_true_n"),
                    "readings without contact detected as contact": _show(scores, "false_readings_n"),
                    "readings in contact that were missed": _show(scores, "missed_readings_n"),
                    "MSE_F / N²": _show(scores, "mse_f_N2"),
                    "accuracy / %": _show(scores, "accuracy_pct"),
                    "source": source,
                }
            )
    table = pd.DataFrame(rows)
    table.attrs["meaning"] = TURNING.format(**{name: numbers[name] for name in ("turning_period_s", "earth_uT")})
    return table


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Plot the estimated and the true force, x and y over time, during contacts only."""
    t_s = np.array(drawn["t_s"])
    with drawing(7.0, 5.0) as figure:
        panels = figure.subplots(3, 1, sharex=True, height_ratios=(2, 1, 1))
        for axes, name, quantity in zip(panels, ("F_N", "x_mm", "y_mm"), ("F / N", "x / mm", "y / mm"), strict=True):
            for which, colour, width in (("estimated", COLOURS[1], 1.8), ("true", COLOURS[2], 0.9)):
                if which in drawn:
                    axes.plot(t_s, np.array(drawn[which][name], float), color=colour, linewidth=width, label=which)
            if "low" in drawn:
                low, high = (np.array(drawn[which][name], float) for which in ("low", "high"))
                label = f"range over {numbers['networks_n']} network seeds"
                axes.fill_between(t_s, low, high, color=COLOURS[1], alpha=0.3, linewidth=0, label=label)
            axes.set_ylabel(quantity)
        panels[0].set_ylim(bottom=0)
        panels[1].set_ylim(-2, 18)  # the grid is 16 mm wide
        panels[2].set_ylim(-2, 18)
        panels[2].set_xlabel("time / s")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
        panels[0].set_title(f"Estimates from a log at {numbers['rate_hz']:.0f} Hz ({source})", loc="left", fontsize=11)
        return {"logs.svg": svg(figure)}


def _show(numbers: Mapping[str, Any], name: str) -> str:
    if name not in numbers:
        return "unknown"
    if isinstance(numbers[name], int):
        return f"{numbers[name]}"
    spread = numbers.get("spread", {})
    return f"{numbers[name]:.3g}" + (f" ± {spread[name]:.2g}" if name in spread else "")
