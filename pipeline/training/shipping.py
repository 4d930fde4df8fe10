"""Make a universal model for a board.

Command `reskin model make` makes a model for a user's own board. Command `python -m pipeline.training.shipping` makes
the model that comes with the project. It takes a few minutes, and writes reskin/universal/universal.safetensors and the
card of the model. The networks are trained with the settings (section `rig`) and the seed of scene lab, but without
its recordings. Likelihood powers (exponents that set how wide the stated intervals are) are chosen on simulated skins.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from reskin.config import parse, read_yaml
from reskin.errors import ParamsError, require
from reskin.seeds import rng_for
from reskin.universal.batches import (
    ERROR_OF_NOMINAL,
    NOMINAL_NAME,
    NOISE_uT,
    SkinPrior,
    TrainingSettings,
    add_error,
)
from reskin.universal.calibration import LabelledPresses, LikelihoodPowers, lower_by_misfit, lower_by_residuals
from reskin.universal.force import NORMAL_90
from reskin.universal.layout import BoardLayout, as_layout, paper_layout, read_layout
from reskin.universal.map import NOMINAL, Estimate, tabulate
from reskin.universal.model import FILE, Universal, write
from reskin.universal.network import FULL_SET_N
from reskin.universal.population import PLACES_N, Population, draw_population

# Numbers of unlabelled presses for which likelihood powers are chosen. `reskin live` asks users for 12 presses.
PRESSES_N = (0, 12, FULL_SET_N)
# Pairs of a number of presses, and whether the presses are spread evenly over the skin.
PRESS_SETS = (*((n, False) for n in PRESSES_N), (FULL_SET_N, True))
LABELS_N = (0, 5, 10, 20, 40)  # numbers of labels for which likelihood powers are chosen
# Candidate likelihood powers, for a skin on which the misfit of the map is 1.
NOMINAL_POWERS = tuple(np.geomspace(0.1, 1.6, 13).tolist())
NO_POWERS = LikelihoodPowers({n: {0: 1.0} for n in PRESSES_N}, {0: 1.0})
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
    f"(8 N), gap and amplitude ({NOMINAL.gap_mm:g} mm, {NOMINAL.amplitude:g}), how they vary together (0.95 per mm), "
    "the direction of the magnetisation, the length scales of the law's error, and the method by which forces are "
    "estimated",
}
SHIPPED = {  # additional entries in the card of the shipped model
    "name": "universal, simulated alone",
    "tested_on": "reports/lab: rows `shipped` of experiment new_board, calibrated by unlabelled presses and by labels",
    "not_for": "boards with other positions or rotations of the chips, skins with another magnetisation or thickness, "
    "two contacts at once, shear",
}
MADE = {
    "name": "universal, simulated alone, for the board of a layout",
    "tested_on": "simulated skins of the layout only",
    "not_for": "boards of another layout, two contacts at once, shear, skins that are not an elastic layer with "
    "magnetic powder",
}


# Number of skins that are simulated with each of CALIBRATION_ERRORS, to choose likelihood powers.
CALIBRATION_SKINS_N = 24

LawError = Callable[[Population, np.random.Generator], np.ndarray]  # returns field changes with errors of the law added


def law_error(scale: float = 1.0) -> LawError:
    """Return a function that adds random errors of the law to field changes.

    The law is the physical model of a skin, from which the map is computed. The errors are `scale` times as large as in
    the training of the model.
    """
    least, most = ERROR_OF_NOMINAL

    def add(skins: Population, rng: np.random.Generator) -> Float32[np.ndarray, "s m ch"]:
        return add_error(skins.db_uT, skins.place_mm, np.log(skins.force_N), (scale * least, scale * most), rng)

    return add


# Sizes of two errors that the map does not model, and that calibration presses hardly reveal.
# - MEMORY_MAX: largest fraction of an earlier press's field change that remains in the no-load reading. In the
#   recordings of scenes lab and eflesh, 5 to 8 % were measured.
# - DIFFERENCE_MAX: largest scale of the random relative difference between equal presses. The value is assumed. The
#   difference has heavy tails; its median length over 15 channels is 1.4 times the scale.
MEMORY_MAX, DIFFERENCE_MAX = 0.15, 0.3
HEAVY_TAILS = 3  # degrees of freedom of Student's t


def unmodelled_error(scale: float = 1.0) -> LawError:
    """Return a function that adds three kinds of errors to field changes.

    - Errors of the law, which are `scale` times as large as in training.
    - Memory: a fraction of another press's field change remains. For each skin, this fraction is drawn uniformly from 0
      to `MEMORY_MAX`.
    - Differences between equal presses. For each skin, their size is drawn uniformly from 0 to `DIFFERENCE_MAX`.
    """
    add_law_error = law_error(scale)

    def add(skins: Population, rng: np.random.Generator) -> Float32[np.ndarray, "s m ch"]:
        db_uT = add_law_error(skins, rng)
        skins_n, presses_n, channels_n = db_uT.shape
        other = rng.permuted(np.tile(np.arange(presses_n), (skins_n, 1)), axis=1)
        memory = rng.uniform(0, MEMORY_MAX, (skins_n, 1, 1)) * np.take_along_axis(db_uT, other[..., None], axis=1)
        size_uT = np.linalg.norm(db_uT, axis=2, keepdims=True) / np.sqrt(channels_n)
        difference = rng.uniform(0, DIFFERENCE_MAX, (skins_n, 1, 1)) * rng.standard_t(HEAVY_TAILS, db_uT.shape)
        return (db_uT - memory + size_uT * difference).astype(np.float32)

    return add


# Errors of the simulated skins on which likelihood powers are chosen, by name. The names also select the random
# streams.
AS_TRAINED = "further"
CALIBRATION_ERRORS = {AS_TRAINED: unmodelled_error(), "further, missed twice": unmodelled_error(2.0)}


def draw_prior_skins(prior: SkinPrior, skins_n: int, seed: int, name: str, error: LawError) -> Population:
    """Simulate skins drawn from a prior, with noise and errors of the law in their field changes."""
    rng = rng_for(seed, "universal", prior.name, name)
    skins = draw_population(prior.centre, prior.spreads, prior.setup, skins_n, rng, prior.forces)
    db_uT = error(skins, rng).reshape(skins.db_uT.shape)
    sd_uT = np.tile(np.array(NOISE_uT), skins.rest_uT.shape[1] // len(NOISE_uT))
    return replace(skins, db_uT=(db_uT + sd_uT * rng.standard_normal(skins.db_uT.shape)).astype(np.float32))


def split_presses(skins: Population, i: int, seed: int) -> tuple[LabelledPresses, LabelledPresses]:
    """Split the presses of a simulated skin at random into a pool for calibration and test presses."""
    order = rng_for(seed, "universal", "pool", i).permutation(skins.db_uT.shape[1])
    parts = (skins.place_mm, skins.force_N, skins.db_uT)
    presses = LabelledPresses(*(part[i][order].astype(float) for part in parts))
    return presses[:PLACES_N], presses[PLACES_N:]


def coverage(estimate: Estimate, place_mm: Float[np.ndarray, "n 2"]) -> float:
    """Return the fraction of true coordinates that are inside the 90 % intervals of the estimate."""
    return float((np.abs(estimate.place_mm - place_mm) <= NORMAL_90 * estimate.sd_mm).mean())


def best_power(candidates: Sequence[float], coverages: Sequence[Float[np.ndarray, " t"]]) -> float:
    """Choose the power for which the coverage of 90 % intervals, averaged over skins, is closest to 90 %."""
    return candidates[int(np.abs(np.mean(coverages, axis=0) - 0.9).argmin())]


def calibrate_powers(model: Universal, prior: SkinPrior, labels_n: Sequence[int], seed: int) -> LikelihoodPowers:
    """Choose the likelihood powers of a model, for each number of presses and labels.

    The chosen powers are those for which the 90 % intervals have a coverage of 90 % on simulated skins. They are valid
    for a skin with a misfit of 1. On any other skin, the power is divided by the misfit of this skin.
    """
    by_setting: dict[tuple[int, bool, int], list[Float[np.ndarray, " t"]]] = {}
    for name, error in CALIBRATION_ERRORS.items():
        skins = draw_prior_skins(prior, CALIBRATION_SKINS_N, seed, name, error)
        for i in range(len(skins)):
            for presses_n, even in PRESS_SETS:
                for n in labels_n if name == AS_TRAINED else [n for n in labels_n if n]:
                    tested = calibrate(model, skins, i, (presses_n, n), even=even, seed=seed)
                    by_setting.setdefault((presses_n, even, n), []).append(_coverages(model, *tested))
    best = {key: best_power(NOMINAL_POWERS, of_skins) for key, of_skins in by_setting.items()}
    anywhere = {presses_n: {n: best[presses_n, False, n] for n in labels_n} for presses_n in PRESSES_N}
    return LikelihoodPowers(anywhere, {n: best[FULL_SET_N, True, n] for n in labels_n})


def calibrate(
    model: Universal, skins: Population, i: int, counts: tuple[int, int], *, even: bool, seed: int
) -> tuple[Float[np.ndarray, "m ch"], Float[np.ndarray, "m 2"]]:
    """Calibrate a model, in place, to presses and labels from the pool of a simulated skin.

    counts: the numbers of presses and of labels. Returns the readings of the skin's test presses, in the chips' axes,
    and the places of these presses in the coordinates of labels.
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
) -> Float[np.ndarray, " t"]:
    """Return the coverage of 90 % intervals for each likelihood power in `NOMINAL_POWERS`."""
    by_misfit = [lower_by_misfit(power, model.misfit) for power in NOMINAL_POWERS]
    powers = [lower_by_residuals(*pair) for pair in zip(by_misfit, model.variance_inflations(by_misfit), strict=True)]
    return np.array([coverage(estimate, place_mm) for estimate in model.estimates(b_uT, powers)])


@dataclass(frozen=True)
class Inputs:
    """Inputs for training the model: prior of the skins, training settings, numbers of labels, and seed."""

    prior: SkinPrior
    training: TrainingSettings
    labels_n: tuple[int, ...]
    seed: int


def read_inputs(scene: Path = Path("pipeline/scenes/lab.yaml"), layout: BoardLayout | None = None) -> Inputs:
    """Read a scene's training settings, for skins on the board of a layout (by default, the paper's)."""
    board = layout or paper_layout()
    settings = read_yaml(scene)
    return Inputs(
        SkinPrior(NOMINAL_NAME, board.law, board.all_spreads, board.setup(), forces=board.forces),
        parse(TrainingSettings, settings["rig"], f"{scene}: rig"),
        LABELS_N,
        settings["seed"],
    )


def make_model(layout: BoardLayout, inputs: Inputs, say: Callable[[str], None] = print) -> Universal:
    """Simulate the map, train the networks and calibrate the likelihood powers for the board of a layout."""
    from reskin.universal.training import train_networks  # imported here, because it imports torch

    times_s = [time.process_time()]
    say("1 of 3: simulating the map ...")
    tables = tabulate(layout.law, layout.all_spreads, inputs.prior.setup, layout.tabulated_N)
    times_s.append(time.process_time())
    largest_mT = (
        float(np.abs(layout.to_chips(tables.rest_uT + tables.mean_uT.reshape(-1, layout.channels_n))).max()) / 1e3
    )
    say(
        f"fields up to {largest_mT:.1f} mT are expected on the nominal skin; the measuring range of your chips must be "
        "at least twice as large"
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
    """Read a layout from a file or name that `read_layout` accepts, or from section `compare` of a scene's file."""
    content = read_yaml(file) if file.suffix in (".yaml", ".yml") else {}
    if not (isinstance(content, dict) and "source" in content):
        return read_layout(file)
    given = content.get("compare", {}).get("layout")
    if given is None:
        raise ParamsError(
            f"{file}: this scene has no layout (compare.layout). Add it to the scene, or pass the file of a layout."
        )
    return read_layout(given) if isinstance(given, str) else as_layout(given, f"{file}: compare.layout")


def make(layout_file: Path, out: Path, say: Callable[[str], None] = print) -> None:
    """Make the model for the layout in a file, and write it and its card (same name with suffix .json).

    Raises
    ------
    ParamsError : the layout is wrong, `out` is not a new .safetensors file, or PyTorch is not installed
    """
    layout = read_layout_of(layout_file)
    if out.suffix != ".safetensors":
        raise ParamsError(f"--out: {out} must end in .safetensors. Try: {out.with_suffix('.safetensors')}")
    for file in (out, out.with_suffix(".json")):
        if file.exists():
            raise ParamsError(f"--out: {file} exists. Choose another name, or delete this file.")
    if layout.name == paper_layout().name and layout != paper_layout():
        raise ParamsError(
            f"{layout_file}: name {layout.name} is reserved for the paper's board. Change the name there."
        )
    require("torch", "model make")
    write_model(make_model(layout, read_inputs(layout=layout), say), MADE, out)


def write_model(model: Universal, about: Mapping[str, Any], out: Path) -> None:
    """Write a model that `make_model` made; `about` is added to its card."""
    write(model.tables, model.networks, model.powers, model.layout, {**about, **model.card}, out)


if __name__ == "__main__":
    write_model(make_model(paper_layout(), read_inputs()), SHIPPED, FILE)
