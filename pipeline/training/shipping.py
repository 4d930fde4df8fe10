"""Make universal models for given boards, and the model that is shipped with the library.

`reskin model make` calls `make`, which makes a model for the layout of chips in a file.

`python -m pipeline.training.shipping` makes the shipped model, which is for the paper's board. The command takes a few
minutes. It writes reskin/universal/universal.safetensors, and a JSON card (a description of the model) beside it. The
networks are trained with the settings and the seed of scene lab. Scene lab also tests the shipped model, under the name
`universal, simulated alone`.

A universal model consists of a map (a probabilistic model of one skin, `reskin.universal.map`), of networks, and of
likelihood powers. A likelihood power is an exponent of the likelihood, and a smaller power gives larger standard
deviations. This module chooses the powers such that the intervals of the model are correct on simulated skins.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.training.universal import (
    AS_TRAINED,
    CALIBRATION_ERRORS,
    CALIBRATION_SKINS_N,
    NOMINAL_POWERS,
    best_powers,
    coverage,
    draw_prior_skins,
    split_presses,
)
from reskin.config import parse, read_yaml
from reskin.errors import ParamsError, require
from reskin.universal.batches import NOMINAL_NAME, SkinPrior, TrainingSettings
from reskin.universal.calibration import LikelihoodPowers, lower_by_misfit, lower_by_residuals
from reskin.universal.layout import BoardLayout, as_layout, paper_layout, read_layout
from reskin.universal.map import tabulate
from reskin.universal.model import FILE, Universal, write
from reskin.universal.network import FULL_SET_N
from reskin.universal.population import Population

# Numbers of unlabelled presses for which likelihood powers are chosen. One of them is 12, because `reskin live` asks
# its users for 12 presses.
PRESSES_N = (0, 12, FULL_SET_N)
# Sets of unlabelled presses for which powers are chosen: the number of presses, and whether they are evenly spread.
PRESS_SETS = (*((n, False) for n in PRESSES_N), (FULL_SET_N, True))
NO_POWERS = LikelihoodPowers({n: {0: 1.0} for n in PRESSES_N}, {0: 1.0})  # placeholder until the powers are chosen
CARD = {
    "source": "simulated",
    "map": "fields of simulated presses on a lattice of places and forces, and their derivatives by the parameters of "
    "the law; no recorded data",
    "network": "trained on presses of simulated skins, with random errors of the law; no recorded data",
    "estimates": "place: the product of the map's probabilities and the network's normal distribution; force: by map "
    "and network, or by the map alone, corrected by a line that is fitted to presses of known force; misfit: the map's",
    "standard_deviations": "from a power of that product (`likelihood_powers`, by the number of unlabelled presses, "
    "anywhere or evenly spread, and the number of labels). The power is divided by the median misfit of 12 or more "
    "presses, and by the variance inflation from cross-validation over the labels. The powers were chosen on simulated "
    "skins: the place plus or minus 1.645 standard deviations contains the true place in 90 % of the readings",
    "made_in_s_of": "processor time of one core",
    "recorded_knowledge": "from two recorded boards: the form of the law, its slide, the force at which the slide ends "
    "(8 N), gap and amplitude (1.6 mm, 1.4), how they vary together (0.95 per mm), the direction of the "
    "magnetisation, the length scales of the law's error, and the method by which forces are estimated",
}
SHIPPED = {  # additional entries in the card of the shipped model
    "name": "universal, simulated alone",
    "tested_on": "reports/lab, leave-one-board-out: `universal, simulated alone` is this model, calibrated by 65 "
    "evenly spread presses (see(presses, even=True)) and by labels. Table `random_presses` "
    "has presses at random places",
    "not_for": "boards with other positions or rotations of the chips, skins with another magnetisation or thickness, "
    "two contacts at once, shear",
}
MADE = {
    "name": "universal, simulated alone, for the board of a layout",
    "tested_on": "simulated skins of the layout only",
    "not_for": "boards of another layout, two contacts at once, shear, skins that are not an elastic layer with "
    "magnetic powder",
}


def calibrate_powers(model: Universal, prior: SkinPrior, labels_n: Sequence[int], seed: int) -> LikelihoodPowers:
    """Choose the likelihood powers of a model, for each set of unlabelled presses and each number of labels.

    The model is calibrated to simulated skins from the prior. The chosen powers are those for which the 90 % intervals
    of places contain about 90 % of the true coordinates on these skins. They are valid for a misfit of 1. In use, a
    power is divided by the misfit of the skin's presses and by the variance inflation of the skin's labels.
    """
    by_setting: dict[tuple[int, bool, int], list[Float[np.ndarray, "t 2"]]] = {}
    for name, error in CALIBRATION_ERRORS.items():
        skins = draw_prior_skins(prior, CALIBRATION_SKINS_N, seed, name, error)
        for i in range(len(skins)):
            for presses_n, even in PRESS_SETS:
                for n in labels_n if name == AS_TRAINED else [n for n in labels_n if n]:
                    tested = calibrate(model, skins, i, (presses_n, n), even=even, seed=seed)
                    by_setting.setdefault((presses_n, even, n), []).append(_coverages(model, *tested))
    best = {key: best_powers(NOMINAL_POWERS, of_skins).combined for key, of_skins in by_setting.items()}
    anywhere = {presses_n: {n: best[presses_n, False, n] for n in labels_n} for presses_n in PRESSES_N}
    return LikelihoodPowers(anywhere, {n: best[FULL_SET_N, True, n] for n in labels_n})


def calibrate(
    model: Universal, skins: Population, i: int, counts: tuple[int, int], *, even: bool, seed: int
) -> tuple[Float[np.ndarray, "m ch"], Float[np.ndarray, "m 2"]]:
    """Calibrate `model` to presses of simulated skin `i`; the model is modified.

    The presses of the skin are split at random into a pool for calibration, and presses for testing.

    Parameters
    ----------
    counts
        The number of unlabelled presses and the number of labelled presses. Both are taken from the start of the pool.
    even
        Whether the model is told that the unlabelled presses are evenly spread over the skin.

    Returns
    -------
    The readings of the test presses, along the axes of the chips, and the places of these presses in the coordinates of
    labels.
    """
    (presses_n, labels_n), (pool, tested) = counts, split_presses(skins, i, seed)
    fields_uT, centre_mm = (skins.rest_uT[i][None], pool.db_uT, tested.db_uT), np.array(model.layout.centre_mm)
    rest_uT, pool_uT, tested_uT = (model.layout.to_chips(db_uT) for db_uT in fields_uT)
    model.zero(rest_uT, turned=False)
    if presses_n:
        model.see(rest_uT + pool_uT[:presses_n], even=even)
    if labels_n:
        first = slice(labels_n)
        force_N = np.maximum(pool.force_N[first], model.tables.force_N[0])
        model.label(pool.place_mm[first] + centre_mm, force_N, rest_uT + pool_uT[first])
    return rest_uT + tested_uT, tested.place_mm + centre_mm


def _coverages(
    model: Universal, b_uT: Float[np.ndarray, "m ch"], place_mm: Float[np.ndarray, "m 2"]
) -> Float[np.ndarray, "t 2"]:
    """Return the coverage of 90 % intervals, with one row for each candidate power.

    Both columns are equal. They are needed because `best_powers` also chooses powers for a second method, which is not
    used here.
    """
    by_misfit = [lower_by_misfit(power, model.misfit) for power in NOMINAL_POWERS]
    powers = [lower_by_residuals(*pair) for pair in zip(by_misfit, model.variance_inflations(by_misfit), strict=True)]
    covered = [coverage(estimate, place_mm) for estimate in model.estimates(b_uT, powers)]
    return np.column_stack([covered, covered])


@dataclass(frozen=True)
class Inputs:
    """The inputs from which a model is made.

    prior: the distribution from which simulated skins are drawn.
    training: the settings of the training of the networks.
    labels_n: the numbers of labels for which likelihood powers are chosen.
    seed: the seed of all random numbers.
    """

    prior: SkinPrior
    training: TrainingSettings
    labels_n: tuple[int, ...]
    seed: int


def read_inputs(scene: Path = Path("pipeline/scenes/lab.yaml"), layout: BoardLayout | None = None) -> Inputs:
    """Read training settings and seed from a scene's file, and combine them with the prior of a layout.

    The prior is the distribution of skins on the layout's board. By default, this is the paper's board.
    """
    board = layout or paper_layout()
    settings = read_yaml(scene)
    training = {name: settings["universal"][name] for name in TrainingSettings.model_fields}
    return Inputs(
        SkinPrior(NOMINAL_NAME, board.law, board.all_spreads, board.setup(), forces=board.forces),
        parse(TrainingSettings, training, f"{scene}: universal"),
        tuple(settings["universal"]["labels_n"]),
        settings["seed"],
    )


def make_model(layout: BoardLayout, inputs: Inputs, say: Callable[[str], None] = print) -> Universal:
    """Make a universal model for the board of a layout.

    The steps are: simulate the map, train the networks, and choose the likelihood powers. Progress is reported by
    calling `say`.
    """
    from reskin.universal.training import train_networks  # imported here, because it imports torch

    times_s = [time.process_time()]
    say("1 of 3: simulating the map ...")
    tables = tabulate(layout.law, layout.all_spreads, inputs.prior.setup, layout.tabulated_N)
    times_s.append(time.process_time())
    largest_mT = (
        float(np.abs(layout.to_chips(tables.rest_uT + tables.mean_uT.reshape(-1, layout.channels_n))).max()) / 1e3
    )
    say(
        f"fields up to {largest_mT:.1f} mT are expected on the nominal skin; the range of your chips must be twice that"
    )
    say("2 of 3: training the network on simulated skins ...")
    networks = train_networks(inputs.prior, inputs.training, inputs.seed)
    times_s.append(time.process_time())
    say("3 of 3: calibrating standard deviations on simulated skins ...")
    powers = calibrate_powers(
        Universal(tables, networks, NO_POWERS, layout), inputs.prior, inputs.labels_n, inputs.seed
    )
    times_s.append(time.process_time())
    elapsed_s = dict(zip(("map", "network", "likelihood_powers"), np.diff(times_s).round().tolist(), strict=True))
    training = inputs.training.model_dump() | {"seed": inputs.seed}
    about = CARD | {"centre": asdict(layout.law), "training": training, "made_in_s": elapsed_s}
    return Universal(tables, networks, powers, layout, about)


def read_layout_of(file: Path) -> BoardLayout:
    """Read a layout of chips from a file.

    `file` can be the file of a layout, the name of a layout (see `read_layout`), or the file of a scene. In a scene's
    file, the layout is in section `compare`.
    """
    content = read_yaml(file) if file.suffix in (".yaml", ".yml") else {}
    if not (isinstance(content, dict) and "source" in content):
        return read_layout(file)
    given = content.get("compare", {}).get("layout")
    if given is None:
        raise ParamsError(
            f"{file}: this scene has no layout (key layout in section compare). Give the file of a layout."
        )
    return read_layout(given) if isinstance(given, str) else as_layout(given, f"{file}: compare.layout")


def make(layout_file: Path, out: Path, say: Callable[[str], None] = print) -> None:
    """Make a model for the layout in a file, and write it to the file `out`.

    The model's card is written beside it, with the same name and suffix .json.

    Raises
    ------
    ParamsError : the layout is wrong, `out` is not a new .safetensors file, or PyTorch is not installed
    """
    layout = read_layout_of(layout_file)
    if out.suffix != ".safetensors":
        raise ParamsError(f"--out: {out} must end in .safetensors. Try: {out.with_suffix('.safetensors')}")
    for file in (out, out.with_suffix(".json")):
        if file.exists():
            raise ParamsError(f"--out: {file} exists. Choose another name, or delete it.")
    if layout.name == paper_layout().name and layout != paper_layout():
        raise ParamsError(f"{layout_file}: name {layout.name} is that of the paper's board. Choose another name there.")
    require("torch", "model make")
    write_model(make_model(layout, read_inputs(layout=layout), say), MADE, out)


def write_model(model: Universal, about: Mapping[str, Any], out: Path) -> None:
    """Write a model that `make_model` made, with its card. The entries of `about` are added to the card."""
    write(model.tables, model.networks, model.powers, model.layout, {**about, **model.card}, out)


if __name__ == "__main__":
    write_model(make_model(paper_layout(), read_inputs()), SHIPPED, FILE)
