"""Measure the shipped model on simulated skins: accuracy, intervals and alarms.

    python -m tools.measure_model

It also tells what recorded boards add (`reskin model make --recordings`), on simulated rigs of three boards: models
that know two of them are tested on the third. The skins are drawn from the population of the training, with other
random numbers; their law errs as much as that of recorded boards. This takes a quarter of an hour of one core. The
tables are written between the markers `measured` of docs/learning.md.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from reskin import metrics
from reskin.seeds import rng_for
from reskin.universal.episodes import RecordedBoard, disturb
from reskin.universal.force import NORMAL_90
from reskin.universal.layout import BoardLayout, paper_layout, read_layout
from reskin.universal.making import REFERENCE_ERROR, WITH_BOARDS, hold_out, simulate
from reskin.universal.model import Universal, load_universal
from reskin.universal.population import PLACES_N, draw_law, draw_skin

PAGE = Path("docs/learning.md")
MARKERS = ("<!-- measured -->\n", "<!-- /measured -->")
SKINS_N, SEED, LABELS_N, FORCE_MIN_N = 200, 7, (0, 1, 10, 40), 0.5
LABELS_OF_ALARMS_N = 10
REFINED_N, RIGS_N, BOARDS_N = 20, 3, 3
OWN = ("seat_x_mm", "seat_y_mm", "rotation_deg", "gap_mm", "amplitude")  # what differs between boards of a shared rig


class Skin(NamedTuple):
    """A simulated skin along the axes of the chips."""

    rest_uT: np.ndarray
    db_uT: np.ndarray
    place_mm: np.ndarray
    force_N: np.ndarray


def draw(layout: BoardLayout, skins_n: int) -> list[Skin]:
    """Draw skins whose law errs."""
    skins, rng = simulate(layout, skins_n, SEED, "measured"), rng_for(SEED, "measured")
    db_uT = disturb(skins.db_uT, skins.place_mm, skins.force_N, REFERENCE_ERROR, rng)[:, 0].astype(float)
    place_mm, force_N = skins.place_mm + np.array(layout.centre_mm), skins.force_N.astype(float)
    rest_uT = layout.to_chips(skins.rest_uT.astype(float))
    return [Skin(rest_uT[i], layout.to_chips(db_uT[i]), place_mm[i], force_N[i]) for i in range(skins_n)]


def calibrate(model: Universal, skin: Skin, seen: np.ndarray, labelled: np.ndarray) -> None:
    """Calibrate a model to presses of a skin."""
    model.zero(skin.rest_uT).see(skin.rest_uT + skin.db_uT[seen])
    if len(labelled):
        model.label(skin.place_mm[labelled], skin.force_N[labelled], skin.rest_uT + skin.db_uT[labelled])


def parts(skin: Skin, i: int, *, halves: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw unlabelled presses, presses that may be labels, and tested presses, which are apart in split `halves`."""
    rng, heavy = rng_for(SEED, "parts", i), skin.force_N >= FORCE_MIN_N
    order = rng.permutation(len(skin.force_N))
    seen, others = order[:PLACES_N], order[PLACES_N:]
    if not halves:
        return seen, seen[heavy[seen]], others[heavy[others]]
    angle = rng.uniform(0, 2 * np.pi)
    along_mm = (skin.place_mm - 8.0) @ np.array([np.cos(angle), np.sin(angle)])
    return seen, order[heavy[order] & (along_mm[order] < -1)], others[heavy[others] & (along_mm[others] > 1)]


def score(
    model: Universal, skins: list[Skin], labels_n: int, *, halves: bool, refined: bool = False
) -> dict[str, float]:
    """Return mean scores over skins; R^2 of force is the median."""
    rows = []
    for i, skin in enumerate(skins):
        seen, pool, tested = parts(skin, i, halves=halves)
        calibrate(model, skin, seen, pool[:labels_n])
        if refined:
            model.refine()
        found = model.estimate(skin.rest_uT + skin.db_uT[tested])
        place_mm, force_N = skin.place_mm[tested], skin.force_N[tested]
        row = {"accuracy_pct": metrics.accuracy_pct(place_mm, found.place_mm)}
        row |= {"r2_f": metrics.r2(force_N, found.force_N)}
        for name, true, estimate, sd in (
            ("coverage_pct", place_mm, found.place_mm, found.sd_mm),
            ("coverage_f_pct", force_N, found.force_N, found.sd_N),
        ):
            row[name] = metrics.coverage_pct(true, estimate - NORMAL_90 * sd, estimate + NORMAL_90 * sd)
        rows.append(row)
    table = pd.DataFrame(rows)
    return {**{str(name): float(value) for name, value in table.mean().items()}, "r2_f": float(table["r2_f"].median())}


def changed(skin: Skin, channels: np.ndarray, factor: float | np.ndarray = 1.0) -> Skin:
    """Return a skin with its channels in another order, multiplied by a factor."""
    return skin._replace(rest_uT=factor * skin.rest_uT[channels], db_uT=factor * skin.db_uT[:, channels])


def faults() -> dict[str, Callable[[Skin], Skin]]:
    """Return what may be wrong with a skin or its labels, by name."""
    by_chip = np.arange(15).reshape(5, 3)
    same, alive = by_chip.ravel(), np.repeat(np.arange(5) != 1, 3)
    return {
        "nothing": lambda skin: skin,
        "reversed magnets": partial(changed, channels=same, factor=-1.0),
        "two outer chips exchanged": partial(changed, channels=by_chip[[0, 3, 2, 1, 4]].ravel()),
        "the middle and an outer chip exchanged": partial(changed, channels=by_chip[[1, 0, 2, 3, 4]].ravel()),
        "a dead chip": partial(changed, channels=same, factor=alive),
        "labels mirrored in y": lambda skin: skin._replace(place_mm=np.array([0, 16]) + [1, -1] * skin.place_mm),
        "labels turned by 90°": lambda skin: skin._replace(place_mm=8 + (skin.place_mm - 8)[:, ::-1] * [1, -1]),
        "labels shifted by 4 mm": lambda skin: skin._replace(
            place_mm=np.clip(skin.place_mm + np.array([4, 0]), -2, 18)
        ),
    }


def alarms(model: Universal, skins: list[Skin], fault: Callable[[Skin], Skin]) -> dict[str, float]:
    """Return the accuracy with a fault, without and with labels, and the shares of skins with an alarm."""
    rows = []
    for i, whole in enumerate(skins):
        skin = fault(whole)
        seen, pool, tested = parts(whole, i, halves=False)
        row = {}
        for labels_n in (0, LABELS_OF_ALARMS_N):
            calibrate(model, skin, seen, pool[:labels_n])
            found = model.estimate(skin.rest_uT + skin.db_uT[tested])
            row[f"accuracy_{labels_n}_pct"] = metrics.accuracy_pct(whole.place_mm[tested], found.place_mm)
            row[f"alarm_{labels_n}_pct"] = 100.0 * bool(model.warnings)
        rows.append(row)
    return {str(name): float(value) for name, value in pd.DataFrame(rows).mean().items()}


def eflesh_alarms_pct(model: Universal) -> float:
    """Return the share of simulated skins of layout eflesh that cause an alarm, read as if they were of the model."""
    found = []
    for skin in draw(read_layout("eflesh"), SKINS_N // 4):
        model.zero(skin.rest_uT).see(skin.rest_uT + skin.db_uT[:PLACES_N])
        found.append(bool(model.warnings))
    return 100 * float(np.mean(found))


def draw_rig(rig_i: int, *, shared: bool) -> list[RecordedBoard]:
    """Draw the boards of a simulated rig.

    If `shared`, the boards have the same errors of the law, the same origin of labels, slide and modulus; only seat,
    gap and magnetisation differ. Otherwise, they are as different as any skins.
    """
    layout, rng = paper_layout(), rng_for(SEED, "rig", rig_i)
    spreads, centre = layout.all_spreads, layout.law
    if shared:
        centre = draw_law(centre, spreads, rng)
        spreads = {name: 0.5 * spreads[name] for name in OWN}
    boards = []
    for board_i in range(BOARDS_N):
        parts = draw_skin([draw_law(centre, spreads, rng)], layout.setup(), rng, layout.forces)
        db_uT, rest_uT, place_mm, force_N = (np.asarray(part, np.float32) for part in parts)
        errors = rng_for(SEED, "errors", rig_i, 0 if shared else board_i)
        both = np.stack([db_uT[0], db_uT[0]])[None]
        db_uT = disturb(both, place_mm[None], force_N[None], REFERENCE_ERROR, errors)[0, 0]
        boards.append(RecordedBoard(f"{rig_i}.{board_i}", db_uT[:, None], rest_uT, place_mm, force_N[:, None]))
    return boards


def measure_rigs(model: Universal) -> list[dict[str, Any]]:
    """Return accuracies on held-out boards, with 0 and 10 labels, without and with the other boards of the rig."""
    rows, skins = [], simulate(model.layout, WITH_BOARDS.skins_n, SEED, "with boards")
    for shared in (True, False):
        found = []
        for rig_i in range(RIGS_N):
            rig = draw_rig(rig_i, shared=shared)
            held_out = hold_out(model, skins, rig, WITH_BOARDS.steps_n, SEED, say=lambda _: None)
            found += [(*each.without_boards_pct, *each.with_boards_pct) for each in held_out]
        names = ("alone, 0 labels", "alone, 10 labels", "with the other boards, 0", "with the other boards, 10")
        means = zip(names, np.mean(found, axis=0).round(1).tolist(), strict=True)
        differences = np.subtract(np.array(found)[:, 2:], np.array(found)[:, :2])
        error = (differences.std(axis=0, ddof=1) / np.sqrt(len(found))).round(1).tolist()
        rows.append({"rigs": "shared" if shared else "unshared", **dict(means), "standard errors of the gain": error})
    return rows


def main() -> None:
    """Measure, and write the tables into the page."""
    model, skins = load_universal(), draw(paper_layout(), SKINS_N)
    scores = [
        {"split": split, "labels": n, **score(model, skins, n, halves=split == "halves")}
        for split in ("anywhere", "halves")
        for n in LABELS_N
    ]
    of_refined = [
        {"split": split, "refined": refined}
        | score(model, skins[:REFINED_N], LABELS_N[-1], halves=split == "halves", refined=refined)
        for split in ("anywhere", "halves")
        for refined in (False, True)
    ]
    of_faults = [{"fault": name, **alarms(model, skins, fault)} for name, fault in faults().items()]
    text = [
        "The shipped model on simulated skins (`python -m tools.measure_model`)", "",
        f"- {SKINS_N} skins of the population of the training, drawn anew; as on recorded boards, the law errs by",
        "  {:.0%} to {:.0%} of the field change".format(*REFERENCE_ERROR),
        f"- calibrated with {PLACES_N} presses without labels, and labels of {FORCE_MIN_N:g} N or more",
        "- anywhere: labels and tests are anywhere; halves: labels are on one side of the skin, tests on the other",
        "- means over skins; R² of force: median", "",
        pd.DataFrame(scores).round(2).to_markdown(index=False), "",
        f"The first {REFINED_N} skins with {LABELS_N[-1]} labels, without and with `refine`:", "",
        pd.DataFrame(of_refined).round(2).to_markdown(index=False), "",
        f"With faults: accuracy with 0 and {LABELS_OF_ALARMS_N} labels, and share of the skins with an alarm", "",
        pd.DataFrame(of_faults).round(1).to_markdown(index=False), "",
        f"Simulated skins of layout eflesh, read as ReSkin's board: {eflesh_alarms_pct(model):.0f} % with an alarm.",
        "",
        f"Within 1 mm in %, on the third board of {RIGS_N} simulated rigs, by models that know none or two of its",
        "boards. Boards of a rig share errors of the law, origin of labels, slide and modulus, or nothing.", "",
        pd.DataFrame(measure_rigs(model)).to_markdown(index=False), "",
    ]  # fmt: skip
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(MARKERS[0])
    PAGE.write_text(
        before + MARKERS[0] + "\n".join(text) + MARKERS[1] + rest.partition(MARKERS[1])[2], encoding="utf-8"
    )


if __name__ == "__main__":
    main()
