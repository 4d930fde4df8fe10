"""Tests of the estimators: scikit-learn's conventions, and equality with the project's training and calibration."""

import warnings

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.model_selection import GroupKFold, cross_validate
from sklearn.utils.estimator_checks import check_estimator

import reskin
from reskin import metrics
from reskin.config import parse
from reskin.errors import ParamsError, SchemaError
from reskin.models.job import TrainingData, TrainingJob
from reskin.models.recipe import Recipe
from reskin.models.train import train_stack
from tests.models.example_jobs import some_rows

ROUNDING = "in single precision, the rounding of a prediction depends on the other rows of the same call"
CONTACT_FAILS = dict.fromkeys(["check_methods_sample_order_invariance", "check_methods_subset_invariance"], ROUNDING)
TITLES = {"steps_n": 4, "batch_n": 16}


def test_estimator_passes_the_checks_of_scikit_learn():
    estimator, fails = reskin.ContactRegressor(steps_n=15), CONTACT_FAILS
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # scikit-learn warns of the checks that it skips
        checks = check_estimator(estimator, expected_failed_checks=fails, on_skip=None)
    assert {check["check_name"] for check in checks if check["status"] == "xfail"} == set(fails)
    assert sum(check["status"] == "passed" for check in checks) > 15


def poke_rows(n: int = 48, board: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return field changes [n 15] and smooth targets [n 3]."""
    return some_rows(n, board)


def network_of(regressor: reskin.ContactRegressor) -> dict[str, np.ndarray]:
    return dict(regressor.network_.tensors)


@pytest.mark.parametrize("triplet_weight", [0.0, 0.1])
def test_network_equals_that_of_the_training_loop_bit_for_bit(triplet_weight):
    X, y = poke_rows()
    skin = np.repeat(["s0", "s1"], len(X) // 2)
    regressor = reskin.ContactRegressor(**TITLES, triplet_weight=triplet_weight, random_state=3)
    recipe = parse(Recipe, {name: getattr(regressor, name) for name in Recipe.model_fields}, "test")
    job = TrainingJob("lobo", "paper", recipe, "all", 3, 0, np.arange(len(X)), np.arange(len(X)))
    (expected,) = train_stack([job], TrainingData(X, y, skin))

    regressor.fit(X, y, skin=skin)

    tensors = dict(expected.weights) | expected.scaler.arrays()
    assert tensors.keys() == network_of(regressor).keys()
    assert all((tensors[name] == values).all() for name, values in network_of(regressor).items())
    assert regressor.loss_curve_ == expected.curve
    np.testing.assert_array_equal(regressor.predict(X), expected.predicted)
    from_grid = clone(regressor).set_params(steps_n=np.int64(4), rate_max=np.float64(regressor.rate_max))
    np.testing.assert_array_equal(from_grid.fit(X, y, skin=skin).predict(X), expected.predicted)
    other_seed = clone(regressor).set_params(random_state=4).fit(X, y, skin=skin)
    assert (other_seed.predict(X) != expected.predicted).all()


def test_scores_of_cross_validation_over_boards_equal_the_metrics_of_the_project():
    X, y = (np.concatenate(parts) for parts in zip(*[poke_rows(board=i) for i in range(3)], strict=True))
    board, regressor = np.repeat(["b0", "b1", "b2"], 48), reskin.ContactRegressor(**TITLES)
    y[::7, 2] = np.nan  # some forces are unknown

    results = cross_validate(regressor, X, y, groups=board, cv=GroupKFold(3), scoring=reskin.SCORERS)

    for i, (train, test) in enumerate(GroupKFold(3).split(X, y, board)):
        assert set(board[train]).isdisjoint(board[test])
        scores = metrics.score(y[test], clone(regressor).fit(X[train], y[train]).predict(X[test]))
        for name, sign in (("accuracy_pct", 1), ("neg_mse_xy_mm2", -1), ("neg_mse_f_N2", -1), ("r2_f", 1)):
            assert results[f"test_{name}"][i] == sign * scores[name.removeprefix("neg_")]


def test_saved_network_is_loaded_as_a_model(tmp_path):
    X, y = poke_rows()
    regressor = reskin.ContactRegressor(**TITLES, inputs="shape").fit(X, y)
    regressor.save(tmp_path / "mine.safetensors")
    model = reskin.load_model(tmp_path / "mine.safetensors").zero(np.zeros(15))
    np.testing.assert_array_equal(model.predict(X), regressor.predict(X))
    with pytest.raises(SchemaError, match="a saved network must be for 3 channels per chip"):
        reskin.ContactRegressor(**TITLES).fit(X[:, :14], y).save(tmp_path / "other.safetensors")
    with pytest.raises(ParamsError, match=r"ends in .safetensors; got mine. Try: mine.safetensors"):
        regressor.save(tmp_path / "mine")
    assert {file.name for file in tmp_path.iterdir()} == {"mine.safetensors", "mine.json"}
