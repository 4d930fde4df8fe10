"""Folds: splits of the rows of a dataset into rows for training and rows for testing.

Depending on the experiment, a fold holds out boards, skins, readings, indentations or passes. In folds that hold out
skins, no skin and no board may have both training rows and held-out rows. This module checks this condition. Random
splits are drawn with scikit-learn. Folds are stored in the file `folds.json`.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import numpy as np
from jaxtyping import Int64, Shaped
from pydantic import Field, field_validator

from reskin.config import Strict
from reskin.data.rows import Rows
from reskin.errors import ParamsError, SchemaError
from reskin.seeds import rng_for, seed_for

# Experiments that train and test on a single skin, and what each of them holds out at random.
WITHIN_SKIN = {"single_random": "readings", "single_indentation": "indentations", "single_pass": "passes"}
SAME_SKIN = {"single_temporal", *WITHIN_SKIN}  # experiments that train and test on the same skin
ONE_SKIN = {"transfer", *SAME_SKIN}  # experiments whose networks are trained on one skin
Count = Annotated[int, Field(ge=1)]
Fraction = Annotated[float, Field(gt=0, lt=1)]
DRAW = "-draw"  # in the name of a fold, this text precedes the number of the random draw
SEED_LIMIT = 2**32  # scikit-learn accepts only seeds below this limit

Sides = tuple[Int64[np.ndarray, " a"], Int64[np.ndarray, " b"]]  # numbers of the training rows and of the test rows


class Split(Strict):
    """Settings for drawing folds.

    Each setting belongs to an experiment. It is required if the scene runs this experiment, and must be None otherwise.
    """

    random_test_fraction: Fraction | None = None
    random_repeats_n: Count | None = None
    temporal_test_fraction: Fraction | None = None
    transfer_skins_n: Count | None = None
    sensors_skins_n: Annotated[tuple[Count, ...], Field(min_length=1)] | None = None
    sensors_draws_n: Count | None = None
    # Number of passes of each held-out skin that adaptation may use. These are the first passes of the skin.
    pool_passes_n: Count | None = None

    @field_validator("sensors_skins_n")
    @classmethod
    def _sensors_differ(cls, skins_n: tuple[int, ...] | None) -> tuple[int, ...] | None:
        if skins_n is not None and len(set(skins_n)) < len(skins_n):
            raise ValueError(f"sensors_skins_n must list each number of skins only once; got {list(skins_n)}")
        return skins_n


@dataclass(frozen=True)
class Fold:
    """A split of the rows of a dataset into training rows, test rows and a pool.

    `train`, `test` and `pool` are row numbers in `Rows`. The pool contains those rows of held-out skins that may be
    used for adaptation. No method is tested on the pool, not even a method that does not use it, so that
    all methods are tested on the same rows.
    """

    experiment: str
    name: str
    train: Int64[np.ndarray, " a"]
    test: Int64[np.ndarray, " b"]
    pool: Int64[np.ndarray, " c"]


NO_POOL = np.zeros(0, np.int64)


def draw_folds(rows: Rows, experiments: Iterable[str], split: Split, seed: int) -> list[Fold]:
    """Draw the folds of every experiment that a scene runs.

    Experiment `lobo` holds out each board in turn. The following example prints, for each fold, its name, its training
    rows and its test rows:

    >>> rows = Rows.of_labels(boards=["b1", "b1", "b2"], skins=["s1", "s2", "s3"])
    >>> [(fold.name, fold.train.tolist(), fold.test.tolist()) for fold in draw_folds(rows, ["lobo"], Split(), 0)]
    [('b1', [2], [0, 1]), ('b2', [0, 1], [2])]

    If the split has a pool, the first passes of each held-out skin are in the pool, and its later passes are the test
    rows. The following example prints, for each fold, its name, its training rows, its pool and its test rows:

    >>> rows = Rows.of_labels(["b1"] * 3 + ["b2"] * 2, ["s1"] * 3 + ["s2"] * 2, pass_i=[0, 1, 2, 0, 1])
    >>> def show(folds):
    ...     for fold in folds:
    ...         print(fold.name, fold.train, fold.pool, fold.test)
    >>> show(draw_folds(rows, ["lobo"], Split(pool_passes_n=1), 0))
    b1 [3 4] [0] [1 2]
    b2 [0 1 2] [3] [4]

    Experiment `sensors` holds out each board in turn, and trains on 1, 2, ... randomly drawn skins of the other boards.
    Within a draw, the training skins for a smaller number are among those for a larger number:

    >>> rows = Rows.of_labels(["b1", "b1", "b2", "b3"], ["s1", "s2", "s3", "s4"])
    >>> show(draw_folds(rows, ["sensors"], Split(sensors_skins_n=(1, 2), sensors_draws_n=1), 0))
    b1-01skins-draw0 [3] [] [0 1]
    b1 [2 3] [] [0 1]
    b2-01skins-draw0 [1] [] [2]
    b2-02skins-draw0 [0 1] [] [2]
    b3-01skins-draw0 [0] [] [3]
    b3-02skins-draw0 [0 1] [] [3]
    """
    return [fold for experiment in experiments for fold in _DRAW[experiment](rows, split, seed)]


def leave_one_board_out(rows: Rows, split: Split, seed: int) -> list[Fold]:
    """Make one fold per board, which trains on the skins of all other boards and tests on the skins of this board.

    This is the experiment of section 5.1 of the paper.
    """
    boards = np.unique(rows.board)
    if len(boards) < 2:
        remedy = "Add the recording of another board, or remove lobo from the experiments of the scene."
        raise ParamsError("experiment lobo", "boards", "two or more", f"{len(boards)} ({', '.join(boards)})", remedy)
    folds = []
    for board in boards:
        sides = np.flatnonzero(rows.board != board), np.flatnonzero(rows.board == board)
        folds.append(hold_out_skins(rows, "lobo", str(board), sides, split))
    return folds


def fewer_sensors(rows: Rows, split: Split, seed: int) -> list[Fold]:
    """Make folds that train on only k skins, and test on a held-out board that has none of these skins.

    This is the experiment of figure 6b of the paper. Every board is held out in turn. For each board, the training
    skins are drawn several times, from the skins of the other boards. Within a draw, the training skins for a smaller k
    are a subset of those for a larger k. There is one fold for each combination of board, k and draw.

    If k is the number of all skins of the other boards, there is nothing to draw, so the board has a single fold for
    this k. This fold equals the fold of experiment `lobo` and has the same name, so that the training runs of `lobo`
    are reused.
    """
    assert split.sensors_skins_n is not None
    assert split.sensors_draws_n is not None
    folds = []
    for board in np.unique(rows.board):
        held, skins = np.flatnonzero(rows.board == board), np.unique(rows.skin[rows.board != board])
        if max(split.sensors_skins_n) > len(skins):
            rule = f"at most the {len(skins)} skins of all boards but {board}"
            remedy = "Reduce split.sensors_skins_n in the scene, or add the recording of another board."
            raise ParamsError("experiment sensors", "split.sensors_skins_n", rule, max(split.sensors_skins_n), remedy)
        draws = range(split.sensors_draws_n)
        orders = [rng_for(seed, "sensors", str(board), draw_i).permutation(skins) for draw_i in draws]
        for skins_n in split.sensors_skins_n:
            for draw_i, order in enumerate(orders if skins_n < len(skins) else orders[:1]):
                train = np.flatnonzero(np.isin(rows.skin, order[:skins_n]))
                name = f"{board}-{skins_n:02d}skins{DRAW}{draw_i}" if skins_n < len(skins) else str(board)
                folds.append(hold_out_skins(rows, "sensors", name, (train, held), split))
    return folds


def one_skin_to_others(rows: Rows, split: Split, seed: int) -> list[Fold]:
    """Make folds that train on one skin, and test on all skins of other boards. There is one fold per training skin.

    No fold is tested on the skins of a board that has a training skin in any fold, so that all folds have the same test
    rows. If `split.pool_passes_n` is set, the passes of the pool are excluded from the test rows in this experiment
    too, so that all experiments are tested on the same passes.

    The paper trains on 3 skins, one at a time, and tests on 9 other skins. With 6 boards of 3 skins each, the training
    skins here are the first skins of the first three boards, and the test skins are the 9 skins of the other three
    boards.
    """
    assert split.transfer_skins_n is not None
    boards, train_n = np.unique(rows.board), split.transfer_skins_n
    if train_n >= len(boards):
        rule = f"less than the number of boards in the scene, {len(boards)}"
        remedy = (
            "Reduce split.transfer_skins_n: each training skin is from another board, and one board is for testing."
        )
        raise ParamsError("experiment transfer", "split.transfer_skins_n", rule, train_n, remedy)
    held = np.flatnonzero(np.isin(rows.board, boards[train_n:]))
    folds = []
    for board in boards[:train_n]:
        skin = np.unique(rows.skin[rows.board == board])[0]
        train = np.flatnonzero((rows.board == board) & (rows.skin == skin))
        folds.append(hold_out_skins(rows, "transfer", str(skin), (train, held), split))
    return folds


def hold_out_skins(rows: Rows, experiment: str, name: str, sides: tuple[np.ndarray, np.ndarray], split: Split) -> Fold:
    """Make a fold that holds out skins.

    `sides` contains the numbers of the training rows and the numbers of the held-out rows. Among the held-out rows, the
    first `split.pool_passes_n` passes of each skin are the pool, and the later passes are the test rows. Without
    `split.pool_passes_n`, all held-out rows are test rows.
    """
    train, held = sides
    pooled = np.zeros(len(held), bool)
    if split.pool_passes_n is not None:
        for skin in np.unique(rows.skin[held]):
            on_skin = rows.skin[held] == skin
            passes = np.unique(rows.pass_i[held[on_skin]])
            if len(passes) <= split.pool_passes_n:
                what, rule = f"passes of held-out skin {skin}", f"more than split.pool_passes_n, {split.pool_passes_n}"
                remedy = (
                    "Record more passes or reduce split.pool_passes_n, or remove both this setting and experiment "
                    "adapt."
                )
                raise ParamsError(f"experiment {experiment}", what, rule, len(passes), remedy)
            pooled |= on_skin & np.isin(rows.pass_i[held], passes[: split.pool_passes_n])
    fold = Fold(experiment, name, train, held[~pooled], held[pooled])
    _check_disjoint(rows, fold)
    return fold


def within_first_skin(rows: Rows, split: Split, seed: int, *, experiment: str) -> list[Fold]:
    """Make folds that hold out random readings, indentations or passes of the first skin.

    The random draw is repeated, and there is one fold per repetition. At least one reading, indentation or pass is held
    out. The paper holds out readings (section 4). This overestimates the accuracy, because some readings of an
    indentation are then in the training rows and others in the test rows.
    """
    assert split.random_test_fraction is not None
    assert split.random_repeats_n is not None
    group = {"readings": np.arange(len(rows)), "indentations": rows.indentation, "passes": rows.pass_i}
    unit, skin_rows = WITHIN_SKIN[experiment], np.flatnonzero(rows.skin == np.unique(rows.skin)[0])
    sides = draw_sides(
        group[unit][skin_rows], test_fraction=split.random_test_fraction, repeats_n=split.random_repeats_n,
        state=seed if unit == "readings" else seed_for(seed, experiment),
        what=f"{unit} of skin {rows.skin[skin_rows[0]]}", where=f"experiment {experiment}",
    )  # fmt: skip
    return [Fold(experiment, f"repeat{i}", skin_rows[a], skin_rows[b], NO_POOL) for i, (a, b) in enumerate(sides)]


def last_passes(rows: Rows, split: Split, seed: int) -> list[Fold]:
    """Make one fold per skin, which trains on the first passes of the skin and tests on its last passes."""
    assert split.temporal_test_fraction is not None
    folds = []
    for skin in np.unique(rows.skin):
        skin_rows = np.flatnonzero(rows.skin == skin)
        captures = np.unique(rows.capture[skin_rows])
        if len(captures) > 1:
            what = f"the order in time of the {len(captures)} captures of skin {skin} is unknown: {', '.join(captures)}"
            remedy = "Record all passes of the skin in one capture, or run experiment single_random instead."
            raise ParamsError(f"experiment single_temporal: {what}. {remedy}")
        pass_i = rows.pass_i[skin_rows]
        passes, what = np.unique(pass_i), f"passes of skin {skin}"
        test_n = _test_n(len(passes), split.temporal_test_fraction, what, "experiment single_temporal")
        train, test = (skin_rows[np.isin(pass_i, side)] for side in (passes[:-test_n], passes[-test_n:]))
        folds.append(Fold("single_temporal", str(skin), train, test, NO_POOL))
    return folds


def draw_sides(
    group: Shaped[np.ndarray, " f"], *, test_fraction: float, repeats_n: int, state: int, what: str, where: str
) -> list[Sides]:
    """Split rows at random into training rows and test rows, `repeats_n` times.

    Rows with the same `group` are never separated. At least one group is in the test rows. `state` is the random seed.
    In error messages, `what` describes the groups, and `where` names the experiment.
    """
    # scikit-learn is imported only here, because the import takes a second, and few stages need it.
    from sklearn.model_selection import GroupShuffleSplit

    groups_n = len(np.unique(group))
    test_n = _test_n(groups_n, max(test_fraction, 1 / groups_n), what, where)
    shuffle = GroupShuffleSplit(repeats_n, test_size=test_n, random_state=state % SEED_LIMIT)
    return [(train, test) for train, test in shuffle.split(group, groups=group)]


def _test_n(all_n: int, fraction: float, what: str, where: str) -> int:
    """Return how many of `all_n` groups are held out for testing.

    Raises ParamsError if no group would be left for training or for testing. In its message, `what` describes the
    groups, and `where` names the experiment.
    """
    test_n = round(fraction * all_n)
    if not 0 < test_n < all_n:
        remedy = f"Record more {what}, change this fraction in the scene, or remove the experiment from the scene."
        raise ParamsError(
            f"{where}: {all_n} {what} are too few to split: a test fraction of {fraction:g} holds out {test_n}. "
            f"{remedy}"
        )
    return test_n


def _check_disjoint(rows: Rows, fold: Fold) -> None:
    """Raise ParamsError if a board or a skin of the training rows also occurs in the test rows or in the pool."""
    held = np.concatenate([fold.test, fold.pool])
    for what, labels in (("board", rows.board), ("skin", rows.skin)):
        both = np.intersect1d(np.unique(labels[fold.train]), np.unique(labels[held]))
        if len(both):
            where = f"fold {fold.experiment}/{fold.name}"
            remedy = "Give each skin a name that no other skin has, and assign each skin to one board only."
            raise ParamsError(
                f"{where}: {what} {', '.join(both)} is both in the training rows and in the held-out rows. {remedy}"
            )


_DRAW: dict[str, Callable[[Rows, Split, int], list[Fold]]] = {
    "lobo": leave_one_board_out,
    "sensors": fewer_sensors,
    "transfer": one_skin_to_others,
    "single_temporal": last_passes,
    **{experiment: partial(within_first_skin, experiment=experiment) for experiment in WITHIN_SKIN},
}


# --- folds.json ---

SIDES = ("train", "test", "pool")


def render_folds(captures: Sequence[str], rows: Rows, folds: Sequence[Fold]) -> dict[str, Any]:
    """Convert folds to the JSON values that are written to `folds.json`.

    Row numbers are written as half-open ranges. The names of the boards and skins of each fold are added for readers.
    """
    content: list[dict[str, Any]] = []
    for fold in folds:
        sides = {side: getattr(fold, side) for side in SIDES}
        labels: dict[str, list[str]] = {}
        for side, numbers in sides.items():
            labels[f"{side}_boards"] = np.unique(rows.board[numbers]).tolist()
            labels[f"{side}_skins"] = np.unique(rows.skin[numbers]).tolist()
        ranges = {side: to_ranges(numbers) for side, numbers in sides.items()}
        content.append({"experiment": fold.experiment, "name": fold.name, **labels, **ranges})
    return {"captures": list(captures), "rows_n": len(rows), "dropped": rows.dropped, "folds": content}


def parse_folds(content: dict[str, Any], rows: Rows, where: str) -> list[Fold]:
    """Convert the JSON values of `folds.json` to folds.

    Raises SchemaError if the folds were drawn from a different number of rows. `where` is the beginning of its message.
    """
    if content["rows_n"] != len(rows):
        raise SchemaError(
            f"{where}: the folds were drawn from {content['rows_n']} rows, but the captures have {len(rows)} rows now. "
            "Run stage split again, which draws new folds."
        )
    return [
        Fold(fold["experiment"], fold["name"], *(from_ranges(fold[side]) for side in SIDES))
        for fold in content["folds"]
    ]


def to_ranges(numbers: Int64[np.ndarray, " n"]) -> list[list[int]]:
    """Convert increasing numbers to half-open ranges, each of which contains consecutive numbers.

    >>> to_ranges(np.array([3, 4, 5, 9]))
    [[3, 6], [9, 10]]
    """
    if len(numbers) == 0:
        return []
    cuts = np.flatnonzero(np.diff(numbers) != 1) + 1
    return [[int(run[0]), int(run[-1]) + 1] for run in np.split(numbers, cuts)]


def from_ranges(ranges: Sequence[Sequence[int]]) -> Int64[np.ndarray, " n"]:
    return np.concatenate([np.arange(start, stop) for start, stop in ranges] or [np.zeros(0, np.int64)])
