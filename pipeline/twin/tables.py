"""What pokes all over a skin would read: a law's centre and spreads -> fields, and how each number moves them.

Linear in the numbers about their centre. Refuses to know readings and what is learnt from them (`skin_map`).
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float

from pipeline.twin.law import Law, Setup, at_rest_uT, simulate_uT, with_numbers

PITCH_MM, STEPS_N = 0.8, 22  # of the lattice of places, along x and y
FORCES_N = np.exp(np.linspace(np.log(0.05), np.log(9.5), 9))  # from a light touch to the hardest recorded press
OF_LOG = ("amplitude", "modulus_MPa")  # their spreads are of the logarithm
# Spreads of a skin's numbers about those of boards of the same rig, and about the nominal ones where no board is known.
# Assumed, wider than two recorded boards differ.
OF_RIG = {
    "seat_x_mm": 0.4, "seat_y_mm": 0.4, "rotation_deg": 1.0, "gap_mm": 0.25, "amplitude": 0.2, "label_x_mm": 0.25,
    "label_y_mm": 0.25, "modulus_MPa": 0.2, "away_um_mm": 2.0, "give_x_um": 15.0, "give_y_um": 15.0,
    "lets_go_N": 2.4, "tilt_x_deg": 0.7, "tilt_y_deg": 0.7, "label_rotation_deg": 0.5,
}  # fmt: skip
OF_NOMINAL = OF_RIG | {
    "gap_mm": 0.45, "amplitude": 0.3, "label_x_mm": 0.5, "label_y_mm": 0.5, "modulus_MPa": 0.25, "away_um_mm": 2.5,
    "give_x_um": 40.0, "give_y_um": 40.0,
}  # fmt: skip
# Nothing of a recorded board but the form of the law and the middle of its slide; modulus: Dragon Skin 10 with filler,
# 150 to 230 kPa.
NOMINAL = Law(0.0, 0.0, 0.0, 1.6, 1.4, 0.0, 0.0, 0.19, 7.0, 0.0, 0.0)
STEP = 0.4  # of a spread: over which slopes are taken


@dataclass(frozen=True)
class Tables:
    """Fields of pokes at places (board's frame) under forces: at the centre, and per spread of each number."""

    names: tuple[str, ...]
    spreads: Float[np.ndarray, " t"]
    axis_mm: Float[np.ndarray, " a"]  # of the lattice, along x and along y alike
    force_N: Float[np.ndarray, " q"]
    mean_uT: Float[np.ndarray, "a a q ch"]
    slope_uT: Float[np.ndarray, "a a q ch t"]
    rest_uT: Float[np.ndarray, " ch"]
    rest_slope_uT: Float[np.ndarray, "ch t"]


def lattice_mm() -> Float[np.ndarray, " a"]:
    """Give the places of the lattice along one axis, from the board's middle."""
    return PITCH_MM * (np.arange(STEPS_N) - (STEPS_N - 1) / 2)


def tabulate(
    centre: Law, spreads: Mapping[str, float], setup: Setup, forces_N: Float[np.ndarray, " q"] = FORCES_N
) -> Tables:
    """Simulate every place and force at the centre, and with each number moved: some 50,000 pokes, half a minute."""
    axis_mm = lattice_mm()
    places_mm = np.stack(np.meshgrid(axis_mm, axis_mm, indexing="ij"), axis=-1).reshape(-1, 2)
    place_mm = np.repeat(places_mm, len(forces_N), axis=0)
    force_N = np.tile(forces_N, len(places_mm))

    def fields_uT(law: Law) -> tuple[np.ndarray, np.ndarray]:
        read_uT = simulate_uT(law, setup, place_mm, force_N)
        return read_uT.reshape(len(axis_mm), len(axis_mm), len(forces_N), -1), at_rest_uT(law, setup).ravel()

    mean_uT, rest_uT = fields_uT(centre)
    moved = [fields_uT(spread_by(centre, name, STEP * spread)) for name, spread in spreads.items()]
    return Tables(
        names=tuple(spreads), spreads=np.array(list(spreads.values())), axis_mm=axis_mm, force_N=forces_N,
        mean_uT=mean_uT, slope_uT=np.stack([(each_uT - mean_uT) / STEP for each_uT, _ in moved], axis=-1),
        rest_uT=rest_uT, rest_slope_uT=np.stack([(each_uT - rest_uT) / STEP for _, each_uT in moved], axis=-1),
    )  # fmt: skip


def middle(laws: list[Law]) -> Law:
    """Give the centre for a further board of a rig: means of the fitted laws, its seat and turns as designed."""
    numbers = {name: np.array([asdict(law)[name] for law in laws]) for name in asdict(laws[0])}
    means = {
        name: float(np.exp(np.log(values).mean()) if name in OF_LOG else values.mean())
        for name, values in numbers.items()
    }
    return Law(**(means | {"seat_x_mm": 0.0, "seat_y_mm": 0.0, "rotation_deg": 0.0}))


def spread_by(centre: Law, name: str, by: float) -> Law:
    """Move one number of a law, in its unit or in the logarithm of it, as its spread is."""
    value = asdict(centre)[name]
    return with_numbers(centre, (name,), np.array([value * np.exp(by) if name in OF_LOG else value + by]))
