"""Tests of how the model finds the orientation of a skin on its board, and whether the axes of labels are wrong."""

from functools import cache, partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from reskin import io
from reskin.errors import SchemaError
from reskin.live.tracker import UniversalEstimator
from reskin.physics import magnet
from reskin.seeds import rng_for
from reskin.universal.law import to_chips
from reskin.universal.map import NOMINAL, NOMINAL_SPREADS, Estimate, OFFSET_uT
from reskin.universal.model import Universal, load_universal
from reskin.universal.mounting import LABELS_MIN_N, LOG_ODDS_MIN, find_label_frame, find_mounting, frames
from reskin.universal.population import Population, draw_population
from tests.universal.skins import SETUP

TABLES = load_universal().tables
SKINS_N = 20
PLACES_MM = np.array([[5.0, 1.0], [-2.0, 6.0], [-4.0, -3.0], [1.0, -5.0]])


@cache
def skins() -> Population:
    """Draw simulated skins on the first call. If they were drawn at import, every test worker would draw them."""
    return draw_population(NOMINAL, NOMINAL_SPREADS, SETUP, SKINS_N, rng_for(0, "mounted"))


def skin(i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the no-load reading of a simulated skin, its readings in contact, their places and their forces.

    Readings are along the axes of the chips.
    """
    rest_uT, db_uT = to_chips(skins().rest_uT[i : i + 1]), to_chips(skins().db_uT[i])
    return rest_uT, rest_uT + db_uT, skins().place_mm[i] + 8.0, np.asarray(skins().force_N[i], float)


def test_log_odds_of_the_orientation_equal_the_ratio_of_densities():
    rest_uT = skins().rest_uT[0].astype(float)
    cov = TABLES.rest_slope_uT @ TABLES.rest_slope_uT.T + OFFSET_uT**2 * np.eye(15)
    log_p, log_p_turned = (multivariate_normal.logpdf(sign * rest_uT, TABLES.rest_uT, cov) for sign in (1, -1))
    found = find_mounting(TABLES, rest_uT)
    assert found.log_odds == pytest.approx(log_p - log_p_turned)
    assert found.probability == pytest.approx(np.exp(log_p) / (np.exp(log_p) + np.exp(log_p_turned)))


def test_orientations_of_all_simulated_skins_are_found():
    for rest_uT in skins().rest_uT.astype(float):
        found, turned = find_mounting(TABLES, rest_uT), find_mounting(TABLES, -rest_uT)
        assert (found.turned, turned.turned) == (False, True)
        assert found.log_odds == pytest.approx(turned.log_odds)
        assert found.log_odds > 0


def test_quarter_turn_of_the_simulated_skin_negates_its_field():
    """A quarter turn exchanges the poles of a checkerboard. A half turn changes nothing."""
    nodes_m, moments = SETUP.rest.nodes_m, np.array(SETUP.rest.moments_A_m2)
    middle_m = np.array([0, 0, SETUP.thickness_m / 2])
    chips_m = np.column_stack([SETUP.chips_mm, np.full(5, -1.6)]) * 1e-3

    def field(matrix) -> np.ndarray:
        turned_m = (nodes_m - middle_m) @ np.transpose(matrix) + middle_m
        return magnet.field(turned_m, np.asfortranarray(moments @ np.transpose(matrix)), chips_m)

    own = field(np.eye(3))
    # The tolerance is rounding, relative to the largest field.
    close = partial(np.testing.assert_allclose, atol=1e-9 * np.abs(own).max())
    close(field([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), -own)
    close(field(np.diag([-1.0, -1.0, 1.0])), own)
    upside_down = field(np.diag([1.0, -1.0, -1.0]))
    ratio = np.linalg.norm(upside_down) / np.linalg.norm(own)
    assert 1.2 < ratio < 1.5
    close(upside_down / ratio, own, rtol=0.2, atol=0.05 * np.abs(own).max())


def test_zero_noload_field_is_reported_as_fitting_both_orientations():
    found = find_mounting(TABLES, np.zeros(15))
    assert not found.turned
    assert found.log_odds == pytest.approx(0, abs=1e-9)
    assert "fits both orientations" in " ".join(found.warnings())


def test_wrong_orientation_that_the_user_states_is_reported():
    found = find_mounting(TABLES, skins().rest_uT[0].astype(float), turned=True)
    assert found.turned
    assert found.log_odds < -LOG_ODDS_MIN
    assert "fits the other orientation better" in " ".join(found.warnings())
    assert found.warnings(turnable=False) == []


def test_turned_skin_has_the_same_estimates():
    rest_uT, b_uT, place_mm, force_N = skin(0)
    own, turned = load_universal(), load_universal()
    for model, sign in ((own, 1), (turned, -1)):
        model.zero(sign * rest_uT).see(sign * b_uT[:20]).label(place_mm[20:30], force_N[20:30], sign * b_uT[20:30])
    assert (own.mounting.turned, turned.mounting.turned) == (False, True)
    assert "turned by a quarter" in repr(turned)
    assert turned.warnings == own.warnings == []
    np.testing.assert_array_equal(turned.predict(-b_uT), own.predict(b_uT))
    np.testing.assert_array_equal(turned.noload_uT, -own.noload_uT)


def test_orientation_stated_by_the_user_is_used_and_kept():
    rest_uT, b_uT, *_ = skin(0)
    model = load_universal().zero(rest_uT, turned=True).see(b_uT[:12])
    assert model.mounting.turned
    assert "fits the other orientation better" in " ".join(model.warnings)
    assert model.zero(rest_uT, keep=True).mounting.turned
    with pytest.raises(SchemaError, match="calibration to keep is of a skin in the other orientation"):
        model.zero(rest_uT, keep=True, turned=False)
    # Without `keep`, the model finds the orientation again from the new no-load reading.
    assert not model.zero(rest_uT).mounting.turned


def test_each_no_load_reading_determines_the_orientation_unless_the_user_states_it():
    rest_uT, *_ = skin(0)
    # The orientation is found again, because the second reading may be of another skin.
    assert not load_universal().zero(-rest_uT).zero(rest_uT, keep=True).mounting.turned
    assert load_universal().zero(-rest_uT, turned=True).zero(rest_uT, keep=True).mounting.turned


def test_skin_is_assumed_turned_only_if_the_evidence_is_strong():
    weak_uT = -0.1 * skins().rest_uT[0].astype(float)
    found = find_mounting(TABLES, weak_uT)
    # The turned orientation is more probable, but the log odds are below the limit at which a skin is assumed turned.
    assert 0 < -found.log_odds < LOG_ODDS_MIN
    assert not found.turned


def test_only_square_checkerboards_with_an_even_number_of_magnets_can_be_turned():
    shipped = load_universal()
    rest_uT, *_ = skin(0)
    for change in ({"polarity": "same"}, {"size_mm": (15.0, 15.0)}, {"size_mm": (20.0, 25.0)}):
        layout = shipped.layout.model_copy(update={"skin": shipped.layout.skin.model_copy(update=change)})
        model = Universal(shipped.tables, shipped.networks, shipped.powers, layout)
        assert not model.turnable
        assert not model.zero(-rest_uT).mounting.turned
        with pytest.raises(SchemaError, match="quarter turn does not reverse the fields of skin reskin"):
            model.zero(rest_uT, turned=True)


def test_unusual_noload_field_is_reported():
    rest_uT, *_ = skin(0)
    model = load_universal()
    assert model.warnings == []  # There is no warning before the first no-load reading.
    assert "the no-load field is unlike" in " ".join(model.zero(5 * rest_uT).warnings)


def test_orientation_is_saved_and_loaded(tmp_path):
    rest_uT, b_uT, *_ = skin(1)
    file = tmp_path / "s.safetensors"
    model = load_universal().zero(-rest_uT).see(-b_uT[:12])
    model.save(file)
    loaded = load_universal(file)
    assert loaded.mounting.turned
    np.testing.assert_allclose(loaded.predict(-b_uT[12:]), model.predict(-b_uT[12:]), rtol=1e-5)
    tensors, metadata = io.read_tensors(file)
    # Skin files of format 2 do not contain the orientation.
    io.write_tensors(file, tensors, {"format": "reskin-skin-2"})
    assert not load_universal(file).mounting.turned
    io.write_tensors(file, tensors, {**metadata, "turned": "perhaps"})
    with pytest.raises(SchemaError, match="turned must be true or false; got perhaps"):
        load_universal(file)


def test_mounting_before_the_noload_reading_is_refused():
    with pytest.raises(SchemaError, match="mounting: the model has no no-load reading"):
        _ = load_universal().mounting


@pytest.mark.parametrize("frame", list(frames()))
def test_warning_names_the_wrong_axes_of_labels(frame):
    estimate = Estimate(PLACES_MM + 0.4, np.full((4, 2), 0.6), np.ones(4), np.ones(4), np.full(4, np.nan))
    # Row vectors times a matrix are the places turned by the inverse of this matrix, because the inverse of an
    # orthogonal matrix is its transpose.
    given_mm = PLACES_MM @ frames()[frame]
    found = find_label_frame(estimate, given_mm)
    if frame == "as given":
        assert found.log_odds < 0
        assert found.warning() is None
    else:
        assert found.name == frame
        assert f"if the labelled places are {frame}" in found.warning()


@pytest.mark.parametrize(
    ("given", "name"),
    [
        (lambda x, y: (-x, y), "mirrored in x"), (lambda x, y: (x, -y), "mirrored in y"),
        (lambda x, y: (y, x), "mirrored at the line x = y"), (lambda x, y: (-y, -x), "mirrored at the line x = -y"),
        (lambda x, y: (-x, -y), "turned by 180°"),
        # The name says how to turn the labels back: labels that were turned clockwise must be turned counterclockwise.
        (lambda x, y: (y, -x), "turned by 90°"), (lambda x, y: (-y, x), "turned by 270°"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_wrong_axes_of_labels_are_found_and_named(given, name):
    estimate = Estimate(PLACES_MM, np.full((4, 2), 0.6), np.ones(4), np.ones(4), np.full(4, np.nan))
    found = find_label_frame(estimate, np.array([given(*place_mm) for place_mm in PLACES_MM]))
    assert found.name == name


def test_possible_label_axes_are_the_eight_symmetries_of_a_square():
    matrices = np.array([*frames().values()])
    np.testing.assert_array_equal(matrices @ matrices.transpose(0, 2, 1), np.tile(np.eye(2), (8, 1, 1)))
    assert len(np.unique(matrices.reshape(8, 4), axis=0)) == 8
    assert (np.linalg.det(matrices) > 0).sum() == 4


@given(st.integers(0, SKINS_N - 1))
def test_labels_with_correct_axes_raise_no_warning(i):
    rest_uT, b_uT, place_mm, force_N = skin(i)
    model = load_universal().zero(rest_uT).label(place_mm[:5], force_N[:5], b_uT[:5])
    assert model.label_frame.warning() is None


def test_axes_of_too_few_labels_are_not_checked():
    rest_uT, b_uT, place_mm, force_N = skin(0)
    few = slice(LABELS_MIN_N - 1)
    assert load_universal().zero(rest_uT).label(place_mm[few], force_N[few], b_uT[few]).label_frame is None


def test_mirrored_labels_raise_a_warning_in_python_and_on_the_live_page():
    rest_uT, b_uT, place_mm, force_N = skin(2)
    mirrored_mm = place_mm[:6] * (-1, 1) + (16, 0)
    model = load_universal().zero(rest_uT).label(mirrored_mm, force_N[:6], b_uT[:6])
    assert model.label_frame.name == "mirrored in x"
    assert any("mirrored in x" in warning for warning in model.warnings)
    estimator = UniversalEstimator(load_universal())
    estimator.set_noload(rest_uT)
    assert estimator.warnings == []
    db_uT = (b_uT - rest_uT)[:6]
    estimator.label(mirrored_mm, db_uT, np.arange(6) == 5)
    assert any("mirrored in x" in warning for warning in estimator.warnings)
