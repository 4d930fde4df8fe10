"""How a recorded board is oriented, and the conversion of its labels and readings to the axes of the board.

Places of recorded presses are in the coordinates of the labels, and fields are along the axes of each chip. The
universal model and simulations use the board's axes, with the origin at the board's middle.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.constants import kilo, mega
from scipy.spatial.transform import Rotation

from pipeline.fitting.law_fit import AlignedPresses
from pipeline.fitting.presses import RecordedPresses
from reskin.errors import ParamsError
from reskin.schema import AXES_PER_CHIP_N
from reskin.universal.law import Law, Setup


@dataclass(frozen=True)
class BoardAxes:
    """Orientation of the chips, the labels and the skin of a recorded board, as somebody has stated it.

    Parameters
    ----------
    setup : positions of the chips, nominal skin and tip
    start : law at which fits start, and mean of the priors of their parameters
    turns_deg : rotation of each chip about z, relative to the board
    labels_middle_mm : label (x, y) of the board's middle
    labels_mirrored : whether y of the labels points opposite to y of the board
    stated_by : name of the layout that states this orientation, for messages
    """

    setup: Setup
    start: Law
    turns_deg: tuple[float, ...]
    labels_middle_mm: tuple[float, float]
    labels_mirrored: bool
    stated_by: str

    @property
    def nominal(self) -> Law:
        """The law of the nominal skin, which does not slide and is as stiff as in simulated scenes (nominal.yaml)."""
        design = self.setup.design
        modulus_MPa = design.modulus_kPa * kilo / mega
        return replace(self.start, modulus_MPa=modulus_MPa, stiffening=design.stiffening, away_um_mm=0.0)

    @cached_property
    def rotations(self) -> Float[np.ndarray, "k 3 3"]:
        """For each chip, the rotation from the chip's axes to the board's axes."""
        return Rotation.from_euler("z", np.array(self.turns_deg)[:, None], degrees=True).as_matrix()

    def place(self, label_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Convert label coordinates to places on the board, relative to its middle."""
        return (label_mm - self.labels_middle_mm) * self._signs

    def label(self, place_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Convert places on the board to label coordinates."""
        return place_mm * self._signs + self.labels_middle_mm

    def field(self, b_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, "f ch"]:
        """Rotate readings, or changes of readings, from the chips' axes to the board's axes."""
        of_chips = b_uT.astype(float).reshape(len(b_uT), len(self.turns_deg), AXES_PER_CHIP_N)
        return np.einsum("kij,nkj->nki", self.rotations, of_chips).reshape(b_uT.shape)

    def align(self, presses: RecordedPresses) -> AlignedPresses:
        """Convert recorded presses to the board's axes.

        Raises
        ------
        ParamsError : the recorded board has another number of chips
        """
        chips_n, stated_n = presses.db_uT.shape[1], len(self.turns_deg)
        if chips_n != stated_n:
            what = f"{chips_n} chips were recorded, but compare.layout has {stated_n}"
            remedy = "Correct the chips in compare.layout of the scene."
            raise ParamsError(f"board {presses.board}: {what}. {remedy}")
        rest_uT = np.einsum("kij,kj->ki", self.rotations, presses.noload_uT.mean(axis=0))
        db_uT = np.einsum("kij,nkj->nki", self.rotations, presses.db_uT)
        return AlignedPresses(presses, self.place(presses.place_mm), db_uT, rest_uT)

    @property
    def _signs(self) -> tuple[int, int]:
        return 1, -1 if self.labels_mirrored else 1
