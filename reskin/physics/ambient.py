"""Ambient fields: the earth's field, the field that an iron ball adds, and how they change the readings of a board.

Fields are in tesla and readings in microtesla.

In a uniform field, an iron ball adds the field of a single dipole at the centre of the ball. In the field of nearby
dipoles, such as the dipoles of a skin, the ball adds the field of an image dipole and of image poles for each of the
dipoles. In reality, the field of the ball also changes the magnetisation of the skin. This effect is neglected.

A reference chip, which is beside the skin, measures an ambient field so that it can be subtracted from the readings.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.constants import micro, mu_0
from scipy.spatial.transform import Rotation

from reskin.physics import magnet
from reskin.physics.board import Board, BoardDesign, Spreads, draw_board
from reskin.physics.chip import ChipDesign
from reskin.physics.magnet import MU0_4PI, Dipoles

# The earth's field at a middle latitude, with x towards the north and z upwards. On the surface of the earth, the
# magnitude of the field is between 25 and 65 uT (IGRF).
EARTH_SIZE_T = 50 * micro
EARTH_DIP_DEG = 66.0
EARTH_T = EARTH_SIZE_T * np.array([np.cos(np.radians(EARTH_DIP_DEG)), 0.0, -np.sin(np.radians(EARTH_DIP_DEG))])
# Relative permeability of soft iron. Its exact value hardly matters: the moment of a ball with this permeability is
# only 0.3 % smaller than the moment of a ball with infinite permeability.
IRON_MU_R = 1000.0
# Distance of the reference chip from the board's middle, along x. It is assumed that a press does not change the field
# there.
REFERENCE_ASIDE_MM = 30.0


def random_directions(n: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Draw n unit vectors whose directions are uniformly distributed."""
    vectors = rng.standard_normal((n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def ball_field(
    observers_m: Float[np.ndarray, "o 3"],
    b_T: Float[np.ndarray, "3"],
    *,
    centre_m: Float[np.ndarray, "3"],
    radius_m: float,
    mu_r: float = IRON_MU_R,
) -> Float[np.ndarray, "o 3"]:
    """Return the field in T that an iron ball adds to the uniform field `b_T`.

    It is the field of a dipole at the centre of the ball. For a ball of radius a in the field B, the moment of the
    dipole is (4 pi a^3 / mu0) (mu_r - 1) / (mu_r + 2) B. The observers must be outside the ball.
    """
    moment_A_m2 = 4 * np.pi * radius_m**3 / mu_0 * (mu_r - 1) / (mu_r + 2) * b_T
    return magnet.field(centre_m[None], moment_A_m2[None], observers_m)


def ball_images(
    observers_m: Float[np.ndarray, "o 3"],
    dipoles: Dipoles,
    *,
    centre_m: Float[np.ndarray, "3"],
    radius_m: float,
) -> Float[np.ndarray, "o 3"]:
    """Return the field in T that a ball of infinite permeability adds to the field of dipoles outside the ball.

    The inverse point of a dipole is on the line from the ball's centre to the dipole, at the distance a^2 / d from the
    centre, where a is the radius of the ball and d is the distance of the dipole. For each dipole, the ball adds the
    field of an image dipole and of a magnetic pole at the inverse point, and of an opposite pole at the ball's centre.
    This is the solution for an uncharged conducting sphere in electrostatics (Jackson, chapter 2). The simpler model of
    `ball_field`, a single dipole at the ball's centre, would give a much too small field if the ball is close to a
    skin.
    """
    away_m = dipoles[0] - centre_m
    distance_m = np.linalg.norm(away_m, axis=1, keepdims=True)
    outward, ratio = away_m / distance_m, radius_m / distance_m
    radial_A_m2 = (dipoles[1] * outward).sum(axis=1, keepdims=True)
    places_m = centre_m + radius_m * ratio * outward
    image_T = magnet.field(places_m, ratio**3 * (2 * radial_A_m2 * outward - dipoles[1]), observers_m)
    poles_A_m = (ratio * radial_A_m2 / distance_m)[:, 0]
    return (
        image_T
        + _poles_field(places_m, poles_A_m, observers_m)
        - _poles_field(centre_m[None], poles_A_m.sum(keepdims=True), observers_m)
    )


def _poles_field(
    places_m: Float[np.ndarray, "s 3"], poles_A_m: Float[np.ndarray, " s"], observers_m: Float[np.ndarray, "o 3"]
) -> Float[np.ndarray, "o 3"]:
    separation_m = observers_m[:, None] - places_m
    over_r3 = poles_A_m / np.linalg.norm(separation_m, axis=2) ** 3
    return MU0_4PI * (over_r3[:, :, None] * separation_m).sum(axis=1)


# --- Readings in ambient fields ---


@dataclass(frozen=True)
class Instrument:
    """A board and a reference chip, both with their manufacturing errors.

    - board, aside: the board, and a board that consists of the reference chip.
    - turn: the rotations of the board's chips as designed. The reference is subtracted with these rotations, because
      the manufacturing errors of a real board are unknown.
    - noise_uT: standard deviation, per axis, of the noise of one reading.
    """

    board: Board
    aside: Board
    turn: Float[np.ndarray, "k 3 3"]
    noise_uT: Float[np.ndarray, "3"]


def draw_instrument(design: BoardDesign, spreads: Spreads, chip: ChipDesign, *, seed: int, name: str) -> Instrument:
    """Draw the board `name` (as `draw_board` draws it), and a reference chip with the same kind of errors."""
    lone = BoardDesign(chips_xy_mm=((REFERENCE_ASIDE_MM, 0.0),), chips_turn_deg=(0.0,), gap_mm=design.gap_mm)
    return Instrument(
        board=draw_board(design, spreads, seed=seed, name=name),
        aside=draw_board(lone, spreads, seed=seed, name=f"{name}-aside"),
        turn=Rotation.from_euler("z", np.array(design.chips_turn_deg)[:, None], degrees=True).as_matrix(),
        noise_uT=np.array([chip.noise_xy_uT, chip.noise_xy_uT, chip.noise_z_uT]),
    )


def readings_uT(board: Board, b_T: Float[np.ndarray, "f k 3"]) -> Float[np.ndarray, "f ch"]:
    """Return how a board's readings change, without noise, if the fields `b_T` are added at its chips."""
    to_chip = board.sensitivity @ board.turn.transpose(0, 2, 1)
    return np.einsum("kij,fkj->fki", to_chip, b_T).reshape(len(b_T), -1) / micro


def reference_uT(
    instrument: Instrument, aside_T: Float[np.ndarray, "f 3"], rng: np.random.Generator
) -> Float[np.ndarray, "f ch"]:
    """Estimate how an ambient field changes the board's readings, from a noisy reading of the reference chip.

    The field is assumed to be the same at all chips, so the reading is only rotated into the axes of each chip.
    `aside_T` is the true field at the reference chip.
    """
    read_uT = readings_uT(instrument.aside, aside_T[:, None])
    read_uT += instrument.noise_uT * rng.standard_normal((len(aside_T), 3))
    return np.einsum("kji,fj->fki", instrument.turn, read_uT).reshape(len(read_uT), -1)
