"""Coverage of the universal model's 90 % intervals on simulated skins with law errors unlike those in training.

Run `RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_intervals_benchmark.py`, which takes three minutes of
processor time. The law error is the difference between a skin's fields and the fields of the simulated law. The network
(variant `nominal`, settings of scene lab) is trained on simulated skins alone. For each kind of law error, the
benchmark prints the misfit of the unlabelled presses. For each number of labels, it prints four numbers for the map
alone, and then for map and network combined: the coverage at the assumed likelihood power, the coverage at the
calibrated power, the half width of the interval at the calibrated power (in brackets), and the accuracy. The last
number of a line is the standard deviation, over skins, of the coverage of map and network at the calibrated power. The
test asserts that larger law errors widen the intervals.
"""

import numpy as np
import pytest

from pipeline.training import universal
from pipeline.training.universal import (
    ASSUMED_POWER,
    LawError,
    Powers,
    calibrate_on_simulated,
    calibrate_to_simulated,
    coverage,
    draw_prior_skins,
    estimate,
    lower_by_labels,
)
from pipeline.training.universal_variants import Variant
from reskin.universal import batches
from reskin.universal.batches import SkinPrior, TrainingSettings, add_error
from reskin.universal.force import NORMAL_90
from reskin.universal.map import NOMINAL, NOMINAL_SPREADS, new_map, tabulate
from reskin.universal.model import PriorModel, load_universal
from reskin.universal.population import Population
from reskin.universal.training import train_networks
from tests.benchmarks import FULL, size
from tests.universal.skins import SETUP

SEED, SETTINGS = 2021, TrainingSettings(skins_n=size(500, 4), steps_n=size(1200, 3), seeds_n=1)  # settings of scene lab
SKINS_N, LABELS_N = size(12, 1), size((0, 5, 10, 20, 40), (0,))


def law_error(size: float, length_mm: tuple[float, float] = batches.ERROR_MM) -> LawError:
    """Return a function that adds law errors as in training to the fields of skins.

    The rms of the errors is `size` |dB|, and their length scale is drawn from `length_mm`.
    """

    def add(skins: Population, rng: np.random.Generator) -> np.ndarray:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(batches, "ERROR_MM", length_mm)
            return add_error(skins.db_uT, skins.place_mm, np.log(skins.force_N), (size, size), rng)

    return add


def mix_chips(skins: Population, rng: np.random.Generator) -> np.ndarray:
    """Add to each chip's gain matrix random entries with a standard deviation of 0.25; apply it to the fields."""
    gain = np.eye(3) + 0.25 * rng.standard_normal((len(skins), 5, 3, 3))
    return np.einsum("skij,snkj->snki", gain, skins.db_uT.reshape(*skins.db_uT.shape[:2], 5, 3))


def add_memory(skins: Population, rng: np.random.Generator) -> np.ndarray:
    """Subtract from each press 15 % of the field change of another, random press on the same skin."""
    order = [rng.permutation(skins.db_uT.shape[1]) for _ in range(len(skins))]
    return np.stack([db_uT - 0.15 * db_uT[one] for db_uT, one in zip(skins.db_uT, order, strict=True)])


def add_independent_errors(skins: Population, rng: np.random.Generator) -> np.ndarray:
    """Add to each press an independent, heavy-tailed error whose size is 30 % of the field change |dB|."""
    length_uT = np.linalg.norm(skins.db_uT, axis=2, keepdims=True) / np.sqrt(skins.db_uT.shape[2])
    return skins.db_uT + 0.3 * length_uT * rng.standard_t(3, skins.db_uT.shape)


FAMILIES: dict[str, LawError] = {
    "no error": law_error(0.0), "0.3 |dB|": law_error(0.3), "0.5 |dB|": law_error(0.5), "0.6 |dB|": law_error(0.6),
    "0.8 |dB|": law_error(0.8), "0.5 |dB|, length scale 1.2 to 2 mm": law_error(0.5, (1.2, 2.0)),
    "0.5 |dB|, length scale 6 to 12 mm": law_error(0.5, (6.0, 12.0)), "random gain matrix of each chip": mix_chips,
    "memory of another press": add_memory, "independent error of each press": add_independent_errors,
}  # fmt: skip


@pytest.mark.timeout(3600)
def test_interval_coverage_by_kind_of_law_error(monkeypatch):
    if not FULL:
        monkeypatch.setattr(universal, "CALIBRATION_SKINS_N", 1)
    prior = SkinPrior("nominal", NOMINAL, NOMINAL_SPREADS, SETUP)
    prior_map = new_map(tabulate(NOMINAL, NOMINAL_SPREADS, SETUP) if FULL else load_universal().tables)
    nominal = Variant(prior, PriorModel(prior_map, train_networks(prior, SETTINGS, SEED)))
    by_labels = calibrate_on_simulated(nominal, LABELS_N, SEED)
    print("\npowers by labels:", {n: [round(power, 2) for power in powers] for n, powers in by_labels.items()})
    widths_mm = {}
    for name, error in {
        "law error as in training": universal.law_error(),
        "law error with which the powers are chosen": universal.unmodelled_error(),
        **size(FAMILIES, dict([*FAMILIES.items()][:1])),
    }.items():
        skins = draw_prior_skins(prior, SKINS_N, SEED, "asked", error)
        calibrated = [calibrate_to_simulated(nominal.model, skins, i, SEED) for i in range(SKINS_N)]
        print(f"{name}: misfit {np.round(np.quantile([one.misfit for one, _ in calibrated], (0, 0.5, 1)), 2)}")
        for n in LABELS_N:
            by_skin = np.array([_scores(*one, n, by_labels[n]) for one in calibrated])
            found, sd = by_skin.mean(axis=0), by_skin[:, 1, 1].std()
            print(f"  {n:2} labels: " + " | ".join(
                f"{100 * assumed:.0f} -> {100 * covered:.0f} % ({mm:.2f} mm), accuracy {100 * within:.0f} %"
                for assumed, covered, mm, within in found
            ) + f" | sd of the coverage over skins: {100 * sd:.1f} points")  # fmt: skip
            widths_mm[name, n] = found[1, 2]
    assert not FULL or widths_mm["no error", 0] < widths_mm["0.5 |dB|", 0] < widths_mm["0.8 |dB|", 0]


def _scores(calibration, tested, labels_n, powers):
    """Return coverage at the assumed and at the calibrated power, half width and accuracy: map, map with network."""
    lowered = lower_by_labels(calibration, labels_n, [calibration.nominal_powers(powers)])
    assumed = Powers(ASSUMED_POWER, ASSUMED_POWER)
    before, found = estimate(calibration.with_labels(labels_n), tested.db_uT, [assumed, *lowered])
    within = [(np.abs(one.place_mm - tested.place_mm) <= 1).all(axis=1).mean() for one in found]
    return [
        (coverage(one, tested.place_mm), coverage(other, tested.place_mm), NORMAL_90 * np.median(other.sd_mm), right)
        for one, other, right in zip(before, found, within, strict=True)
    ]
