"""Place error after labelling presses at places chosen by the map's uncertainty, at fixed places, or at random.

Run `RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_next_place_benchmark.py`, which takes one minute. The skins
are simulated, with parameters around those of the nominal skin. As in training, their fields differ from those of the
simulated law by random errors. The shipped model was not trained on these skins. On each skin, 65 presses on the grid
are candidates for labels, and another 65 are test presses.
"""

from collections.abc import Callable

import numpy as np

from reskin.config import parse
from reskin.data.grid import CENTRE_MM, SKIN_MM
from reskin.live.session import GuidedPresses
from reskin.physics.skin import SkinDesign
from reskin.seeds import rng_for
from reskin.simulation.defaults import nominal
from reskin.universal.batches import ERROR_OF_NOMINAL, NOISE_uT, add_error
from reskin.universal.law import CHIPS_MM, Setup, to_board
from reskin.universal.map import NOMINAL, NOMINAL_SPREADS, expected_gain
from reskin.universal.model import Universal, load_universal
from reskin.universal.population import PLACES_N, draw_population
from tests.benchmarks import size

SKINS_N, LABELS_N, PRESS_N = size(40, 2), size((0, 1, 3, 5, 10), (0, 1)), 2.0
Choose = Callable[[Universal, list[int]], int]


def test_place_errors_by_strategy_of_choosing_labelled_places():
    rng, errors = rng_for(0, "next place"), {}
    design = parse(SkinDesign, nominal("skin"), "params.yaml: skin")
    setup = Setup(design, np.array(CHIPS_MM), NOMINAL.gap_mm, SKIN_MM, design.flipped, design.tip_radius_mm)
    skins = draw_population(NOMINAL, NOMINAL_SPREADS, setup, SKINS_N, rng)
    db_uT = add_error(skins.db_uT, skins.place_mm, np.log(skins.force_N), ERROR_OF_NOMINAL, rng)
    db_uT = db_uT + np.tile(NOISE_uT, 5) * rng.standard_normal(db_uT.shape)
    to_chips = np.linalg.inv(to_board(np.eye(db_uT.shape[2])))
    for rest_uT, own_uT, place_mm, force_N in zip(
        skins.rest_uT @ to_chips, db_uT @ to_chips, skins.place_mm, skins.force_N, strict=True
    ):
        for strategy, choose in strategies(place_mm[:PLACES_N].astype(float), rng).items():
            skin, taken = load_universal().zero(rest_uT[None]), []
            for n in range(max(LABELS_N) + 1):
                if n in LABELS_N:
                    off_mm = skin.predict(own_uT[PLACES_N:] + rest_uT)[:, :2] - CENTRE_MM - place_mm[PLACES_N:]
                    errors.setdefault((strategy, n), []).append(off_mm)
                taken.append(choose(skin, taken))
                skin.zero(rest_uT[None])
                skin.label(place_mm[taken] + CENTRE_MM, force_N[taken].astype(float), own_uT[taken] + rest_uT)
    for (strategy, n), off_mm in errors.items():
        within = 100 * (np.abs(off_mm) <= 1).all(axis=2).mean()
        mse_mm2 = (np.array(off_mm) ** 2).mean(axis=(1, 2))
        line = f"{strategy}, {n} labels: {within:.1f} % within 1 mm, MSE_xy {mse_mm2.mean():.3f} mm2"
        more = mse_mm2 - (np.array(errors["fixed", n]) ** 2).mean(axis=(1, 2))
        print(f"{line}; minus fixed {more.mean():+.3f} +- {more.std(ddof=1) / SKINS_N**0.5:.3f} (standard error)")
    assert all(np.isfinite(off_mm).all() for off_mm in errors.values())


def strategies(pool_mm: np.ndarray, rng: np.random.Generator) -> dict[str, Choose]:
    """Return functions that choose the next press to label; `fixed` labels the places that `reskin live` shows."""
    live_mm = np.array(sorted(GuidedPresses().place_mm.tolist(), key=lambda place: place[::-1])) - CENTRE_MM
    fixed = [int(np.linalg.norm(pool_mm - one, axis=1).argmin()) for one in rng.permutation(live_mm)]
    anywhere = rng.permutation(len(pool_mm)).tolist()

    def chosen(skin: Universal, taken: list[int]) -> int:
        free = [i for i in range(len(pool_mm)) if i not in taken]
        return free[int(expected_gain(skin.skin, pool_mm[free], np.full(len(free), PRESS_N)).argmax())]

    return {
        "fixed": lambda _, taken: fixed[len(taken)],
        "random": lambda _, taken: anywhere[len(taken)],
        "chosen": chosen,
    }
