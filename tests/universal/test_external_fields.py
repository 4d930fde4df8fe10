"""Tests of the option `external_uT` of the universal model, which allows for magnetic fields from outside the skin."""

import numpy as np
import pytest

import reskin
from reskin import load_universal
from reskin.errors import SchemaError
from reskin.universal.law import to_board, to_chips
from reskin.universal.map import NOISE_uT, new_map
from reskin.universal.model import EXTERNAL_MAX_uT, Universal
from tests.universal.skins import make_tables
from tests.universal.test_shipped import PLACES_MM, pokes

UNIFORM_uT = to_chips(np.tile(100.0 * np.array([[0.0, 1.0, 0.0], [0.6, 0.0, -0.8], [-1.0, 0.0, 0.0]]), 5))

# This is the index of the force of all pokes. At this force, field changes have norms of 220 to 410 uT over all
# channels. The norm of each uniform field is 224 uT.
FORCE_I = 4


def nominal(external_uT: float) -> tuple[Universal, np.ndarray]:
    """Return the model after its no-load reading on its nominal skin, and the readings of four pokes on this skin."""
    model = load_universal(external_uT=external_uT)
    rest_uT = to_chips(model.tables.rest_uT[None])
    return model.zero(rest_uT), pokes(model, FORCE_I) + rest_uT


def moved_mm(model: Universal, b_uT: np.ndarray) -> np.ndarray:
    """Return the distances in mm by which uniform fields move the estimated places, as an array [field, poke]."""
    before_mm = model.estimate(b_uT).place_mm
    after_mm = np.stack([model.estimate(b_uT + uniform_uT).place_mm for uniform_uT in UNIFORM_uT])
    return np.linalg.norm(after_mm - before_mm, axis=2)


def test_uniform_field_of_100_uT_does_not_move_estimates_with_option_external_uT():
    with_mm, without_mm = moved_mm(*nominal(100.0)), moved_mm(*nominal(0.0))
    assert with_mm.max() < 0.2
    assert without_mm.max() > 1.0


def test_estimates_in_changing_fields_are_more_accurate_with_option_external_uT():
    places = np.column_stack([np.random.default_rng(0).uniform(3, 13, (40, 2)), np.full(40, 1.0)])
    noload_uT, b_uT, _ = reskin.simulate_pokes(reskin.draw_skin(seed=3), places, seed=3)
    uniform_uT = 100 * np.random.default_rng(1).standard_normal((40, 3))
    moving_uT = b_uT + to_chips(np.tile(uniform_uT, 5))

    def error_mm(external_uT: float, readings_uT: np.ndarray) -> float:
        found = load_universal(external_uT=external_uT).zero(noload_uT).predict(readings_uT)
        return float(np.median(np.linalg.norm(found[:, :2] - places[:, :2], axis=1)))

    assert error_mm(100.0, moving_uT) < error_mm(0.0, moving_uT)
    # If there are no external fields, the option makes estimates less accurate, because a part of each field change is
    # attributed to external fields.
    assert error_mm(0.0, b_uT) < error_mm(100.0, b_uT)


def test_place_uncertainty_grows_with_the_assumed_external_field():
    sd_mm = [model.estimate(b_uT).sd_mm.mean() for model, b_uT in map(nominal, (0.0, 30.0, 140.0))]
    assert sd_mm[0] < sd_mm[1] < sd_mm[2]


def test_labels_reduce_the_effect_of_external_fields_on_the_likelihood_power():
    powers = {}
    for external_uT in (0.0, 30.0, 140.0):
        model, b_uT = nominal(external_uT)
        powers[external_uT, 0] = model.power
        powers[external_uT, 4] = model.label(PLACES_MM, np.full(4, model.tables.force_N[FORCE_I]), b_uT).power
    assert powers[0.0, 0] > powers[30.0, 0] > powers[140.0, 0]
    ratio = {n: powers[140.0, n] / powers[0.0, n] for n in (0, 4)}
    assert ratio[4] > ratio[0]


def test_estimated_external_field_is_close_to_the_true_one():
    model, b_uT = nominal(100.0)
    db_uT = to_board(b_uT - model.noload_uT)
    uniform_uT = to_board(UNIFORM_uT[:1])
    evaluator = model.skin.evaluator
    cleaned_uT = [
        evaluator.without_external(read_uT, evaluator.evaluate(read_uT)) for read_uT in (db_uT, db_uT + uniform_uT)
    ]
    # Less than a tenth of the 224 uT remains. The estimate cannot be exact, because a part of the field is attributed
    # to noise.
    assert np.linalg.norm(cleaned_uT[1] - cleaned_uT[0], axis=1).max() < 0.1 * np.linalg.norm(uniform_uT)


def test_model_makes_no_allowance_for_external_fields_without_option_external_uT():
    skin = new_map(make_tables())
    db_uT = np.random.default_rng(0).normal(0, 300, (3, 15))
    assert skin.evaluator.without_external(db_uT, skin.evaluator.evaluate(db_uT)) is db_uT
    np.testing.assert_array_equal(skin.hypotheses.noise_cov, NOISE_uT**2 * np.eye(15))
    assert load_universal().external_cov is None
    assert "external" not in repr(load_universal())


def test_calibration_file_can_be_used_with_option_external_uT(tmp_path):
    """The calibration is saved without the option, and loaded with it."""
    model, b_uT = nominal(0.0)
    model.see(b_uT).save(tmp_path / "skin.safetensors")
    loaded = load_universal(tmp_path / "skin.safetensors", external_uT=100.0)
    assert loaded.presses_n == len(b_uT)
    assert loaded.external_uT == 100.0
    assert moved_mm(loaded, b_uT).max() < 0.5


@pytest.mark.parametrize("wrong", [-1.0, np.nan, np.inf, EXTERNAL_MAX_uT + 1])
def test_external_field_of_invalid_size_is_refused(wrong):
    with pytest.raises(SchemaError, match=r"external_uT must be 0 to 1,000 uT"):
        load_universal(external_uT=wrong)


def test_suppressor_removes_uniform_fields_given_along_the_axes_of_the_chips():
    assert load_universal().suppressor(4.0) is None
    shrunk_uT = UNIFORM_uT @ load_universal(external_uT=100.0).suppressor(4.0)
    # The suppressor whitens the sum of field and noise. A field of one standard deviation becomes at most about as long
    # as the noise of one chip along its three axes.
    assert np.linalg.norm(shrunk_uT, axis=1).max() < 2 * 4.0


def test_chi2_in_single_precision_is_accurate_for_the_largest_external_field():
    """chi^2 for the largest external field equals chi^2 in double precision, up to 0.1 or 1 %."""
    model, b_uT = nominal(EXTERNAL_MAX_uT)
    db_uT, skin = to_board(b_uT - model.noload_uT), model.skin
    chi2, h = skin.evaluator.evaluate(db_uT).chi2, slice(None, None, 97)
    mean_uT, slope_uT = (part[h].astype(float) for part in (skin.hypotheses.mean_uT, skin.hypotheses.slope_uT))
    mean_uT = mean_uT + slope_uT @ skin.mean
    error_cov = (mean_uT**2).sum(axis=1)[:, None, None] * skin.error_cov
    cov = slope_uT @ skin.cov @ slope_uT.swapaxes(1, 2) + error_cov + skin.hypotheses.noise_cov
    off_uT = db_uT[:, None] - mean_uT
    expected = np.einsum("nhi,hij,nhj->nh", off_uT, np.linalg.inv(cov), off_uT)
    np.testing.assert_allclose(chi2[:, h], expected, rtol=0.01, atol=0.1)
