"""What fields from outside add to a board's readings. In: synthesis, names, fields. Out: uT to add, uT to subtract.

The field comes up between the no-load reading and the contact, so that it stays in the change of field. What the poke
changes at a ball of iron, and the ball in turn at the chips, is left out. Refuses to know networks and rows.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Float32, Int64
from scipy.constants import micro, milli
from scipy.spatial.transform import Rotation

from pipeline.report.statistics import summarise, with_seeds
from reskin.physics.ambient import EARTH_T, ball_field, ball_images, directions
from reskin.physics.board import Board, BoardDesign, draw_board
from reskin.physics.skin import Skin
from reskin.simulation.settings import Synthesis

REFERENCE_ASIDE_MM = 30.0  # the lone chip, from the board's middle along x: assumed far enough to read no poke


@dataclass(frozen=True)
class Instrument:
    """A board as it really is, a chip aside on a board of its own, and what is known of both: the design's turns."""

    board: Board
    aside: Board
    turn: Float[np.ndarray, "k 3 3"]
    noise_uT: Float[np.ndarray, " 3"]  # of the change that the chip aside reads


def take_board(of: Synthesis, name: str, *, seed: int) -> Instrument:
    """Draw the board of this name as its captures did, and a chip beside it that differs from its design as much."""
    design, rig, chip = of.main_boards.design, of.rig, of.chip
    lone = BoardDesign(chips_xy_mm=((REFERENCE_ASIDE_MM, 0.0),), chips_turn_deg=(0.0,), gap_mm=design.gap_mm)
    # Both readings that make a change of field are means.
    noise = np.array([chip.noise_xy_uT, chip.noise_xy_uT, chip.noise_z_uT])
    return Instrument(
        board=draw_board(design, of.spreads, seed=seed, name=name),
        aside=draw_board(lone, of.spreads, seed=seed, name=f"{name}-aside"),
        turn=Rotation.from_euler("z", np.array(design.chips_turn_deg)[:, None], degrees=True).as_matrix(),
        noise_uT=noise * np.sqrt(1 / rig.readings_n + 1 / rig.noload_frames_n),
    )


def seen_uT(board: Board, b_T: Float[np.ndarray, "f k 3"]) -> Float[np.ndarray, "f ch"]:
    """Give by how much the board's readings change when a field comes up, noise aside."""
    to_chip = board.sensitivity @ board.turn.transpose(0, 2, 1)
    return np.einsum("kij,fkj->fki", to_chip, b_T).reshape(len(b_T), -1) / micro


def guessed_uT(
    own: Instrument, aside_T: Float[np.ndarray, "f 3"], rng: np.random.Generator
) -> Float[np.ndarray, "f ch"]:
    """Give what the chip aside makes one subtract: its noisy reading, turned as the design turns each chip."""
    read_uT = seen_uT(own.aside, aside_T[:, None]) + own.noise_uT * rng.standard_normal((len(aside_T), 3))
    return np.einsum("kji,fj->fki", own.turn, read_uT).reshape(len(read_uT), -1)


def without_common_part(turn: Float[np.ndarray, "k 3 3"]) -> Float[np.ndarray, "ch ch"]:
    """Give the matrix that takes the uniform field of least squares off a reading, by the design's turns."""
    seen = turn.transpose(0, 2, 1).reshape(-1, 3)  # what the chips read of a uniform field
    return np.eye(len(seen)) - seen @ np.linalg.pinv(seen)


def iron_fields(
    own: Instrument, skin: Skin, *, radius_mm: float, distance_mm: float
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "1 3"]]:
    """Give what a ball right above the skin's middle adds at the chips, and at the chip aside, in tesla.

    The earth and the skin at rest magnetise it; `distance_mm` is from the skin's top to the ball's surface.
    """
    above_m = skin.thickness_m + (distance_mm + radius_mm) * milli
    centre_m = np.append(skin.seat_m, above_m)
    chips_m = np.concatenate([own.board.chips_m, own.aside.chips_m])
    added_T = ball_field(chips_m, EARTH_T, centre_m=centre_m, radius_m=radius_mm * milli)
    added_T += ball_images(chips_m, (skin.nodes_m, skin.moments_A_m2), centre_m=centre_m, radius_m=radius_mm * milli)
    return added_T[:-1], added_T[-1:]


@dataclass(frozen=True)
class Case:
    """One field from outside: its place on an axis, what it adds to each row, what the chip aside makes of it."""

    words: Mapping[str, float]
    added_uT: Float[np.ndarray, "f ch"]
    guessed_uT: Float[np.ndarray, "f ch"]


def uniform_cases(
    own: Instrument, fields_uT: Sequence[float], *, rows_n: int, rng: np.random.Generator
) -> Iterator[Case]:
    """Let no field and uniform ones come up, each row's in a random direction of its own, whatever the strength."""
    along = directions(rows_n, rng)
    for field_uT in sorted({0.0, *fields_uT}):
        b_T = field_uT * micro * along
        added_uT = seen_uT(own.board, np.repeat(b_T[:, None], len(own.turn), axis=1))
        yield Case({"field_uT": field_uT}, added_uT, guessed_uT(own, b_T, rng))


def iron_cases(
    own: Instrument, skins: Sequence[Skin], which: Int64[np.ndarray, " f"], *, radius_mm: float,
    distances_mm: Sequence[float], rng: np.random.Generator,
) -> Iterator[Case]:  # fmt: skip
    """Put the ball at every distance over the skin of each row, which `which` names."""
    for distance_mm in sorted(distances_mm):
        both = [iron_fields(own, skin, radius_mm=radius_mm, distance_mm=distance_mm) for skin in skins]
        chips_T, aside_T = np.stack([one for one, _ in both]), np.concatenate([other for _, other in both])
        words = {"distance_mm": distance_mm, "rms_uT": rms_uT(chips_T), "aside_rms_uT": rms_uT(aside_T)}
        yield Case(words, seen_uT(own.board, chips_T)[which], guessed_uT(own, aside_T[which], rng))


def one_a_poke(
    indentation: Int64[np.ndarray, " f"], own: Int64[np.ndarray, " a"], rng: np.random.Generator
) -> Int64[np.ndarray, " b"]:
    """Keep one row of every indentation, drawn."""
    drawn = rng.permutation(own)
    return np.sort(drawn[np.unique(indentation[drawn], return_index=True)[1]])


def by_step(points: Sequence[dict[str, Any]], case: str, boards: Sequence[str]) -> list[dict[str, Any]]:
    """Summarise scores over boards: a row a step of the `case`, in it each arm (of the boards that it was tried on).

    Each point is one network's; `sd_seeds` is the standard deviation over the networks of one board, mean over boards.
    """
    of_case = [point for point in points if case in point and point["board"] in boards]
    rows = []
    for step in sorted({point[case] for point in of_case}):
        here = [point for point in of_case if point[case] == step]
        row: dict[str, Any] = {case: step}
        for size, name in (("rms_uT", "field_uT"), ("aside_rms_uT", "aside_field_uT")):
            if size in here[0]:
                row[name] = float(np.sqrt(np.mean([point[size] ** 2 for point in here])))
        for arm in dict.fromkeys(point["arm"] for point in here):
            own = pd.DataFrame([{"board": point["board"], **point["scores"]} for point in here if point["arm"] == arm])
            row[arm] = with_seeds(summarise(own.groupby("board").mean(), boards=True), own, "board")
        rows.append(row)
    return rows


def rms_uT(b_T: Float[np.ndarray, "*f 3"]) -> float:
    """Give the root of the mean square of fields' sizes."""
    return float(np.sqrt((b_T**2).sum(axis=-1).mean())) / micro


def project(db_uT: Float32[np.ndarray, "f ch"], matrix: Float[np.ndarray, "ch ch"]) -> Float32[np.ndarray, "f ch"]:
    """Apply a matrix to every change of field."""
    return (db_uT @ matrix.T).astype(np.float32)
