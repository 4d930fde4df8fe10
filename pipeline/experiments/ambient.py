"""Ambient fields and nearby iron that appear after the no-load reading (paper section 7, future work).

The experiment measures how much these disturbances degrade the scores of networks on held-out boards. Two methods try
to remove a disturbance from the readings. The first method subtracts the reading of a separate reference chip beside
the skin. The second method subtracts the common part of the board's own chips, which is the uniform field that best
fits the readings of all these chips.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Float32, Int64
from pydantic import Field
from scipy.constants import micro, milli
from scipy.spatial.transform import Rotation

from pipeline.experiments.results import write_results
from pipeline.formatting import show_digits
from pipeline.plot import COLOURS, MARKERS, drawing, svg
from pipeline.settings import Settings, Training
from pipeline.simulation import simulation_settings
from pipeline.statistics import add_seed_sd, summarise, tally
from pipeline.training.jobs import SceneData, collapse_record, make_jobs, read_data, train_jobs
from reskin.config import Strict
from reskin.data.splits import Fold
from reskin.metrics import score
from reskin.models.recipe import HEADLINE
from reskin.models.trained import Network, networks_held_out
from reskin.physics.ambient import EARTH_DIP_DEG, EARTH_SIZE_T, EARTH_T, ball_field, ball_images, random_directions
from reskin.physics.board import Board, BoardDesign, draw_board
from reskin.physics.skin import Skin, draw_skin
from reskin.seeds import rng_for
from reskin.simulation.settings import SimulationSettings

# Distance of the reference chip from the board's middle, along x. The reference chip is assumed to be so far from the
# skin that a poke does not change the field at this chip.
REFERENCE_ASIDE_MM = 30.0
AS_IT_IS, ASIDE, OWN = "reading as it is", "reference chip subtracted", "common part of all chips subtracted"

Networks = Mapping[str, Sequence[Network]]  # networks by method of subtraction (AS_IT_IS, ASIDE, OWN)


class Iron(Strict):
    """A ball of soft iron directly above the middle of the skin."""

    radius_mm: Annotated[float, Field(gt=0, le=100)]
    # Each distance is from the top of the skin to the surface of the ball.
    distances_mm: Annotated[tuple[Annotated[float, Field(gt=0)], ...], Field(min_length=1)]


class Ambient(Strict):
    """Settings section `ambient`: strengths of uniform fields, and the ball of iron."""

    fields_uT: Annotated[tuple[Annotated[float, Field(ge=0)], ...], Field(min_length=1)]
    iron: Iron


def ambient(settings: Settings, section: Ambient, folds: Path, indentations: Path, models: Path, results: Path) -> None:
    """Score the networks of every held-out board in ambient fields.

    The method that subtracts the common part of all chips (see `remove_common_part`) needs networks that were trained
    on inputs from which this part was also subtracted. To save time, such networks are trained only for the last
    board.
    """
    data = read_data(settings, indentations, folds)
    synthesis, seed = simulation_settings(data.settings), data.settings.seed
    training = data.settings.section(Training, "train_multi")
    held_out = data.folds_of("lobo")
    boards = [fold.name for fold in held_out]
    points: list[dict[str, Any]] = []
    for fold in held_out:
        instrument = draw_instrument(synthesis, fold.name, seed=seed)
        networks = dict.fromkeys((AS_IT_IS, ASIDE), networks_held_out(models, fold.name))
        if fold is held_out[-1]:
            networks[OWN], trainings = train_without_common_part(data, fold, training, instrument)
        points += score_board(data, fold, section, synthesis, instrument, networks)
    last = boards[-1:]
    numbers = {
        "arms": {
            AS_IT_IS: "nothing but the no-load reading is subtracted from the input of the paper's network",
            ASIDE: f"a reference chip {REFERENCE_ASIDE_MM:g} mm from the middle of the board measures the ambient "
            "field, and its mean reading is subtracted from the readings of all chips of the board",
            OWN: "the uniform field that best fits the readings of the board's own chips is subtracted from these "
            "readings, in training and in use",
        },
        "boards_n": len(boards),
        "seeds_n": training.seeds_n,
        "directions": "drawn at random for each poke",
        "earth_uT": EARTH_SIZE_T / micro,
        "earth_dip_deg": EARTH_DIP_DEG,
        "iron_radius_mm": section.iron.radius_mm,
        "uniform": scores_by_field(points, "field_uT", boards),
        "iron": scores_by_field(points, "distance_mm", boards),
        "last_board": {
            "board": boards[-1],
            "uniform": scores_by_field(points, "field_uT", last),
            "iron": scores_by_field(points, "distance_mm", last),
        },
    }
    write_results(results, numbers, {}, trainings=trainings)


@dataclass(frozen=True)
class Instrument:
    """A board (`board`) and a separate reference chip (`aside`), both with their manufacturing errors.

    `turn` contains the rotations of the board's chips as designed, without manufacturing errors. The methods that
    subtract a field use only these rotations, because the manufacturing errors of a real board are unknown.
    """

    board: Board
    aside: Board
    turn: Float[np.ndarray, "k 3 3"]
    # Standard deviation, per axis, of the noise of the reference chip's change of field.
    noise_uT: Float[np.ndarray, " 3"]


@dataclass(frozen=True)
class Disturbance:
    """One ambient field, and its effect on the input rows.

    - keys: the strength of a uniform field, or the distance of the ball of iron and the rms fields that the ball
      causes.
    - added_uT: the change that the ambient field causes in each input row.
    - reference_uT: the estimate of this change from the reading of the reference chip.
    """

    keys: Mapping[str, float]
    added_uT: Float[np.ndarray, "f ch"]
    reference_uT: Float[np.ndarray, "f ch"]


def train_without_common_part(
    data: SceneData, fold: Fold, training: Training, instrument: Instrument
) -> tuple[list[Network], dict[str, int]]:
    """Train the headline recipe on inputs without the common part of all chips.

    Returns the networks, and the numbers of networks trained and collapsed (`pipeline.statistics.tally`).
    """
    projected_uT = project(data.rows.db_uT, remove_common_part(instrument.turn))
    headline = training.model_copy(update={"recipes": {HEADLINE: training.recipes[HEADLINE]}})
    jobs = make_jobs(data, headline, [fold], experiment="ambient")
    trained = train_jobs(replace(data, rows=replace(data.rows, db_uT=projected_uT)), jobs, "ambient")
    networks = [
        Network({"recipe": job.recipe.model_dump(mode="json")}, {**result.weights, **result.scaler.arrays()})
        for job, result in zip(jobs, trained, strict=True)
    ]
    return networks, tally(map(collapse_record, trained))


def score_board(
    data: SceneData,
    fold: Fold,
    section: Ambient,
    synthesis: SimulationSettings,
    instrument: Instrument,
    networks: Networks,
) -> Iterator[dict[str, Any]]:
    """Yield the scores of every network of every method in every ambient field, on the held-out board of `fold`.

    The networks are tested on one reading of each poke of the board, which is drawn at random.
    """
    rows, seed = data.rows, data.settings.seed
    test = one_row_per_poke(rows.indentation, fold.test, rng_for(seed, "ambient", fold.name, "pokes"))
    db_uT, true = rows.db_uT[test], rows.target[test]
    without_common = remove_common_part(instrument.turn)
    methods: dict[str, Callable[[Disturbance], np.ndarray]] = {
        AS_IT_IS: lambda disturbance: db_uT + disturbance.added_uT,
        ASIDE: lambda disturbance: db_uT + disturbance.added_uT - disturbance.reference_uT,
        OWN: lambda disturbance: project((db_uT + disturbance.added_uT).astype(np.float32), without_common),
    }
    names, skin_i = np.unique(rows.skin[test], return_inverse=True)
    rule = synthesis.main_boards.quadrature.in_si()
    skins = [draw_skin(synthesis.skin, synthesis.spreads, seed=seed, name=str(name), rule=rule) for name in names]
    uniform_rng, iron_rng = (rng_for(seed, "ambient", fold.name, kind) for kind in ("uniform", "iron"))
    for disturbance in (
        *uniform_fields(instrument, section.fields_uT, rows_n=len(test), rng=uniform_rng),
        *iron_balls(instrument, skins, skin_i, section.iron, rng=iron_rng),
    ):
        for method, trained in networks.items():
            inputs_uT = methods[method](disturbance).astype(np.float32)
            for network in trained:
                yield {"board": fold.name, "arm": method, **disturbance.keys, "scores": score(true, network(inputs_uT))}


def one_row_per_poke(
    indentation: Int64[np.ndarray, " f"], candidates: Int64[np.ndarray, " a"], rng: np.random.Generator
) -> Int64[np.ndarray, " b"]:
    """Draw one row at random from each indentation; `candidates` are the row numbers to draw from.

    `indentation` has one element for every row of the scene. The result is sorted.
    """
    shuffled = rng.permutation(candidates)
    return np.sort(shuffled[np.unique(indentation[shuffled], return_index=True)[1]])


def scores_by_field(points: Sequence[dict[str, Any]], axis: str, boards: Sequence[str]) -> list[dict[str, Any]]:
    """Summarise scores over `boards` in one row per value of `axis`, with one entry per method tested on these boards.

    Each element of `points` contains the scores of one network in one ambient field; `axis` is `field_uT` or
    `distance_mm`. In the result, `sd_seeds` is the standard deviation over the networks of one board, averaged over
    boards.
    """
    selected = [point for point in points if axis in point and point["board"] in boards]
    rows = []
    for value in sorted({point[axis] for point in selected}):
        at_value = [point for point in selected if point[axis] == value]
        row: dict[str, Any] = {axis: value}
        for size, name in (("rms_uT", "field_uT"), ("aside_rms_uT", "aside_field_uT")):
            if size in at_value[0]:
                row[name] = float(np.sqrt(np.mean([point[size] ** 2 for point in at_value])))
        for method in dict.fromkeys(point["arm"] for point in at_value):
            scores = pd.DataFrame(
                [{"board": point["board"], **point["scores"]} for point in at_value if point["arm"] == method]
            )
            row[method] = add_seed_sd(summarise(scores.groupby("board").mean(), boards=True), scores, "board")
        rows.append(row)
    return rows


def rms_uT(b_T: Float[np.ndarray, "*f 3"]) -> float:
    """Return the root mean square, in uT, of the magnitudes of field vectors in tesla."""
    return float(np.sqrt((b_T**2).sum(axis=-1).mean())) / micro


# --- Fields at the chips ---


def draw_instrument(simulation: SimulationSettings, name: str, *, seed: int) -> Instrument:
    """Draw the same board as in the captures of board `name`, and a reference chip with manufacturing errors.

    The manufacturing errors of the reference chip have the same distribution as those of the board's chips.
    """
    design, rig, chip = simulation.main_boards.design, simulation.rig, simulation.chip
    lone = BoardDesign(chips_xy_mm=((REFERENCE_ASIDE_MM, 0.0),), chips_turn_deg=(0.0,), gap_mm=design.gap_mm)
    noise = np.array([chip.noise_xy_uT, chip.noise_xy_uT, chip.noise_z_uT])
    return Instrument(
        board=draw_board(design, simulation.spreads, seed=seed, name=name),
        aside=draw_board(lone, simulation.spreads, seed=seed, name=f"{name}-aside"),
        turn=Rotation.from_euler("z", np.array(design.chips_turn_deg)[:, None], degrees=True).as_matrix(),
        noise_uT=noise * np.sqrt(1 / rig.readings_n + 1 / rig.noload_frames_n),
    )


def readings_uT(board: Board, b_T: Float[np.ndarray, "f k 3"]) -> Float[np.ndarray, "f ch"]:
    """Return how a board's readings change, without noise, if the fields `b_T` are added at the chips of the board."""
    to_chip = board.sensitivity @ board.turn.transpose(0, 2, 1)
    return np.einsum("kij,fkj->fki", to_chip, b_T).reshape(len(b_T), -1) / micro


def reference_uT(
    instrument: Instrument, aside_T: Float[np.ndarray, "f 3"], rng: np.random.Generator
) -> Float[np.ndarray, "f ch"]:
    """Estimate the change of the board's readings by an ambient field, from a noisy reading of the reference chip.

    The ambient field is assumed to be the same at all chips. The reading of the reference chip is therefore only
    rotated into the axes of each chip of the board, as designed. `aside_T` is the true ambient field at the reference
    chip.
    """
    read_uT = readings_uT(instrument.aside, aside_T[:, None]) + instrument.noise_uT * rng.standard_normal(
        (len(aside_T), 3)
    )
    return np.einsum("kji,fj->fki", instrument.turn, read_uT).reshape(len(read_uT), -1)


def remove_common_part(turn: Float[np.ndarray, "k 3 3"]) -> Float[np.ndarray, "ch ch"]:
    """Return the projection matrix that subtracts from a reading its best-fitting uniform field (least squares).

    `turn` contains the rotations of the chips in the design.
    """
    uniform = turn.transpose(0, 2, 1).reshape(-1, 3)  # readings of unit fields along x, y, z
    return np.eye(len(uniform)) - uniform @ np.linalg.pinv(uniform)


def project(db_uT: Float32[np.ndarray, "f ch"], matrix: Float[np.ndarray, "ch ch"]) -> Float32[np.ndarray, "f ch"]:
    """Multiply each row of `db_uT` by `matrix`."""
    return (db_uT @ matrix.T).astype(np.float32)


def uniform_fields(
    instrument: Instrument, fields_uT: Sequence[float], *, rows_n: int, rng: np.random.Generator
) -> Iterator[Disturbance]:
    """Yield the disturbances by a zero field and by uniform fields of the given strengths, in increasing order.

    Each input row has a random direction of the field, which is the same for all strengths.
    """
    along = random_directions(rows_n, rng)
    for field_uT in sorted({0.0, *fields_uT}):
        b_T = field_uT * micro * along
        added_uT = readings_uT(instrument.board, np.repeat(b_T[:, None], len(instrument.turn), axis=1))
        yield Disturbance({"field_uT": field_uT}, added_uT, reference_uT(instrument, b_T, rng))


def iron_balls(
    instrument: Instrument,
    skins: Sequence[Skin],
    skin_i: Int64[np.ndarray, " f"],
    iron: Iron,
    *,
    rng: np.random.Generator,
) -> Iterator[Disturbance]:
    """Yield the disturbance by a ball of iron above the skin, for each of its distances in increasing order.

    `skin_i` contains, for each row, the index of its skin in `skins`.
    """
    for distance_mm in sorted(iron.distances_mm):
        fields_T = [iron_fields(instrument, skin, radius_mm=iron.radius_mm, distance_mm=distance_mm) for skin in skins]
        chips_T, aside_T = np.stack([chips for chips, _ in fields_T]), np.concatenate([aside for _, aside in fields_T])
        keys = {"distance_mm": distance_mm, "rms_uT": rms_uT(chips_T), "aside_rms_uT": rms_uT(aside_T)}
        added_uT = readings_uT(instrument.board, chips_T)[skin_i]
        yield Disturbance(keys, added_uT, reference_uT(instrument, aside_T[skin_i], rng))


def iron_fields(
    instrument: Instrument, skin: Skin, *, radius_mm: float, distance_mm: float
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "1 3"]]:
    """Return the field in tesla that a ball of iron adds at the board's chips, and at the reference chip.

    The ball is directly above the skin's middle; `distance_mm` is the distance from the top of the skin to the ball's
    surface. The ball is magnetised by the earth's field and by the field of the undeformed skin.
    """
    above_m = skin.thickness_m + (distance_mm + radius_mm) * milli
    centre_m = np.append(skin.seat_m, above_m)
    chips_m = np.concatenate([instrument.board.chips_m, instrument.aside.chips_m])
    added_T = ball_field(chips_m, EARTH_T, centre_m=centre_m, radius_m=radius_mm * milli)
    added_T += ball_images(chips_m, (skin.nodes_m, skin.moments_A_m2), centre_m=centre_m, radius_m=radius_mm * milli)
    return added_T[:-1], added_T[-1:]


# --- Tables and figures ---

COLUMNS = {
    "accuracy_pct": ("accuracy, %", 1), "mse_xy_mm2": ("MSE_xy, mm²", 2), "mse_f_N2": ("MSE_F, N²", 3),
}  # fmt: skip
DASHES = ("-", "--", "-.")  # line styles of the methods, so that overlapping lines can be distinguished


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate the scores of every method in every field.

    Some rows are means over all held-out boards. Other rows are for the last board alone, because this is the only
    board for which the networks of all methods were trained.
    """
    last = numbers["last_board"]
    summaries = (("all held out", numbers), (str(last["board"]), last))
    rows = [
        {"field": field, "boards": boards, "method": method} | _scores(row[method]) | {"source": source}
        for boards, summary in summaries
        for kind in ("uniform", "iron")
        for row in summary[kind]
        for field in [_field(kind, row)]
        for method in numbers["arms"]
        if method in row and (boards == last["board"] or row[method]["mse_xy_mm2"]["n"] == numbers["boards_n"])
    ]
    table = pd.DataFrame(rows)
    meanings = "; ".join(f"{method}: {text}" for method, text in numbers["arms"].items())
    table.attrs["meaning"] = (
        "The field appears after the no-load reading, so subtracting the no-load reading does not remove the field. "
        f"The direction of a uniform field is {numbers['directions']}. The ball of iron, "
        f"{2 * numbers['iron_radius_mm']:g} mm across, is directly above the skin's middle. The ball is magnetised by "
        f"the earth's field ({numbers['earth_uT']:g} µT, dipping {numbers['earth_dip_deg']:g}°) and by the skin's "
        f"field. Methods: {meanings}. Networks for the last method were trained for board {last['board']} only, so "
        "compare all methods in the rows of this board. [low, high] is the 95 % confidence interval over held-out "
        f"boards (Student's t); ± (seeds) is the standard deviation over {numbers['seeds_n']} network seeds on one "
        "board, averaged over boards. The paper names external fields as future work (section 7), and gives no number."
    )
    return {"ambient": table}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Plot accuracy on the last board, against the strength of a uniform field and against the distance of the iron."""
    last, methods = numbers["last_board"], list(numbers["arms"])
    with drawing(7.8, 4.6) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        _draw(left, last["uniform"], "field_uT", methods)
        _draw(right, last["iron"], "distance_mm", methods)
        left.axvline(numbers["earth_uT"], color="0.5", linestyle=":")
        left.annotate(
            "earth", (numbers["earth_uT"], 98), xytext=(3, 0), textcoords="offset points", va="top", fontsize=9
        )
        left.set(xlabel="uniform field / µT", ylabel="accuracy / %", ylim=(0, 100))
        right.set(xscale="log", xlabel="distance of the iron ball from the skin / mm")
        ticks_mm = [row["distance_mm"] for row in last["iron"]]
        right.set_xticks(ticks_mm, [f"{mm:g}" for mm in ticks_mm])
        right.minorticks_off()
        handles, labels = left.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", frameon=False, fontsize=9, ncols=2)
        title = f"Accuracy in external fields, held-out board {last['board']} ({source})"
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        return {"ambient.svg": svg(figure)}


def _draw(axes: Any, rows: Sequence[Mapping[str, Any]], axis: str, methods: Sequence[str]) -> None:
    for i, method in enumerate(methods):
        points = [(row[axis], row[method]["accuracy_pct"]["mean"]) for row in rows]
        axes.plot(*zip(*points, strict=True), color=COLOURS[i], marker=MARKERS[i], linestyle=DASHES[i], label=method)
    axes.grid(alpha=0.25)


def _field(kind: str, row: Mapping[str, Any]) -> str:
    if kind == "uniform":
        return f"uniform, {row['field_uT']:g} µT"
    return f"iron at {row['distance_mm']:g} mm ({row['field_uT']:.2g} µT at the chips)"


def _scores(stats: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    return {title: show_digits(stats[name], digits) for name, (title, digits) in COLUMNS.items() if name in stats}
