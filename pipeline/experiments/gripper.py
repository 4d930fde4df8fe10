"""Gripper: force control with the force estimates of networks or of the universal model (paper section 6).

A simulated gripper squeezes objects of several stiffnesses. The true force is compared with the intended force (the
aim). The force estimates are used without correction, or are corrected with one press of known force.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float, Float32, Float64
from pydantic import Field

from pipeline.experiments.results import group_by_level, read_captures, read_losses, write_results
from pipeline.plot import COLOURS, drawing, svg
from pipeline.settings import Settings
from pipeline.simulation import load_protocol
from pipeline.stage import say
from pipeline.statistics import add_seed_sd, summarise
from reskin.config import Strict
from reskin.data.contact import CONTACT_SDS
from reskin.data.grid import CENTRE_MM
from reskin.models.trained import networks_held_out
from reskin.schema import Readings
from reskin.seeds import rng_for
from reskin.simulation.protocols import load_steps_N
from reskin.universal.model import Universal, load_universal

# Rate of the controller, duration of a run, and the time in a run after which forces are scored.
RATE_HZ, SECONDS, SETTLED_S = 50.0, 4.0, 1.0
SWING = 3.0  # an object's stiffness varies between a third of its nominal value and three times this value
# Assumed indentation of the skin by a round tip with a force of 1 N; for other forces, the indentation follows Hertz's
# law. It affects how fast a force is reached, but not which force is reached.
DEPTH_OF_1_N_MM = 0.8
READINGS_N = 5  # readings averaged for the press of known force, as the paper does for indentations (section 3)
WITHIN = 0.1  # tolerance of the held force, relative to the aim; assumed, because the paper states none
Estimate = Callable[[Float[np.ndarray, "r ch"]], Float[np.ndarray, " r"]]  # readings in uT -> forces in N
Predict = Callable[[Float32[np.ndarray, "r ch"]], Float[np.ndarray, "r 3"]]  # dB in uT -> x, y in mm, F in N
Positive = Annotated[float, Field(gt=0, le=100)]


class Gripper(Strict):
    """Settings section `gripper`: forces to hold (aims), stiffnesses of the objects, and the gain of the controller."""

    aims_N: tuple[Positive, ...]
    stiffness_N_mm: tuple[Positive, ...]
    gain_mm_N: Positive


@dataclass(frozen=True)
class Finger:
    """The skin on a gripper's finger, described by its response to forces at its middle.

    - board: name of the board.
    - force_N: forces, the first of which is 0.
    - depth_mm, change_uT: indentation and field change at each of these forces.
    - noload_uT: field without contact.
    - noise_uT: standard deviation of the noise of a reading.
    """

    board: str
    force_N: Float64[np.ndarray, " p"]
    depth_mm: Float64[np.ndarray, " p"]
    change_uT: Float64[np.ndarray, "p ch"]
    noload_uT: Float64[np.ndarray, " ch"]
    noise_uT: float

    def read(self, force_N: Float64[np.ndarray, " r"], rng: np.random.Generator) -> Float64[np.ndarray, "r ch"]:
        """Return simulated readings of the skin under these forces, with noise."""
        clean_uT = np.stack([np.interp(force_N, self.force_N, column) for column in self.change_uT.T], axis=1)
        return self.noload_uT + clean_uT + self.noise_uT * rng.standard_normal(clean_uT.shape)

    def squeezed_N(
        self, closed_mm: Float64[np.ndarray, " r"], stiffness_N_mm: Float64[np.ndarray, " r"]
    ) -> Float64[np.ndarray, " r"]:
        """Return the force in each run after the gripper has closed by `closed_mm`.

        Skin and object are compressed one behind the other, so the same force acts on both, and their indentations add
        up to `closed_mm`.
        """
        return np.array([
            np.interp(closed, self.depth_mm + self.force_N / stiffness, self.force_N)
            for closed, stiffness in zip(closed_mm, stiffness_N_mm, strict=True)
        ])  # fmt: skip


class Press(NamedTuple):
    """One press whose force is known; `b_uT` is the mean of `READINGS_N` readings."""

    force_N: float
    b_uT: Float64[np.ndarray, " ch"]


def gripper(settings: Settings, section: Gripper, indentations: Path, models: Path, results: Path) -> None:
    """Simulate holding objects by force control, with forces estimated from the readings of a gripper's finger."""
    load = load_protocol(settings, "grip")
    weight_N = load_steps_N(load.force_max_N, load.step_N)
    fingers = [make_finger(capture, weight_N) for capture in read_captures(indentations)]
    networks = {finger.board: networks_held_out(models, finger.board) for finger in fingers}
    numbers, plot_data = hold_all(fingers, networks, section, seed=settings.seed)
    write_results(results, numbers, plot_data, read_losses(indentations, {}))
    best = max(numbers["rows"], key=lambda row: row["held_pct"])
    say(
        f"{settings.scene}: best result: {best['aim_N']} N held in {best['held_pct']:.0f} % of runs; force estimated "
        f"by {best['feedback']}, one known press used: {PRESSES[best['press']]}"
    )


def make_finger(capture: Readings, weight_N: Float64[np.ndarray, " p"]) -> Finger:
    """Average the readings of a capture under each weight.

    The noise is the standard deviation of single readings from these averages.
    """
    change_uT = capture.db_uT
    levels_uT = group_by_level(
        change_uT, capture.indentation, capture.Fz_N, levels_n=len(weight_N), where=capture.capture
    ).astype(np.float64)
    mean_uT = levels_uT.mean(axis=(0, 2))
    noise_uT = float((levels_uT - mean_uT[:, None]).std())
    depth_mm = DEPTH_OF_1_N_MM * weight_N ** (2 / 3)
    noload_uT = capture.noload_uT.mean(axis=0, dtype=np.float64)
    return Finger(capture.board, weight_N, depth_mm, mean_uT - mean_uT[0], noload_uT, noise_uT)


def estimators(finger: Finger, networks: Sequence[Predict], press: Press) -> Iterator[tuple[str, str, Estimate]]:
    """Yield every force estimator, as a tuple of three elements.

    The elements are the name of its model, how it uses the press of known force, and a function that estimates forces
    from readings.
    """
    unlabelled = load_universal().zero(finger.noload_uT[None])
    labelled = load_universal().zero(finger.noload_uT[None])
    labelled.label(np.full((1, 2), CENTRE_MM), np.array([press.force_N]), press.b_uT[None])

    def by_network(network: Predict) -> Estimate:
        return lambda b_uT: network((b_uT - finger.noload_uT).astype(np.float32))[:, 2].astype(np.float64)

    def by_universal(universal: Universal) -> Estimate:
        return lambda b_uT: universal.estimate(b_uT).force_N

    for name, estimate in (
        *(("networks", by_network(network)) for network in networks),
        ("shipped", by_universal(unlabelled)),
    ):
        yield name, "none", estimate
        yield name, "factor", scale_to_press(estimate, press)
    yield "shipped", "label", by_universal(labelled)


def scale_to_press(estimate: Estimate, press: Press) -> Estimate:
    """Scale all estimates by the factor that makes the estimate for the press of known force correct."""
    # The estimate is raised to at least 1 mN, because a network may predict a force of 0 or less.
    factor = press.force_N / max(float(estimate(press.b_uT[None])[0]), 1e-3)
    return lambda b_uT: factor * estimate(b_uT)


def hold(
    finger: Finger, estimate: Estimate, aim_N: float, section: Gripper, rng: np.random.Generator
) -> Float64[np.ndarray, "f r"]:
    """Simulate one run per object stiffness; return the true forces, with control steps as rows and runs as columns."""
    nominal_N_mm = np.array(section.stiffness_N_mm)
    closed_mm, force_N = np.zeros(len(nominal_N_mm)), np.zeros(len(nominal_N_mm))
    touch_uT = finger.noise_uT * (np.sqrt(len(finger.noload_uT)) + CONTACT_SDS)
    held_N = []
    for step in range(round(SECONDS * RATE_HZ)):
        b_uT = finger.read(force_N, rng)
        touched = np.linalg.norm(b_uT - finger.noload_uT, axis=1) > touch_uT
        estimate_N = np.where(touched, estimate(b_uT), 0.0)
        closed_mm = np.maximum(closed_mm + section.gain_mm_N * (aim_N - estimate_N), 0.0)  # the controller
        stiffness_N_mm = nominal_N_mm * SWING ** np.sin(2 * np.pi * step / RATE_HZ / SECONDS)
        force_N = finger.squeezed_N(closed_mm, stiffness_N_mm)
        held_N.append(force_N)
    return np.array(held_N)


def hold_all(
    fingers: Sequence[Finger], networks: Mapping[str, Sequence[Predict]], section: Gripper, *, seed: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Simulate all runs (every aim, skin and estimator); return the numbers, and the data for the figure."""
    rows, plot_rows = [], []
    for aim_N in section.aims_N:
        results: dict[tuple[str, str], dict[str, list[Float64[np.ndarray, "f r"]]]] = {}
        for finger in fingers:
            rng = rng_for(seed, "gripper", finger.board, f"{aim_N:g}")
            known_uT = finger.read(np.full(READINGS_N, aim_N), rng).mean(axis=0)
            for model, press, estimate in estimators(finger, networks[finger.board], Press(aim_N, known_uT)):
                held_N = hold(finger, estimate, aim_N, section, rng)
                results.setdefault((model, press), {}).setdefault(finger.board, []).append(held_N)
        for (model, press), by_board in results.items():
            keys = {"aim_N": aim_N, "feedback": model, "press": press}
            rows.append(keys | judge(by_board, aim_N))
            mean_N = np.concatenate(
                [held_N[round(SETTLED_S * RATE_HZ) :].mean(axis=0) for runs in by_board.values() for held_N in runs]
            )
            plot_rows.append(keys | {"off_pct": np.round(100 * (mean_N / aim_N - 1), 2).tolist()})
    return {
        "rows": rows,
        "within_pct": 100 * WITHIN,
        "skins_n": len(fingers),
        "seeds_n": max(len(board_networks) for board_networks in networks.values()),
        "rate_hz": RATE_HZ,
        **section.model_dump(mode="json"),
    }, {"rows": plot_rows}


def judge(runs: Mapping[str, Sequence[Float64[np.ndarray, "f r"]]], aim_N: float) -> dict[str, Any]:
    """Score the deviations of true forces from the aim after settling.

    `runs` maps each board to one array per estimator (network seed), with true forces by step and run. `sd_seeds` is
    the standard deviation over the estimators of one board, averaged over boards.
    """
    first_step = round(SETTLED_S * RATE_HZ)
    deviations = {
        board: [forces_N[first_step:] / aim_N - 1 for forces_N in board_runs] for board, board_runs in runs.items()
    }
    all_runs = np.concatenate([deviation for board_runs in deviations.values() for deviation in board_runs], axis=1)
    rows = pd.DataFrame(
        [
            {"board": board, "error_pct": 100 * np.abs(deviation).mean()}
            for board, board_runs in deviations.items()
            for deviation in board_runs
        ]
    )
    error = add_seed_sd(summarise(rows.groupby("board").mean(), boards=True), rows, "board")["error_pct"]
    return {
        "runs_n": all_runs.shape[1],
        "held_pct": 100 * float((np.abs(all_runs.mean(axis=0)) < WITHIN).mean()),
        "always_pct": 100 * float((np.abs(all_runs) < WITHIN).all(axis=0).mean()),
        "median_error_pct": 100 * float(np.median(np.abs(all_runs).mean(axis=0))),
        "worst_error_pct": 100 * float(np.abs(all_runs).mean(axis=0).max()),
        "error_pct": error,
    }


PRESSES = {"none": "no", "factor": "as a factor", "label": "as a label"}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Plot the deviation of each run's mean force from the aim, one panel per aim."""
    aims_N = list(numbers["aims_N"])
    with drawing(0.9 + 1.8 * len(aims_N), f"Force control by model and known press ({source})") as figure:
        panels = figure.subplots(len(aims_N), 1, sharex=True, squeeze=False)[:, 0]
        for axes, aim_N in zip(panels, aims_N, strict=True):
            rows = [row for row in drawn["rows"] if row["aim_N"] == aim_N]
            axes.axhspan(-numbers["within_pct"], numbers["within_pct"], color=COLOURS[6], alpha=0.35, linewidth=0)
            for i, row in enumerate(rows):
                runs_n = len(row["off_pct"])
                x = [i + 0.5 * (j + 0.5) / runs_n - 0.25 for j in range(runs_n)]
                axes.plot(x, row["off_pct"], "o", color=COLOURS[1 + (row["press"] != "none")], markersize=3)
            axes.set(title=f"{aim_N:g} N", ylabel="force minus aim / %")
        labels = [f"{row['feedback']}\n{PRESSES[row['press']]}" for row in rows]
        axes.set_xticks(range(len(rows)), labels)
        return {"gripper.svg": svg(figure)}
