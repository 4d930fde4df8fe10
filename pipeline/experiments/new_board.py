"""New board: place and force on a board that was not in training, with few labels or none (recorded or simulated).

Each board of a scene is held out in turn. A method may use the board's no-load field, unlabelled presses anywhere on
the skin, and a few *labels*, which are presses with a known place and force; it is then tested on the readings of other
presses. Presses are drawn at random, several times. All readings are relative to the no-load reading before the same
press, so the scores are for a no-load reading that is always fresh. The results depend on where the labels are. There
are three splits:

- `checkerboard`: places are coloured like the squares of a checkerboard. Labels have one colour, tests the other.
- `halves`: labels are on one half of the skin, tests on the other.
- `grid`: unlabelled presses are at different places, labels are some of them, and tests are at the same places.

The experiment also scores contact, by the age of the no-load reading, if recordings contain readings without contact.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import pyarrow as pa
from jaxtyping import Bool, Float, Int64
from pydantic import Field
from tqdm import tqdm

from pipeline.executors import make_executor
from pipeline.experiments.results import NO_LOSSES, read_captures, write_results
from pipeline.formatting import TITLES
from pipeline.plot import drawing, svg
from pipeline.scores import COUNTS, make_table, metrics_of, write_scores
from pipeline.settings import Adaptations, Settings, Training
from pipeline.statistics import tally
from pipeline.training.jobs import SceneData, collapse_record, read_data, read_pretrained, select_pretrained, train_jobs
from pipeline.training.methods import (
    Case,
    InContext,
    Method,
    PaperNetwork,
    Prediction,
    Registered,
    Samples,
    constant,
    gaussian_process,
    kernel_ridge,
    score_prediction,
)  # fmt: skip
from pipeline.training.recorded import Compare
from reskin import io
from reskin.config import Strict
from reskin.data.contact import contact_threshold_uT, magnitudes_uT
from reskin.data.lines import grid_lines
from reskin.errors import SchemaError
from reskin.models.job import Adaptation, TrainingJob
from reskin.models.recipe import HEADLINE
from reskin.models.trained import networks_by_fold
from reskin.recordings.fault_policy import FaultPolicy
from reskin.recordings.ingest import read_header
from reskin.recordings.readers import lab
from reskin.seeds import rng_for

CHECKERBOARD, HALVES, GRID = "checkerboard", "halves", "grid"
SPACING_MM = 2.0  # the squares of the checkerboard, and the width of the strip between two halves
MIDDLE_MM = 1.0  # a press in the middle of the skin has |x| and |y| below this, relative to the middle
PLACE_MM = 0.1  # presses closer than this are at the same place
KNOWN_N = 5  # presses at known places for the rigid registration, as in the published procedure (MagTouch-RA)
READINGS_N = 5  # at most so many readings of each press are tested, evenly spaced; the paper has 5 readings a press
SHIPPED = "shipped"
NETWORKS = {"multi": ("train_multi", "lobo"), "triplet": ("train_triplet", "triplet")}  # stage and experiment
AGES = ("each", "previous", "initial")  # the no-load reading: before each press, before the press before, at the start


class NewBoard(Strict):
    """Settings section `new_board`.

    - presses_n: numbers of unlabelled presses; labels are added to the largest number only.
    - labels_n: numbers of labels; 1 is a single press in the middle of the skin.
    - draws_n: number of random draws of the presses.
    - model: file of an in-context model for the scene's layout; None if there is none.
    """

    presses_n: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
    labels_n: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
    draws_n: Annotated[int, Field(ge=1)]
    model: str | None = "reskin/universal/universal.safetensors"


# --- Boards and draws ---


@dataclass(frozen=True)
class Board:
    """The presses of one skin on a board, with their no-load drift removed.

    - presses: one row per press, averaged over its readings. Its number is its rank by capture and indentation.
    - readings, press_i: the readings that may be tested, and the number of the press of each.
    - rows, row_press_i: the row numbers of all readings in the scene's data, and the number of the press of each.
    - noload_uT: mean no-load field. It has been added to the change of field of each reading since the no-load reading
      before the same press, so that one no-load reading serves all presses.
    - middle_mm: the middle of the skin in the coordinates of the labels.
    """

    board: str
    skin: str
    noload_uT: Float[np.ndarray, " ch"]
    presses: Samples
    readings: Samples
    press_i: Int64[np.ndarray, " f"]
    rows: Int64[np.ndarray, " r"]
    row_press_i: Int64[np.ndarray, " r"]
    middle_mm: tuple[float, float]

    def readings_of(self, presses: Int64[np.ndarray, " k"]) -> Samples:
        """Return the tested readings of these presses."""
        return self.readings[np.flatnonzero(np.isin(self.press_i, presses))]

    def rows_of(self, presses: Int64[np.ndarray, " k"]) -> Int64[np.ndarray, " q"]:
        """Return the row numbers of all readings of these presses in the scene's data."""
        return self.rows[np.isin(self.row_press_i, presses)]

    def part(self, split: str, draw_i: int) -> Int64[np.ndarray, " m"]:
        """Return 1 for presses that may be labels, -1 for tests, and 0 for neither; draws exchange the parts."""
        place_mm = self.presses.place_mm - self.middle_mm
        if split == CHECKERBOARD:
            colour = np.floor(place_mm / SPACING_MM + 0.5).astype(int).sum(axis=1) % 2
            return np.array((-1) ** (colour + draw_i))
        along_mm = place_mm[:, draw_i // 2 % 2] * (-1) ** draw_i
        return np.where(np.abs(along_mm) < SPACING_MM / 2, 0, np.sign(along_mm)).astype(int)


@dataclass(frozen=True)
class Draw:
    """Numbers of the presses that are drawn: unlabelled, labels (in random order), the middle press, and tested."""

    split: str
    draw_i: int
    unlabelled: Int64[np.ndarray, " n"]
    labels: Int64[np.ndarray, " m"]
    middle: Int64[np.ndarray, " 1"]
    tested: Int64[np.ndarray, " t"]


def read_boards(data: SceneData, captures: Sequence[Any], middle_mm: tuple[float, float]) -> list[Board]:
    """Collect the presses of each skin of a scene; readings whose force is known and not above 0 are left out."""
    rows, boards = data.rows, []
    for skin in np.unique(rows.skin):
        own = np.flatnonzero((rows.skin == skin) & ~(rows.target[:, 2] <= 0))
        noload = [readings.noload_uT for readings in captures if readings.skin == skin]
        noload_uT = np.concatenate(noload).mean(axis=0, dtype=float)
        target = rows.target[own].astype(float)
        readings = Samples(target[:, :2], target[:, 2], noload_uT + rows.db_uT[own].astype(float))
        _, press_i = np.unique(rows.indentation[own], return_inverse=True)
        means = pd.DataFrame(np.column_stack([target, readings.b_uT])).groupby(press_i).mean().to_numpy()
        presses = Samples(means[:, :2], means[:, 2], means[:, 3:])
        board, kept = str(rows.board[own[0]]), spaced(press_i, READINGS_N)
        tested = readings[kept], press_i[kept]
        boards.append(Board(board, str(skin), noload_uT, presses, *tested, own, press_i, middle_mm))
    return boards


def spaced(press_i: Int64[np.ndarray, " f"], most_n: int) -> Int64[np.ndarray, " k"]:
    """Return the numbers of at most `most_n` evenly spaced readings of each press."""
    parts = [np.flatnonzero(press_i == press) for press in np.unique(press_i)]
    return np.concatenate(
        [part[np.linspace(0, len(part) - 1, min(most_n, len(part))).round().astype(int)] for part in parts]
    )


def draw_presses(board: Board, split: str, presses_n: int, seed: int, draw_i: int) -> Draw:
    """Draw the presses of one draw; raise `SchemaError` if there are too few presses."""
    rng, every = rng_for(seed, "new_board", board.skin, split, draw_i), np.arange(len(board.presses))
    off_mm = np.abs(board.presses.place_mm - board.middle_mm).max(axis=1)
    near = off_mm < MIDDLE_MM
    middle = rng.choice(np.flatnonzero(near) if near.any() else off_mm.argmin()[None], 1)
    if split == GRID:
        shuffled = rng.permutation(every)
        _, first = np.unique(np.rint(board.presses.place_mm[shuffled] / PLACE_MM), axis=0, return_index=True)
        unlabelled = labels = rng.permutation(shuffled[first])[:presses_n]
        tested = np.setdiff1d(every, [*unlabelled, *middle])
    else:
        part, unlabelled = board.part(split, draw_i), rng.permutation(every)[:presses_n]
        labels = rng.permutation(np.flatnonzero(part == 1))
        tested = np.setdiff1d(np.flatnonzero((part == -1) & ~near), [*unlabelled, *middle])
    if len(unlabelled) < presses_n or not len(tested) or not len(labels):
        what = f"skin {board.skin} has only {len(every)} presses: too few for labels, tests and {presses_n} others"
        raise SchemaError(f"new_board, split {split}: {what}. Reduce new_board.presses_n, or add recordings.")
    return Draw(split, draw_i, unlabelled, labels, middle, tested)


def splits_of(board: Board, presses_n: int) -> list[str]:
    """Return the splits that are possible: `grid` needs `presses_n` places, pressed twice or more on average."""
    places_n = count_places(board.presses)
    return [CHECKERBOARD, HALVES, *[GRID] * (presses_n <= places_n <= len(board.presses) // 2)]


def count_places(presses: Samples) -> int:
    """Return the number of different places."""
    return len(np.unique(np.rint(presses.place_mm / PLACE_MM), axis=0))


# --- Methods ---


Methods = Mapping[str, Sequence[Method]]  # by name; the paper's networks are there once for each seed


def methods_of(board: Board, section: NewBoard, compare: Compare, models: Path, *, rig: bool) -> Methods:
    """Return the methods for a held-out board. None but `shipped` is made without recordings of the other boards."""
    turned = compare.labels_mirrored, compare.layout.centre_mm
    methods: dict[str, Sequence[Method]] = {}
    if section.model is not None:
        methods[SHIPPED] = [InContext(Path(section.model), *turned)]
    if rig:
        methods["rig"] = [InContext(models / "rig" / f"{board.board}.safetensors", *turned)]
    for name, (stage, experiment) in NETWORKS.items():
        methods[name] = [PaperNetwork(each) for each in networks_by_fold(models / stage, experiment)[board.board]]
    methods |= {"registration": [Registered(network) for network in methods["multi"]], "kernel_ridge": [kernel_ridge]}
    return methods | {"gaussian_process": [gaussian_process], "constant": [constant]}


# --- Scores ---


def score_draw(board: Board, draw: Draw, section: NewBoard, methods: Methods, others: Samples) -> list[dict[str, Any]]:
    """Score every method on one draw, for each number of unlabelled presses and of labels."""
    readings = board.readings_of(draw.tested)
    keys, rows = _keys(board, draw, len(readings)), []
    for name, versions in methods.items():
        for presses_n, labels_n in _settings(name, draw, section):
            presses_uT = board.presses.b_uT[draw.unlabelled[:presses_n]]
            labels = board.presses[draw.middle if labels_n == 1 else draw.labels[:labels_n]]
            case = Case(board.noload_uT, presses_uT, labels, others, readings.b_uT)
            for seed_i, method in enumerate(versions):
                row = {"method": name, "seed": seed_i, "pokes_n": presses_n, "labels_n": labels_n}
                rows.append(keys | row | score_prediction(readings, method(case)))
    return rows


def _keys(board: Board, draw: Draw, rows_n: int) -> dict[str, Any]:
    keys = {"experiment": "new_board", "fold": board.board, "board": board.board, "skin": board.skin}
    return keys | {"split": draw.split, "draw": draw.draw_i, "rows_n": rows_n}


def _settings(method: str, draw: Draw, section: NewBoard) -> list[tuple[int, int]]:
    """Return the numbers of unlabelled presses and of labels with which a method is scored.

    Methods that do not use unlabelled presses have the same number as the others, so that rows can be compared.
    """
    most_n, labels_n = len(draw.unlabelled), [n for n in section.labels_n if n <= len(draw.labels)]
    if method in NETWORKS:
        return [(most_n, 0)]
    if method == "registration":
        return [(most_n, KNOWN_N)] if len(draw.labels) >= KNOWN_N else []
    if method in ("gaussian_process", "constant"):
        return [(most_n, n) for n in labels_n if n > 1]
    fewer = [(n, 0) for n in section.presses_n if n < most_n] if draw.split == CHECKERBOARD else []
    return [*(fewer if method != "kernel_ridge" else ()), *((most_n, n) for n in labels_n)]


def tabulate_draws(board: Board, draws: Sequence[Draw]) -> pd.DataFrame:
    """Tabulate which press has which part in each draw, so that any row of scores can be computed again."""
    parts = ("unlabelled", "labels", "middle", "tested")
    frames = [
        pd.DataFrame({"part": part, "order": np.arange(len(numbers)), "press": numbers}).assign(
            board=board.board, skin=board.skin, split=draw.split, draw=draw.draw_i
        )
        for draw in draws
        for part, numbers in ((part, getattr(draw, part)) for part in parts)
    ]
    return pd.concat(frames, ignore_index=True)


# --- Contact ---


def score_contact(captures: Mapping[str, Sequence[tuple[np.ndarray, ...]]]) -> list[dict[str, Any]]:
    """Score contact by the live page's rule, by the age of the no-load reading.

    The threshold comes from readings before presses with odd numbers; false touches are counted before even numbers.

    captures: for each board, its captures, each with the press number of every reading without contact, these readings,
    the press number of every reading in contact, these readings, and their forces.
    """
    rows = []
    for board, parts in captures.items():
        changes = {age: [_change_since(age, *part) for part in parts] for age in AGES}
        quiet_uT = np.concatenate([noload[odd] for noload, odd, _ in changes["each"]])
        threshold_uT = contact_threshold_uT(quiet_uT, None)
        force_N = np.concatenate([part[4] for part in parts])
        for age, of_age in changes.items():
            untouched_uT = np.concatenate([noload[~odd] for noload, odd, _ in of_age])
            touched_uT = np.concatenate([touched for _, _, touched in of_age])
            rows.append(
                {"experiment": "new_board", "method": "contact", "board": board, "split": age}
                | {"false_pct": 100 * float((magnitudes_uT(untouched_uT, None) > threshold_uT).mean())}
                | {"missed_pct": 100 * float((magnitudes_uT(touched_uT, None) <= threshold_uT).mean())}
                | {"force_min_N": float(force_N.min()), "force_max_N": float(force_N.max())}
            )
    return rows


def _change_since(
    age: str, quiet_i: np.ndarray, quiet_uT: np.ndarray, press_i: np.ndarray, b_uT: np.ndarray, _: np.ndarray
) -> tuple[Float[np.ndarray, "a ch"], Bool[np.ndarray, " a"], Float[np.ndarray, "f ch"]]:
    """Return the changes of field since the no-load reading of an age, without and with contact.

    The second result says which readings without contact are before presses with odd numbers. A reading without contact
    is compared with the other readings before the same press (`each`), and not with itself. With an older no-load
    reading, the first press is left out, because no press is before it.
    """
    n = np.bincount(quiet_i, minlength=press_i.max() + 1)
    sums_uT = np.stack([np.bincount(quiet_i, column, len(n)) for column in quiet_uT.T], axis=1)
    mean_uT = sums_uT / np.maximum(n, 1)[:, None]
    if age == "each":
        noload_uT = (quiet_uT - mean_uT[quiet_i]) * (n / np.maximum(n - 1, 1))[quiet_i, None]
        kept, pressed, since_uT = n[quiet_i] > 1, np.ones(len(press_i), bool), mean_uT
    else:
        since_uT = np.roll(mean_uT, 1, axis=0) if age == "previous" else np.broadcast_to(mean_uT[0], mean_uT.shape)
        noload_uT, kept, pressed = quiet_uT - since_uT[quiet_i], quiet_i > 0, press_i > 0
    return noload_uT[kept], quiet_i[kept] % 2 == 1, (b_uT - since_uT[press_i])[pressed]


def read_contact(captures: Sequence[Any], raw: Path, policy: FaultPolicy) -> dict[str, list[tuple[np.ndarray, ...]]]:
    """Read the captures whose files contain single readings without contact, for `score_contact`."""
    by_board: dict[str, list[tuple[np.ndarray, ...]]] = {}
    for readings in captures:
        header = read_header(raw / readings.capture)
        if header.layout == "lab":
            quiet_i, quiet_uT = lab.read_noload(raw / readings.capture, header, policy)
            contact = (readings.indentation.astype(int), readings.b_uT.astype(float), readings.Fz_N.astype(float))
            by_board.setdefault(readings.board, []).append((quiet_i, quiet_uT, *contact))
    return by_board


# --- Stage ---


def new_board(
    settings: Settings, section: NewBoard, raw: Path, indentations: Path, folds: Path, models: Path, scores: Path,
    results: Path, draws: Path,
) -> None:  # fmt: skip
    """Score every method on every held-out board."""
    data, compare = read_data(settings, indentations, folds), settings.section(Compare, "compare")
    captures = read_captures(indentations, tuple(settings.captures_in(indentations)))
    boards = read_boards(data, captures, compare.layout.centre_mm)
    drawn = {
        board.skin: [
            draw_presses(board, split, max(section.presses_n), settings.seed, draw_i)
            for split in splits_of(board, max(section.presses_n))
            for draw_i in range(section.draws_n)
        ]
        for board in boards
    }
    rig = "rig" in settings["experiments"]
    with make_executor(imports="reskin.universal.model") as executor:
        tasks = [
            executor.submit(score_draw, board, draw, section, methods, others)
            for board in boards
            for methods in [methods_of(board, section, compare, models, rig=rig)]
            for others in [_others(board, boards)]
            for draw in drawn[board.skin]
        ]
        rows = []
        for task in tqdm(tasks, unit="draw"):
            rows += task.result()
    adapted, trainings = score_adapted(data, boards, drawn, models)
    policy = settings.shared_section(FaultPolicy, "faults")
    contact = score_contact(read_contact(captures, raw, policy))
    write_scores(scores, make_table([*rows, *adapted, *contact]))
    table = pd.concat([tabulate_draws(board, drawn[board.skin]) for board in boards], ignore_index=True)
    io.write_table(draws, pa.Table.from_pandas(table, preserve_index=False))
    write_results(results, {}, {}, NO_LOSSES, trainings)


def score_adapted(
    data: SceneData, boards: Sequence[Board], drawn: Mapping[str, Sequence[Draw]], models: Path
) -> tuple[list[dict[str, Any]], dict[str, int]]:
    """Adapt the network with triplet loss to the unlabelled presses of each draw, and score it.

    The order of the presses on the rig's grid is known, but not their places (paper section 5). Also returns the counts
    of training runs.
    """
    recipe = data.settings.section(Adaptations, "adapt").recipes[HEADLINE]
    base = data.settings.section(Training, "train_triplet").recipes[recipe.base]
    pretrained, jobs, pairs = read_pretrained(models / "train_triplet"), [], []
    folds = {fold.name: fold for fold in data.folds_of("lobo")}
    for board in boards:
        fold = folds[board.board]
        start = select_pretrained(pretrained, recipe.base, fold)[0]
        for draw in drawn[board.skin]:
            unlabelled, tested = board.rows_of(draw.unlabelled), board.rows_of(draw.tested)
            tuning, what = Adaptation(start, recipe, grid_lines(data.rows, unlabelled)), f"{draw.split}{draw.draw_i}"
            names, seeds = ("new_board", HEADLINE, base, fold.name), (data.settings.seed, 0)
            jobs.append(TrainingJob(*names, *seeds, fold.train, tested, tuning, board.skin, what))
            pairs.append((board, draw))
    trained, rows = train_jobs(data, jobs, "new_board"), []
    for (board, draw), result in zip(pairs, trained, strict=True):
        kept = spaced(board.row_press_i[np.isin(board.row_press_i, draw.tested)], READINGS_N)
        readings = board.readings_of(draw.tested)
        scores = score_prediction(readings, Prediction(result.predicted[kept].astype(float)))
        keys = _keys(board, draw, len(readings)) | {"method": "adapted", "pokes_n": len(draw.unlabelled)}
        rows.append(keys | {"labels_n": 0} | scores)
    return rows, tally(map(collapse_record, trained))


def _others(board: Board, boards: Sequence[Board]) -> Samples:
    """Return the presses of the other boards, as changes of field."""
    parts = [(other.presses, other.presses.b_uT - other.noload_uT) for other in boards if other.board != board.board]
    places, forces = (np.concatenate([getattr(own, name) for own, _ in parts]) for name in ("place_mm", "force_N"))
    return Samples(places, forces, np.concatenate([change_uT for _, change_uT in parts]))


# --- Views of the scores ---

GROUP = ["method", "split", "pokes_n", "labels_n"]


def summarise(scores: pd.DataFrame, measured: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Average the scores over draws and skins, for each method, split, and numbers of presses and labels.

    Each metric has its `mean` over boards and the value of each board. `sd_draws` is the standard deviation over draws
    of the mean over boards. `minus_shipped` is the difference to the shipped model on the same draws.
    """
    metrics, draw = metrics_of(scores), ["board", "draw"]
    means = scores.groupby([*GROUP, *draw], sort=False, dropna=False)[metrics].mean().reset_index()
    means["rms_f_N"] = np.sqrt(means["mse_f_N2"])
    shipped, rows = means[means["method"] == SHIPPED], []
    for _, group in means.groupby(GROUP, sort=False, dropna=False):
        keys = group[GROUP].iloc[0].dropna()  # rows of contact have no numbers of presses and labels
        row = {str(name): int(value) if name in COUNTS else value for name, value in keys.items()}
        known = [name for name in (*metrics, "rms_f_N") if group[name].notna().all()]
        row |= {name: _summary(group, group[name]) for name in known}
        pairs = group.merge(shipped, on=[*GROUP[1:], *draw], suffixes=("", "_shipped"))
        if len(pairs) and row["method"] != SHIPPED:
            compared = [name for name in ("accuracy_pct", "rms_f_N") if name in known]
            row["minus_shipped"] = {name: _summary(pairs, pairs[name] - pairs[f"{name}_shipped"]) for name in compared}
        rows.append(row)
    return rows


def _summary(rows: pd.DataFrame, values: pd.Series) -> dict[str, Any]:
    """Summarise the values of rows, each of which is for a board and a draw."""
    by_board = {str(board): float(value) for board, value in values.groupby(rows["board"]).mean().items()}
    summary = {"mean": float(np.mean(list(by_board.values()))), "by_board": by_board}
    over_draws = values.groupby(rows["draw"]).mean()
    return summary | ({"sd_draws": float(over_draws.std(ddof=1))} if len(over_draws) > 1 else {})


def figures(numbers: Sequence[Mapping[str, Any]], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Plot place and force against the number of labels, with one panel for each metric (split `checkerboard`)."""
    panels = {"accuracy_pct": "within 1 mm / %", "rms_f_N": "force error (rms) / N"}
    rows = [row for row in numbers if row["split"] == CHECKERBOARD]
    rows = [row for row in rows if row["pokes_n"] == max(other["pokes_n"] for other in rows)]
    with drawing(5.6, f"Boards that were not in training ({source})") as figure:
        panels_drawn = figure.subplots(len(panels), 1, sharex=True)
        for axes, (metric, title) in zip(panels_drawn, panels.items(), strict=True):
            for method in dict.fromkeys(row["method"] for row in rows):
                scored = [row for row in rows if row["method"] == method and metric in row]
                points = sorted((row["labels_n"], row[metric]["mean"]) for row in scored)
                axes.plot(*np.reshape(points, (-1, 2)).T, label=TITLES[method])
            axes.set_ylabel(title)
        axes.set_xlabel("labels on the new board")
        figure.align_ylabels()
        figure.legend(*panels_drawn[0].get_legend_handles_labels(), loc="outside lower left")
        return {"new_board.svg": svg(figure)}
