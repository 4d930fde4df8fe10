"""Stage universal: a map that comes with the project, on each held-out board, with no, a few and more of its labels.

With recorded boards of the rig (`rig`), and with none (`nominal`): its law's nominal numbers and their spreads alone.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float, Int64
from pydantic import Field

from pipeline.core import io
from pipeline.core.config import Files, Settings, Strict, parse, read_settings
from pipeline.core.errors import ParamsError
from pipeline.core.executors import make_executor
from pipeline.core.seeds import rng_for
from pipeline.core.stage import run, say
from pipeline.dataset.splits import Fold
from pipeline.experiments.answer import read_folder
from pipeline.experiments.compare.run import Compare, see, setup_of, skins_of, turns_of
from pipeline.physics.skin import SkinDesign
from pipeline.trials.data import SceneData, read_data
from pipeline.trials.models import score_test
from pipeline.twin.fit import TEN, Seen, fit
from pipeline.twin.law import Law, Setup, simulate_uT
from pipeline.twin.residual import Residual, carry
from pipeline.twin.skin_map import Estimate, Reader, SkinMap, new_map, see_even, see_labelled, see_pokes, see_rest
from pipeline.twin.tables import NOMINAL, OF_NOMINAL, OF_RIG, Tables, middle, tabulate

QUESTION = "labels"  # whose folds these are
METHODS = {"rig": "universal map, and boards of the rig", "nominal": "universal map, simulated alone"}
REACH = 1.645  # standard deviations to either side of a 90 % interval
TEMPERS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15)
ASSUMED_TEMPER = 0.5  # where no board is known that it could be told on
FORCE_MIN_N = 0.3  # of a labelled poke: below, the map is not tabulated


class Universal(Strict):
    """Section universal: with so many labelled pokes of the held-out board."""

    labels_n: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]


@dataclass(frozen=True)
class Bench:
    """All that folds share: rows, how boards lie under labels, what is known of each, the tables of nominal skins."""

    data: SceneData
    section: Compare
    setup: Setup
    seen: Mapping[str, Seen]
    laws: Mapping[str, Law]
    nominal: Tables


@dataclass(frozen=True)
class Pokes:
    """Pokes of one board, the mean of their readings each, in the board's frame and axes; in the order of labelling."""

    place_mm: Float[np.ndarray, "m 2"]
    force_N: Float[np.ndarray, " m"]
    db_uT: Float[np.ndarray, "m ch"]


def universal(scene: str, files: Files, indentations: Path, folds: Path, scores: Path) -> None:
    """Score the map on every held-out board, with every number of its labels, on the rows that others are tested on."""
    settings = read_settings("universal", scene, files)
    data, labels_n = read_data(settings, indentations, folds), settings.section(Universal, "universal").labels_n
    section = settings.section(Compare, "compare")
    setup = setup_of(section, parse(SkinDesign, settings.shared["skin"], "params.yaml: skin"))
    skins = skins_of(read_folder(indentations, tuple(settings.captures_in(indentations))))
    seen = {board: see(pokes, section) for board, pokes in skins.items()}
    with make_executor(imports="pipeline.twin.fit") as executor:
        laws = dict(zip(seen, executor.map(fit, seen.values(), [setup] * len(seen), [TEN] * len(seen)), strict=True))
        say(f"{scene} universal: fitted {len(laws)} boards")
        centres = {board: middle([laws[other] for other in laws if other != board]) for board in laws}
        jobs = [(NOMINAL, OF_NOMINAL, setup), *((centre, OF_RIG, setup) for centre in centres.values())]
        nominal, *of_rig = executor.map(tabulate, *zip(*jobs, strict=True))
    tables = dict(zip(centres, of_rig, strict=True))
    bench = Bench(data, section, setup, seen, laws, nominal)
    points = []
    for fold in data.folds_of(QUESTION):
        points += score_fold(bench, fold, tables, labels_n)
        say(f"{scene} universal: {fold.name} done")
    io.write_json(scores, points)


def score_fold(bench: Bench, fold: Fold, tables: Mapping[str, Tables], labels_n: Sequence[int]) -> list[dict[str, Any]]:
    """Score both maps on one fold: which uncertainty is true is told on the boards that are not held out."""
    board = str(bench.data.rows.board[fold.test[0]])
    others = [other for other in bench.seen if other != board]
    if not others or board not in bench.seen:
        raise ParamsError(f"fold {fold.name}", "boards", "two or more, each of one skin", len(bench.seen), "Add one.")
    pool, rest_uT = pool_of(bench, fold), bench.seen[board].rest_uT.ravel()
    maps = {"rig": new_map(tables[board], carried(bench, others)), "nominal": new_map(bench.nominal)}
    points = []
    for way, method in METHODS.items():
        start_s = time.monotonic()
        skin = see_unlabelled(maps[way], rest_uT, pool.db_uT)
        took_s = time.monotonic() - start_s
        for n in labels_n:
            temper = tell_temper(bench, others, n) if way == "rig" else ASSUMED_TEMPER
            labelled = replace(see_first(skin, pool, n), temper=temper)
            estimate = Reader(labelled).estimate(board_axes(bench, bench.data.rows.db_uT[fold.test]))
            words = {"method": method, "inputs": "map", "labels_n": n, "fold": fold.name.rsplit("-draw", 1)[0]}
            words |= {"seed_i": int(fold.name.rsplit("-draw", 1)[1]), "temper": temper, "seconds": took_s}
            points.append(words | {"scores": scored(bench, fold.test, estimate)})
    return points


def scored(bench: Bench, test: Int64[np.ndarray, " b"], estimate: Estimate) -> dict[str, Any]:
    """Score estimates as every method's, and count what their 90 % intervals hold."""
    label_mm = to_labels(bench, estimate.place_mm)
    predicted = np.column_stack([label_mm, estimate.force_N]).astype(np.float32)
    scores = score_test(bench.data, test, predicted)
    held = np.abs(label_mm - bench.data.rows.target[test, :2]) <= REACH * estimate.sd_mm
    coverage = {"coverage_pct": 100 * float(held.mean())}
    skins = {name: own | coverage for name, own in scores["by_skin"].items()} if len(scores["by_skin"]) == 1 else {}
    return scores | {"all": scores["all"] | coverage} | ({"by_skin": skins} if skins else {})


def see_unlabelled(skin: SkinMap, rest_uT: Float[np.ndarray, " ch"], db_uT: Float[np.ndarray, "m ch"]) -> SkinMap:
    """Learn what a new board gives without a label: its field at rest, and pokes all over it."""
    return see_even(see_pokes(see_rest(skin, rest_uT), db_uT), db_uT)


def see_first(skin: SkinMap, pokes: Pokes, labels_n: int) -> SkinMap:
    """Learn the first so many labels."""
    first = slice(labels_n)
    force_N = np.maximum(pokes.force_N[first], FORCE_MIN_N)
    return see_labelled(skin, pokes.place_mm[first], force_N, pokes.db_uT[first])


def tell_temper(bench: Bench, boards: Sequence[str], labels_n: int) -> float:
    """Find how much the map is to be believed: so that 90 % intervals hold 90 % on boards that are not held out.

    Each is read by the nominal map, which knows no board, with as many labels of its own, on its other pokes.
    """
    held: dict[float, list[float]] = {temper: [] for temper in TEMPERS}
    for board in boards:
        seen = bench.seen[board]
        order = rng_for(bench.data.settings.seed, "universal", board).permutation(len(seen.pokes))
        pool_n = len(order) // 3
        db_uT = seen.db_uT.reshape(len(order), -1)
        pokes = Pokes(seen.place_mm[order], seen.pokes.force_N[order], db_uT[order])
        skin = see_first(see_unlabelled(new_map(bench.nominal), seen.rest_uT.ravel(), pokes.db_uT[:pool_n]), pokes,
                         min(labels_n, pool_n))  # fmt: skip
        for temper in TEMPERS:
            found = Reader(replace(skin, temper=temper)).estimate(pokes.db_uT[pool_n:])
            inside = np.abs(found.place_mm - pokes.place_mm[pool_n:]) <= REACH * found.sd_mm
            held[temper].append(float(inside.mean()))
    return min(TEMPERS, key=lambda temper: abs(np.mean(held[temper]) - 0.9))


def carried(bench: Bench, boards: Sequence[str]) -> Residual:
    """Carry what the law misses on boards."""
    missed = []
    for board in boards:
        seen = bench.seen[board]
        simulated_uT = simulate_uT(bench.laws[board], bench.setup, seen.place_mm, seen.pokes.force_N)
        simulated_uT = simulated_uT.reshape(len(seen.pokes), -1)
        off_uT = seen.db_uT.reshape(simulated_uT.shape) - simulated_uT
        missed.append(off_uT / np.linalg.norm(simulated_uT, axis=1, keepdims=True))
    own = [bench.seen[board] for board in boards]
    return carry([seen.place_mm for seen in own], [seen.pokes.force_N for seen in own], missed)


def pool_of(bench: Bench, fold: Fold) -> Pokes:
    """Give the means of the pool's pokes, in the order in which question labels hands out labels."""
    rows, indentation = bench.data.rows, bench.data.rows.indentation[fold.pool]
    order = rng_for(bench.data.settings.seed, "labelled", fold.name).permutation(np.unique(indentation))
    own = [fold.pool[indentation == one] for one in order]
    target = np.array([rows.target[one].mean(axis=0) for one in own], float)
    db_uT = np.array([rows.db_uT[one].mean(axis=0) for one in own], float)
    mirrored = (1, -1) if bench.section.labels_mirrored else (1, 1)
    return Pokes((target[:, :2] - bench.section.labels_middle_mm) * mirrored, target[:, 2], board_axes(bench, db_uT))


def board_axes(bench: Bench, db_uT: Float[np.ndarray, "n ch"]) -> Float[np.ndarray, "n ch"]:
    """Turn readings from the chips' axes to the board's."""
    of_chips = db_uT.astype(float).reshape(len(db_uT), -1, 3)
    return np.einsum("kij,nkj->nki", turns_of(bench.section), of_chips).reshape(len(db_uT), -1)


def to_labels(bench: Bench, place_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Turn places in the board's frame to labels."""
    return place_mm * (1, -1 if bench.section.labels_mirrored else 1) + bench.section.labels_middle_mm


def read(settings: Settings) -> Universal:
    """Read section universal."""
    return settings.section(Universal, "universal")


if __name__ == "__main__":
    run(universal)
