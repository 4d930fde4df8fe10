"""A synthetic skin for tests.

Its fields are given by a simple formula, so that no simulation is needed. Its design is that of the real skin.
"""

from pathlib import Path

import numpy as np

from reskin.universal.layout import paper_layout
from reskin.universal.map import Tables, lattice_mm
from reskin.universal.population import PRESSES_N, Population, draw_places

ROOT = Path(__file__).resolve().parents[2]
CHIPS_MM = np.array([[0.0, 0.0], [-7.0, 0.0], [0.0, -7.0], [7.0, 0.0], [0.0, 7.0]])
SETUP = paper_layout().setup()
WIDE_MM = 5.0
# The tables give the fields at these forces. Few forces are enough, because the formula is smooth in the force.
FORCES_N = np.geomspace(0.55, 9.5, 6)
NAMES, SPREADS = ("label_x_mm", "label_y_mm", "gap_mm"), np.array([0.25, 0.25, 0.3])
REST_SLOPE_uT = np.sin(np.arange(45.0)).reshape(15, 3) * 300


def fields_uT(place_mm: np.ndarray, force_N: np.ndarray, upright: float = 1.0) -> np.ndarray:
    """Return fields in 15 channels, which are largest near each chip.

    The x and y components point away from the chip. The z component is multiplied by `upright`.
    """
    offset = (place_mm[:, None] - CHIPS_MM) / WIDE_MM
    size = 400 * force_N[:, None] ** 0.7 * np.exp(-(offset**2).sum(axis=2) / 2)
    return np.stack([size * offset[..., 0], size * offset[..., 1], size * upright], axis=2).reshape(len(place_mm), -1)


def poked_uT(place_mm: np.ndarray, force_N: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Return the fields of presses on a skin whose three parameters differ from the prior mean.

    `number` is this difference for each parameter, in standard deviations of the prior.
    """
    label_x_mm, label_y_mm, gap_mm = number * SPREADS
    return fields_uT(place_mm + [label_x_mm, label_y_mm], force_N, 1 + gap_mm)


def make_tables() -> Tables:
    """Return the tables of the synthetic skin. Slopes are finite differences of 0.001 standard deviations."""
    axis_mm = lattice_mm()
    place_mm = np.stack(np.meshgrid(axis_mm, axis_mm, indexing="ij"), axis=-1).reshape(-1, 2)
    place_mm, force_N = np.repeat(place_mm, len(FORCES_N), axis=0), np.tile(FORCES_N, len(place_mm))
    mean_uT = poked_uT(place_mm, force_N, np.zeros(3))
    slope_uT = np.stack([(poked_uT(place_mm, force_N, 1e-3 * one) - mean_uT) / 1e-3 for one in np.eye(3)], axis=-1)
    shape = (len(axis_mm), len(axis_mm), len(FORCES_N), 15)
    return Tables(
        NAMES, SPREADS, axis_mm, FORCES_N, mean_uT.reshape(shape), slope_uT.reshape(*shape, 3),
        rest_uT=np.zeros(15), rest_slope_uT=REST_SLOPE_uT,
    )  # fmt: skip


def make_population(skins_n: int, rng: np.random.Generator, weight_N: float | None = None) -> Population:
    """Draw synthetic skins with random parameters.

    If `weight_N` is given, each skin gets one more press: at the place (0, 0), with this force.
    """
    place_mm = np.stack([draw_places(rng) for _ in range(skins_n)])
    force_N = np.exp(rng.uniform(np.log(0.5), np.log(10), (skins_n, PRESSES_N)))
    number = rng.standard_normal((skins_n, 3))
    if weight_N is not None:
        place_mm = np.concatenate([place_mm, np.zeros((skins_n, 1, 2))], axis=1)
        force_N = np.column_stack([force_N, np.full(skins_n, weight_N)])
    db_uT = np.stack([poked_uT(*poke) for poke in zip(place_mm, force_N, number, strict=True)])
    parts = db_uT, number @ REST_SLOPE_uT.T, place_mm, force_N
    return Population(*(part.astype(np.float32) for part in parts))
