"""How far a map and networks are to be believed: boards and simulated skins that are not held out -> tempers.

Where boards of the rig are known, on these. Where none is, on simulated skins of the prior, and the less the worse a
skin's unlabelled pokes fit and the farther its labelled ones are off. Refuses to know files, folds and what is tested.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32

from pipeline.core.seeds import rng_for
from pipeline.trials.experts import Experts
from pipeline.trials.universal import TEMPERS, Bench, Pokes, Tempers, Told, by_own_labels, coverages, tell
from pipeline.twin.population import PLACES_N, Population, draw_population
from pipeline.twin.training import ERROR_OF_NOMINAL, NOISE_uT, add_error

FURTHER_N = 24  # simulated skins of each kind that tell how sure experts are that know no board
SURENESS = tuple(np.geomspace(0.1, 1.6, 13).tolist())  # tempers at a misfit of 1

Coverage = Float[np.ndarray, "t 2"]  # by temper, of the map alone and with networks
Miss = Callable[[Population, np.random.Generator], np.ndarray]  # changes of field of skins that a law misses


def missed(times: float = 1.0) -> Miss:
    """Say that a law misses as much as networks are taught, times so much."""
    least, most = ERROR_OF_NOMINAL

    def miss(skins: Population, rng: np.random.Generator) -> Float32[np.ndarray, "s m ch"]:
        return add_error(skins.db_uT, skins.place_mm, np.log(skins.force_N), (times * least, times * most), rng)

    return miss


AS_TAUGHT = "further"  # names stand in seeds
MISSES = {AS_TAUGHT: missed(), "further, missed twice": missed(2.0)}


def tell_tempers(bench: Bench, labels_n: Sequence[int]) -> dict[str, dict[int, Tempers]]:
    """Find, for each board that is held out, how much experts are to be believed: as was best on the other boards."""
    held = {board: _of_board(bench, board, labels_n) for board in bench.seen}
    return {
        board: {n: best(TEMPERS, [own[n] for other, own in held.items() if other != board]) for n in labels_n}
        for board in held
    }


def tell_sureness(nominal: Experts, labels_n: Sequence[int], seed: int) -> dict[int, Tempers]:
    """Find, on simulated skins, tempers at a misfit of 1; a board's is this over its own misfit and labels' residuals.

    What the law misses on a skin is as large as its unlabelled pokes say: covariances are taken to be larger by that
    factor (Birge's ratio). On these skins it misses as much as on those that networks are taught. With labels, also on
    as many on which it misses twice that: residuals are to tell how much, so that skins of more than one kind must fit.
    """
    held: dict[int, list[Coverage]] = {n: [] for n in labels_n}
    for name, miss in MISSES.items():
        skins = skins_of_prior(nominal, FURTHER_N, seed, name, miss)
        told = [told_of(nominal, skins, i, seed) for i in range(len(skins))]
        for n in labels_n:
            held[n] += [_of_skin(*one, n) for one in told] if n or name == AS_TAUGHT else []
    return {n: best(SURENESS, held[n]) for n in labels_n}


def best(candidates: Sequence[float], held: Sequence[Coverage]) -> Tempers:
    """Choose the candidates under which 90 % intervals hold 90 %, on the mean."""
    of_map, of_both = np.abs(np.mean(held, axis=0) - 0.9).argmin(axis=0)
    return candidates[of_map], candidates[of_both]


def skins_of_prior(nominal: Experts, skins_n: int, seed: int, name: str, miss: Miss) -> Population:
    """Draw skins of the prior, noisy, and with what the law misses."""
    taught, rng = nominal.syllabus, rng_for(seed, "universal", nominal.syllabus.name, name)
    skins = draw_population(taught.centre, taught.spreads, taught.setup, skins_n, rng)
    db_uT = miss(skins, rng).reshape(skins.db_uT.shape)
    sd_uT = np.tile(np.array(NOISE_uT), skins.rest_uT.shape[1] // len(NOISE_uT))
    return replace(skins, db_uT=(db_uT + sd_uT * rng.standard_normal(skins.db_uT.shape)).astype(np.float32))


def told_of(nominal: Experts, skins: Population, i: int, seed: int) -> tuple[Told, Pokes]:
    """Tell experts of a simulated skin its pool, and give the pokes that are asked."""
    pool, asked = pool_of_prior(skins, i, seed)
    return tell(nominal, skins.rest_uT[i].astype(float), pool), asked


def pool_of_prior(skins: Population, i: int, seed: int) -> tuple[Pokes, Pokes]:
    """Take a random half of a simulated skin's pokes as its pool; the others are asked."""
    order = rng_for(seed, "universal", "pool", i).permutation(skins.db_uT.shape[1])
    pokes = Pokes(*(part[i][order].astype(float) for part in (skins.place_mm, skins.force_N, skins.db_uT)))
    return pokes[:PLACES_N], pokes[PLACES_N:]


def _of_skin(told: Told, asked: Pokes, labels_n: int) -> Coverage:
    tempers = by_own_labels(told, labels_n, [told.tempers((one, one)) for one in SURENESS])
    return coverages(told, asked, labels_n, tempers)


def _of_board(bench: Bench, board: str, labels_n: Sequence[int]) -> dict[int, Coverage]:
    # The board is read by the nominal experts, which know no board, with labels of its own, on its other pokes.
    seen = bench.seen[board]
    order = rng_for(bench.data.settings.seed, "universal", board).permutation(len(seen.pokes))
    pokes = Pokes(seen.place_mm[order], seen.pokes.force_N[order], seen.db_uT.reshape(len(order), -1)[order])
    pool_n = len(order) // 3
    told = tell(bench.nominal, seen.rest_uT.ravel(), pokes[:pool_n])
    tempers = [(one, one) for one in TEMPERS]
    return {n: coverages(told, pokes[pool_n:], min(n, pool_n), tempers) for n in labels_n}
