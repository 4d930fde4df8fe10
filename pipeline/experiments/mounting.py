"""How reliably the universal model finds the orientation of a skin and of its labels.

The shipped model is used as a user would use it, on data of recorded boards and simulated skins that are changed first.
Fields are changed as if the skin had been turned by 90 degrees before it was glued on, or as if two chips had been
exchanged. The places of labels are changed as if their axes had been mirrored or turned.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float
from pydantic import Field

from pipeline.experiments.known_boards import read_known_boards
from pipeline.experiments.random_presses import (
    CHECKERBOARD,
    BoardPresses,
    board_presses,
    draw_presses,
    place_scores,
    raise_forces,
)
from pipeline.experiments.results import write_results
from pipeline.formatting import show, tabulate
from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.statistics import statistic
from pipeline.training.universal import draw_prior_skins, law_error
from reskin.config import Strict
from reskin.data.grid import CENTRE_MM
from reskin.seeds import rng_for
from reskin.universal.batches import NOMINAL_NAME, SkinPrior
from reskin.universal.law import Setup, to_chips
from reskin.universal.map import NOMINAL, NOMINAL_SPREADS
from reskin.universal.model import MISFIT_MAX, Universal, load_universal
from reskin.universal.mounting import frames
from reskin.universal.population import PLACES_N

CHIPS_SWAPPED = (0, 2, 1, 3, 4)  # order of the chips if two neighbouring outer chips are exchanged
AS_RECORDED, TURNED, SWAPPED = "as recorded", "turned by a quarter", "two chips exchanged"
RECORDED, SIMULATED = "recorded", "simulated"
WITH_CHECK, WITHOUT_CHECK = "orientation found", "orientation assumed"


class Mounting(Strict):
    """Settings section `mounting`: numbers of simulated skins, of labels, and of random draws for each board."""

    skins_n: Annotated[int, Field(ge=1, le=10_000)]
    labels_n: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)]
    draws_n: Annotated[int, Field(ge=1)]


class Skin(NamedTuple):
    """A skin, with data in the form that the universal model expects.

    - name: name of the skin.
    - rest_uT: no-load field, in the chips' axes.
    - db_uT: field changes of presses, in the chips' axes.
    - place_mm, force_N: places of the presses, in the coordinates of labels, and their forces.
    """

    name: str
    rest_uT: Float[np.ndarray, " ch"]
    db_uT: Float[np.ndarray, "m ch"]
    place_mm: Float[np.ndarray, "m 2"]
    force_N: Float[np.ndarray, " m"]

    def changed(self, change: str) -> "Skin":
        """Return the skin with the fields that it would have after a change of its mounting."""
        rest_uT, db_uT = (_changed(field_uT, change) for field_uT in (self.rest_uT, self.db_uT))
        return self._replace(rest_uT=rest_uT, db_uT=db_uT)


def _changed(field_uT: Float[np.ndarray, "*n ch"], change: str) -> Float[np.ndarray, "*n ch"]:
    if change == TURNED:
        return -field_uT
    if change == SWAPPED:
        return field_uT.reshape(*field_uT.shape[:-1], -1, 3)[..., CHIPS_SWAPPED, :].reshape(field_uT.shape)
    return field_uT


def mounting(settings: Settings, section: Mounting, indentations: Path, folds: Path, results: Path) -> None:
    """Change the mounting of recorded boards and simulated skins, and count what the universal model finds."""
    known = read_known_boards(settings, indentations, folds)
    recorded = {board: board_presses(known, board) for board in known.presses}
    boards = [skin_of_board(board) for board in recorded.values()]
    skins = simulated_skins(known.setup, section.skins_n, settings.seed, "mounting")
    say(f"{settings.scene} mounting: {len(skins)} skins simulated")
    orientation = [
        {"source": source, "change": change} | orientations([skin.changed(change) for skin in group], settings.seed)
        for source, group in ((RECORDED, boards), (SIMULATED, skins))
        for change in (AS_RECORDED, TURNED, SWAPPED)
    ]
    labels = label_rows(RECORDED, boards, section, settings.seed, section.draws_n)
    labels += label_rows(SIMULATED, skins, section, settings.seed, 1)
    say(f"{settings.scene} mounting: orientations and labels checked")
    accuracy = [row for board in recorded.values() for row in accuracy_rows(board, section, settings.seed)]
    numbers = {
        "orientation": orientation, "labels": labels, "accuracy": summarise_accuracy(accuracy),
        "draws_n": section.draws_n,
    }  # fmt: skip
    write_results(results, numbers, {})


def skin_of_board(board: BoardPresses) -> Skin:
    """Return the presses of a recorded board as inputs of the universal model."""
    presses = raise_forces(board.presses)
    rest_uT, db_uT = to_chips(board.rest_uT[None])[0], to_chips(presses.db_uT)
    return Skin(board.board, rest_uT, db_uT, presses.place_mm + CENTRE_MM, presses.force_N)


def simulated_skins(setup: Setup, skins_n: int, seed: int, name: str) -> list[Skin]:
    """Draw skins from the prior of the shipped model, with errors of the law as in the training of the model.

    name: name of the random stream.
    """
    prior = SkinPrior(NOMINAL_NAME, NOMINAL, NOMINAL_SPREADS, setup)
    drawn = draw_prior_skins(prior, skins_n, seed, name, law_error())
    parts = zip(drawn.rest_uT, drawn.db_uT, drawn.place_mm, drawn.force_N, strict=True)
    return [
        Skin(
            f"skin {i}", to_chips(rest_uT[None].astype(float))[0], to_chips(db_uT.astype(float)),
            place_mm.astype(float) + CENTRE_MM, force_N.astype(float),
        )
        for i, (rest_uT, db_uT, place_mm, force_N) in enumerate(parts)
    ]  # fmt: skip


def orientations(skins: Sequence[Skin], seed: int) -> dict[str, Any]:
    """Count how often the model notices a changed mounting of the skin.

    From the no-load field, the model may find a turned orientation or give a warning. From 65 presses, it may notice a
    large misfit.
    """
    turned, warned, log_odds, misfits = [], [], [], []
    for skin in skins:
        model = load_universal().zero(skin.rest_uT)
        turned.append(model.mounting.turned)
        warned.append(bool(model.warnings))
        log_odds.append(model.mounting.log_odds)
        pressed = rng_for(seed, "mounting", skin.name).permutation(len(skin.db_uT))[:PLACES_N]
        misfits.append(model.see(skin.rest_uT + skin.db_uT[pressed]).misfit)
    return {
        "skins_n": len(skins), "turned_pct": percentage(turned), "warned_pct": percentage(warned),
        "log_odds_min": min(log_odds), "misfit_pct": percentage(misfit > MISFIT_MAX for misfit in misfits),
    }  # fmt: skip


def percentage(conditions: Iterable[bool]) -> float:
    """Return the percentage of conditions that are true."""
    return 100 * float(np.mean([*conditions]))


def label_rows(source: str, skins: Sequence[Skin], section: Mounting, seed: int, draws_n: int) -> list[dict[str, Any]]:
    """Return, for each of the eight orientations of the labels' axes, how often a warning names this orientation.

    If the axes are right, every warning counts, because it is a false alarm.
    """
    warned: dict[tuple[int, str], list[bool]] = {}
    for skin in skins:
        model = load_universal().zero(skin.rest_uT)
        for draw_i in range(draws_n):
            order = rng_for(seed, "mounting", skin.name, "labels", draw_i).permutation(len(skin.db_uT))
            for labels_n in section.labels_n:
                chosen = order[:labels_n]
                for name, matrix in frames().items():
                    # The model receives labels in wrong axes: the true places are multiplied by `matrix`.
                    place_mm = (skin.place_mm[chosen] - CENTRE_MM) @ matrix + CENTRE_MM
                    model.label(place_mm, skin.force_N[chosen], skin.rest_uT + skin.db_uT[chosen])
                    frame = model.label_frame
                    named = frame is not None and frame.warning() is not None and name in ("as given", frame.name)
                    warned.setdefault((labels_n, name), []).append(named)
    return [
        {"source": source, "labels_n": n, "axes": name, "warned_pct": percentage(each), "trials_n": len(each)}
        for (n, name), each in warned.items()
    ]


def accuracy_rows(board: BoardPresses, section: Mounting, seed: int) -> list[dict[str, Any]]:
    """Compute scores on a recorded board, as it was recorded and after turning the skin.

    Both are computed with and without the check of the orientation.

    The calibration uses 65 unlabelled presses at random places. Labels are at places of one colour of a checkerboard,
    and tests at places of the other colour.
    """
    rows = []
    for change in (AS_RECORDED, TURNED):
        skin = skin_of_board(board).changed(change)
        for draw_i in range(section.draws_n):
            draw = draw_presses(board, CHECKERBOARD, PLACES_N, seed, draw_i)
            readings_uT = skin.rest_uT + _changed(to_chips(board.readings.db_uT[draw.tested]), change)
            for check, turned in ((WITH_CHECK, None), (WITHOUT_CHECK, False)):
                model = load_universal().zero(skin.rest_uT, turned=turned)
                model.see(skin.rest_uT + skin.db_uT[draw.unlabelled], area=True)
                for labels_n in (0, *section.labels_n):
                    scores = score_places(model, skin, draw.labels[:labels_n], readings_uT, board, draw.tested)
                    where = {"board": board.board, "change": change, "check": check, "labels_n": labels_n}
                    rows.append(where | scores)
    return rows


def score_places(
    model: Universal, skin: Skin, labelled: np.ndarray, readings_uT: np.ndarray, board: BoardPresses, tested: np.ndarray
) -> dict[str, float]:
    """Calibrate to labels, if there are any, and score the places of the tested readings."""
    if len(labelled):
        model.label(skin.place_mm[labelled], skin.force_N[labelled], skin.rest_uT + skin.db_uT[labelled])
    found_mm = model.predict(readings_uT)[:, :2]
    return place_scores(found_mm - CENTRE_MM - board.readings.place_mm[tested])


def summarise_accuracy(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Average the scores over draws, and summarise these averages over boards."""
    frame = pd.DataFrame(rows)
    keys = ["change", "check", "labels_n"]
    summary = []
    for key, group in frame.groupby(keys, sort=False):
        by_board = group.groupby("board")[["accuracy_pct", "median_mm"]].mean()
        row: dict[str, Any] = dict(zip(keys, key, strict=True))
        row |= {str(name): statistic(by_board[name].to_numpy(), boards=True) for name in by_board}
        summary.append(row)
    return summary


OF_ORIENTATION = (
    "The orientation that the shipped universal model finds from the no-load field alone. Found turned: percentage of "
    "skins that the model takes for skins turned by 90 degrees. Warned: percentage of skins for which the model warns "
    "that the orientation is uncertain. Smallest log odds: smallest value, over the skins, of the log odds of the "
    "found orientation against the other orientation. Large misfit: percentage of skins for which 65 presses at random "
    "places have a median misfit above {misfit:g}. A skin that is turned by 90 degrees "
    "has all fields negated."
)
OF_LABELS = (
    "Percentage of trials in which the model warns that the labels have these wrong axes. In the row `as given`, the "
    "axes are right, so every warning is a false alarm, and all warnings are counted. The model receives only the "
    "no-load field and the labels. On each recorded board, labels are drawn at random {draws_n} times."
)
OF_ACCURACY = (
    "Accuracy of estimated places on recorded boards, as recorded and with all fields negated (as if the skin had been "
    "turned by 90 degrees). The model is calibrated with 65 unlabelled presses at random places. Labelled presses are "
    "at places of one colour of a checkerboard, and tested presses at places of the other colour. The scores are means "
    "over {draws_n} random draws and then over boards; (a; b) are the values of the boards. `orientation found`: the "
    "model finds the orientation from the no-load field. `orientation assumed`: the model assumes that no skin is "
    "turned."
)


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate the rates of detection and of false alarms, and the accuracy on turned skins."""
    orientation = [
        {
            "skins": f"{row['skins_n']} {row['source']}", "mounting": row["change"],
            "found turned, %": round(row["turned_pct"], 1), "warned, %": round(row["warned_pct"], 1),
            "smallest log odds": round(row["log_odds_min"], 1), "large misfit, %": round(row["misfit_pct"], 1),
        }
        for row in numbers["orientation"]
    ]  # fmt: skip
    frame = pd.DataFrame(numbers["labels"])
    labels = []
    for (of, name), group in frame.groupby(["source", "axes"], sort=False):
        line: dict[str, Any] = {"skins": of, "axes of the labels": name, "trials": int(group["trials_n"].iloc[0])}
        rates = zip(group["labels_n"], group["warned_pct"], strict=True)
        labels.append(line | {f"{n} labels: warned, %": round(pct, 1) for n, pct in rates})
    accuracy = [
        {"mounting": row["change"], "model": row["check"], "labels": row["labels_n"]}
        | {"within 1 mm, %": show(row["accuracy_pct"]), "median error, mm": show(row["median_mm"]), "source": source}
        for row in numbers["accuracy"]
    ]
    draws_n = numbers["draws_n"]
    return {
        "mounting": tabulate(orientation, meaning=OF_ORIENTATION.format(misfit=MISFIT_MAX)),
        "mounting_labels": tabulate(labels, meaning=OF_LABELS.format(draws_n=draws_n)),
        "mounting_accuracy": tabulate(accuracy, meaning=OF_ACCURACY.format(draws_n=draws_n)),
    }
