"""Choose the default force estimator, and the power of the map's probabilities of forces, on simulated skins.

Run `RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_force_benchmark.py`, which takes four minutes. On each skin,
the shipped model is calibrated to 65 presses at unknown places and to labels; 25 other presses are tested. The fields
of the skins differ from those of the simulated law by errors as in training, or by errors that are twice as large. No
recorded press is used.
"""

from statistics import median

import numpy as np
from pipeline.experiments.random_presses import r2

from pipeline.training.shipping import draw_prior_skins, law_error
from reskin.seeds import rng_for
from reskin.universal import model as universal
from reskin.universal.batches import NOMINAL_NAME, SkinPrior
from reskin.universal.calibration import CalibrationData, LabelledPresses
from reskin.universal.force import DEFAULT, ESTIMATORS, prior_line
from reskin.universal.map import NOMINAL, NOMINAL_SPREADS, new_map
from reskin.universal.model import FORCE_POWER, PressCalibration, PriorModel, load_universal
from reskin.universal.population import PLACES_N
from tests.benchmarks import FULL, size
from tests.universal.skins import SETUP

SKINS_N, TESTED_N = size(96, 1), 25
POWERS, LABELS_N, SCALES = size((0.15, 0.3, 0.6, 1.0), (0.6,)), size((10, 40), (10,)), size((1.0, 2.0), (1.0,))


def test_default_force_estimator_and_power_have_the_highest_mean_score(monkeypatch):
    shipped = load_universal()
    model = PriorModel(new_map(shipped.tables), shipped.networks)
    prior = SkinPrior(NOMINAL_NAME, NOMINAL, NOMINAL_SPREADS, SETUP)
    scores: dict[tuple[float, str], list[float]] = {}
    for scale in SCALES:
        skins = draw_prior_skins(prior, SKINS_N, 77, f"force power {scale}", law_error(scale))
        for i in range(SKINS_N):
            order = rng_for(i, "force power").permutation(skins.db_uT.shape[1])
            parts = (part[i][order].astype(float) for part in (skins.place_mm, skins.force_N, skins.db_uT))
            presses = LabelledPresses(*parts)
            pool_uT = presses.db_uT[:PLACES_N]
            calibration = model.calibrate(CalibrationData(skins.rest_uT[i].astype(float), pool_uT, area_uT=pool_uT))
            tested = presses[np.arange(len(presses) - TESTED_N, len(presses))]
            for power in POWERS:
                monkeypatch.setattr(universal, "FORCE_POWER", power)
                for n in LABELS_N:
                    labels = presses[np.arange(PLACES_N, PLACES_N + n)]
                    for estimator, score in scores_by_estimator(calibration, labels, tested).items():
                        scores.setdefault((scale, n, power, estimator), []).append(score)
    print()
    for (scale, n, power, estimator), of_skins in sorted(scores.items()):
        print(
            f"law errors x {scale:g}, {n} labels, power {power:g}, {estimator}: median R2 of F {median(of_skins):.3f}"
        )
    means = {
        (power, estimator): np.mean([
            median(of_skins) for (_, _, own, name), of_skins in scores.items() if (own, name) == (power, estimator)
        ])
        for power in POWERS for estimator in ESTIMATORS
    }  # fmt: skip
    for (power, estimator), mean in means.items():
        print(f"mean over the rows above: power {power:g}, {estimator}: {mean:.3f}")
    assert np.isfinite([*means.values()]).all()
    if FULL:
        assert max(means, key=means.__getitem__) == (FORCE_POWER, DEFAULT)


def scores_by_estimator(
    calibration: PressCalibration, labels: LabelledPresses, tested: LabelledPresses
) -> dict[str, float]:
    """Return R2 of F of each estimator, with a line that is fitted to the labels."""
    folds = list(calibration.held_out(labels))
    true_log_N = np.log(np.concatenate([fold.labels.force_N for fold in folds]))
    of_labels = [np.concatenate(parts) for parts in zip(*(fold.evaluation.log_forces() for fold in folds), strict=True)]
    of_tested = calibration.with_labels(labels).evaluate(tested.db_uT).log_forces()
    scores = {}
    for estimator, label_log_N, tested_log_N in zip(ESTIMATORS, of_labels, of_tested, strict=True):
        line = prior_line(estimator).condition(label_log_N, true_log_N)
        scores[estimator] = r2(np.exp(line.apply(tested_log_N)[0]), tested.force_N)
    return scores
