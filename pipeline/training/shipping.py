"""Make the universal model that `reskin` ships: `python -m pipeline.training.shipping`, a few minutes on one core.

Writes reskin/universal/universal.safetensors and its card. The network has the training settings and the seed of scene
lab, which tests it as `universal, simulated alone`. The likelihood powers are calibrated on simulated skins.
"""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.training.universal import (
    AS_TAUGHT,
    FORCE_MIN_N,
    FURTHER_N,
    MISSES,
    SURENESS,
    Experts,
    best,
    covered,
    pool_of_prior,
    skins_of_prior,
)
from reskin.config import parse, read_yaml
from reskin.data.grid import CENTRE_MM
from reskin.physics.skin import SkinDesign
from reskin.simulation import defaults
from reskin.universal.calibration import LikelihoodPowers, lower_by_misfit, lower_by_residuals
from reskin.universal.law import CHIPS_MM, Setup, to_chips
from reskin.universal.map import NOMINAL, OF_NOMINAL, tabulate
from reskin.universal.model import SKIN_MM, Universal, write
from reskin.universal.network import FULL_SET_N
from reskin.universal.population import Population
from reskin.universal.training import NAMELESS, Lessons, Syllabus, teach

POKES_N = (0, 12, FULL_SET_N)  # unlabelled ones; `reskin live` asks for a dozen
WAYS = (*((n, False) for n in POKES_N), (FULL_SET_N, True))  # so many, and whether they are said to lie evenly
UNKNOWN = LikelihoodPowers({n: {0: 1.0} for n in POKES_N}, {0: 1.0})
CARD = {
    "name": "universal, simulated alone",
    "source": "simulated",
    "centre": asdict(NOMINAL),
    "map": "pokes of simulated skins on a lattice of places and forces, and their slopes; no recorded row",
    "network": "taught pokes of simulated skins, with errors of the law drawn anew at every step; no recorded row",
    "answers": "places: the map's probabilities times the network's normal; misfit: the map's",
    "standard_deviations": "of a power of that product. The power: sureness, by unlabelled pokes (anywhere, or evenly "
    "over the skin) and by labels, over the median misfit of the pokes (of 12 or more) and over what labelled pokes "
    "that are left out in their turn are off. Told on simulated skins so that 1.645 to either side hold 90 %",
    "made_in_s_of": "one core's processor time; other machines take others",
    "recorded_knowledge": "the form of the law and the middle of its slide, from two recorded boards",
    "tested_on": "reports/lab, leave-one-board-out: `universal, simulated alone` is this model, told 65 pokes that lie "
    "evenly (see(pokes, even=True)) and labels; intervals of skins that were told fewer pokes are told on simulated "
    "skins alone",
    "not_for": "boards of other chips or turns, skins of other magnets, of other thickness, two contacts, shear",
}


def tell_sureness(experts: Experts, labels_n: Sequence[int], seed: int) -> LikelihoodPowers:
    """Find, on simulated skins, tempers at a misfit of 1 of the model as it is used, by pokes and by labels."""
    model = Universal(experts.tables, experts.networks, UNKNOWN)
    held: dict[tuple[int, bool, int], list[Float[np.ndarray, "t 2"]]] = {}
    for name, miss in MISSES.items():
        skins = skins_of_prior(experts, FURTHER_N, seed, name, miss)
        for i in range(len(skins)):
            for pokes_n, even in WAYS:
                for n in labels_n if name == AS_TAUGHT else [n for n in labels_n if n]:
                    asked = shown(model, skins, i, (pokes_n, n), even=even, seed=seed)
                    held.setdefault((pokes_n, even, n), []).append(_coverage(model, asked))
    told = {key: best(SURENESS, of)[1] for key, of in held.items()}
    anywhere = {pokes_n: {n: told[pokes_n, False, n] for n in labels_n} for pokes_n in POKES_N}
    return LikelihoodPowers(anywhere, {n: told[FULL_SET_N, True, n] for n in labels_n})


def shown(
    model: Universal, skins: Population, i: int, counts: tuple[int, int], *, even: bool, seed: int
) -> tuple[Float[np.ndarray, "m ch"], Float[np.ndarray, "m 2"]]:
    """Show a model a simulated skin, so many pokes and so many labels of its pool; give what is asked, as boards do.

    Readings in the chips' axes and places as labels, in mm.
    """
    (pokes_n, labels_n), (pool, asked) = counts, pool_of_prior(skins, i, seed)
    rest_uT, pool_uT, asked_uT = (to_chips(db_uT) for db_uT in (skins.rest_uT[i][None], pool.db_uT, asked.db_uT))
    model.zero(rest_uT)
    if pokes_n:
        model.see(rest_uT + pool_uT[:pokes_n], even=even)
    if labels_n:
        first = slice(labels_n)
        force_N = np.maximum(pool.force_N[first], FORCE_MIN_N)
        model.label(pool.place_mm[first] + CENTRE_MM, force_N, rest_uT + pool_uT[first])
    return rest_uT + asked_uT, asked.place_mm + CENTRE_MM


def _coverage(
    model: Universal, asked: tuple[Float[np.ndarray, "m ch"], Float[np.ndarray, "m 2"]]
) -> Float[np.ndarray, "t 2"]:
    # Of the map with networks, twice: as others are given with the map alone.
    told = [lower_by_misfit(one, model.misfit) for one in SURENESS]
    tempers = [lower_by_residuals(*one) for one in zip(told, model.variance_inflations(told), strict=True)]
    held = [covered(found, asked[1]) for found in model.estimates(asked[0], tempers)]
    return np.column_stack([held, held])


@dataclass(frozen=True)
class Inputs:
    """What the shipped model is made from."""

    setup: Setup
    lessons: Lessons
    labels_n: tuple[int, ...]
    seed: int


def read_inputs(scene: Path = Path("pipeline/scenes/lab.yaml")) -> Inputs:
    """Read the nominal skin, placed on the paper's board, and the training settings of a scene."""
    design = parse(SkinDesign, defaults.nominal("skin"), f"{defaults.NOMINAL}: skin")
    setup = Setup(design, np.array(CHIPS_MM), NOMINAL.gap_mm, SKIN_MM, design.flipped, design.tip_radius_mm)
    settings = read_yaml(scene)
    training = {name: settings["universal"][name] for name in Lessons.model_fields}
    lessons = parse(Lessons, training, f"{scene}: universal")
    return Inputs(setup, lessons, tuple(settings["universal"]["labels_n"]), settings["seed"])


def make() -> None:
    """Make the model anew and overwrite its file and card."""
    inputs = read_inputs()
    times_s = [time.process_time()]
    tables = tabulate(NOMINAL, OF_NOMINAL, inputs.setup)
    times_s.append(time.process_time())
    syllabus = Syllabus(NAMELESS, NOMINAL, OF_NOMINAL, inputs.setup)
    networks = teach(syllabus, inputs.lessons, inputs.seed)
    times_s.append(time.process_time())
    sureness = tell_sureness(Experts(tables, networks, None, syllabus), inputs.labels_n, inputs.seed)
    times_s.append(time.process_time())
    took_s = dict(zip(("map", "network", "sureness"), np.diff(times_s).round().tolist(), strict=True))
    lessons = inputs.lessons.model_dump() | {"seed": inputs.seed}
    write(tables, networks, sureness, CARD | {"lessons": lessons, "made_in_s": took_s})


if __name__ == "__main__":
    make()
