"""Design choices of the universal model in external fields, compared on simulated skins.

Run `RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_moving_benchmark.py`, which takes a minute of processor
time. Experiment `moving_hand` measures the results of these choices, also on recordings.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from pipeline.experiments.random_presses import place_scores, raise_forces
from pipeline.training.universal import draw_prior_skins, law_error, split_presses

from reskin.data.grid import CENTRE_MM
from reskin.physics import external
from reskin.seeds import rng_for
from reskin.universal.batches import SkinPrior
from reskin.universal.calibration import CalibrationData
from reskin.universal.force import NORMAL_90
from reskin.universal.law import CHIPS_MM, to_chips
from reskin.universal.map import NOMINAL, NOMINAL_SPREADS, new_map
from reskin.universal.model import CalibratedModel, Evaluation, PriorModel, load_universal
from tests.benchmarks import FULL, size
from tests.universal.skins import SETUP

SEED, POWER = 2021, 0.5  # the likelihood power; it affects only standard deviations, which are not printed


def magnets_uT(distance_mm: float, sd_uT: float, n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw fields of magnets at this distance from the board's centre, along the board's axes: [n, 15]."""
    cov = external.covariance(np.array(CHIPS_MM), sd_uT, distance_mm)
    return rng.multivariate_normal(np.zeros(15), cov, n, method="eigh")


FIELDS: Mapping[str, Callable[[int, np.random.Generator], np.ndarray]] = {
    "none": lambda n, rng: np.zeros((n, 15)),
    "uniform, 30 uT": lambda n, rng: magnets_uT(1e5, 30.0, n, rng),
    "magnets at 80 mm, 30 uT": lambda n, rng: magnets_uT(80.0, 30.0, n, rng),
    "magnets at 40 mm, 140 uT": lambda n, rng: magnets_uT(40.0, 140.0, n, rng),
    "magnets at 60 mm, 140 uT": lambda n, rng: magnets_uT(60.0, 140.0, n, rng),
}
NETWORKS = ("reading as it is", "mean over chips removed", "left out", "expected external field removed")


def with_networks(model: CalibratedModel, found: Evaluation, db_uT: np.ndarray, networks: str) -> Evaluation:
    """Replace the networks' estimates by those for another input; `networks` is one of `NETWORKS`."""
    own = found.network
    if networks == "left out":
        nothing = np.full_like(own.sd_mm, 1e6)
        own = replace(own, sd_mm=nothing, sd_log_N=nothing[:, 0])
    elif networks == "reading as it is":
        own = model.evaluate_networks(db_uT)
    elif networks == "mean over chips removed":
        chips_uT = db_uT.reshape(len(db_uT), 5, 3)
        own = model.evaluate_networks((chips_uT - chips_uT.mean(axis=1, keepdims=True)).reshape(db_uT.shape))
    return replace(found, network=own)


def test_accuracy_by_inputs_of_the_networks_and_distance_of_magnets():
    """Compare inputs of the networks and assumed distances of magnets; both choices follow from these results."""
    skins_n, shipped = size(24, 1), load_universal()
    prior = SkinPrior("nominal", NOMINAL, NOMINAL_SPREADS, SETUP)
    skins = draw_prior_skins(prior, skins_n, SEED, "external fields", law_error())
    variants = [(0.0, external.DISTANCE_MM, NETWORKS[0])]
    variants += [(sd_uT, external.DISTANCE_MM, networks) for sd_uT in (30.0, 140.0) for networks in NETWORKS]
    variants += [
        (sd_uT, distance_mm, NETWORKS[3]) for sd_uT in (30.0, 140.0) for distance_mm in (40.0, 60.0, 80.0, 1e5)
    ]
    print(f"\nSIMULATED, {skins_n} skins: % within 1 mm / MSE_xy in mm2; columns: {', '.join(FIELDS)}")
    within = {}
    for sd_uT, distance_mm, networks in size(variants, variants[:3]):
        cov = external.covariance(np.array(CHIPS_MM), sd_uT, distance_mm) if sd_uT else None
        prior_model = PriorModel(new_map(shipped.tables, external_cov=cov), shipped.networks)
        scores = np.zeros((2, len(FIELDS), skins_n, 2))
        for i in range(skins_n):
            pool, tested = split_presses(skins, i, SEED)
            calibration = prior_model.calibrate(CalibrationData(skins.rest_uT[i].astype(float), pool.db_uT))
            for row, labels_n in enumerate((0, 10)):
                model = calibration.with_labels(raise_forces(pool[:labels_n]))
                for column, draw in enumerate(FIELDS.values()):
                    db_uT = tested.db_uT + draw(len(tested), rng_for(SEED, "fields", i, column))
                    found = with_networks(model, model.evaluate(db_uT), db_uT, networks).combined(POWER)
                    placed = place_scores(found.place_mm - tested.place_mm)
                    scores[row, column, i] = placed["accuracy_pct"], placed["mse_xy_mm2"]
        for labels_n, row in zip((0, 10), scores.mean(axis=2), strict=True):
            within[sd_uT, distance_mm, networks, labels_n] = row[:, 0]
            cells = "  ".join(f"{pct:5.1f} / {mse:.2f}" for pct, mse in row)
            name = f"external_uT {sd_uT:3.0f}, magnets at {distance_mm:6.0f} mm, networks: {networks}"
            print(f"{labels_n:2} labels, {name:82} {cells}")
    if FULL:  # option `external_uT` makes places near magnets more accurate, and less accurate without external fields
        on = within[140.0, external.DISTANCE_MM, NETWORKS[3], 0]
        off = within[0.0, external.DISTANCE_MM, NETWORKS[0], 0]
        assert on[3] > off[3]
        assert on[0] < off[0]


def test_interval_coverage_in_external_fields():
    """Compute the coverage of 90 % intervals, in fields of magnets that have the expected size.

    `POWER_uT` and `POWER_PER_LABEL_uT` were chosen on other skins, which were drawn with the name "external powers".
    """
    skins_n = size(24, 1)
    prior = SkinPrior("nominal", NOMINAL, NOMINAL_SPREADS, SETUP)
    skins = draw_prior_skins(prior, skins_n, SEED, "external powers, test", law_error())
    print(f"\nSIMULATED, {skins_n} skins, magnets at 60 mm: coverage of 90 % intervals")
    for sd_uT in size((0.0, 10.0, 30.0, 70.0, 140.0, 300.0), (0.0, 30.0)):
        for labels_n in size((0, 10, 40), (10,)):
            covered = []
            for i in range(skins_n):
                pool, tested = split_presses(skins, i, SEED)
                model = load_universal(external_uT=sd_uT).zero(to_chips(skins.rest_uT[i][None].astype(float)))
                model.see(model.noload_uT + to_chips(pool.db_uT))
                if labels_n:
                    labels = raise_forces(pool[:labels_n])
                    labelled_uT = model.noload_uT + to_chips(labels.db_uT)
                    model.label(labels.place_mm + CENTRE_MM, labels.force_N, labelled_uT)
                external_uT = magnets_uT(60.0, sd_uT, len(tested), rng_for(SEED, "coverage", i))
                found = model.estimate(model.noload_uT + to_chips(tested.db_uT + external_uT))
                error_mm = np.abs(found.place_mm - CENTRE_MM - tested.place_mm)
                covered.append(100 * float((error_mm <= NORMAL_90 * found.sd_mm).mean()))
            print(f"external_uT {sd_uT:3.0f}, {labels_n:2} labels: {np.mean(covered):.0f} %")
            assert not FULL or 84 < np.mean(covered) < 96
