"""The universal model on held-out boards: its training on other boards and simulated skins, its calibration, scores."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int64

from pipeline.executors import make_executor
from pipeline.training.jobs import SceneData, score_test
from reskin import io
from reskin.data.rows import Rows
from reskin.data.splits import Fold
from reskin.errors import ParamsError
from reskin.seeds import rng_for
from reskin.universal.calibration import folds_of_labels, lower_by_misfit, lower_by_residuals, variance_inflations
from reskin.universal.combine import Labels, centre, multiply, off_middle_mm, shift
from reskin.universal.law import TEN, Law, Seen, Setup, fit, simulate_uT
from reskin.universal.map import (
    FORCES_N,
    NOMINAL,
    OF_NOMINAL,
    OF_RIG,
    Estimate,
    Reader,
    Residual,
    SkinMap,
    Tables,
    carry,
    joined,
    middle,
    new_map,
    see_even,
    see_labelled,
    see_pokes,
    see_rest,
    tabulate,
)
from reskin.universal.network import Opinion, Weights, of_tensors, predict, to_tensors
from reskin.universal.population import PLACES_N, Population, draw_population
from reskin.universal.training import (
    ERROR_OF_NOMINAL,
    NAMELESS,
    Lessons,
    NOISE_uT,
    Recorded,
    Syllabus,
    add_error,
    teach,
)

READINGS_N = 100  # of a poke that a network is taught
FORMAT = "reskin-universal-1"


@dataclass(frozen=True)
class Frame:
    """How boards lie under their labels: chips' axes, and labels' middle and direction of y."""

    turn: Float[np.ndarray, "k 3 3"]
    middle_mm: tuple[float, float]
    mirrored: bool

    def field(self, b_uT: Float[np.ndarray, "n ch"]) -> Float[np.ndarray, "n ch"]:
        """Turn readings from the chips' axes to the board's."""
        of_chips = b_uT.astype(float).reshape(len(b_uT), -1, 3)
        return np.einsum("kij,nkj->nki", self.turn, of_chips).reshape(len(b_uT), -1)

    def place(self, label_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Turn labels to places in the board's frame."""
        return (label_mm - self.middle_mm) * (1, -1 if self.mirrored else 1)

    def label(self, place_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Turn places in the board's frame to labels."""
        return place_mm * (1, -1 if self.mirrored else 1) + self.middle_mm


@dataclass(frozen=True)
class Known:
    """What is known before a board is held out."""

    data: SceneData
    frame: Frame
    setup: Setup
    seen: Mapping[str, Seen]


@dataclass(frozen=True)
class Experts:
    """What is ready for a further board: tables, networks, and what the law misses on known boards."""

    tables: Tables
    networks: Sequence[Weights]
    residual: Residual | None
    syllabus: Syllabus


def make_experts(known: Known, lessons: Lessons) -> tuple[Experts, dict[str, Experts]]:
    """Fit known boards; make experts that know none, and for each board those that know the others."""
    with make_executor(imports="reskin.universal.training") as executor:
        syllabuses = _syllabuses(known, executor)
        tables = [executor.submit(tabulate, each.centre, each.spreads, known.setup) for each in syllabuses]
        networks = [executor.submit(teach, each, lessons, known.data.settings.seed) for each in syllabuses]
        found = [
            Experts(of_map.result(), of_networks.result(), each.residual, each)
            for each, of_map, of_networks in zip(syllabuses, tables, networks, strict=True)
        ]
    return found[0], dict(zip(known.seen, found[1:], strict=True))


def read_experts(known: Known, models: Path) -> tuple[Experts, dict[str, Experts]]:
    """Make the same again with networks that were written; laws and tables, which are no files, are found anew."""
    with make_executor(imports="reskin.universal.map") as executor:
        syllabuses = _syllabuses(known, executor)
        tables = [executor.submit(tabulate, each.centre, each.spreads, known.setup) for each in syllabuses]
        found = [
            Experts(of_map.result(), read_networks(models, each.name), each.residual, each)
            for each, of_map in zip(syllabuses, tables, strict=True)
        ]
    return found[0], dict(zip(known.seen, found[1:], strict=True))


def _syllabuses(known: Known, executor: Executor) -> list[Syllabus]:
    """Say what may be known where no board is, and where each is held out."""
    seen, setup = known.seen, known.setup
    laws = dict(zip(seen, executor.map(fit, seen.values(), [setup] * len(seen), [TEN] * len(seen)), strict=True))
    nominal = Syllabus(NAMELESS, NOMINAL, OF_NOMINAL, setup)
    return [nominal, *(syllabus_without(known, laws, board) for board in seen)]


def syllabus_without(known: Known, laws: Mapping[str, Law], board: str) -> Syllabus:
    """Put together what may be known where a board is held out: laws, errors and readings of the others."""
    others = {other: own for other, own in known.seen.items() if other != board}
    rows, frame = known.data.rows, known.frame
    taught = [recorded(rows, frame, other, own.rest_uT.ravel()) for other, own in others.items()]
    centre, residual = middle([laws[other] for other in others]), carried(others, laws, known.setup)
    return Syllabus(f"without {board}", centre, OF_RIG, known.setup, taught, residual)


def carried(seen: Mapping[str, Seen], laws: Mapping[str, Law], setup: Setup) -> Residual:
    """Carry what laws miss on the boards that they were fitted on."""
    missed = []
    for board, own in seen.items():
        simulated_uT = simulate_uT(laws[board], setup, own.place_mm, own.pokes.force_N).reshape(len(own.pokes), -1)
        off_uT = own.db_uT.reshape(simulated_uT.shape) - simulated_uT
        missed.append(off_uT / np.linalg.norm(simulated_uT, axis=1, keepdims=True))
    boards = list(seen.values())
    return carry([own.place_mm for own in boards], [own.pokes.force_N for own in boards], missed)


def recorded(rows: Rows, frame: Frame, board: str, rest_uT: Float[np.ndarray, " ch"]) -> Recorded:
    """Take a known board's readings for teaching: as many of each poke, of those with a force."""
    own = np.flatnonzero((rows.board == board) & (rows.target[:, 2] > 0))
    _, first, counts = np.unique(rows.indentation[own], return_index=True, return_counts=True)
    each = own[first[:, None] + np.arange(READINGS_N) % counts[:, None]]  # an indentation's readings lie together
    db_uT = frame.field(rows.db_uT[each.ravel()]).reshape(*each.shape, -1)
    place_mm = frame.place(rows.target[each[:, 0], :2].astype(float))
    parts = db_uT, rest_uT, place_mm, rows.target[each, 2]
    return Recorded(*(part.astype(np.float32) for part in parts))


def write_networks(models: Path, experts: Sequence[Experts], lessons: Lessons, seed: int) -> None:
    """Write the networks of each, and beside them what they were taught."""
    with io.replacing(models) as folder:
        folder.mkdir()
        for each in experts:
            name = _file_name(each.syllabus.name)
            io.write_tensors(folder / f"{name}.safetensors", to_tensors(each.networks), {"format": FORMAT})
            io.write_json(folder / f"{name}.json", card_of(each, lessons, seed))


def read_networks(models: Path, name: str) -> list[Weights]:
    """Read the networks of what is known, by its name, in their order."""
    return of_tensors(io.read_tensors(models / f"{_file_name(name)}.safetensors")[0])


def _file_name(name: str) -> str:
    return name.replace(" ", "-")


def card_of(experts: Experts, lessons: Lessons, seed: int) -> dict[str, object]:
    """Describe networks: what skins they were taught, and what they are not for."""
    taught = experts.syllabus
    return {
        "format": FORMAT, "method": f"universal, {taught.name}", "seed": seed,
        "skins_n": lessons.skins_n, "steps_n": lessons.steps_n, "networks_n": len(experts.networks),
        "centre": asdict(taught.centre), "spreads": dict(taught.spreads), "recorded_boards_n": len(taught.recorded),
        "inputs": "change of field (uT, board's axes), field at rest, any number of unlabelled pokes",
        "outputs": "x, y over 8 mm; log F over 3; log sd of each",
        "not_for": "other boards' layouts, skins of another polarity, two contacts at once, shear",
    }  # fmt: skip


EXPERIMENT = "labels"  # whose folds these are
METHODS = ("universal map, ", "universal, ")  # the map alone; with networks
WAYS = {"rig": "boards of the rig", "nominal": "simulated alone"}
REACH = 1.645  # standard deviations to either side of a 90 % interval
TEMPERS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15)
ASSUMED_TEMPER = 0.5  # of the map's places, and where nothing tells how sure it is: as if channels erred in pairs
BLOCK_N = 200  # readings at a time, to bound memory
FORCE_MIN_N = float(FORCES_N[0])  # of a labelled poke: below, the map is not tabulated

Tempers = tuple[float, float]  # of the map alone, and of the map with networks


@dataclass(frozen=True)
class Bench:
    """All that folds share: rows, how boards lie under labels, what is known of each board, experts that know none."""

    data: SceneData
    frame: Frame
    seen: Mapping[str, Seen]
    nominal: Experts
    tempers: Mapping[str, Mapping[int, Tempers]]
    sureness: Mapping[int, Tempers]  # of experts that know no board, at a misfit of 1


@dataclass(frozen=True)
class Pokes:
    """Pokes of one board, the mean of their readings each, in the board's frame and axes; in the order of labelling."""

    place_mm: Float[np.ndarray, "m 2"]
    force_N: Float[np.ndarray, " m"]
    db_uT: Float[np.ndarray, "m ch"]

    def __getitem__(self, which: slice | Int64[np.ndarray, " k"]) -> "Pokes":
        """Take some of them."""
        return Pokes(self.place_mm[which], self.force_N[which], self.db_uT[which])


@dataclass(frozen=True)
class Told:
    """Experts that have seen a board's field at rest and its unlabelled pokes."""

    skin: SkinMap
    networks: Sequence[Weights]
    rest_uT: Float[np.ndarray, " ch"]
    pool: Pokes
    pool_mm: Float[np.ndarray, "m 2"]  # where the networks say that these are
    misfit: float  # of these, the median: chi^2 a channel, about 1 where the law errs as the map expects

    def opinion(self, db_uT: Float[np.ndarray, "n ch"], labels_n: int) -> Opinion:
        """Ask the networks, centred by the pool and shifted by its first labels."""
        said = predict(self.networks, db_uT, self.rest_uT, self.pool.db_uT)
        said_mm = self.pool_mm[:labels_n] - off_middle_mm(self.pool_mm, labels_n)
        return shift(centre(said, self.pool_mm, labels_n), Labels(said_mm, self.pool.place_mm[:labels_n]))

    def tempers(self, sureness: Tempers) -> Tempers:
        """Believe experts that know no board the less the worse the pokes fit."""
        of_map, of_both = (lower_by_misfit(one, self.misfit) for one in sureness)
        return of_map, of_both

    def first(self, which: Int64[np.ndarray, " k"]) -> "Told":
        """Put some of the pool's pokes first: they are labelled next."""
        order = np.concatenate([which, np.setdiff1d(np.arange(len(self.pool.force_N)), which)])
        return replace(self, pool=self.pool[order], pool_mm=self.pool_mm[order])


def score_fold(bench: Bench, fold: Fold, rig: Mapping[str, Experts], labels_n: Sequence[int]) -> list[dict[str, Any]]:
    """Score the map alone and both experts on one fold: how sure they are is told on boards that are not held out."""
    board = str(bench.data.rows.board[fold.test[0]])
    if board not in bench.seen:  # they are named by board and skin where a board has several
        rule = "boards of one skin each"
        raise ParamsError(f"fold {fold.name}", "the boards", rule, ", ".join(bench.seen), "Do not ask it.")
    pool, rest_uT = pool_of(bench, fold), bench.seen[board].rest_uT.ravel()
    test_uT = bench.frame.field(bench.data.rows.db_uT[fold.test])
    points = []
    for way, experts in {"rig": rig[board], "nominal": bench.nominal}.items():
        told = tell(experts, rest_uT, pool)
        for n in labels_n:
            tempers = bench.tempers[board][n] if way == "rig" else told.tempers(bench.sureness[n])
            (tempers,) = by_own_labels(told, n, [tempers]) if way == "nominal" else [tempers]
            ((alone, both),) = read_both(ready(told, n), test_uT, [tempers])
            for name, temper, found in zip(METHODS, tempers, (alone, both), strict=True):
                words = {"method": f"{name}{WAYS[way]}", "labels_n": n, "fold": fold.name.rsplit("-draw", 1)[0]}
                words |= {"inputs": "map" if "map" in name else "map and network", "temper": temper}
                words |= {"seed_i": int(fold.name.rsplit("-draw", 1)[1]), "misfit": told.misfit}
                points.append(words | {"scores": scored(bench, fold.test, found)})
    return points


def tell(experts: Experts, rest_uT: Float[np.ndarray, " ch"], pool: Pokes) -> Told:
    """Tell experts what a new board gives without a label: its field at rest, and pokes all over it."""
    skin = see_pokes(see_rest(new_map(experts.tables, experts.residual), rest_uT), pool.db_uT)
    pool_mm = predict(experts.networks, pool.db_uT, rest_uT, pool.db_uT).place_mm
    skin = see_even(skin, pool.db_uT)
    misfit = float(np.median(Reader(skin).weigh(pool.db_uT).misfit()))
    return Told(skin, experts.networks, rest_uT, pool, pool_mm, misfit)


@dataclass(frozen=True)
class Ready:
    """Experts with so many labels, ready to read."""

    reader: Reader
    told: Told
    labels_n: int


def ready(told: Told, labels_n: int) -> Ready:
    """Tell a map the first labels."""
    first = slice(labels_n)
    force_N = np.maximum(told.pool.force_N[first], FORCE_MIN_N)
    skin = see_labelled(told.skin, told.pool.place_mm[first], force_N, told.pool.db_uT[first])
    return Ready(Reader(skin), told, labels_n)


def read_both(
    ready: Ready, db_uT: Float[np.ndarray, "n ch"], tempers: Sequence[Tempers]
) -> list[tuple[Estimate, Estimate]]:
    """Read places by the map alone, and by it and the networks; under other tempers intervals alone differ."""
    opinion, alone, both = ready.told.opinion(db_uT, ready.labels_n), [], []
    for first in range(0, len(db_uT), BLOCK_N):
        here = slice(first, first + BLOCK_N)
        weighed = ready.reader.weigh(db_uT[here])
        answer = ready.reader.answer(weighed, ASSUMED_TEMPER)
        alone.append([about(answer, ready.reader.answer(weighed, of_map)) for of_map, _ in tempers])
        both.append([multiply(ready.reader, weighed, opinion[here], of_both) for _, of_both in tempers])
    by_temper = zip(zip(*alone, strict=True), zip(*both, strict=True), strict=True)
    return [(joined(of_map), joined(of_both)) for of_map, of_both in by_temper]


def by_own_labels(told: Told, labels_n: int, tempers: Sequence[Tempers]) -> list[Tempers]:
    """Believe experts by how far labelled pokes are off that they were not told, under each temper."""
    of_map: list[tuple[list[Estimate], Any]] = []
    of_both: list[tuple[list[Estimate], Any]] = []
    for kept, left in folds_of_labels(min(labels_n, len(told.pool.force_N))):
        found = read_both(ready(told.first(kept), len(kept)), told.pool.db_uT[left], tempers)
        for parts, of_way in zip((of_map, of_both), zip(*found, strict=True), strict=True):
            parts.append((list(of_way), told.pool.place_mm[left]))
    of_ways = zip(tempers, *(variance_inflations(len(tempers), parts) for parts in (of_map, of_both)), strict=True)
    return [
        (lower_by_residuals(alone, of_alone), lower_by_residuals(both, of)) for (alone, both), of_alone, of in of_ways
    ]


def about(answer: Estimate, likely: Estimate) -> Estimate:
    """Give an answer how far what is likely spreads about it."""
    return replace(answer, sd_mm=np.hypot(likely.sd_mm, likely.place_mm - answer.place_mm))


def coverages(told: Told, asked: Pokes, labels_n: int, tempers: Sequence[Tempers]) -> Float[np.ndarray, "t 2"]:
    """Give what 90 % intervals of pokes hold under each temper, of the map alone and with networks."""
    both = read_both(ready(told, labels_n), asked.db_uT, tempers)
    return np.array([[covered(found, asked.place_mm) for found in pair] for pair in both])


def covered(estimate: Estimate, place_mm: Float[np.ndarray, "n 2"]) -> float:
    """Give the part of coordinates that lie in their 90 % intervals."""
    return float((np.abs(estimate.place_mm - place_mm) <= REACH * estimate.sd_mm).mean())


def scored(bench: Bench, test: Int64[np.ndarray, " b"], estimate: Estimate) -> dict[str, Any]:
    """Score estimates as every method's, and count what their 90 % intervals hold."""
    label_mm = bench.frame.label(estimate.place_mm)
    predicted = np.column_stack([label_mm, estimate.force_N]).astype(np.float32)
    scores = score_test(bench.data, test, predicted)
    true_mm = bench.frame.place(bench.data.rows.target[test, :2].astype(float))
    half_width_mm = REACH * float(np.median(estimate.sd_mm))
    coverage = {"coverage_pct": 100 * covered(estimate, true_mm), "half_width_mm": half_width_mm}
    skins = {name: own | coverage for name, own in scores["by_skin"].items()} if len(scores["by_skin"]) == 1 else {}
    return scores | {"all": scores["all"] | coverage} | ({"by_skin": skins} if skins else {})


def pool_of(bench: Bench, fold: Fold) -> Pokes:
    """Give the means of the pool's pokes, in the order in which experiment labels hands out labels."""
    rows, indentation = bench.data.rows, bench.data.rows.indentation[fold.pool]
    order = rng_for(bench.data.settings.seed, "labelled", fold.name).permutation(np.unique(indentation))
    own = [fold.pool[indentation == one] for one in order]
    target = np.array([rows.target[one].mean(axis=0) for one in own], float)
    db_uT = np.array([rows.db_uT[one].mean(axis=0) for one in own], float)
    return Pokes(bench.frame.place(target[:, :2]), target[:, 2], bench.frame.field(db_uT))


FURTHER_N = 24  # simulated skins of each kind that tell how sure experts are that know no board
SURENESS = tuple(np.geomspace(0.1, 1.6, 13).tolist())  # tempers at a misfit of 1

Coverage = Float[np.ndarray, "t 2"]  # by temper, of the map alone and with networks
Miss = Callable[[Population, np.random.Generator], np.ndarray]  # changes of field of skins that a law misses


def missed(times: float = 1.0) -> Miss:
    """Say that a law misses as much as networks are taught, times so much."""
    least, most = ERROR_OF_NOMINAL

    def miss(skins: Population, rng: np.random.Generator) -> Float32[np.ndarray, "s m ch"]:
        return add_error(skins.db_uT, skins.place_mm, np.log(skins.force_N), (times * least, times * most), rng)

    return miss


AS_TAUGHT = "further"  # names stand in seeds
MISSES = {AS_TAUGHT: missed(), "further, missed twice": missed(2.0)}


def tell_tempers(bench: Bench, labels_n: Sequence[int]) -> dict[str, dict[int, Tempers]]:
    """Find, for each board that is held out, how much experts are to be believed: as was best on the other boards."""
    held = {board: _of_board(bench, board, labels_n) for board in bench.seen}
    return {
        board: {n: best(TEMPERS, [own[n] for other, own in held.items() if other != board]) for n in labels_n}
        for board in held
    }


def tell_sureness(nominal: Experts, labels_n: Sequence[int], seed: int) -> dict[int, Tempers]:
    """Find, on simulated skins, tempers at a misfit of 1; a board's is this over its own misfit and labels' residuals.

    What the law misses on a skin is as large as its unlabelled pokes say: covariances are taken to be larger by that
    factor (Birge's ratio). On these skins it misses as much as on those that networks are taught. With labels, also on
    as many on which it misses twice that: residuals are to tell how much, so that skins of more than one kind must fit.
    """
    held: dict[int, list[Coverage]] = {n: [] for n in labels_n}
    for name, miss in MISSES.items():
        skins = skins_of_prior(nominal, FURTHER_N, seed, name, miss)
        told = [told_of(nominal, skins, i, seed) for i in range(len(skins))]
        for n in labels_n:
            held[n] += [_of_skin(*one, n) for one in told] if n or name == AS_TAUGHT else []
    return {n: best(SURENESS, held[n]) for n in labels_n}


def best(candidates: Sequence[float], held: Sequence[Coverage]) -> Tempers:
    """Choose the candidates under which 90 % intervals hold 90 %, on the mean."""
    of_map, of_both = np.abs(np.mean(held, axis=0) - 0.9).argmin(axis=0)
    return candidates[of_map], candidates[of_both]


def skins_of_prior(nominal: Experts, skins_n: int, seed: int, name: str, miss: Miss) -> Population:
    """Draw skins of the prior, noisy, and with what the law misses."""
    taught, rng = nominal.syllabus, rng_for(seed, "universal", nominal.syllabus.name, name)
    skins = draw_population(taught.centre, taught.spreads, taught.setup, skins_n, rng)
    db_uT = miss(skins, rng).reshape(skins.db_uT.shape)
    sd_uT = np.tile(np.array(NOISE_uT), skins.rest_uT.shape[1] // len(NOISE_uT))
    return replace(skins, db_uT=(db_uT + sd_uT * rng.standard_normal(skins.db_uT.shape)).astype(np.float32))


def told_of(nominal: Experts, skins: Population, i: int, seed: int) -> tuple[Told, Pokes]:
    """Tell experts of a simulated skin its pool, and give the pokes that are asked."""
    pool, asked = pool_of_prior(skins, i, seed)
    return tell(nominal, skins.rest_uT[i].astype(float), pool), asked


def pool_of_prior(skins: Population, i: int, seed: int) -> tuple[Pokes, Pokes]:
    """Take a random half of a simulated skin's pokes as its pool; the others are asked."""
    order = rng_for(seed, "universal", "pool", i).permutation(skins.db_uT.shape[1])
    pokes = Pokes(*(part[i][order].astype(float) for part in (skins.place_mm, skins.force_N, skins.db_uT)))
    return pokes[:PLACES_N], pokes[PLACES_N:]


def _of_skin(told: Told, asked: Pokes, labels_n: int) -> Coverage:
    tempers = by_own_labels(told, labels_n, [told.tempers((one, one)) for one in SURENESS])
    return coverages(told, asked, labels_n, tempers)


def _of_board(bench: Bench, board: str, labels_n: Sequence[int]) -> dict[int, Coverage]:
    # The board is read by the nominal experts, which know no board, with labels of its own, on its other pokes.
    seen = bench.seen[board]
    order = rng_for(bench.data.settings.seed, "universal", board).permutation(len(seen.pokes))
    pokes = Pokes(seen.place_mm[order], seen.pokes.force_N[order], seen.db_uT.reshape(len(order), -1)[order])
    pool_n = len(order) // 3
    told = tell(bench.nominal, seen.rest_uT.ravel(), pokes[:pool_n])
    tempers = [(one, one) for one in TEMPERS]
    return {n: coverages(told, pokes[pool_n:], min(n, pool_n), tempers) for n in labels_n}
