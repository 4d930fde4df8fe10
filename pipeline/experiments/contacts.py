"""Two contacts at once on a held-out skin (paper section 7, future work).

The skins have no recordings of two simultaneous contacts, so the field change of two contacts is modelled as the sum of
the field changes of two pokes (single presses). The experiment tests
- which place and force networks predict for two contacts, if they were trained on single contacts,
- whether two contacts can be detected,
- by simulation, how much the true field change of two contacts differs from the sum.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Float32, Int64
from pydantic import Field
from scipy.constants import milli

from pipeline.experiments.detection import (
    NEIGHBOURS_N,
    NOISE_uT,
    Scores,
    above_pct,
    direction_distance,
    neighbour_distance,
    roc_areas,
    thresholds,
)
from pipeline.experiments.results import write_results
from pipeline.formatting import show_digits
from pipeline.plot import COLOURS, MARKERS, drawing, svg
from pipeline.settings import Settings
from pipeline.simulation import simulation_settings
from pipeline.statistics import statistic
from pipeline.training.jobs import SceneData, read_data
from reskin.config import Strict
from reskin.data.rows import Rows
from reskin.data.splits import Fold
from reskin.errors import ParamsError
from reskin.metrics import ACCURACY_LIMIT_MM
from reskin.models.inputs import shape
from reskin.models.trained import networks_held_out
from reskin.physics import deformation
from reskin.physics.board import Board, draw_board
from reskin.physics.magnet import Dipoles, change_of_field
from reskin.physics.skin import Skin, draw_skin
from reskin.seeds import rng_for
from reskin.simulation.capture import list_captures
from reskin.simulation.settings import MAIN, SimulationSettings

KNOWN_ROWS_N = 6000  # number of training rows, drawn at random, in which detectors search for nearest neighbours
# Number of single contacts that set the thresholds. As many other single contacts test the thresholds.
SINGLES_N = 1000
DRAWN_N = 60  # number of pairs in the figure, for each board and separation
# Separation in mm of pairs of pokes at the same place. Such pairs differ from a single poke only in the strength of the
# signal and in noise, so they show the effect of signal strength and noise alone.
SAME_PLACE = 0.0
TOLERANCE_MM = 0.5  # places are on a grid, so the separation of a pair may differ by this much (assumed)
PLACE_DECIMALS = 2  # places in mm are rounded to this many decimals before they are compared

Predict = Callable[[np.ndarray], np.ndarray]  # changes of field in uT -> x and y in mm, F in N


class Contacts(Strict):
    """Settings section `contacts`: number and separations of the pairs, and the intended fraction of false alarms."""

    pairs_n: Annotated[int, Field(ge=1)]
    separations_mm: Annotated[tuple[Annotated[float, Field(gt=0)], ...], Field(min_length=1)]
    false_alarm_fraction: Annotated[float, Field(gt=0, lt=1)]


def contacts(
    settings: Settings, section: Contacts, folds: Path, indentations: Path, models: Path, results: Path
) -> None:
    """Test networks on sums of two pokes of every board; the networks for a board were trained without this board."""
    data = read_data(settings, indentations, folds)
    boards, plot_data = zip(
        *(evaluate_board(data, fold, section, networks_held_out(models, fold.name)) for fold in data.folds_of("lobo")),
        strict=True,
    )
    stats = summarise_nested(boards)

    def row(separation_mm: float) -> dict[str, Any]:
        prediction, detected = stats["falls"][separation_mm], stats["by_separation"][separation_mm]
        return {"separation_mm": separation_mm, **prediction, **detected}

    numbers: dict[str, Any] = {
        "pairs_n": section.pairs_n,
        "boards_n": len(boards),
        # Two detectors use networks. These networks were trained on all training contacts, so their training data
        # include the contacts that set the thresholds.
        "threshold_set_on": (
            f"training contacts of one {plot_data[0]['kept_aside']}, to which the detectors are not fitted; but the "
            "networks behind `residual` and `networks disagree` were trained on these contacts"
        ),
        "noise": "the noise of two readings, because two field changes are added",
        "by_separation": [row(separation_mm) for separation_mm in section.separations_mm],
        "same_place": row(SAME_PLACE),
        "false_alarm_pct": {
            detector: {"asked": 100 * section.false_alarm_fraction, "realised": realised}
            for detector, realised in stats["false_alarm_pct"].items()
        },
        "auc": stats["auc"],
    }
    if "simulate" in settings.of_scene:
        numbers["superposition"] = superposition(
            simulation_settings(settings), section.separations_mm, seed=settings.seed
        )
    along = {s: [value for board_data in plot_data for value in board_data["along"][s]] for s in plot_data[0]["along"]}
    write_results(results, numbers, {"along": along})


def evaluate_board(
    data: SceneData, fold: Fold, section: Contacts, networks: Sequence[Predict]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Evaluate pairs of pokes of one held-out board; return the board's numbers, and the predicted places to plot."""
    rows = data.rows
    rng = rng_for(data.settings.seed, "contacts", fold.name)
    fit, aside, kept_aside = keep_aside(rows, fold.train)
    known = rng.choice(fit, min(KNOWN_ROWS_N, len(fit)), replace=False)
    singles = {
        side: rng.choice(row_i, min(SINGLES_N, len(row_i)), replace=False)
        for side, row_i in (("aside", aside), ("test", fold.test))
    }
    pairs = {
        separation_mm: draw_pairs(rows, fold.test, separation_mm, pairs_n=section.pairs_n, rng=rng)
        for separation_mm in (SAME_PLACE, *section.separations_mm)
    }

    def predict(db_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "m f 3"]:
        return np.stack([network(db_uT) for network in networks])

    def detect(db_uT: Float32[np.ndarray, "f ch"], predicted: Float32[np.ndarray, "m f 3"]) -> Scores:
        reference = rows.target[known], rows.db_uT[known]
        scores = {
            "direction and length": neighbour_distance(shape(rows.db_uT[known]), shape(db_uT)),
            "direction above noise": direction_distance(rows.db_uT[known], db_uT),
            "residual": residual(reference, predicted.mean(axis=0), db_uT),
        }
        return scores | ({"networks disagree": disagreement(predicted)} if len(predicted) > 1 else {})

    predicted = {s: predict(drawn_pairs.sum_uT(rows.db_uT)) for s, drawn_pairs in pairs.items()}
    double = {s: detect(drawn_pairs.sum_uT(rows.db_uT), predicted[s]) for s, drawn_pairs in pairs.items()}
    single = {side: detect(rows.db_uT[row_i], predict(rows.db_uT[row_i])) for side, row_i in singles.items()}
    numbers = detection_rates(single["aside"], single["test"], double, section.false_alarm_fraction)
    truth = {s: (rows.target[both.weaker], rows.target[both.stronger]) for s, both in pairs.items()}
    numbers["falls"] = {}
    for separation_mm, true_pair in truth.items():
        by_network = [compare_prediction(*true_pair, prediction) for prediction in predicted[separation_mm]]
        numbers["falls"][separation_mm] = {
            name: float(np.mean([comparison[name] for comparison in by_network])) for name in by_network[0]
        }
    along = {
        f"{s:g}": position_along_line(*truth[s], predicted[s][0])[:DRAWN_N].round(2).tolist()
        for s in section.separations_mm
    }
    return numbers, {"kept_aside": kept_aside, "along": along}


# --- Pairs of pokes ---


@dataclass(frozen=True)
class Pairs:
    """Pairs of pokes on the same skin, as row numbers.

    In each pair, the weaker poke is the one with the smaller force or, if some forces are unknown, with the smaller
    |dB|.
    """

    weaker: Int64[np.ndarray, " p"]
    stronger: Int64[np.ndarray, " p"]

    def sum_uT(self, db_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "p ch"]:
        """Return the sum of the changes of field of both pokes of each pair."""
        return db_uT[self.weaker] + db_uT[self.stronger]


def draw_pairs(
    rows: Rows, candidates: Int64[np.ndarray, " a"], separation_mm: float, *, pairs_n: int, rng: np.random.Generator
) -> Pairs:
    """Draw pairs of rows at two places of a skin whose distance is `separation_mm`.

    For each pair, two places are drawn first, and then one row at each place. `candidates` are the row numbers to draw
    from. With a separation of 0 mm, both rows are at the same place.
    """
    by_skin = [
        _pairs_at_distance(rows, candidates[rows.skin[candidates] == skin], separation_mm)
        for skin in np.unique(rows.skin[candidates])
    ]
    sides = [(rows_at[i], rows_at[j]) for rows_at, pairs in by_skin for i, j in pairs]
    if not sides:
        what = f"no two held-out places of one skin are {separation_mm:g} mm apart, within {TOLERANCE_MM:g} mm"
        raise ParamsError(f"contacts: {what}. Correct contacts.separations_mm of the scene.")
    chosen = [sides[k] for k in rng.integers(len(sides), size=pairs_n)]
    first, second = (np.array([rng.choice(side) for side in both]) for both in zip(*chosen, strict=True))
    force_N, length_uT = rows.target[:, 2], np.linalg.norm(rows.db_uT, axis=1)
    strength = length_uT if np.isnan(force_N[candidates]).any() else force_N
    swap = strength[first] > strength[second]
    return Pairs(np.where(swap, second, first), np.where(swap, first, second))


def _pairs_at_distance(
    rows: Rows, skin_rows: Int64[np.ndarray, " a"], separation_mm: float
) -> tuple[list[Int64[np.ndarray, " b"]], Int64[np.ndarray, "p 2"]]:
    """Return the row numbers at each place of a skin, and the pairs of places whose distance is `separation_mm`.

    A pair consists of the indices of two places. `skin_rows` are the row numbers of the skin.
    """
    places_mm, place_i = np.unique(rows.target[skin_rows, :2].round(PLACE_DECIMALS), axis=0, return_inverse=True)
    order = np.argsort(place_i.ravel(), kind="stable")
    rows_at = np.split(skin_rows[order], np.cumsum(np.bincount(place_i.ravel()))[:-1])
    distance_mm = np.linalg.norm(places_mm[:, None] - places_mm, axis=2)
    near = np.abs(distance_mm - separation_mm) <= TOLERANCE_MM
    # A place is paired with itself only if the separation is 0 mm. For other small separations, such a pair would also
    # be within the tolerance, so it must be excluded.
    return rows_at, np.argwhere(np.triu(near, k=1) if separation_mm else np.eye(len(places_mm), dtype=bool))


def keep_aside(rows: Rows, train: Int64[np.ndarray, " a"]) -> tuple[np.ndarray, np.ndarray, str]:
    """Split training rows into rows to which detectors are fitted, and rows that set the thresholds.

    The thresholds are set with the rows of the last board. If there is only one board, the rows of its last skin are
    used; if there is only one skin, the rows of its last pass. The third return value is `board`, `skin` or `pass`.
    """
    for what, labels in (("board", rows.board), ("skin", rows.skin), ("pass", rows.pass_i)):
        kinds = np.unique(labels[train])
        if len(kinds) > 1:
            last = labels[train] == kinds[-1]
            return train[~last], train[last], what
    what = "the training rows are of a single board, skin and pass; two boards, skins or passes are needed"
    raise ParamsError(f"contacts: {what}. Record a second pass, skin or board, or remove contacts from the scene.")


def compare_prediction(
    weaker: Float32[np.ndarray, "p 3"], stronger: Float32[np.ndarray, "p 3"], predicted: Float32[np.ndarray, "p 3"]
) -> dict[str, float]:
    """Compare a prediction of one contact (x_mm, y_mm, F_N) with the two true contacts of each pair.

    The result contains ratios of forces only if all true forces are known.
    """
    off_mm = np.stack([predicted[:, :2] - side[:, :2] for side in (weaker, stronger)])
    numbers = {
        "near_either_pct": 100 * float((np.abs(off_mm) <= ACCURACY_LIMIT_MM).all(axis=2).any(axis=0).mean()),
        "nearest_mm": float(np.linalg.norm(off_mm, axis=2).min(axis=0).mean()),
    }
    if (np.abs(stronger - weaker)[:, :2] > 0).any(axis=1).all():
        nearer = np.linalg.norm(off_mm[1], axis=1) < np.linalg.norm(off_mm[0], axis=1)
        numbers["nearer_the_stronger_pct"] = 100 * float(nearer.mean())
        numbers["along"] = float(position_along_line(weaker, stronger, predicted).mean())
    force_N = np.stack([weaker[:, 2], stronger[:, 2]]).astype(np.float64)
    if not np.isnan(force_N).any():
        predicted_N = float(predicted[:, 2].sum(dtype=np.float64))
        numbers["force_over_sum"] = predicted_N / float(force_N.sum())
        numbers["force_over_larger"] = predicted_N / float(force_N.max(axis=0).sum())
    return numbers


def position_along_line(
    weaker: Float32[np.ndarray, "p 3"], stronger: Float32[np.ndarray, "p 3"], predicted: Float32[np.ndarray, "p 3"]
) -> Float[np.ndarray, " p"]:
    """Return each prediction's position along the line from the weaker contact (0) to the stronger contact (1)."""
    line_mm = (stronger - weaker)[:, :2].astype(np.float64)
    return ((predicted - weaker)[:, :2] * line_mm).sum(axis=1) / (line_mm**2).sum(axis=1)


# --- Detectors ---


def detection_rates(
    aside: Scores, single: Scores, double: Mapping[float, Scores], false_alarm_fraction: float
) -> dict[str, Any]:
    """Return the rates of detection and of false alarms of each detector, and the area under the ROC curve.

    A detector reports two contacts if its score is above its threshold. `aside` contains the scores of the single
    contacts that set the thresholds. `single` contains the scores of other single contacts, which give the rate of
    false alarms. `double` maps each separation in mm to the scores of double contacts, which give the rates of
    detection.
    """
    limits = thresholds(aside, false_alarm_fraction)
    separated = {
        name: np.concatenate([scores[name] for separation_mm, scores in double.items() if separation_mm])
        for name in aside
    }
    return {
        "false_alarm_pct": above_pct(single, limits),
        "auc": roc_areas(single, separated),
        "by_separation": {
            separation_mm: {"detected_pct": above_pct(scores, limits), "auc": roc_areas(single, scores)}
            for separation_mm, scores in double.items()
        },
    }


def residual(
    known: tuple[Float[np.ndarray, "a 3"], Float[np.ndarray, "a ch"]],
    predicted: Float[np.ndarray, "f 3"],
    db_uT: Float[np.ndarray, "f ch"],
) -> Float[np.ndarray, " f"]:
    """Return how badly the predicted single contact explains each reading.

    A network predicts one contact (x_mm, y_mm, F_N) from a reading. The dB that such a contact would cause is
    interpolated from `known` contacts, which are given as (x_mm, y_mm, F_N) and dB in uT. The interpolation uses the
    known contacts with the most similar place and, if forces are known, the most similar force. The result is the norm
    of the difference between the interpolated dB and the reading, divided by the reading's |dB| plus noise.
    """
    from sklearn.neighbors import KNeighborsRegressor  # imported here because importing scikit-learn takes a second

    target, known_uT = known
    columns = ~np.isnan(target).any(axis=0)
    scale = np.maximum(target[:, columns].std(axis=0), 1e-12)
    model = KNeighborsRegressor(min(NEIGHBOURS_N, len(target)), weights="distance")
    expected_uT = model.fit(target[:, columns] / scale, known_uT).predict(predicted[:, columns] / scale)
    return np.linalg.norm(db_uT - expected_uT, axis=1) / (np.linalg.norm(db_uT, axis=1) + NOISE_uT)


def disagreement(predicted: Float[np.ndarray, "m f 3"]) -> Float[np.ndarray, " f"]:
    """Return how much networks with different seeds disagree on the place of each contact.

    The disagreement is the rms distance, in mm, between the predicted places and their mean.
    """
    place_mm = predicted[:, :, :2]
    return np.sqrt(((place_mm - place_mm.mean(axis=0)) ** 2).sum(axis=2).mean(axis=0))


def summarise_nested(boards: Sequence[Any]) -> Any:
    """Summarise the results of several boards, which are nested mappings of equal structure.

    In the result, each number is replaced by its statistic over boards.
    """
    first = boards[0]
    if isinstance(first, Mapping):
        return {key: summarise_nested([board[key] for board in boards if key in board]) for key in first}
    return statistic(boards, boards=True)


# --- Superposition of simulated fields ---

PAIRS_N = 6  # number of pairs drawn for each separation
MIDDLE_MM = 2.0  # largest distance of a pair's midpoint from the skin's middle, along each axis
HEIGHTS_N = 9  # number of heights in the table of displacements, which is interpolated linearly between heights


def superposition(
    simulation: SimulationSettings, separations_mm: Sequence[float], *, seed: int
) -> list[dict[str, Any]]:
    """Return the rms error of the assumption that the field changes of two single contacts can be added.

    The field change of two contacts is simulated, and compared with the sum of the field changes of the single
    contacts. The skin is the first skin of the scene. The result has one row for each depth and separation; the two
    depths are the largest commanded depth, and half of it.
    """
    board_name, skin_name = list_captures(simulation, MAIN)[0]
    board = draw_board(simulation.main_boards.design, simulation.spreads, seed=seed, name=board_name)
    rule = simulation.main_boards.quadrature.in_si()
    skin = draw_skin(simulation.skin, simulation.spreads, seed=seed, name=skin_name, rule=rule)
    rng = rng_for(seed, "superposition")
    centres_mm, angles = rng.uniform(-MIDDLE_MM, MIDDLE_MM, (PAIRS_N, 2)), rng.uniform(0, np.pi, PAIRS_N)
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rows = []
    for depth_mm in (max(simulation.main.depths_mm) / 2, max(simulation.main.depths_mm)):
        depth_m = np.full(PAIRS_N, depth_mm * milli + skin.depth_zero_m)
        for separation_mm in separations_mm:
            half_mm = separation_mm / 2 * directions
            ends_m = [
                np.column_stack([place_mm * milli, depth_m])
                for place_mm in (centres_mm - half_mm, centres_mm + half_mm)
            ]
            changes_T = np.array([_changes_of_pair(board, skin, *pair) for pair in zip(*ends_m, strict=True)])
            keys = {"depth_mm": depth_mm, "separation_mm": separation_mm, "pairs_n": PAIRS_N}
            rows.append(keys | _errors(changes_T))
    return rows


def press_on(skin: Skin, dipoles: Dipoles, poke_m: Float[np.ndarray, "3"]) -> Dipoles:
    """Return dipoles after a poke (x, y and true depth in metres) has displaced and rotated them.

    The given dipoles may be at rest, or already displaced by another poke.
    """
    nodes_m, moments_A_m2 = dipoles
    heights = np.linspace(0, 1, HEIGHTS_N)
    position = nodes_m[:, 2] / skin.thickness_m * (HEIGHTS_N - 1)
    low = np.clip(position.astype(np.intp), 0, HEIGHTS_N - 2)
    fraction = (position - low)[:, None]
    table = deformation.tabulate(
        skin.thickness_m, skin.tip_radius_m, float(poke_m[2]), heights=tuple(heights.tolist()), base=skin.base
    )
    below, above = (
        deformation.move_dipoles(
            table, deformation.RestingDipoles(nodes_m, moments_A_m2, low + i, tuple(heights)), poke_m
        )
        for i in (0, 1)
    )
    after_m, rotated_A_m2 = nodes_m.copy(), moments_A_m2.copy()
    weight = fraction[below.i]
    after_m[below.i] = (1 - weight) * below.after[0] + weight * above.after[0]
    rotated_A_m2[below.i] = (1 - weight) * below.after[1] + weight * above.after[1]
    return after_m, rotated_A_m2


def _changes_of_pair(
    board: Board, skin: Skin, a_m: Float[np.ndarray, "3"], b_m: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 k 3"]:
    """Return four changes of field in tesla: by contact a alone, b alone, a pressed before b, and b before a."""
    rest = skin.nodes_m, skin.moments_A_m2
    only_a, only_b = press_on(skin, rest, a_m), press_on(skin, rest, b_m)
    pressed = (only_a, only_b, press_on(skin, only_a, b_m), press_on(skin, only_b, a_m))
    return np.stack([change_of_field(rest, after, board.chips_m) for after in pressed])


def _errors(changes_T: Float[np.ndarray, "p 4 k 3"]) -> dict[str, float]:
    a, b, ab, ba = np.moveaxis(changes_T, 1, 0)
    together = (ab + ba) / 2
    size = np.sqrt((together**2).mean())
    return {
        "error_pct": 100 * float(np.sqrt(((a + b - together) ** 2).mean()) / size),
        "orders_differ_pct": 100 * float(np.sqrt(((ab - ba) ** 2).mean()) / size),
    }


# --- Tables and figures ---

MEANING = (
    "Two contacts at once are modelled as the sum of two field changes that were recorded on the same held-out skin, "
    "so their noise is that of two readings. Networks that were trained on single contacts predict one place and one "
    "force. The first two columns of results compare the predicted place with the two true places. Column `along the "
    "line` is the position of the predicted place on the line from the weaker contact (0) to the stronger contact (1). "
    "Detected: percentage of the double contacts for which the score of a detector is above its threshold. Thresholds "
    "are set so that a given fraction of single contacts of training skins exceeds them. Row `single contacts` "
    "contains the false alarms: the percentage of single contacts of the held-out boards that are above the "
    "thresholds. The networks behind `residual` and `networks disagree` were trained on the contacts that set the "
    "thresholds, so these two thresholds may be too low. At 0 mm, both pokes are at one place: this row shows the "
    "effect of signal strength and noise alone. [low, high] is the 95 % confidence interval over held-out boards "
    "(Student's t). The paper gives no number (section 7: future work)."
)
TWO_TIPS = (
    "Two real tips cannot be closer than their width. Smaller distances are possible only because the field changes of "
    "two separate pokes are added."
)


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate predictions and detections by distance, and the error of superposition."""
    rows = [
        _table_row(numbers["same_place"], numbers),
        *(_table_row(result, numbers) for result in numbers["by_separation"]),
    ]
    false_alarm = {"distance of the contacts, mm": "single contacts"} | {
        f"detected by {name}, %": show_digits(result["realised"], 1)
        for name, result in numbers["false_alarm_pct"].items()
    }
    table = pd.DataFrame([*rows, false_alarm]).fillna("–").assign(source=source)
    asked = next(iter(numbers["false_alarm_pct"].values()))["asked"]
    table.attrs["meaning"] = f"{MEANING} Thresholds are set for {asked:g} % false alarms. {TWO_TIPS}"
    result = {"contacts": table}
    if "superposition" in numbers:
        result["superposition"] = _superposition(numbers["superposition"], source)
    return result


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Plot predicted places along the line between two contacts, and how often two contacts are detected."""
    with drawing(7.8, 4.4) as figure:
        left, right = figure.subplots(1, 2)
        _draw_places(left, drawn["along"])
        _draw_detection(right, numbers)
        figure.suptitle(f"Two contacts at once on held-out skins ({source})", x=0.01, ha="left", fontsize=11)
        return {"contacts.svg": svg(figure)}


def _draw_places(axes: Any, along: Mapping[str, Sequence[float]]) -> None:
    separations_mm = sorted(map(float, along))
    width_mm = 0.5 * min([b - a for a, b in pairwise(separations_mm)] or [1.0])
    places_mm = [[mm * share for share in along[f"{mm:g}"]] for mm in separations_mm]
    boxes = {"widths": width_mm, "showfliers": False, "manage_ticks": False, "medianprops": {"color": COLOURS[0]}}
    axes.boxplot(places_mm, positions=separations_mm, whis=(5, 95), **boxes)
    ends_mm = [separations_mm[0] - width_mm, separations_mm[-1] + width_mm]
    axes.plot(ends_mm, ends_mm, color=COLOURS[2], label="stronger contact")
    axes.plot(ends_mm, [0, 0], color=COLOURS[1], linestyle="--", label="weaker contact")
    axes.set(xlabel="distance of the contacts / mm", ylabel="predicted place on the line between them / mm")
    axes.set_title("Predicted place (box: middle 50 %; whiskers: 90 %)", loc="left", fontsize=10)
    axes.set_ylim(top=1.45 * ends_mm[1])
    axes.legend(frameon=False, loc="upper left", fontsize=9)


def _draw_detection(axes: Any, numbers: Mapping[str, Any]) -> None:
    rows, together = numbers["by_separation"], numbers["same_place"]
    distance_mm = [row["separation_mm"] for row in rows]
    for i, (name, alarm) in enumerate(numbers["false_alarm_pct"].items()):
        detected_pct = [row["detected_pct"][name]["mean"] for row in rows]
        colour, marker = COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)]
        axes.plot(distance_mm, detected_pct, color=colour, marker=marker, label=name)
        at_one = together["detected_pct"][name]["mean"]
        axes.plot(
            together["separation_mm"], at_one, color=colour, marker=marker, markerfacecolor="white", clip_on=False
        )
        axes.axhline(alarm["realised"]["mean"], color=colour, linestyle=":", linewidth=1)
    axes.set(xlabel="distance of the contacts / mm", ylabel="detected as two contacts / %", ylim=(0, 100))
    axes.set_title(
        "Detected as two contacts (dotted: false alarms;\nhollow: both contacts at one place)", loc="left", fontsize=10
    )
    axes.legend(frameon=False, loc="upper left", fontsize=9)


def _table_row(result: Mapping[str, Any], numbers: Mapping[str, Any]) -> dict[str, str]:
    row = {
        "distance of the contacts, mm": f"{result['separation_mm']:g}",
        "prediction within 1 mm of a contact, %": show_digits(result["near_either_pct"], 1),
        "distance to the nearer contact, mm": show_digits(result["nearest_mm"], 2),
    }
    optional = {
        "along": "along the line (0 weaker, 1 stronger)",
        "force_over_sum": "force / sum of both forces",
        "force_over_larger": "force / larger of both forces",
    }
    row |= {title: show_digits(result[name], 2) for name, title in optional.items() if name in result}
    return row | {
        f"detected by {name}, %": show_digits(result["detected_pct"][name], 1) for name in numbers["false_alarm_pct"]
    }


def _superposition(rows: Sequence[Mapping[str, Any]], source: str) -> pd.DataFrame:
    table = pd.DataFrame(
        {
            "depth of both contacts, mm": f"{row['depth_mm']:g}",
            "distance of the contacts, mm": f"{row['separation_mm']:g}",
            "error of the sum, % of the change of field": f"{row['error_pct']:.1f}",
            "difference of the two orders, %": f"{row['orders_differ_pct']:.1f}",
            "pairs": row["pairs_n"],
            "source": source,
        }
        for row in rows
    )
    table.attrs["meaning"] = (
        "Compares two changes of field (rms over chips and pairs of contacts). One is the sum of the changes of field "
        "of two single contacts. The other is the change of field if both contacts are on one skin, so that the second "
        "contact displaces material that the first contact has already displaced. It depends on which contact is "
        "first, so the mean of both orders is used, and column `difference of the two orders` states how much they "
        "differ. Neglected effect: each contact also lowers the surface under the other tip."
    )
    return table
