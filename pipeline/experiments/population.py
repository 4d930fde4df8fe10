"""Experts taught simulated skins only, on skins of a simulated scene: unlabelled pokes, one weight, a few labels."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from pydantic import Field
from scipy.constants import mega, milli
from scipy.spatial.transform import Rotation

import reskin.universal
from pipeline.experiments.results import read_captures, write_results
from pipeline.report.drawing import COLOURS, MARKERS, drawing, svg
from pipeline.report.formatting import n_of, scores, tabulate
from pipeline.settings import Settings
from pipeline.simulation import simulation_settings
from pipeline.stage import say
from pipeline.statistics import summarise
from pipeline.training.jobs import SceneData, read_data
from pipeline.training.population import (
    WEIGHT_N,
    WEIGHT_SD,
    Case,
    Experts,
    Told,
    Weight,
    cases_of,
    fewer,
    scores_of,
    trust,
    weight_of,
)
from pipeline.training.universal import Frame, Pokes
from reskin import io
from reskin.code import digest, imported
from reskin.config import Strict
from reskin.data.grid import CENTRE_MM
from reskin.data.splits import Fold
from reskin.errors import ParamsError, SchemaError
from reskin.physics.skin import SkinDesign
from reskin.physics.slide import force_at
from reskin.seeds import rng_for
from reskin.simulation.settings import BoardKind
from reskin.universal.law import Law, Setup
from reskin.universal.map import OF_RIG, Tables, new_map
from reskin.universal.map import tabulate as tabulate_map
from reskin.universal.network import Weights
from reskin.universal.population import Forces, Population, draw_population
from reskin.universal.training import Syllabus, draw_weights, train

PACKAGE = Path(reskin.universal.__file__).parent
TRAINS = "reskin.universal.training"
PART_N = 100  # skins that are kept together
STEPS_OF_FORCE = 0.6  # at most, of log F between two tabulated forces
FORCE_SHARES = (0.7, 1.5)  # of the least and of the largest force of the skin as designed: skins differ


class Taught(Strict):
    """How many skins there are, of which networks are taught the first so many, each for as many steps."""

    skins_n: Annotated[tuple[Annotated[int, Field(ge=1, le=100_000)], ...], Field(min_length=1)]
    steps_n: Annotated[int, Field(ge=2, le=1_000_000)]


@dataclass(frozen=True)
class Lesson:
    """A syllabus of skins as a scene's are designed, with forces as its depths ask for."""

    syllabus: Syllabus
    forces_N: tuple[float, float]
    seed: int

    def skins(self, name: str, which: slice, weight_N: float | None = None) -> Population:
        """Draw some skins of the population that bears this name; where a weight is given, its press comes last."""
        centre, spreads, setup = self.syllabus.centre, self.syllabus.spreads, self.syllabus.setup
        rng = rng_for(self.seed, "population", name)
        return draw_population(centre, spreads, setup, which, rng, Forces(*self.forces_N, weight_N))

    def tables(self) -> Tables:
        """Tabulate the skin as designed, for the map."""
        first, last = np.log(self.forces_N)
        forces_N = np.exp(np.linspace(first, last, 1 + int(np.ceil((last - first) / STEPS_OF_FORCE))))
        return tabulate_map(self.syllabus.centre, self.syllabus.spreads, self.syllabus.setup, forces_N)


def lesson_of(design: SkinDesign, kind: BoardKind, depths_mm: tuple[float, ...], seed: int) -> Lesson:
    """Put a designed skin over designed boards: the law's numbers as the design has them, its slide included."""
    if design.hold is None:
        remedy = "Ask this experiment of a scene whose skin has hold."
        raise ParamsError("params.yaml: skin", "hold", "that of a skin that slides, as the law's", "null", remedy)
    modulus_MPa = design.modulus_kPa * 1e-3
    law = Law(
        0.0, 0.0, 0.0, kind.design.gap_mm, 1.0, 0.0, 0.0, modulus_MPa, design.hold.away_um_mm,
        *design.hold.give_um, lets_go_N=design.hold.lets_go_mm2 * modulus_MPa,
        grip_N_mm=design.hold.springs_N_mm / design.hold.friction,
    )  # fmt: skip
    chips_mm = np.array(kind.design.places_mm)
    setup = Setup(design, chips_mm, kind.design.gap_mm, kind.skin_mm, design.flipped, design.tip_radius_mm)
    deep_m = 1e-3 * np.array([min(depths_mm), max(depths_mm)])
    tip_m = design.tip_radius_mm * milli
    ends_N = FORCE_SHARES * force_at(
        deep_m, modulus_Pa=mega * modulus_MPa, thickness_m=setup.thickness_m, tip_radius_m=tip_m
    )
    syllabus = Syllabus("as designed", law, OF_RIG, setup, follows_law=True)
    return Lesson(syllabus, (float(ends_N[0]), float(ends_N[1])), seed)


def draw(lesson: Lesson, skins_n: int, tell: Callable[[str], None]) -> Population:
    """Draw a population part by part."""
    parts = []
    for first in range(0, skins_n, PART_N):
        which = slice(first, min(first + PART_N, skins_n))
        parts.append(_once(lesson, f"skins {which}", partial(_stack_of, lesson, which)))
        tell(f"{which.stop} of {skins_n} skins are drawn")
    return _unstack(np.concatenate(parts))


def network(lesson: Lesson, skins: Population, skins_n: int, steps_n: int) -> Weights:
    """Train a network on the first skins of a population."""
    first = Population(*(getattr(skins, name)[:skins_n] for name in Population.__annotations__))
    rng_name = (lesson.seed, "population", "network")  # without the number: equal first weights
    empty = draw_weights(skins.rest_uT.shape[1], rng_for(*rng_name))

    def teach() -> Float[np.ndarray, " w"]:
        weights, _ = train(first, lesson.syllabus, steps_n, rng_for(*rng_name))
        return np.concatenate([weights[name].ravel() for name in empty])

    flat, found, start = _once(lesson, f"network of {skins_n} skins, {steps_n} steps", teach), {}, 0
    for name, value in empty.items():
        found[name] = flat[start : start + value.size].reshape(value.shape)
        start += value.size
    return found


def _once(lesson: Lesson, what: str, make: Callable[[], np.ndarray]) -> np.ndarray:
    """Give what is kept under this name and these lessons; the first skin's fields stand for all physics below."""
    seen = hashlib.sha256(_stack_of(lesson, slice(1)).tobytes()).hexdigest()
    spreads = sorted(lesson.syllabus.spreads.items())
    code = [digest(module) for module in imported(TRAINS)]
    of = f"torch {version('torch')}; {code}; {seen}"
    name = f"{what}; {of}; {lesson.syllabus.centre}; {spreads}; {lesson.forces_N}; seed {lesson.seed}"
    found = io.load(PACKAGE, name)
    if found is None:
        found = make()
        io.save(PACKAGE, name, found)
    return found


def _stack_of(lesson: Lesson, which: slice) -> np.ndarray:
    return _stack(lesson.skins("taught", which))


def _stack(skins: Population) -> np.ndarray:
    rest_uT = np.repeat(skins.rest_uT[:, None], skins.db_uT.shape[1], axis=1)
    return np.concatenate([skins.db_uT, rest_uT, skins.place_mm, skins.force_N[..., None]], axis=2)


def _unstack(stacked: np.ndarray) -> Population:
    channels_n = (stacked.shape[2] - 3) // 2
    db_uT, rest_uT, place_mm, force_N = np.split(stacked, (channels_n, 2 * channels_n, -1), axis=2)
    return Population(db_uT, rest_uT[:, 0], place_mm, force_N[..., 0])


EXPERIMENT = "lobo"  # whose folds these are: their pools are those of adaptation
POOL_MAX_N = 65  # pokes: one at each place of the paper's grid, under any of its depths
TESTED_MAX_N = 2000  # rows of a skin that are read, drawn
ASKED_FURTHER_N = 16  # skins of the population that tell how sure experts are
FRESH_N = 32  # and others, on which is counted what their intervals hold
BY = ("way", "pokes_n", "labels_n")


class Asked(Taught):
    """Section population: what experts are taught, and what they are told of each skin."""

    unlabelled_n: Annotated[tuple[Annotated[int, Field(ge=0, le=POOL_MAX_N)], ...], Field(min_length=1)]
    labels_n: tuple[Annotated[int, Field(ge=1, le=POOL_MAX_N)], ...]

    def told(self) -> list[Told]:
        """List what experts are told: ever more pokes, then all of them and ever more labels."""
        return [(n, 0) for n in self.unlabelled_n] + [(max(self.unlabelled_n), n) for n in self.labels_n]


def cases(data: SceneData, fold: Fold, frame: Frame, rest_uT: dict[str, np.ndarray]) -> list[Case]:
    """Take the skins of a held-out board: a poke at each place of their first passes, and rows of later ones."""
    rows, found = data.rows, []
    for skin in np.unique(rows.skin[fold.test]):
        rng = rng_for(data.settings.seed, "population", "asked", str(skin))
        pooled = fold.pool[rows.skin[fold.pool] == skin]
        pool = _pool(data, pooled, frame, rng)
        test = fold.test[rows.skin[fold.test] == skin]
        test = np.sort(rng.permutation(test)[:TESTED_MAX_N])
        place_mm = frame.place(rows.target[test, :2].astype(float))
        true = np.column_stack([place_mm, rows.target[test, 2]])
        noload_uT = frame.field(rest_uT[str(skin)][None])[0]
        weight = _weight(data, pooled, frame, rng_for(data.settings.seed, "population", "weight", str(skin)))
        found.append(Case(str(rows.board[test[0]]), noload_uT, pool, weight, frame.field(rows.db_uT[test]), true))
    return found


def _weight(data: SceneData, own: np.ndarray, frame: Frame, rng: np.random.Generator) -> Weight:
    # Of the presses of the place next to the middle, that whose force comes next to the weight's.
    rows = data.rows
    off_mm = np.linalg.norm(frame.place(rows.target[own, :2].astype(float)), axis=1).round(1)
    middle = own[off_mm == off_mm.min()]
    press_i, first = np.unique(rows.indentation[middle], return_index=True)
    ratio = rows.target[middle[first], 2] / WEIGHT_N
    off = np.full(len(ratio), np.inf)  # a gauge may read 0 N and less, which no logarithm knows
    off[ratio > 0] = np.abs(np.log(ratio[ratio > 0]))
    if np.isinf(off).all():
        rule, got = "of a press with a force above 0 N", f"{len(ratio)} without"
        raise SchemaError(f"skin {rows.skin[own[0]]}", "the known weight", rule, got, "Check the sign of its forces.")
    next_i = press_i[off.argmin()]
    press = middle[rows.indentation[middle] == next_i]
    return weight_of(frame.field(rows.db_uT[press]).mean(axis=0), float(rows.target[press, 2].mean()), rng)


def _pool(data: SceneData, own: np.ndarray, frame: Frame, rng: np.random.Generator) -> Pokes:
    # Of each place one indentation, the mean of its readings.
    rows = data.rows
    first = np.unique(rows.indentation[own], return_index=True)[1]
    _, place_i = np.unique(rows.target[own[first], :2].round(2), axis=0, return_inverse=True)
    order = rng.permutation(len(first))
    _, chosen = np.unique(place_i.ravel()[order], return_index=True)
    taken = [own[rows.indentation[own] == rows.indentation[own[first[i]]]] for i in rng.permutation(order[chosen])]
    target = np.array([rows.target[one].mean(axis=0) for one in taken], float)
    db_uT = np.array([rows.db_uT[one].mean(axis=0) for one in taken], float)
    return Pokes(frame.place(target[:, :2]), target[:, 2], frame.field(db_uT))


def rest_by_skin(indentations: Path) -> dict[str, np.ndarray]:
    """Give the mean no-load field of each skin's first pass, in the chips' axes."""
    return {
        one.skin: one.noload_uT[one.pass_i == one.pass_i.min()].mean(axis=0, dtype=float)
        for one in read_captures(indentations)
    }


def score_all(
    lesson: Lesson, section: Asked, asked: Sequence[Case], scene: str
) -> tuple[pd.DataFrame, pd.DataFrame, dict[str, Any]]:
    """Score the experts of the whole population on every skin, and networks of smaller ones; and say what they are."""
    skins = draw(lesson, max(section.skins_n), lambda line: say(f"{scene} population: {line}"))
    networks: dict[int, Weights] = {}
    for n in section.skins_n:
        networks[n] = network(lesson, skins, n, section.steps_n)
        say(f"{scene} population: network of {n} skins is trained")
    whole = Experts(new_map(lesson.tables()), [networks[max(section.skins_n)]])
    further = lesson.skins("further", slice(ASKED_FURTHER_N), WEIGHT_N)
    held = cases_of(further, rng_for(lesson.seed, "population", "noise"))
    fresh = cases_of(lesson.skins("fresh", slice(FRESH_N), WEIGHT_N), rng_for(lesson.seed, "population", "fresh noise"))
    rows, sizes, untaught, full, trusted = [], [], [], (max(section.unlabelled_n), 0), {}
    for told in section.told():
        trusted[told] = trust(whole, held, told)
        rows += [row for case in asked for row in scores_of(whole, case, told, trusted[told])]
        untaught += [row for case in fresh for row in scores_of(whole, case, told, trusted[told])]
        say(f"{scene} population: told {told[0]} pokes and {told[1]} labels")
    for n, weights in networks.items():
        of_n = [row for case in asked for row in scores_of(fewer(whole, [weights]), case, full, trusted[full])]
        sizes += [row | {"skins_n": n} for row in of_n]
    within = [row for case in held for row in scores_of(whole, case, full, trusted[full])]
    coverage = pd.DataFrame(within).groupby("way")["coverage_pct"].mean().to_dict()
    share = trusted[full].weight_share
    words = {"coverage_further_pct": coverage, "weight_share": share, "fresh": over_boards(pd.DataFrame(untaught), *BY)}
    return pd.DataFrame(rows), pd.DataFrame(sizes), words


def over_boards(rows: pd.DataFrame, *keys: str) -> list[dict[str, Any]]:
    """Summarise scores over boards, each the mean of its skins."""
    found = []
    for key, own in rows.groupby(list(keys), sort=False):
        boards = own.groupby("board").mean(numeric_only=True).drop(columns=list(set(keys) - {"way"}))
        found.append(dict(zip(keys, key, strict=True)) | summarise(boards, boards=True))
    return found


def read(settings: Settings) -> Asked:
    """Read section population."""
    return settings.section(Asked, "population")


def population(settings: Settings, folds: Path, indentations: Path, results: Path) -> None:
    """Ask experts of simulated skins about every held-out skin of a simulated scene."""
    data, section, simulation = read_data(settings, indentations, folds), read(settings), simulation_settings(settings)
    kind, design = simulation.main_boards, settings.shared_section(SkinDesign, "skin")
    lesson = lesson_of(design, kind, simulation.main.depths_mm, settings.seed)
    turn = Rotation.from_euler("z", np.array(kind.design.turns_deg)[:, None], degrees=True).as_matrix()
    frame, rest_uT = Frame(turn, (CENTRE_MM, CENTRE_MM), mirrored=False), rest_by_skin(indentations)
    asked = [case for fold in data.folds_of(EXPERIMENT) for case in cases(data, fold, frame, rest_uT)]
    rows, sizes, words = score_all(lesson, section, asked, settings.scene)
    numbers = {
        "told": over_boards(rows, *BY),
        "scaling": over_boards(sizes, *BY, "skins_n"),
        "skins_asked_n": len(asked), "rows_asked_n": sum(len(case.true) for case in asked),
        "pool_n": min(len(case.pool.force_N) for case in asked), "steps_n": section.steps_n,
        "weight_N": WEIGHT_N, "weight_sd": WEIGHT_SD, **words,
    }  # fmt: skip
    write_results(results, numbers, {})


NAMES = {
    "map": "universal map, skin as designed",
    "universal": "universal, skin as designed",
    "network": "universal network alone, skin as designed",
}
WAYS = {"map": "map", "network": "network", "universal": "both"}
WEIGHED, FACTOR = "MSE_F with one known weight / N²", "MSE_F after one factor a skin (diagnosis) / N²"
COVERAGE = "in 90 % intervals / %"
FURTHER = {"mse_f_weight_N2": WEIGHED, "mse_f_factor_N2": FACTOR, "coverage_pct": COVERAGE}


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Show errors by what is told of a skin, and by how many skins a network was taught."""
    told = [_line(row, source) for row in numbers["told"]]
    scaling = [_line(row, source, taught=row["skins_n"]) for row in numbers["scaling"]]
    shown = {
        "population": tabulate(told, meaning=_meaning(numbers)),
        "population_scaling": tabulate(scaling, meaning=_scaling(numbers)),
    }
    if "fresh" in numbers:  # committed results may be of before it was counted
        shown["population_fresh"] = tabulate(_fresh(numbers["fresh"], source), meaning=_of_fresh(numbers))
    return shown


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw the error against the number of skins that a network was taught."""
    rows = pd.DataFrame(numbers["scaling"])
    with drawing(6.0, 3.8) as figure:
        axes = figure.subplots()
        for i, way in enumerate(("network", "universal")):
            own = rows[rows["way"] == way]
            wrong_pct = [100 - one["mean"] for one in own["accuracy_pct"]]
            sd = [one.get("sd", 0.0) for one in own["accuracy_pct"]]
            style = {"color": COLOURS[i], "marker": MARKERS[i], "capsize": 3}
            axes.errorbar(own["skins_n"], wrong_pct, sd, label=NAMES[way], **style)
        axes.set(xscale="log", xlabel="simulated skins that the network was taught", ylim=(0, None))
        axes.set_ylabel("error above 1 mm / %")
        axes.legend(frameon=False)
        boards_n = rows["accuracy_pct"].iloc[0]["n"]
        axes.set_title(f"{numbers['steps_n']} steps each, skins of {boards_n} boards ({source})", fontsize=9)
        return {"population_scaling.svg": svg(figure)}


def _line(row: Mapping[str, Any], source: str, taught: int | None = None) -> dict[str, str]:
    line = {"method": NAMES[row["way"]]} | ({} if taught is None else {"skins taught": str(taught)})
    line |= {"unlabelled pokes": str(row["pokes_n"]), "labels": str(row["labels_n"]), "source": source}
    return line | scores(row) | scores(row, FURTHER) | {"n": n_of(row)}


def _fresh(rows: Sequence[Mapping[str, Any]], source: str) -> list[dict[str, str]]:
    lines: dict[tuple[int, int], dict[str, str]] = {}
    for row in rows:
        told = row["pokes_n"], row["labels_n"]
        first = {"unlabelled pokes": str(told[0]), "labels": str(told[1]), "source": source}
        line = lines.setdefault(told, first)
        line |= scores(row, {"coverage_pct": f"{WAYS[row['way']]}: {COVERAGE}"})
    skins_n = n_of(rows[0])
    return [line | {"n": skins_n} for line in lines.values()]


def _of_fresh(numbers: Mapping[str, Any]) -> str:
    return (
        "Fresh skins of the population: neither those that networks were taught nor those that tell how sure experts "
        "are. [low, high]: 95 % interval over n skins. The population is drawn wider than the scene's "
        f"{numbers['skins_asked_n']} skins."
    )


def _meaning(numbers: Mapping[str, Any]) -> str:
    coverage = ", ".join(f"{NAMES[way]} {pct:.3g} %" for way, pct in numbers["coverage_further_pct"].items())
    return (
        f"Experts that were taught simulated skins about the skin as designed, and none of the scene's "
        f"{numbers['skins_asked_n']}, of which {numbers['rows_asked_n']:,} rows of later passes are read. Unlabelled "
        f"pokes: one at each of the {numbers['pool_n']} places of the grid under any depth, or the first of these; "
        f"labels are among them. The weight: of one press in the middle, {numbers['weight_N']:g} N or what of the "
        f"first passes comes next to it, the force is known to {100 * numbers['weight_sd']:g} %; the factor uses all "
        "forces: no weight that moves them alike goes below it. How sure each "
        "way is, and how far a weight moves its forces, was told on further skins of the population; there 90 % "
        f"intervals hold {coverage}."
    )


def _scaling(numbers: Mapping[str, Any]) -> str:
    return (
        f"Networks of {numbers['steps_n']} steps each, from equal first weights, on the first so many skins of one "
        "population; the map beside them is the same, and so is how sure they are, told with the network of most skins."
    )
