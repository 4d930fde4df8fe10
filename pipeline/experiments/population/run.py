"""Stage population: experts that were taught simulated skins only, on held-out rows of those that table 2 is scored on.

They know the skin and the board as designed; none of the scene's own skins. Further skins of the population tell how
sure they are, and fresh ones what their intervals hold. Refuses to know how experts are taught (`taught`).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from pydantic import Field
from scipy.spatial.transform import Rotation

from pipeline.experiments.answer import read_folder, write_answer
from pipeline.experiments.population.taught import Lesson, Taught, draw, lesson_of, network
from pipeline.report.statistics import summarise
from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.synthesis import synthesis_of
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
from pipeline.training.trainings import SceneData, read_data
from pipeline.training.universal import Frame, Pokes
from reskin.data.grid import CENTRE_MM
from reskin.data.splits import Fold
from reskin.errors import SchemaError
from reskin.physics.skin import SkinDesign
from reskin.seeds import rng_for
from reskin.universal.map import new_map
from reskin.universal.network import Weights

QUESTION = "lobo"  # whose folds these are: their pools are those of adaptation
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
        for one in read_folder(indentations)
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


def population(settings: Settings, folds: Path, indentations: Path, answer: Path) -> None:
    """Ask experts of simulated skins about every held-out skin of a simulated scene."""
    data, section, synthesis = read_data(settings, indentations, folds), read(settings), synthesis_of(settings)
    kind, design = synthesis.main_boards, settings.shared_section(SkinDesign, "skin")
    lesson = lesson_of(design, kind, synthesis.main.depths_mm, settings.seed)
    turn = Rotation.from_euler("z", np.array(kind.design.turns_deg)[:, None], degrees=True).as_matrix()
    frame, rest_uT = Frame(turn, (CENTRE_MM, CENTRE_MM), mirrored=False), rest_by_skin(indentations)
    asked = [case for fold in data.folds_of(QUESTION) for case in cases(data, fold, frame, rest_uT)]
    rows, sizes, words = score_all(lesson, section, asked, settings.scene)
    numbers = {
        "told": over_boards(rows, *BY),
        "scaling": over_boards(sizes, *BY, "skins_n"),
        "skins_asked_n": len(asked), "rows_asked_n": sum(len(case.true) for case in asked),
        "pool_n": min(len(case.pool.force_N) for case in asked), "steps_n": section.steps_n,
        "weight_N": WEIGHT_N, "weight_sd": WEIGHT_SD, **words,
    }  # fmt: skip
    write_answer(answer, numbers, {})
