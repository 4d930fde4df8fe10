"""How far a map and networks are to be believed: boards and simulated skins that are not held out -> tempers.

Where boards of the rig are known, on these. Where none is, on simulated skins of the prior, and the less the worse a
skin's unlabelled pokes fit. Refuses to know files, folds and what is tested.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32

from pipeline.core.seeds import rng_for
from pipeline.trials.experts import Experts
from pipeline.trials.universal import TEMPERS, Bench, Pokes, Tempers, Told, coverages, tell
from pipeline.twin.population import PLACES_N, Population, draw_population
from pipeline.twin.training import ERROR_OF_NOMINAL, NOISE_uT, add_error

FURTHER_N = 24  # simulated skins that tell how sure experts are that know no board
SURENESS = tuple(np.geomspace(0.1, 1.6, 13).tolist())  # tempers at a misfit of 1

Coverage = Float[np.ndarray, "t 2"]  # by temper, of the map alone and with networks
Miss = Callable[[Population, np.random.Generator], np.ndarray]  # changes of field of skins that a law misses


def tell_tempers(bench: Bench, labels_n: Sequence[int]) -> dict[str, dict[int, Tempers]]:
    """Find, for each board that is held out, how much experts are to be believed: as was best on the other boards."""
    held = {board: _of_board(bench, board, labels_n) for board in bench.seen}
    return {
        board: {n: best(TEMPERS, [own[n] for other, own in held.items() if other != board]) for n in labels_n}
        for board in held
    }


def tell_sureness(nominal: Experts, labels_n: Sequence[int], seed: int) -> dict[int, Tempers]:
    """Find, on simulated skins, tempers at a misfit of 1; a board's is this over its own misfit.

    What the law misses on a skin is as large as its unlabelled pokes say: covariances are taken to be larger by that
    factor (Birge's ratio). On these skins it misses as much as on those that networks are taught.
    """
    skins = skins_of_prior(nominal, FURTHER_N, seed, "further")
    held = [_of_skin(*told_of(nominal, skins, i, seed), labels_n) for i in range(len(skins))]
    return {n: best(SURENESS, [own[n] for own in held]) for n in labels_n}


def best(candidates: Sequence[float], held: Sequence[Coverage]) -> Tempers:
    """Choose the candidates under which 90 % intervals hold 90 %, on the mean."""
    of_map, of_both = np.abs(np.mean(held, axis=0) - 0.9).argmin(axis=0)
    return candidates[of_map], candidates[of_both]


def skins_of_prior(nominal: Experts, skins_n: int, seed: int, name: str, miss: Miss | None = None) -> Population:
    """Draw skins of the prior, noisy, and with what the law misses: as networks are taught, or as `miss` says."""
    taught, rng = nominal.syllabus, rng_for(seed, "universal", nominal.syllabus.name, name)
    skins = draw_population(taught.centre, taught.spreads, taught.setup, skins_n, rng)
    db_uT = (miss or _as_taught)(skins, rng).reshape(skins.db_uT.shape)
    sd_uT = np.tile(np.array(NOISE_uT), skins.rest_uT.shape[1] // len(NOISE_uT))
    return replace(skins, db_uT=(db_uT + sd_uT * rng.standard_normal(skins.db_uT.shape)).astype(np.float32))


def told_of(nominal: Experts, skins: Population, i: int, seed: int) -> tuple[Told, Pokes]:
    """Tell experts of a simulated skin: a random half of its pokes is the pool, the others are asked."""
    order = rng_for(seed, "universal", "pool", i).permutation(skins.db_uT.shape[1])
    pokes = Pokes(*(part[i][order].astype(float) for part in (skins.place_mm, skins.force_N, skins.db_uT)))
    return tell(nominal, skins.rest_uT[i].astype(float), pokes[:PLACES_N]), pokes[PLACES_N:]


def _of_skin(told: Told, asked: Pokes, labels_n: Sequence[int]) -> dict[int, Coverage]:
    return coverages(told, asked, labels_n, [told.tempers((one, one))[0] for one in SURENESS])


def _as_taught(skins: Population, rng: np.random.Generator) -> Float32[np.ndarray, "s m ch"]:
    return add_error(skins.db_uT, skins.place_mm, np.log(skins.force_N), ERROR_OF_NOMINAL, rng)


def _of_board(bench: Bench, board: str, labels_n: Sequence[int]) -> dict[int, Coverage]:
    # The board is read by the nominal experts, which know no board, with labels of its own, on its other pokes.
    seen = bench.seen[board]
    order = rng_for(bench.data.settings.seed, "universal", board).permutation(len(seen.pokes))
    pokes = Pokes(seen.place_mm[order], seen.pokes.force_N[order], seen.db_uT.reshape(len(order), -1)[order])
    pool_n = len(order) // 3
    told = tell(bench.nominal, seen.rest_uT.ravel(), pokes[:pool_n])
    return coverages(told, pokes[pool_n:], labels_n, TEMPERS)
