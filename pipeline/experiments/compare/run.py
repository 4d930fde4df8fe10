"""Stage compare: recorded changes of field beside simulated ones, for each board of a recorded scene.

Simulated with the nominal skin, with a law fitted on the board, and with the law of another board, of which only what
may differ from board to board is fitted anew. Refuses to know folds and networks.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from pydantic import Field
from scipy.constants import milli
from scipy.spatial.transform import Rotation

from pipeline.experiments.answer import read_folder, write_answer
from pipeline.experiments.compare import frames
from pipeline.report.statistics import statistic
from pipeline.settings import Settings
from reskin.config import Strict
from reskin.errors import ParamsError
from reskin.physics.board import BoardDesign
from reskin.physics.skin import SkinDesign
from reskin.schema import Readings
from reskin.seeds import rng_for
from reskin.universal.law import SEVEN, START, TEN, Law, Seen, Setup, beyond_n, fit, nominal_uT, simulate_uT
from reskin.universal.presses import Pokes, cosines, explained, growth, lengths_uT, memory, pool

Side_mm = Annotated[float, Field(gt=0, le=500)]
ARROWS_N = 4  # places that the figure shows
WALK_uT = 0.5  # of the no-load field from poke to poke, assumed, where memory is simulated
NOLOAD_READINGS_N = 10
CURVE_N = np.geomspace(3e-4, 10.0, 46)  # forces of the curve from the lightest touch to a firm press
LIGHT_N = 1e-3
EVERY = 5  # of a board's places, one is on that curve
# Friction under the tip bounds the slide: k / mu in N/mm, of none (the whole slide at any force) to a slippery tip.
GRIPS_N_MM = (1e-6, 4.0, START.grip_N_mm, 18.0)


class Compare(Strict):
    """How the recorded board lies under its labels and its skin, and what is put in by hand."""

    design: BoardDesign
    skin_mm: tuple[Side_mm, Side_mm]
    skin_flipped: bool  # every field has the other sign: a checkerboard skin that lies turned by a quarter
    labels_middle_mm: tuple[float, float]  # the label of the board's middle
    labels_mirrored: bool  # y labels run against the board's y
    tip_radius_mm: Annotated[float, Field(gt=0, le=50)]
    memory: Annotated[float, Field(ge=0, lt=1)]  # part of a poke's change that stays in the next no-load reading


def turns_of(section: Compare) -> Float[np.ndarray, "k 3 3"]:
    """Give the rotations from the chips' axes to the board's, as the scene has them."""
    return Rotation.from_euler("z", np.array(section.design.turns_deg)[:, None], degrees=True).as_matrix()


def setup_of(section: Compare, design: SkinDesign) -> Setup:
    """Put the designed skin over the scene's chips."""
    chips_mm, flipped = np.array(section.design.places_mm), section.skin_flipped
    return Setup(design, chips_mm, section.design.gap_mm, section.skin_mm, flipped, section.tip_radius_mm)


def see(pokes: Pokes, section: Compare) -> Seen:
    """Turn what was read into the board's axes."""
    turn, chips_n = turns_of(section), pokes.db_uT.shape[1]
    if len(turn) != chips_n:
        rule, remedy = f"{chips_n}, as recorded", "Mend compare.design of the scene."
        raise ParamsError(f"board {pokes.board}", "chips of compare.design", rule, len(turn), remedy)
    place_mm = (pokes.place_mm - section.labels_middle_mm) * (1, -1 if section.labels_mirrored else 1)
    rest_uT = np.einsum("kij,kj->ki", turn, pokes.noload_uT.mean(axis=0))
    return Seen(pokes, place_mm, np.einsum("kij,nkj->nki", turn, pokes.db_uT), rest_uT)


def beside(seen: Seen, simulated_uT: Float[np.ndarray, "n k 3"]) -> dict[str, Any]:
    """Compare simulated changes with recorded ones: direction, size and growth with force."""
    cosine, groups = cosines(simulated_uT, seen.db_uT), seen.pokes.groups
    grown = {"recorded": growth(seen.pokes, seen.db_uT), "simulated": growth(seen.pokes, simulated_uT)}
    return {
        "cosine_mean": float(cosine.mean()),
        "cosine_by_group": {name: float(cosine[seen.pokes.group_i == i].mean()) for i, name in enumerate(groups)},
        "explained_median": float(np.median(explained(simulated_uT, seen.db_uT))),
    } | ({"growth": grown} if None not in grown.values() else {})


def remembered(seen: Seen, simulated_uT: Float[np.ndarray, "n k 3"], section: Compare, seed: int) -> dict[str, Any]:
    """Find the memory of the recordings, and of simulated no-load readings into which one was put by hand."""
    pokes = seen.pokes  # turning a chip changes no sum of products, so its axes may be any
    rng = rng_for(seed, "compare", pokes.board)
    walk_uT = WALK_uT * rng.standard_normal(simulated_uT.shape).cumsum(axis=0)
    noise_uT = pokes.noise_uT / np.sqrt(NOLOAD_READINGS_N) * rng.standard_normal(simulated_uT.shape)
    before_uT = np.roll(simulated_uT, 1, axis=0)  # the first of a capture follows none, and is not asked
    found = {
        "recorded": memory(pokes, pokes.db_uT, pokes.noload_uT),
        "simulated": memory(pokes, simulated_uT, walk_uT + noise_uT + section.memory * before_uT),
    }
    return {"memory": found} if None not in found.values() else {}


def curve(law: Law, setup: Setup, place_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " c"]:
    """Give |dB| in uT, the median over some places, of presses with the forces of `CURVE_N`."""
    places_mm = np.unique(place_mm.round(2), axis=0)[::EVERY]
    at_mm, force_N = np.repeat(places_mm, len(CURVE_N), axis=0), np.tile(CURVE_N, len(places_mm))
    length_uT = lengths_uT(simulate_uT(law, setup, at_mm, force_N)).reshape(len(places_mm), -1)
    return np.median(length_uT, axis=0)


def grips(seen: Seen, setup: Setup, fitted: Law) -> list[dict[str, Any]]:
    """Fit the law anew with other frictions under the tip: what recordings tell of it, and what a touch would read.

    `grip_N` is the force that takes two thirds of the slide in the skin's middle.
    """
    rows = []
    for grip_N_mm in GRIPS_N_MM:
        law = replace(fitted, grip_N_mm=grip_N_mm)
        if grip_N_mm != fitted.grip_N_mm:
            law = fit(seen, setup, TEN, replace(START, grip_N_mm=grip_N_mm))
        agrees = beside(seen, simulate_uT(law, setup, seen.place_mm, seen.pokes.force_N))
        length_uT = curve(law, setup, seen.place_mm)
        rows.append(
            {name: agrees[name] for name in ("cosine_mean", "explained_median", "growth") if name in agrees}
            | {"grip_N_mm": grip_N_mm, "grip_N": grip_N_mm * milli * float(np.hypot(law.give_x_um, law.give_y_um))}
            | {"light_uT": float(np.interp(LIGHT_N, CURVE_N, length_uT)), "curve_uT": length_uT.round(2).tolist()}
        )
    return rows


def framed(seen: Seen, setup: Setup, section: Compare) -> dict[str, Any]:
    """Say whether labels, chips and skin lie as the scene has them."""
    found = frames.check(
        seen.place_mm, seen.pokes.db_uT, turns_of(section),
        lambda at_mm: nominal_uT(setup, at_mm, seen.pokes.force_N),
    )  # fmt: skip
    columns = zip(found.chips.tolist(), found.as_written.tolist(), found.cosines.tolist(), found.turns, strict=True)
    chips = [
        {"chip": i, "at": at, "cosine_as_written": written, "cosine_best": best, "read": turn.say()}
        for i, (at, written, best, turn) in enumerate(columns)
    ]
    return {"sentence": found.sentence, "chips": chips}


def skins_of(captures: Sequence[Readings]) -> dict[str, Pokes]:
    """Pool the captures of each skin on its board; named by the board, where that has one skin only."""
    skins: dict[str, list[Readings]] = {}
    for one in captures:
        skins.setdefault(f"{one.board}/{one.skin}", []).append(one)
    boards = [name.partition("/")[0] for name in skins]
    names = {name: board if boards.count(board) == 1 else name for name, board in zip(skins, boards, strict=True)}
    return {names[name]: pool(own) for name, own in skins.items()}


def compare_boards(boards: Mapping[str, Pokes], section: Compare, design: SkinDesign, seed: int) -> tuple[Any, Any]:
    """Compare every board; give the numbers, and what the figures draw."""
    setup = setup_of(section, design)
    seen = {board: see(pokes, section) for board, pokes in boards.items()}
    fitted = {board: fit(own, setup, TEN) for board, own in seen.items()}
    names = list(seen)
    by_board, drawn = {}, {}
    for i, (board, own) in enumerate(seen.items()):
        laws, told = {"fitted": fitted[board]}, {"fitted": asdict(fitted[board])}
        if len(names) > 1:
            law_of = names[(i + 1) % len(names)]
            laws["refitted"] = fit(own, setup, SEVEN, fitted[law_of])
            told["refitted"] = asdict(laws["refitted"]) | {"law_of": law_of}
        simulated_uT = {way: simulate_uT(law, setup, own.place_mm, own.pokes.force_N) for way, law in laws.items()}
        simulated_uT["nominal"] = nominal_uT(setup, own.place_mm, own.pokes.force_N)
        ways = {
            way: beside(own, of_way) | {"beyond_n": beyond_n(laws.get(way), setup, own.pokes.force_N)}
            for way, of_way in simulated_uT.items()
        }
        gripped = grips(own, setup, fitted[board])
        curves = {f"{row['grip_N_mm']:g}": row.pop("curve_uT") for row in gripped}
        by_board[board] = (
            ways.pop("fitted")
            | {"grips": gripped}
            | ways
            | remembered(own, simulated_uT["fitted"], section, seed)
            | {"laws": told, "frames": framed(own, setup, section)}
            | {"noise_uT": dict(zip("xyz", own.pokes.noise_uT.tolist(), strict=True))}
            | {"pokes_n": len(own.pokes), "left_out_n": own.pokes.left_out_n}
        )
        drawn[board] = _drawn(own, simulated_uT["fitted"]) | {"curve_uT": curves}
    numbers = {
        "by_board": by_board, "over_boards": over_boards(by_board), "memory_put_in": section.memory,
        "light_N": LIGHT_N, "grip_N_mm": START.grip_N_mm,
    }  # fmt: skip
    return numbers, {"chips_mm": setup.chips_mm.tolist(), "curve_N": CURVE_N.tolist(), "boards": drawn}


def over_boards(by_board: Mapping[str, Any]) -> dict[str, Any]:
    """Summarise over boards what has bounds: the board is the unit."""
    found: dict[str, Any] = {}
    for way in ("nominal", "fitted", "refitted"):
        rows = [own if way == "fitted" else own[way] for own in by_board.values() if way == "fitted" or way in own]
        values = {name: [own[name] for own in rows] for name in ("cosine_mean", "explained_median")}
        grown = [own["growth"] for own in rows if "growth" in own]
        values["growth_difference"] = [one["simulated"] - one["recorded"] for one in grown]
        if rows:
            found[way] = {name: statistic(each, boards=True) for name, each in values.items() if each}
    return found


def _drawn(seen: Seen, simulated_uT: Float[np.ndarray, "n k 3"]) -> dict[str, Any]:
    # Places in the middle group, from the middle outwards.
    own = np.flatnonzero(seen.pokes.group_i == len(seen.pokes.groups) // 2)
    order = own[np.argsort(np.hypot(*seen.place_mm[own].T), kind="stable")]
    chosen = order[np.unique(np.linspace(0, len(order) - 1, ARROWS_N).round().astype(int))]
    fields = {"recorded": seen.db_uT, "simulated": simulated_uT}
    return {
        "group": seen.pokes.groups[len(seen.pokes.groups) // 2],
        "places_mm": seen.place_mm[chosen].round(2).tolist(),
        "arrows_uT": {name: of[chosen].round(1).tolist() for name, of in fields.items()},
        "force_N": seen.pokes.force_N.round(3).tolist(),
        "length_uT": {name: lengths_uT(of).round(1).tolist() for name, of in fields.items()},
    }


def read(settings: Settings) -> Compare:
    """Read section compare."""
    return settings.section(Compare, "compare")


def compare(settings: Settings, indentations: Path, answer: Path) -> None:
    """Compare the recorded boards of a scene with simulated ones."""
    design = settings.shared_section(SkinDesign, "skin")
    boards = skins_of(read_folder(indentations, tuple(settings.captures_in(indentations))))
    write_answer(answer, *compare_boards(boards, read(settings), design, settings.seed))
