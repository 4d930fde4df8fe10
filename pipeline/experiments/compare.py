"""Compare recorded changes of field with simulated ones, poke by poke, on boards with known forces (not in the paper).

A poke is a press at one place to one depth. A law is a physical model of a skin, which gives the change of field from
the place and the force of a poke. Each board is simulated in three ways:
- with the nominal skin, without any fit,
- with a law that is fitted to the pokes of this board,
- with the law of another board, after the parameters that may differ between boards are fitted to the pokes of this
  board.

The experiment also examines:
- the friction under the tip,
- the memory, which is the fraction of a poke's change of field that remains in the next no-load reading,
- whether labels, chips and skin are oriented as the scene's settings state.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from pydantic import Field
from scipy.constants import milli
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from pipeline.experiments.results import read_captures, write_results
from pipeline.formatting import show_digits, tabulate
from pipeline.plot import COLOURS, MARKERS, drawing, svg
from pipeline.settings import Row, SectionWithRows, Settings
from pipeline.statistics import combine_verdicts, statistic, verdict, verdict_within
from reskin.errors import ParamsError
from reskin.physics.board import BoardDesign
from reskin.physics.skin import SkinDesign
from reskin.schema import Readings
from reskin.seeds import rng_for
from reskin.universal.law import SEVEN, START, TEN, AlignedPresses, Law, Setup, beyond_n, fit, nominal_uT, simulate_uT
from reskin.universal.layout import BoardLayout, as_layout, read_layout
from reskin.universal.presses import RecordedPresses, cosines, explained, growth, magnitudes_uT, memory, pool

ARROWS_N = 4  # number of places per board in the figure of arrows
WALK_uT = 0.5  # the simulated no-load field is a random walk; this is its assumed step from one poke to the next
NOLOAD_READINGS_N = 10
CURVE_N = np.geomspace(3e-4, 10.0, 46)  # forces at which |dB| is simulated, from a light touch to a firm press
LIGHT_N = 1e-3  # force of a light touch
FITTED_MAX_N = 600  # largest number of presses per board; fits to more would take minutes
PLACE_STRIDE = 5  # to save time, |dB| is simulated only at every fifth place of a board, and the median is plotted
# Values of k / mu in N/mm, where k is the stiffness of the springs that hold the skin, and mu is the friction
# coefficient under the tip. This ratio limits how far a tip can slide the skin. With the first value, there is almost
# no limit: the skin slides fully at any force. The last value stands for a slippery tip.
GRIPS_N_MM = (1e-6, 4.0, START.grip_N_mm, 18.0)

Fields = Float[np.ndarray, "n k 3"]
Side_mm = Annotated[float, Field(gt=0, le=500)]


class Compare(SectionWithRows):
    """Settings section `compare`.

    The section states how the recorded board, its labels (places of pokes) and its skin are oriented, and which memory
    is simulated. A scene's file may describe the board by one key `layout` instead of `tip_radius_mm` and the keys from
    `design` to `labels_middle_mm`. The value of `layout` is either the layout of a board, in the form of the files in
    `reskin/universal/layouts`, or the name of one of these files.
    """

    layout: BoardLayout | None = None
    design: BoardDesign
    skin_mm: tuple[Side_mm, Side_mm]
    skin_flipped: bool  # whether all magnetic poles are swapped, as by a quarter turn of a checkerboard skin
    labels_middle_mm: tuple[float, float]  # label (x, y) of the place at the board's middle
    labels_mirrored: bool  # whether y of the labels points opposite to y of the board
    tip_radius_mm: Annotated[float, Field(gt=0, le=50)]
    # Simulated fraction of a poke's change of field that remains in the next no-load reading. The value is assumed.
    memory: Annotated[float, Field(ge=0, lt=1)]

    @classmethod
    def expand(cls, section: Row, settings: Settings, where: str) -> Row:
        if "layout" not in section:
            return section
        given, key = section["layout"], f"{where}.layout"
        if isinstance(given, str) and Path(given).suffix:
            problem = f"{given} is the name of a file, and DVC would not notice when this file changes"
            raise ParamsError(f"{key}: {problem}. Replace the name by the content of the file, as `reskin new` does.")
        layout = read_layout(given) if isinstance(given, str) else as_layout(given, key)
        design = {
            "chips_xy_mm": layout.chips_mm.tolist(), "chips_turn_deg": list(layout.turns_deg), "gap_mm": layout.gap_mm,
        }  # fmt: skip
        of_layout = {
            "layout": layout.model_dump(mode="json"), "design": design, "skin_mm": layout.skin.size_mm,
            "skin_flipped": layout.skin.flipped, "labels_middle_mm": layout.centre_mm,
            "tip_radius_mm": layout.tip_radius_mm,
        }  # fmt: skip
        if twice := sorted(section.keys() & of_layout.keys() - {"layout"}):
            raise ParamsError(
                f"{where}: {', '.join(twice)} cannot be set together with layout. Change the layout instead."
            )
        return section | of_layout

    @property
    def stated_by(self) -> str:
        """Name of the source of the stated orientations, for use in messages: the scene, or a layout."""
        return "the scene" if self.layout is None else f"layout {self.layout.name}"


def compare(settings: Settings, section: Compare, indentations: Path, results: Path) -> None:
    """Compare the recorded changes of field of a scene's boards with simulated ones, and write the results.

    For boards without known forces, only the orientations of labels, chips and skin are compared.
    """
    design = settings.shared_section(SkinDesign, "skin")
    boards = pool_skins(read_captures(indentations, tuple(settings.captures_in(indentations))), with_force=False)
    write_results(results, *compare_boards(boards, section, design, settings.seed))


def compare_boards(
    boards: Mapping[str, RecordedPresses], section: Compare, design: SkinDesign, seed: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Compare the recordings of every board with simulations; return the numbers, and the data for the figures."""
    setup = make_setup(section, design)
    all_aligned = {board: to_board_axes(_thin(pokes, FITTED_MAX_N), section) for board, pokes in boards.items()}
    aligned = {board: presses for board, presses in all_aligned.items() if presses.recorded.forces_known}
    fitted = {board: fit(presses, setup, TEN) for board, presses in aligned.items()}
    names = list(aligned)
    plot_data = {}
    by_board = {board: _without_law(presses, boards[board], setup, section) for board, presses in all_aligned.items()}
    for i, (board, aligned_presses) in enumerate(aligned.items()):
        laws, parameters = {"fitted": fitted[board]}, {"fitted": asdict(fitted[board])}
        if len(names) > 1:
            law_of = names[(i + 1) % len(names)]
            laws["refitted"] = fit(aligned_presses, setup, SEVEN, fitted[law_of])
            parameters["refitted"] = asdict(laws["refitted"]) | {"law_of": law_of}
        simulated_uT = {
            name: simulate_uT(law, setup, aligned_presses.place_mm, aligned_presses.recorded.force_N)
            for name, law in laws.items()
        }
        simulated_uT["nominal"] = nominal_uT(setup, aligned_presses.place_mm, aligned_presses.recorded.force_N)
        agreements = {
            name: agreement(aligned_presses, fields_uT)
            | {"beyond_n": beyond_n(laws.get(name), setup, aligned_presses.recorded.force_N)}
            for name, fields_uT in simulated_uT.items()
        }
        whole = len(aligned_presses.recorded) == len(boards[board])  # the estimate of memory needs successive presses
        frictions = fit_frictions(aligned_presses, setup, fitted[board])
        curves = {f"{row['grip_N_mm']:g}": row.pop("curve_uT") for row in frictions}
        by_board[board] = (
            agreements.pop("fitted")
            | {"grips": frictions}
            | agreements
            | (estimate_memory(aligned_presses, simulated_uT["fitted"], section, seed) if whole else {})
            | {"laws": parameters}
            | by_board[board]
        )
        plot_data[board] = _plot_data(aligned_presses, simulated_uT["fitted"]) | {"curve_uT": curves}
    numbers = {
        "by_board": by_board,
        "over_boards": summarise_boards(by_board),
        "memory_put_in": section.memory,
        "light_N": LIGHT_N,
        "grip_N_mm": START.grip_N_mm,
    }
    outline = {} if section.layout is None else {"outline": _outline(section)}
    drawn = {"chips_mm": setup.chips_mm.tolist(), "curve_N": CURVE_N.tolist(), "boards": plot_data}
    return numbers, drawn | outline


def _outline(section: Compare) -> dict[str, Any]:
    """Return the skin's smallest x and y, its sides and the chips' centres, in the coordinates of the labels."""
    middle_mm, sides_mm = np.array(section.labels_middle_mm), np.array(section.skin_mm)
    chips_mm = np.array(section.design.places_mm) * (1, -1 if section.labels_mirrored else 1) + middle_mm
    corner_mm = middle_mm - sides_mm / 2
    return {"corner_mm": corner_mm.tolist(), "sides_mm": sides_mm.tolist(), "chips_mm": chips_mm.tolist()}


def _without_law(aligned: AlignedPresses, recorded: RecordedPresses, setup: Setup, section: Compare) -> dict[str, Any]:
    """Return the numbers of a board that need no fitted law, and which therefore exist even if forces are unknown.

    `aligned` contains the presses that are used for fits, and `recorded` contains all presses of the board.
    """
    noise_uT = recorded.noise_uT
    noise = {"noise_uT": dict(zip("xyz", noise_uT.tolist(), strict=True))} if np.isfinite(noise_uT).all() else {}
    counts = {"pokes_n": len(recorded), "left_out_n": recorded.excluded_n}
    counts |= {"fitted_n": len(aligned.recorded)} if len(aligned.recorded) < len(recorded) else {}
    return {"frames": check_frames(aligned, setup, section)} | noise | counts


def summarise_boards(by_board: Mapping[str, Any]) -> dict[str, Any]:
    """Return statistics over boards of the agreement of each simulation with the recordings."""
    summary: dict[str, Any] = {}
    for simulation in ("nominal", "fitted", "refitted"):
        rows = [
            _of_simulation(numbers, simulation) for numbers in by_board.values() if _has_simulation(numbers, simulation)
        ]
        values = {name: [numbers[name] for numbers in rows] for name in ("cosine_mean", "explained_median")}
        grown = [numbers["growth"] for numbers in rows if "growth" in numbers]
        values["growth_difference"] = [growths["simulated"] - growths["recorded"] for growths in grown]
        if rows:
            summary[simulation] = {
                name: statistic(board_values, boards=True) for name, board_values in values.items() if board_values
            }
    return summary


def _has_simulation(board: Mapping[str, Any], simulation: str) -> bool:
    return ("cosine_mean" if simulation == "fitted" else simulation) in board


def _of_simulation(board: Mapping[str, Any], simulation: str) -> Mapping[str, Any]:
    """Return the agreement of a simulation with a board's recordings.

    The agreement of the fitted law is at the top level of a board's numbers. The agreement of any other simulation is
    under the name of the simulation.
    """
    agreement_numbers: Mapping[str, Any] = board if simulation == "fitted" else board[simulation]
    return agreement_numbers


def _plot_data(aligned: AlignedPresses, simulated_uT: Float[np.ndarray, "n k 3"]) -> dict[str, Any]:
    """Return the data for the figures: changes of field at a few places, and |dB| against force.

    Only places of one group of pokes are returned. The middle group in the board's list of groups is used.
    """
    in_group = np.flatnonzero(aligned.recorded.group_i == len(aligned.recorded.groups) // 2)
    order = in_group[np.argsort(np.hypot(*aligned.place_mm[in_group].T), kind="stable")]
    chosen = order[np.unique(np.linspace(0, len(order) - 1, ARROWS_N).round().astype(int))]
    fields = {"recorded": aligned.db_uT, "simulated": simulated_uT}
    return {
        "group": aligned.recorded.groups[len(aligned.recorded.groups) // 2],
        "places_mm": aligned.place_mm[chosen].round(2).tolist(),
        "arrows_uT": {name: changes_uT[chosen].round(1).tolist() for name, changes_uT in fields.items()},
        "force_N": aligned.recorded.force_N.round(3).tolist(),
        "length_uT": {name: magnitudes_uT(changes_uT).round(1).tolist() for name, changes_uT in fields.items()},
    }


# --- Recordings in the board's axes ---


def pool_skins(captures: Sequence[Readings], *, with_force: bool = True) -> dict[str, RecordedPresses]:
    """Pool the captures (recorded files) of each skin.

    The keys of the result are names of boards, or `board/skin` for boards with several skins. For the meaning of
    `with_force`, see `pool`.
    """
    skins: dict[str, list[Readings]] = {}
    for capture in captures:
        skins.setdefault(f"{capture.board}/{capture.skin}", []).append(capture)
    boards = [name.partition("/")[0] for name in skins]
    names = {name: board if boards.count(board) == 1 else name for name, board in zip(skins, boards, strict=True)}
    return {names[name]: pool(captures_of_skin, with_force=with_force) for name, captures_of_skin in skins.items()}


def chip_rotations(section: Compare) -> Float[np.ndarray, "k 3 3"]:
    """Return the rotations from the chips' axes to the board's axes, according to the scene's settings."""
    return Rotation.from_euler("z", np.array(section.design.turns_deg)[:, None], degrees=True).as_matrix()


def make_setup(section: Compare, design: SkinDesign) -> Setup:
    """Return the setup to simulate: the skin as designed, on the board and under the tip that the scene states."""
    if section.layout is not None:
        return section.layout.setup()
    chips_mm, flipped = np.array(section.design.places_mm), section.skin_flipped
    return Setup(design, chips_mm, section.design.gap_mm, section.skin_mm, flipped, section.tip_radius_mm)


def to_board_axes(pokes: RecordedPresses, section: Compare) -> AlignedPresses:
    """Transform the places of pokes from the labels' axes, and fields from the chips' axes, to the board's axes."""
    turn, chips_n = chip_rotations(section), pokes.db_uT.shape[1]
    if len(turn) != chips_n:
        where = f"compare.{'design' if section.layout is None else 'layout'}"
        what = f"{chips_n} chips were recorded, but {where} has {len(turn)}"
        raise ParamsError(f"board {pokes.board}: {what}. Correct the chips in {where} of the scene.")
    place_mm = (pokes.place_mm - section.labels_middle_mm) * (1, -1 if section.labels_mirrored else 1)
    rest_uT = np.einsum("kij,kj->ki", turn, pokes.noload_uT.mean(axis=0))
    return AlignedPresses(pokes, place_mm, np.einsum("kij,nkj->nki", turn, pokes.db_uT), rest_uT)


# --- Agreement, memory, friction ---


def agreement(aligned: AlignedPresses, simulated_uT: Fields) -> dict[str, Any]:
    """Compare simulated with recorded changes of field: their directions, their sizes, and their growth with force."""
    cosine, groups = cosines(simulated_uT, aligned.db_uT), aligned.recorded.groups
    grown = {"recorded": growth(aligned.recorded, aligned.db_uT), "simulated": growth(aligned.recorded, simulated_uT)}
    return {
        "cosine_mean": float(cosine.mean()),
        "cosine_by_group": {name: float(cosine[aligned.recorded.group_i == i].mean()) for i, name in enumerate(groups)},
        "explained_median": float(np.median(explained(simulated_uT, aligned.db_uT))),
    } | ({"growth": grown} if None not in grown.values() else {})


def estimate_memory(aligned: AlignedPresses, simulated_uT: Fields, section: Compare, seed: int) -> dict[str, Any]:
    """Estimate the memory from the recordings and, to test the estimator, from simulated no-load readings.

    Memory is the fraction of a poke's change of field that remains in the next no-load reading. The simulated readings
    have memory `section.memory`. Returns an empty dict if either estimate is impossible.
    """
    pokes = aligned.recorded  # in the chips' axes, because the memory is the same in any axes
    if not np.isfinite(pokes.noise_uT).all():
        return {}
    rng = rng_for(seed, "compare", pokes.board)
    walk_uT = WALK_uT * rng.standard_normal(simulated_uT.shape).cumsum(axis=0)
    noise_uT = pokes.noise_uT / np.sqrt(NOLOAD_READINGS_N) * rng.standard_normal(simulated_uT.shape)
    before_uT = np.roll(simulated_uT, 1, axis=0)  # the first poke of a capture has no predecessor, and is not used
    memories = {
        "recorded": memory(pokes, pokes.db_uT, pokes.noload_uT),
        "simulated": memory(pokes, simulated_uT, walk_uT + noise_uT + section.memory * before_uT),
    }
    return {"memory": memories} if None not in memories.values() else {}


def size_against_force(law: Law, setup: Setup, place_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " c"]:
    """Return the simulated |dB| in uT for each force in `CURVE_N`, as the median over every fifth place."""
    places_mm = np.unique(place_mm.round(2), axis=0)[::PLACE_STRIDE]
    tips_mm, force_N = np.repeat(places_mm, len(CURVE_N), axis=0), np.tile(CURVE_N, len(places_mm))
    length_uT = magnitudes_uT(simulate_uT(law, setup, tips_mm, force_N)).reshape(len(places_mm), -1)
    return np.median(length_uT, axis=0)


def fit_frictions(aligned: AlignedPresses, setup: Setup, fitted: Law) -> list[dict[str, Any]]:
    """Refit the law for each value of the friction under the tip in `GRIPS_N_MM`.

    Returns one row per value, with the agreement of the refitted law with the recordings, and |dB| of a light touch.
    `grip_N` is the force at which the slide in the skin's middle reaches two thirds of its limit.
    """
    rows = []
    for grip_N_mm in GRIPS_N_MM:
        law = replace(fitted, grip_N_mm=grip_N_mm)
        if grip_N_mm != fitted.grip_N_mm:
            law = fit(aligned, setup, TEN, replace(setup.start, grip_N_mm=grip_N_mm))
        agreed = agreement(aligned, simulate_uT(law, setup, aligned.place_mm, aligned.recorded.force_N))
        length_uT = size_against_force(law, setup, aligned.place_mm)
        rows.append(
            {name: agreed[name] for name in ("cosine_mean", "explained_median", "growth") if name in agreed}
            | {"grip_N_mm": grip_N_mm, "grip_N": grip_N_mm * milli * float(np.hypot(law.give_x_um, law.give_y_um))}
            | {"light_uT": float(np.interp(LIGHT_N, CURVE_N, length_uT)), "curve_uT": length_uT.round(2).tolist()}
        )
    return rows


# --- Frames: are labels, chips and skin oriented as the scene states? ---

# For each chip, a cosine tells how well the directions of the recorded and the simulated fields agree. An orientation
# that differs from the scene's is reported only if it raises the sum of the chips' cosines by this much. The value is
# assumed. Wrong axes lower the cosine of a chip by 0.5 or more, which is enough to be reported. A skin that is
# displaced by 0.5 mm changes each cosine by less than 0.1.
PENALTY = 0.1
AXES = "xyz"
AS_SAID = "Labels, chips and skin are oriented as {} states."
# This force replaces unknown forces. Only the directions of fields are compared, which hardly depend on the force.
ASSUMED_N = 1.0


@dataclass(frozen=True)
class Turn:
    """Orientation of a chip's axes or of the labels' axes, relative to the axes that the scene states.

    The stated axes are first multiplied by `signs`, and then rotated by `quarters` quarter turns about z.
    """

    quarters: int
    signs: tuple[int, int, int]

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        return quarter_turn(self.quarters) @ np.diag(self.signs)

    def describe(self, stated_by: str = "the scene") -> str:
        """Describe how this orientation differs from the one that the scene states.

        Returns an empty string if there is no difference.
        """
        mirrored = " and ".join(axis for axis, sign in zip(AXES, self.signs, strict=True) if sign < 0)
        turned = [f"turned by {90 * self.quarters} degrees more than {stated_by} says"] * bool(self.quarters)
        return " and ".join(turned + [f"mirrored along {mirrored}"] * bool(mirrored))


# The 16 different orientations. Some combinations of turns and signs are left out, because they are equal to others:
# mirroring x and rotating by a half turn is the same as mirroring y. The first orientation is the one that the scene
# states. The first eight orientations leave z unchanged; only these are possible for labels.
PLAIN = [(quarters, 1, 1) for quarters in range(4)] + [(0, -1, 1), (0, 1, -1), (1, -1, 1), (1, 1, -1)]
TURNS = [Turn(quarters, (x, y, z)) for z in (1, -1) for quarters, x, y in PLAIN]


def quarter_turn(quarters: int) -> Float[np.ndarray, "3 3"]:
    """Return the matrix that rotates by this number of quarter turns about z."""
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters % 4]
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Frames:
    """The orientations of labels, skin and chips with which recordings and the nominal skin agree best.

    - labels: orientation of the labels' axes.
    - flipped: whether all magnetic poles of the skin are swapped.
    - chips: element i is the number, in the scene's list of chips, of the position where recorded chip i was found.
    - turns: element i is the orientation of recorded chip i.
    - cosines: cosine between recorded and simulated fields of each chip, in the orientations found.
    - as_written: the same cosines in the orientations that the scene states.
    - worth: sum of `cosines`, minus a penalty for each difference from the scene.
    """

    labels: Turn
    flipped: bool
    chips: Int[np.ndarray, " k"]
    turns: tuple[Turn, ...]
    cosines: Float[np.ndarray, " k"]
    as_written: Float[np.ndarray, " k"]
    worth: float

    @property
    def as_stated(self) -> bool:
        """Whether the orientations are those that the scene states."""
        in_place = bool((self.chips == np.arange(len(self.chips))).all())
        return in_place and not self.flipped and {self.labels, *self.turns} == {TURNS[0]}

    def sentence(self, stated_by: str = "the scene") -> str:
        """Describe all differences from the orientations that the scene (or its layout) states."""
        if self.as_stated:
            return AS_SAID.format(stated_by)
        differences = [f"the labels are {self.labels.describe(stated_by)}"] * (self.labels != TURNS[0])
        differences += ["the skin is flipped: every field has the opposite sign"] * self.flipped
        differences += _describe_exchanges(self.chips)
        for turn in dict.fromkeys(self.turns):
            chips = [i for i, chip_turn in enumerate(self.turns) if chip_turn == turn]
            if turn != TURNS[0]:
                differences.append(f"{_name_chips(chips, len(self.turns))} {turn.describe(stated_by)}")
        return f"Contrary to {stated_by}, {'; '.join(differences)}."


def _name_chips(chips: Sequence[int], chips_n: int) -> str:
    if len(chips) == chips_n:
        return "all chips are"
    return f"chip {chips[0]} is" if len(chips) == 1 else f"chips {', '.join(map(str, chips))} are"


def _describe_exchanges(positions: Int[np.ndarray, " k"]) -> list[str]:
    moved = np.flatnonzero(positions != np.arange(len(positions))).tolist()
    if len(moved) == 2:
        return [f"chips {moved[0]} and {moved[1]} are exchanged"]
    places = ", ".join(f"chip {i} is at the position of chip {positions[i]}" for i in moved)
    return [f"chips are exchanged ({places})"] if moved else []


def check_frames(aligned: AlignedPresses, setup: Setup, section: Compare) -> dict[str, Any]:
    """Check whether labels, chips and skin are oriented as the scene states.

    `ASSUMED_N` replaces unknown forces.
    """
    frames = _frames_of(aligned, setup, section)
    columns = zip(frames.chips.tolist(), frames.as_written.tolist(), frames.cosines.tolist(), frames.turns, strict=True)
    chips = [
        {
            "chip": i,
            "at": position,
            "cosine_as_written": written,
            "cosine_best": best,
            "read": turn.describe(section.stated_by),
        }
        for i, (position, written, best, turn) in enumerate(columns)
    ]
    outside = describe_outside(aligned.place_mm, section)
    return {"sentence": outside or frames.sentence(section.stated_by), "chips": chips}


def describe_outside(place_mm: Float[np.ndarray, "n 2"], section: Compare) -> str | None:
    """Describe the presses whose stated places are outside the skin.

    The size and the position of the skin are taken from the settings of the scene. Returns None if all presses are on
    the skin. `place_mm` are places relative to the board's centre. If presses seem to be outside the skin, their places
    are wrong, so the orientations that agree best with them mean nothing.
    """
    outside_n = int((np.abs(place_mm) > np.array(section.skin_mm) / 2).any(axis=1).sum())
    if not outside_n:
        return None
    (x_mm, y_mm), (width_mm, height_mm) = section.labels_middle_mm, section.skin_mm
    ranges = [
        f"{axis} from {low:.3g} to {high:.3g} mm"
        for axis, low, high in zip(AXES, place_mm.min(axis=0), place_mm.max(axis=0), strict=False)
    ]
    key = "labels_middle_mm" if section.layout is None else "centre_mm"
    return (
        f"{outside_n} of {len(place_mm)} presses are outside the skin ({width_mm:g} x {height_mm:g} mm) that "
        f"{section.stated_by} states: relative to {key} [{x_mm:g}, {y_mm:g}], all presses have "
        f"{' and '.join(ranges)}. Correct {key}, the size of the skin or the places of the presses."
    )


def _frames_of(aligned: AlignedPresses, setup: Setup, section: Compare) -> Frames:
    recorded = aligned.recorded
    force_N = recorded.force_N if recorded.forces_known else np.full(len(recorded), ASSUMED_N)
    return find_frames(
        aligned.place_mm, recorded.db_uT, chip_rotations(section),
        lambda places_mm: nominal_uT(setup, places_mm, force_N),
    )  # fmt: skip


def find_frames(
    place_mm: Float[np.ndarray, "n 2"],
    read_uT: Float[np.ndarray, "n k 3"],
    chips_turn: Float[np.ndarray, "k 3 3"],
    nominal: Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, "n k 3"]],
) -> Frames:
    """Find the orientations of labels, skin and chips with which recordings and the nominal skin agree best.

    Parameters
    ----------
    place_mm
        Places of the pokes.
    read_uT
        Recorded changes of field in the chips' axes.
    chips_turn
        Rotations of the chips according to the scene.
    nominal
        Function that simulates pokes of the nominal skin at places in the board's axes.

    If a chip is found at the position of another chip, its rotation is assumed to be the rotation that the scene states
    for this position.
    """
    turns = np.stack([turn.matrix for turn in TURNS])
    as_written, candidate_frames = np.empty(0), []
    for labels in TURNS[:8]:
        simulated_uT = nominal(place_mm @ labels.matrix[:2, :2].T)
        # Entry [k, l, t] of `cosine` is the cosine, over all pokes, between two fields. One is the field of recorded
        # chip k, transformed by orientation t. The other is the field that is simulated at the position of chip l.
        rotated_uT = np.einsum("kij,nki->nkj", chips_turn, simulated_uT)
        moments = np.einsum("nka,nlb->klab", read_uT, rotated_uT)
        sizes = np.linalg.norm(read_uT, axis=(0, 2))[:, None] * np.linalg.norm(simulated_uT, axis=(0, 2))
        cosine = np.einsum("klab,tba->klt", moments, turns) / sizes[..., None]
        if labels == TURNS[0]:
            as_written = np.diagonal(cosine[..., 0]).copy()
        candidates = product((False, True), TURNS)
        candidate_frames += [_best_chips(labels, flipped, common, cosine, as_written) for flipped, common in candidates]
    return max(candidate_frames, key=lambda frames: frames.worth)


def _best_chips(
    labels: Turn, flipped: bool, common: Turn, cosine: Float[np.ndarray, "k l t"], as_written: np.ndarray
) -> Frames:
    """Find the best positions and orientations of the chips for given orientations of labels and skin.

    `common` is a candidate for the orientation that most chips share. Only chips whose orientation differs from
    `common` get a penalty. If `common` itself differs from the scene's orientation, one further penalty is subtracted.
    It is 1.5 times as large as the other penalties, because a flipped skin can look like a common turn of all chips,
    and a flipped skin shall then be preferred.
    """
    signed = -cosine if flipped else cosine
    worth = signed - PENALTY * np.array([turn != common for turn in TURNS])
    pair_worth = worth.max(axis=2) - PENALTY * (1 - np.eye(len(worth)))
    chips, positions = linear_sum_assignment(pair_worth, maximize=True)
    turn_i = worth[chips, positions].argmax(axis=1)
    total = pair_worth[chips, positions].sum() - PENALTY * ((labels != TURNS[0]) + flipped + 1.5 * (common != TURNS[0]))
    turns = tuple(TURNS[i] for i in turn_i)
    return Frames(labels, flipped, positions, turns, signed[chips, positions, turn_i], as_written, float(total))


CHIPS_MIN_N = 4  # orientations are checked only on boards with at least four chips, on all sides of the middle
# With fewer pokes, the check is unreliable. With more pokes, it takes seconds and is no more reliable: in scene lab,
# every third of 65 places is enough.
POKES_MIN_N, POKES_MAX_N = 20, 70


def find_departure(blocks: Sequence[Readings], section: Compare, design: SkinDesign) -> str | None:
    """Describe how a capture contradicts what the scene states about labels, chips and skin.

    If presses are outside the skin, these presses are described. Otherwise, orientations that differ from the scene are
    described. Returns None if there is no difference, or if the data are too few to decide. `blocks` are the readings
    of the capture.
    """
    if not any(_pressed_rows(block).any() for block in blocks):
        return None
    all_pokes = pool(blocks, with_force=False)
    if outside := describe_outside(to_board_axes(all_pokes, section).place_mm, section):
        return outside
    chips_mm = np.array(section.design.places_mm)
    surrounded = len(chips_mm) >= CHIPS_MIN_N and (chips_mm.min(axis=0) < 0).all() and (chips_mm.max(axis=0) > 0).all()
    pokes = _thin(all_pokes, POKES_MAX_N)
    if not surrounded or len(pokes) < POKES_MIN_N or not (np.linalg.norm(pokes.db_uT, axis=(0, 2)) > 0).all():
        return None
    frames = _frames_of(to_board_axes(pokes, section), make_setup(section, design), section)
    return None if frames.as_stated else frames.sentence(section.stated_by)


def _pressed_rows(readings: Readings) -> np.ndarray:
    pressed = (readings.Fz_N > 0) | np.isnan(readings.Fz_N)
    return np.isfinite(readings.x_mm) & np.isfinite(readings.y_mm) & pressed


def _thin(pokes: RecordedPresses, most_n: int) -> RecordedPresses:
    """Select at most `most_n` pokes, evenly distributed over the recording."""
    kept = np.unique(np.linspace(0, len(pokes) - 1, most_n).round().astype(int))
    names = ("group_i", "capture_i", "place_mm", "force_N", "db_uT", "noload_uT")
    return replace(pokes, **{name: getattr(pokes, name)[kept] for name in names})


# --- Tables and figures ---

COSINE_MIN = {"nominal": 0.90, "fitted": 0.90, "refitted": 0.85}
EXPLAINED_MIN, GROWTH_WITHIN, MEMORY_PCT = 0.80, 0.10, (5.0, 8.0)
SIMULATIONS = {
    "nominal": "nominal skin, no fit", "fitted": "law with ten parameters fitted to this board",
    "refitted": "law of another board, seven parameters refitted",
}  # fmt: skip
COSINE, EXPLAINED, GROWTH = "cosine", f"explained (≥ {EXPLAINED_MIN:.2f})", f"growth (within {GROWTH_WITHIN:.2f})"
HELD = "pokes simulated at the largest depth"
MEMORY = "memory, % ({:g} to {:g})".format(*MEMORY_PCT)
NONE = "–"
MEANING = (
    "Compares the recorded field change dB of each poke (mean in contact minus mean before contact) with the field "
    "change that is simulated at the labelled place and the recorded force. Bounds are in brackets. Law: the physical "
    "model of a skin, which gives the field change from place and force. Cosine: between recorded and simulated dB "
    "over all channels, mean over pokes. Cosine by file: the same for each recorded file. Explained: 1 - |simulated - "
    "recorded|² / |recorded|², median over pokes. Growth: the exponent with which |dB| grows with the force F, d "
    "log|dB| / d log F at one place, median over places, simulated / recorded. The bounds are applied to each board "
    "separately. With four or more boards, they are also applied to all boards together, by the 95 % confidence "
    "interval over boards (Student's t). The form of the law, its tip radius, its exponent of stiffening, and the "
    "force at which the skin stops sliding were chosen with data of both boards of scene lab, so only a new board can "
    "test them. The law does not explain why a skin slides towards its middle. Memory, simulated / recorded: the "
    "fraction of a poke's field change that remains in the next no-load reading. The simulated memory is set to {:g} "
    "%, so its estimate tests the estimator and is not a prediction. Pokes simulated at the largest depth: the law is "
    "valid up to an indentation of 0.72 of the skin's thickness. The column contains the number of pokes whose force "
    "would need a deeper indentation; they are simulated at this depth, and count like all other pokes."
)
ABOUT_PARAMETERS = (
    "Seat: position of the middle of the skin relative to the middle of the board. Rotation: angle by which the skin "
    "is turned on the board. Gap: distance between chips and skin. Amplitude: magnetisation relative to the nominal "
    "skin. A larger gap has nearly the same effect as a smaller amplitude, so the fit determines only a combination of "
    "both, and neither is a measurement. Label offset: place of the tip minus labelled place. Slide to the middle: a "
    "press displaces the material under the tip towards the middle of the skin. The parameter is this displacement at "
    "small forces, divided by the distance of the tip from the middle. Give: displacement of the skin that is the same "
    "at all places, because the arm of the rig gives way."
)
ABOUT_GRIP = (
    "The friction under the tip limits how far a tip can slide the skin: k |u| <= mu F, with spring constant k, slide "
    "u, friction coefficient mu and force F. Here, k / mu = {grip_N_mm:g} N/mm is used. The constant k follows from a "
    "recorded sideways force, and mu is assumed (`skin.hold` in nominal.yaml). For each value of k / mu in the table, "
    "all other parameters are fitted again. The recorded forces are larger than half a newton. At such forces, the "
    "skin hardly slides any further, so the recordings do not determine the friction, and the simulated field of a "
    "light touch depends on the assumed friction. Without this limit, the skin would jump at first contact."
)
ABOUT_FRAMES = (
    "Checks whether labels, chips and skin are oriented as the scene states. Column `orientation` describes the "
    "differences from the scene. The cosines are between recorded and simulated dB, over all pokes together; the "
    "simulated dB is that of the nominal skin. There is one cosine for each chip, in the orientations that the scene "
    "states (`as written`) and in the orientations with the best agreement (`best`). A difference from the scene is "
    "reported only if it raises the sum of the cosines over chips by 0.1 or more."
)
TITLES = {
    "seat_x_mm": "seat x, mm", "seat_y_mm": "seat y, mm", "rotation_deg": "rotation, degrees", "gap_mm": "gap, mm",
    "amplitude": "amplitude", "label_x_mm": "label offset x, mm", "label_y_mm": "label offset y, mm",
    "modulus_MPa": "Young's modulus, MPa", "away_um_mm": "slide to the middle, µm/mm", "give_x_um": "give x, µm",
    "give_y_um": "give y, µm",
}  # fmt: skip
ARROW_MM = 6.0  # length of the longest arrow of a board
BOARDS_MAX_N = 4  # largest number of boards in the figure of arrows


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Return tables of the agreement, of the fitted parameters, of the friction, and of the orientations."""
    by_board = numbers["by_board"]
    rows = [
        _board_row(board, name, _of_simulation(numbers_of_board, name), numbers_of_board.get("laws", {}).get(name, {}))
        for board, numbers_of_board in by_board.items()
        for name in SIMULATIONS
        if _has_simulation(numbers_of_board, name)
    ] + [_summary_row(name, stats) for name, stats in numbers["over_boards"].items()]
    laws = [
        {"board": board, "law": _title(name, law)}
        | {title: f"{law[parameter]:.3g}" for parameter, title in TITLES.items()}
        for board, numbers_of_board in by_board.items()
        for name, law in numbers_of_board.get("laws", {}).items()
    ]
    result = (
        {}
        if not laws
        else {
            "compare": tabulate(rows, meaning=MEANING.format(100 * numbers["memory_put_in"])),
            "compare_parameters": tabulate(laws, meaning=ABOUT_PARAMETERS),
            "compare_grip": tabulate(_friction_rows(by_board), meaning=ABOUT_GRIP.format(**numbers)),
        }
    )
    result["compare_frames"] = tabulate([_frames_row(*row) for row in by_board.items()], meaning=ABOUT_FRAMES)
    for table in result.values():
        table["source"] = source
    return result


def _board_row(board: str, name: str, agreed: Mapping[str, Any], law: Mapping[str, Any]) -> dict[str, str]:
    good = [agreed["cosine_mean"] >= COSINE_MIN[name], agreed["explained_median"] >= EXPLAINED_MIN]
    row = _cells(board, _title(name, law), f"{agreed['cosine_mean']:.3f}", f"{agreed['explained_median']:.3f}", name)
    row[HELD] = f"{agreed['beyond_n']}"
    row["cosine by file"] = ", ".join(f"{value:.3f}" for value in agreed["cosine_by_group"].values())
    if "growth" in agreed:
        grown = agreed["growth"]
        row[GROWTH] = f"{grown['simulated']:.2f} / {grown['recorded']:.2f}"
        good.append(abs(grown["simulated"] - grown["recorded"]) <= GROWTH_WITHIN)
    if "memory" in agreed:
        row[MEMORY] = " / ".join(f"{100 * agreed['memory'][side]:.1f}" for side in ("simulated", "recorded"))
    return row | {"within bounds": "yes" if all(good) else "no"}


def _summary_row(name: str, stats: Mapping[str, Any]) -> dict[str, str]:
    verdicts = [
        verdict(stats["cosine_mean"], above=COSINE_MIN[name]), verdict(stats["explained_median"], above=EXPLAINED_MIN)
    ]  # fmt: skip
    cosine, explained = (show_digits(stats[metric], 3) for metric in ("cosine_mean", "explained_median"))
    row = _cells(f"all ({stats['cosine_mean']['n']})", SIMULATIONS[name], cosine, explained, name)
    if "growth_difference" in stats:
        row[GROWTH] = f"difference {show_digits(stats['growth_difference'], 2)}"
        verdicts.append(verdict_within(stats["growth_difference"], GROWTH_WITHIN))
    return row | {"within bounds": combine_verdicts(verdicts)}


def _cells(board: str, law: str, cosine: str, explained: str, name: str) -> dict[str, str]:
    cells = {"board": board, "simulated with": law, COSINE: f"{cosine} (≥ {COSINE_MIN[name]:.2f})"}
    return cells | {"cosine by file": NONE, EXPLAINED: explained, GROWTH: NONE, MEMORY: NONE, HELD: NONE}


def _friction_rows(by_board: Mapping[str, Any]) -> list[dict[str, str]]:
    lines = []
    for board, board_numbers in by_board.items():
        for row in board_numbers.get("grips", []):
            line = {"board": board, "k / mu, N/mm": f"{row['grip_N_mm']:.3g}"}
            line["force at 2/3 of the largest slide, N"] = f"{row['grip_N']:.2g}"
            line |= {"cosine": f"{row['cosine_mean']:.3f}", "explained": f"{row['explained_median']:.3f}"}
            grown = row.get("growth")
            line[GROWTH] = f"{grown['simulated']:.2f} / {grown['recorded']:.2f}" if grown else NONE
            lines.append(line | {"|dB| at 1 mN, µT (median place)": f"{row['light_uT']:.3g}"})
    return lines


def _title(name: str, law: Mapping[str, Any]) -> str:
    title = SIMULATIONS[name]
    return title.replace("another board", str(law["law_of"])) if "law_of" in law else title


def _frames_row(board: str, board_numbers: Mapping[str, Any]) -> dict[str, str]:
    chips, noise_uT = board_numbers["frames"]["chips"], board_numbers.get("noise_uT", {})
    cosine = {
        f"cosine by chip, {title}": ", ".join(f"{chip[key]:.2f}" for chip in chips)
        for title, key in (("as written", "cosine_as_written"), ("best", "cosine_best"))
    }
    noise = {"noise of a reading x, y, z, µT": ", ".join(f"{value:.2g}" for value in noise_uT.values()) or NONE}
    pokes = {"pokes": str(board_numbers["pokes_n"]), "pokes left out": str(board_numbers["left_out_n"])}
    return {"board": board, "orientation": board_numbers["frames"]["sentence"]} | cosine | noise | pokes


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw recorded and simulated changes of field, as arrows at the chips for a few places, and against the force."""
    boards = dict(list(drawn["boards"].items())[:BOARDS_MAX_N])
    if not boards:  # no board has known forces
        return {}
    return {
        "compare_arrows.svg": _draw_arrows(boards, np.array(drawn["chips_mm"]), source),
        "compare_growth.svg": _draw_growth(drawn["boards"], numbers["by_board"], source),
        "compare_touch.svg": _draw_touch(drawn, numbers, source),
    }


def _draw_touch(drawn: Mapping[str, Any], numbers: Mapping[str, Any], source: str) -> str:
    """Plot |dB| of recorded presses, and of presses simulated with several frictions, against forces from 0.3 mN."""
    boards, used = drawn["boards"], f"{numbers['grip_N_mm']:g}"
    with drawing(4.2 * len(boards) + 0.6, 4.2) as figure:
        panels = figure.subplots(1, len(boards), squeeze=False)[0]
        for axes, (board, board_data) in zip(panels, boards.items(), strict=True):
            style = {"color": COLOURS[0], "marker": MARKERS[0], "linestyle": "", "markersize": 3, "alpha": 0.5}
            axes.plot(board_data["force_N"], board_data["length_uT"]["recorded"], label="recorded", **style)
            styles = iter(("-.", ":", "--", (0, (1, 3))))
            for grip, length_uT in board_data["curve_uT"].items():
                line = {"linestyle": "-", "linewidth": 2} if grip == used else {"linestyle": next(styles)}
                friction = "no friction limit" if float(grip) < 1e-3 else f"k / μ {grip} N/mm"
                label = f"simulated, {friction}" + (" (used)" if grip == used else "")
                axes.plot(drawn["curve_N"], length_uT, color=COLOURS[1], label=label, **line)
            axes.set(xscale="log", yscale="log", xlabel="force / N", ylabel="|dB| / µT", title=board)
            axes.set_ylim(bottom=0.1)
            axes.grid(alpha=0.25)
            axes.legend(frameon=False, fontsize=8)
        title = f"Change of field against force, down to the lightest touch ({source}; simulated: median over places)"
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        return svg(figure)


def _draw_arrows(boards: Mapping[str, Any], chips_mm: np.ndarray, source: str) -> str:
    columns_n = max(len(board_data["places_mm"]) for board_data in boards.values())
    half_mm = np.abs(chips_mm).max() + 0.6 * ARROW_MM
    with drawing(2.0 * columns_n, 4.2 * len(boards) + 0.6) as figure:
        panels = figure.subplots(2 * len(boards), columns_n, squeeze=False)
        for row_i, (board, board_data) in enumerate(boards.items()):
            recorded_uT = np.array(board_data["arrows_uT"]["recorded"])
            longest_uT = np.linalg.norm(recorded_uT[..., :2], axis=-1).max()
            for side_i, (side, colour) in enumerate(zip(("recorded", "simulated"), COLOURS, strict=False)):
                row = panels[2 * row_i + side_i]
                row[0].set_ylabel(f"{board}\n{side}")
                for axes, db_uT, place_mm in zip(
                    row, board_data["arrows_uT"][side], board_data["places_mm"], strict=False
                ):
                    sides_mm = np.array(db_uT)[:, :2] * ARROW_MM / longest_uT
                    style = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.014}
                    axes.quiver(*chips_mm.T, *sides_mm.T, color=colour, **style)
                    axes.plot(*place_mm, marker="x", color="black")
                    for (x_mm, y_mm), (_, y_uT, z_uT) in zip(chips_mm, db_uT, strict=True):
                        # The text is on that side of the chip to which the arrow does not point.
                        side_mm, va = (1.2, "bottom") if y_uT < 0 else (-1.2, "top")
                        axes.text(x_mm, y_mm + side_mm, f"{z_uT:+z.0f}", fontsize=6, ha="center", va=va)
            panels[2 * row_i][0].set_title(f"longest arrow {longest_uT:.0f} µT", fontsize=8, loc="left")
        for axes in panels.ravel():
            axes.set(xlim=(-half_mm, half_mm), ylim=(-half_mm, half_mm), aspect="equal", xticks=[], yticks=[])
        title = f"Change of field at the chips ({source}; ×: poke; number: along z, µT)"
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        return svg(figure)


def _draw_growth(boards: Mapping[str, Any], by_board: Mapping[str, Any], source: str) -> str:
    with drawing(3.6 * len(boards) + 0.6, 3.6) as figure:
        panels = figure.subplots(1, len(boards), squeeze=False)[0]
        for axes, (board, board_data) in zip(panels, boards.items(), strict=True):
            for side, colour, marker in zip(("recorded", "simulated"), COLOURS, MARKERS, strict=False):
                slope = by_board[board].get("growth", {}).get(side)
                label = side if slope is None else f"{side}: power {slope:.2f}"
                style = {"color": colour, "marker": marker, "linestyle": "", "markersize": 3, "alpha": 0.6}
                axes.plot(board_data["force_N"], board_data["length_uT"][side], label=label, **style)
            axes.set(xscale="log", yscale="log", xlabel="force / N", ylabel="|dB| / µT", title=board)
            axes.legend(frameon=False, fontsize=8)
        figure.suptitle(f"Change of field against force ({source})", x=0.01, ha="left", fontsize=11)
        return svg(figure)
