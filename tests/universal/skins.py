"""Simulated skins of the population on which the shipped model was trained, for tests of this model."""

from functools import cache
from typing import NamedTuple

import numpy as np

from reskin.seeds import rng_for
from reskin.universal import population
from reskin.universal.episodes import NOISE_uT
from reskin.universal.layout import paper_layout
from reskin.universal.population import draw_population

LAYOUT = paper_layout()


class Skin(NamedTuple):
    """A skin along the axes of the chips: no-load field, readings of 130 presses, places as labels, and forces."""

    rest_uT: np.ndarray
    b_uT: np.ndarray
    place_mm: np.ndarray
    force_N: np.ndarray


@cache
def draw(skins_n: int, seed: int = 0) -> list[Skin]:
    """Draw skins that follow the law exactly, of the usual thickness and pressed with the usual tip."""
    sizes = population.THICKNESSES, population.TIPS
    population.THICKNESSES, population.TIPS = {1.0: 1.0}, {1.0: 1.0}  # each combination takes seconds to tabulate
    try:
        rng = rng_for(seed, "skins of tests")
        drawn = draw_population(LAYOUT.law, LAYOUT.all_spreads, LAYOUT.setup(), skins_n, rng, LAYOUT.forces)
    finally:
        population.THICKNESSES, population.TIPS = sizes
    db_uT = drawn.db_uT[:, 0] + np.tile(NOISE_uT, 5) * rng.standard_normal(drawn.db_uT[:, 0].shape)
    skins = []
    for i in range(skins_n):
        rest_uT = LAYOUT.to_chips(drawn.rest_uT[i : i + 1].astype(float))
        b_uT = rest_uT + LAYOUT.to_chips(db_uT[i])
        skins.append(Skin(rest_uT[0], b_uT, drawn.place_mm[i] + 8.0, drawn.force_N[i].astype(float)))
    return skins
