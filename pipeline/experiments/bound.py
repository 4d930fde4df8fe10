"""The smallest error that the noise of the chips allows, compared with the scores of a network (paper section 4).

Place and force are estimated from one input row. The experiment computes the Cramér-Rao bound, which is a lower limit
of the variance of unbiased estimates. The skin is simulated, and its properties are assumed to be known.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from scipy.constants import milli
from scipy.special import owens_t

from pipeline.experiments.ambient import readings_uT
from pipeline.experiments.results import write_results
from pipeline.formatting import COLUMNS, n_of, show, tabulate
from pipeline.scores import rows_of_cards
from pipeline.settings import Settings
from pipeline.simulation import simulation_settings
from pipeline.stage import say
from pipeline.statistics import over_folds
from reskin import io
from reskin.data.grid import CENTRE_MM, points_mm
from reskin.errors import ParamsError, SchemaError
from reskin.metrics import ACCURACY_LIMIT_MM, METRICS
from reskin.models.recipe import HEADLINE
from reskin.physics.board import draw_board
from reskin.physics.chip import ChipDesign, steps_uT
from reskin.physics.skin import Skin, changes_of_field, draw_skin, forces
from reskin.simulation.capture import list_captures
from reskin.simulation.settings import MAIN, SimulationSettings

ROW_READINGS_N = 1  # number of readings that are averaged in one input row of a network
STEP_MM = 0.01  # step of the finite differences; steps from 0.002 to 0.05 mm give the same bound within 2 %
NETWORK = "single_pass"  # experiment in which no press has readings in both the training data and the test data

Measure = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n ch"]]  # x, y, depth in mm -> measured channels


def bound(settings: Settings, models: Path, results: Path) -> None:
    """Compute lower bounds of the errors of estimates from one input row; compare them with the paper's network."""
    numbers = bound_errors(simulation_settings(settings), seed=settings.seed)
    write_results(results, numbers | {"network": score_network(models, numbers["skin"])}, {})
    overall = numbers["all"]["with_label_errors"]
    say(
        f"{settings.scene}: bound with label errors: {overall['accuracy_pct']:.4g} % and {overall['mse_xy_mm2']:.3g} "
        "mm2"
    )


def bound_errors(simulation: SimulationSettings, *, seed: int) -> dict[str, Any]:
    """Return lower bounds of the errors on the first skin of the main protocol, averaged over places.

    There is one bound for each depth, and one over all depths. Pokes that do not reach the skin are excluded, and their
    number is reported.
    """
    kind, (board_name, skin_name) = simulation.main_boards, list_captures(simulation, MAIN)[0]
    board = draw_board(kind.design, simulation.spreads, seed=seed, name=board_name)
    rule = kind.quadrature.in_si()
    skin = draw_skin(simulation.skin, simulation.spreads, seed=seed, name=skin_name, rule=rule, sides_m=kind.skin_m)
    places_mm = points_mm() - CENTRE_MM
    depths_mm = np.repeat(simulation.main.depths_mm, len(places_mm))
    pokes_mm = np.column_stack([np.tile(places_mm, (len(simulation.main.depths_mm), 1)), depths_mm])
    touched = reach_skin(skin, depths_mm)
    pokes_mm = pokes_mm[touched]
    var_uT2 = noise_var_uT2(
        simulation.chip, len(board.chips_m), readings_n=ROW_READINGS_N, noload_frames_n=simulation.rig.noload_frames_n
    )
    covariance = least_covariance(
        slopes(lambda mm: readings_uT(board, changes_of_field(board, skin, mm * milli)[1]), pokes_mm),
        slopes(lambda mm: forces(skin, mm[:, 2] * milli)[:, None], pokes_mm)[:, 0],
        var_uT2,
    )
    labels = {"place_sd_mm": simulation.rig.robot_place_sd_mm, "force_sd_N": simulation.rig.force_noise_N}
    return {
        "board": board_name, "skin": skin_name, "places_n": len(places_mm), "above_the_skin_n": int((~touched).sum()),
        "readings_n": ROW_READINGS_N, "noload_frames_n": simulation.rig.noload_frames_n, "labels": labels,
        **by_depth(pokes_mm[:, 2], covariance, labels),
    }  # fmt: skip


def reach_skin(skin: Skin, depths_mm: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Return which commanded depths indent the skin by more than the finite-difference step `STEP_MM`.

    Raises `ParamsError` if none of the depths does.
    """
    touched = depths_mm - STEP_MM + skin.depth_zero_m / milli > 0
    if not touched.any():
        what = (
            f"no poke touches the skin, because its surface is {-skin.depth_zero_m / milli:.2g} mm below depth 0, and "
            f"the largest of depths_mm is {depths_mm.max():g} mm"
        )
        raise ParamsError(f"skin {skin.name}: {what}. Increase depths_mm of the main protocol.")
    return touched


def noise_var_uT2(chip: ChipDesign, chips_n: int, *, readings_n: int, noload_frames_n: int) -> Float[np.ndarray, " ch"]:
    """Return the noise variance of each channel of an input row.

    A row is the mean of `readings_n` readings minus the mean of `noload_frames_n` no-load readings.
    """
    noise_uT = np.array([chip.noise_xy_uT, chip.noise_xy_uT, chip.noise_z_uT])
    # Rounding errors are uniformly distributed, because the noise is larger than one step of the converter.
    frame_uT2 = noise_uT**2 + steps_uT(chip.gain_sel) ** 2 / 12
    return np.tile(frame_uT2 * (1 / readings_n + 1 / noload_frames_n), chips_n)


def slopes(measure: Measure, pokes_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n ch 3"]:
    """Return the derivatives of `measure` at each poke with respect to x, y and depth, per mm (central differences)."""
    steps_mm = STEP_MM * np.concatenate([np.eye(3), -np.eye(3)])
    values = measure((pokes_mm + steps_mm[:, None]).reshape(-1, 3)).reshape(2, 3, len(pokes_mm), -1)
    return np.moveaxis((values[0] - values[1]) / (2 * STEP_MM), 0, -1)


def least_covariance(
    db_slopes: Float[np.ndarray, "n ch 3"], force_slopes: Float[np.ndarray, "n 3"], var_uT2: Float[np.ndarray, " ch"]
) -> Float[np.ndarray, "n 3 3"]:
    """Return the Cramér-Rao bound on the covariance of x, y (mm) and force (N), for each poke.

    The bound is the inverse Fisher information of x, y and depth, transformed from depth to force by `force_slopes`.
    Both slopes are derivatives with respect to x, y and depth: of the field in uT/mm, and of the force in N/mm.
    """
    information = np.einsum("nci,c,ncj->nij", db_slopes, 1 / var_uT2, db_slopes)
    to_force = np.broadcast_to(np.eye(3), information.shape).copy()
    to_force[:, 2] = force_slopes
    return to_force @ np.linalg.inv(information) @ to_force.transpose(0, 2, 1)


def expected_scores(
    covariance: Float[np.ndarray, "n 3 3"], *, place_sd_mm: float, force_sd_N: float
) -> dict[str, Float[np.ndarray, " n"]]:
    """Return the expected scores of each poke if the errors of estimates are normally distributed.

    The errors have the given covariance, plus independent errors of the labels with the given standard deviations.
    """
    variance = np.diagonal(covariance, axis1=1, axis2=2) + np.array([place_sd_mm, place_sd_mm, force_sd_N]) ** 2
    correlation = covariance[:, 0, 1] / np.sqrt(variance[:, 0] * variance[:, 1])
    within = probability_within(ACCURACY_LIMIT_MM / np.sqrt(variance[:, :2]), correlation)
    return {"accuracy_pct": 100 * within, "mse_xy_mm2": variance[:, :2].mean(axis=1), "mse_f_N2": variance[:, 2]}


def probability_within(
    limits: Float[np.ndarray, "n 2"], correlation: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Return the probability of |x| <= h and |y| <= k for correlated standard normal x and y.

    `limits` contains h and k, which must be positive. The result is exact: the probability outside the limits is
    computed with Owen's T function (Owen 1956, equation 2.1).
    """
    h, k = limits.T
    outside = np.zeros(len(h))
    for r in (correlation, -correlation):
        root = np.sqrt(1 - r**2)
        outside += owens_t(h, (k - r * h) / (h * root)) + owens_t(k, (h - r * k) / (k * root))
    return 1 - 2 * outside


def by_depth(
    depth_mm: Float[np.ndarray, " n"], covariance: Float[np.ndarray, "n 3 3"], labels: Mapping[str, float]
) -> dict[str, Any]:
    """Return expected scores, averaged over places, for each depth and for all depths together.

    `signal` contains the scores for exact labels, `with_label_errors` the scores for labels whose errors have the
    standard deviations `labels`.
    """
    no_errors = dict.fromkeys(labels, 0.0)
    scores = {
        name: pd.DataFrame(expected_scores(covariance, **sds))
        for name, sds in (("signal", no_errors), ("with_label_errors", labels))
    }
    rows = [
        {"depth_mm": float(depth)} | {name: table[depth_mm == depth].mean().to_dict() for name, table in scores.items()}
        for depth in np.unique(depth_mm)
    ]
    return {"by_depth": rows, "all": {name: table.mean().to_dict() for name, table in scores.items()}}


def score_network(models: Path, skin: str) -> dict[str, Any]:
    """Summarise, over folds, the scores of the paper's network on a skin.

    Raises `SchemaError` if the networks were trained on another skin.
    """
    cards = [io.read_json(file) for file in sorted(models.glob("*.json"))]
    cards = [card for card in cards if (card["question"], card["recipe_name"]) == (NETWORK, HEADLINE)]
    skins = sorted({name for card in cards for name in card["train_skins"]})
    if skins != [skin]:
        raise SchemaError(
            f"{models}: the networks of {NETWORK} were trained on skins {skins}, not on {skin}. Run stage "
            "train_single again."
        )
    scores = over_folds(rows_of_cards(cards))
    return {metric: scores[metric] for metric in METRICS if metric in scores}


SIDES = {"signal": "bound", "with_label_errors": "bound with label errors"}
NONE = "–"


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate the bound by depth and over all depths. Only the row over all depths has the scores of the network."""
    lines = [_line(f"{row['depth_mm']:g}", row, {}, source) for row in numbers["by_depth"]]
    lines.append(_line("all", numbers["all"], numbers["network"], source))
    spread = "± is the standard deviation of the network's scores over n folds."
    return {"bound": tabulate(lines, meaning=_meaning(numbers), spread=spread)}


def _line(depth: str, row: Mapping[str, Any], network: Mapping[str, Any], source: str) -> dict[str, str]:
    line = {"depth, mm": depth, "source": source}
    for metric, title in COLUMNS.items():
        if metric in row[next(iter(SIDES))]:  # there is no bound for R^2
            line |= {f"{title} ({name})": f"{row[side][metric]:.3g}" for side, name in SIDES.items()}
        line[f"{title} (network)"] = show(network.get(metric)) if network else NONE
    return line | {"n": n_of(network) if network else NONE}


def _meaning(numbers: Mapping[str, Any]) -> str:
    labels, above_n = numbers["labels"], numbers["above_the_skin_n"]
    above = f" {above_n} pokes that do not touch the skin are excluded." if above_n else ""
    return (
        "Bound (Cramér-Rao): the smallest error of an unbiased estimate from the change of field of one input row "
        f"({numbers['readings_n']} reading minus the mean of {numbers['noload_frames_n']} no-load readings), averaged "
        f"over the {numbers['places_n']} places of skin {numbers['skin']}. The accuracy of the bound assumes normally "
        "distributed errors. The only sources of error are the noise of the chips and rounding, because the skin, its "
        "board and the after-effects of earlier pokes are assumed to be known. Standard deviations of the labels' "
        f"errors: {labels['place_sd_mm']:g} mm per axis for the robot's position, and {labels['force_sd_N']:.2g} N for "
        f"the force sensor, which measures the force at the true depth.{above} Network: random passes of the same skin "
        "are held out. All places are on a grid. A network that learns this grid is biased towards its places, and may "
        "therefore have a smaller error than the bound."
    )
