"""Tests of calibrations over several days: the algebra, the decision whether the slide has changed, and saved files.

The slide is how far the skin slides on its base under presses. It can change from one day to the next.
"""

from dataclasses import replace

import numpy as np
import pytest

from reskin import io
from reskin.errors import ParamsError, SchemaError
from reskin.predicting import read_models
from reskin.seeds import rng_for
from reskin.universal import calibration, map
from reskin.universal.calibration import (
    CalibrationData,
    LabelledPresses,
    is_calibration,
    read_calibration,
    write_calibration,
)
from reskin.universal.law import to_chips
from reskin.universal.map import (
    OFFSET_uT,
    begin_day,
    condition_on_labels,
    condition_on_noload,
    interpolate,
    kernel,
    new_map,
)
from reskin.universal.model import Slide, Universal, load_universal
from reskin.universal.network import FULL_SET_N
from reskin.universal.population import grid
from tests.universal.skins import REST_SLOPE_uT, make_tables, poked_uT

# The tests of the algebra use three parameters. The third one stands for the slide, which may change between days.
NAMES = (
    "label_x_mm",
    "label_y_mm",
    "away_um_mm",
)


@pytest.fixture(scope="module")
def skin_map() -> map.SkinMap:
    return new_map(replace(make_tables(), names=NAMES))


@pytest.fixture
def skin() -> Universal:
    return load_universal()


def labelled_presses(presses_n=9):
    """Return places, forces and field changes of labelled presses.

    The last array says how many days ago each press was made (0, 1 or 2).
    """
    rng = rng_for(0, "days")
    place_mm, force_N = rng.permutation(grid())[:presses_n], np.exp(rng.uniform(np.log(0.7), np.log(8), presses_n))
    db_uT = poked_uT(place_mm, force_N, np.array([0.5, -0.5, 1.0])) + rng.normal(0, 20, (presses_n, 15))
    return place_mm, force_N, db_uT, np.arange(presses_n) % 3


def test_conditioning_on_three_days_equals_conditioning_of_a_joint_gaussian(skin_map, monkeypatch):
    monkeypatch.setattr(map, "SLIDE_CORRELATION", 0.4)
    place_mm, force_N, db_uT, days_ago = labelled_presses()
    rest_uT = rng_for(1, "rest").normal(0, 300, 15)
    found = condition_on_labels(
        begin_day(begin_day(condition_on_noload(skin_map, rest_uT))), place_mm, force_N, db_uT, days_ago
    )

    # Reference: Gaussian conditioning with the full covariance. There are five unknowns: two parameters that are
    # constant, and the slide of today, of yesterday and of two days ago. The no-load field was read two days ago.
    prior = np.eye(5)
    prior[2:, 2:] = [[1, 0.4, 0.16], [0.4, 1, 0.4], [0.16, 0.4, 1]]
    mean_uT, slope_uT, _ = interpolate(skin_map, place_mm, force_N)
    magnitude_uT = np.linalg.norm(mean_uT, axis=1)
    row, value = [], []
    for press in range(len(place_mm)):
        own = np.zeros((15, 5))
        own[:, [0, 1, 2 + days_ago[press]]] = slope_uT[press] / magnitude_uT[press]
        row.append(own)
        value.append((db_uT[press] - mean_uT[press]) / magnitude_uT[press])
    rest_row = np.zeros((15, 5))
    rest_row[:, [0, 1, 4]] = REST_SLOPE_uT
    k = kernel(place_mm, place_mm, np.log(force_N), np.log(force_N))
    k = k * map.ERROR_CORRELATION ** np.abs(np.subtract.outer(days_ago, days_ago))
    noise = np.zeros((15 * 10, 15 * 10))
    noise[:135, :135] = np.kron(k + skin_map.residual.noise * np.eye(9), skin_map.error_cov)
    noise[135:, 135:] = OFFSET_uT**2 * np.eye(15)
    rows, values = np.concatenate([*row, rest_row]), np.concatenate([*value, rest_uT])
    gain = prior @ rows.T @ np.linalg.inv(rows @ prior @ rows.T + noise)
    np.testing.assert_allclose(found.mean, gain @ values, atol=1e-9)
    np.testing.assert_allclose(found.cov, prior - gain @ rows @ prior, atol=1e-9)
    np.testing.assert_array_equal(found.current[0], found.mean[:3])


def test_calibration_over_several_unchanged_days_equals_that_of_a_single_day(skin_map, monkeypatch):
    place_mm, force_N, db_uT, days_ago = labelled_presses()
    at_once = condition_on_labels(skin_map, place_mm, force_N, db_uT)
    # With a correlation of exactly 1, the covariance of the slides cannot be inverted.
    monkeypatch.setattr(map, "SLIDE_CORRELATION", 1 - 1e-8)
    monkeypatch.setattr(map, "ERROR_CORRELATION", 1.0)
    by_day = condition_on_labels(begin_day(begin_day(skin_map)), place_mm, force_N, db_uT, days_ago)
    np.testing.assert_allclose(by_day.current[0], at_once.mean, atol=1e-5)
    np.testing.assert_allclose(by_day.current[1], at_once.cov, atol=1e-5)
    one, other = (each.evaluator.estimate(db_uT) for each in (at_once, by_day))
    # The tolerance in mm is the effect of rounding, because deviances are in single precision.
    np.testing.assert_allclose(one.place_mm, other.place_mm, atol=1e-3)


def test_beginning_a_new_day_resets_the_slide_and_no_other_parameter(skin_map):
    known = condition_on_labels(skin_map, *labelled_presses()[:3])
    after, (mean, cov) = replace(known, labelled=None), begin_day(known).current
    np.testing.assert_array_equal(mean[:2], after.mean[:2])
    np.testing.assert_array_equal(cov[:2, :2], after.cov[:2, :2])
    assert mean[2] == 0
    assert cov[2].tolist() == [0, 0, 1]


def pokes(skin, shift=None, force_i=3):
    """Return the field changes of presses at 16 places, along the axes of the chips.

    `shift` gives, by name of a parameter, its difference from the prior mean in standard deviations.
    """
    at, tables = np.ix_([4, 9, 14, 19], [4, 9, 14, 19]), skin.tables
    slope_uT = tables.slope_uT[at][:, :, force_i]
    change = sum(by * slope_uT[..., tables.names.index(name)] for name, by in (shift or {}).items())
    return to_chips((tables.mean_uT[at][:, :, force_i] + change).reshape(16, -1))


OTHER_SLIDE = {"give_x_um": 2.5, "away_um_mm": -2.0}
PLACES_MM = np.array([[4.0, 4.0], [4.0, 12.0], [12.0, 4.0], [12.0, 12.0], [8.0, 8.0]])


@pytest.fixture
def first_day(skin, tmp_path):
    """Return a no-load reading, and the file in which the presses and labels of the first day are saved."""
    rest_uT, file = to_chips(skin.tables.rest_uT[None]), tmp_path / "first.safetensors"
    pressed_uT = pokes(skin) + rest_uT
    skin.zero(rest_uT).see(pressed_uT)
    axis_mm = skin.tables.axis_mm[[4, 9, 14, 19]] + 8
    place_mm = np.stack(np.meshgrid(axis_mm, axis_mm, indexing="ij"), axis=-1).reshape(-1, 2)
    skin.label(place_mm[::3], np.full(6, skin.tables.force_N[3]), pressed_uT[::3]).save(file)
    return rest_uT, file


def test_model_finds_from_presses_of_a_new_day_whether_the_slide_has_changed(skin, first_day):
    rest_uT, file = first_day
    same_uT, changed_uT = pokes(skin)[:5] + rest_uT, pokes(skin, OTHER_SLIDE)[:5] + rest_uT
    assert load_universal(file).slide is None
    later = load_universal(file, new_day=True).zero(rest_uT, keep=True)
    assert later.slide == Slide(same=False, log_odds=0.0)
    assert later.see(same_uT).slide.same
    # If the slide is the same, the presses of both days are used together, as if they had been made on one day.
    together = load_universal(file).zero(rest_uT, keep=True)
    data = replace(together._data, presses_uT=np.concatenate([together._data.presses_uT, together._change(same_uT)]))
    expected = together._begin(data).estimate(changed_uT)
    for found, value in zip(vars(later.estimate(changed_uT)).values(), vars(expected).values(), strict=True):
        np.testing.assert_array_equal(found, value)
    other = load_universal(file, new_day=True).zero(rest_uT, keep=True).see(changed_uT)
    assert not other.slide.same
    assert other.slide.log_odds < -10
    off_mm = [
        np.abs(
            each.predict(pokes(skin, OTHER_SLIDE) + rest_uT)[:, :2] - skin.predict(pokes(skin) + rest_uT)[:, :2]
        ).mean()
        for each in (other, together)
    ]
    assert off_mm[0] < off_mm[1]
    # Presses that are made later on the same day can change the decision.
    assert not later.see(np.concatenate([changed_uT, changed_uT])).slide.same
    assert "earlier days: 1, 15 presses at unknown places, 0 labelled" in repr(later)


def test_order_of_presses_and_labels_of_a_new_day_does_not_matter(skin, first_day):
    rest_uT, file = first_day
    for shift in ({}, OTHER_SLIDE):
        read_uT = pokes(skin, shift) + rest_uT
        labels = PLACES_MM, np.full(5, 1.5), read_uT[[0, 3, 12, 15, 5]]
        one, other = (load_universal(file, new_day=True).zero(rest_uT, keep=True) for _ in range(2))
        one.see(read_uT).label(*labels)
        if shift:
            other.label(*labels).see(read_uT[::-1])
        # If the slide is unchanged, presses are added to those of the first day. The order of the two calls then
        # matters, so only the order of the presses is reversed.
        else:
            other.see(read_uT[::-1]).label(*labels)
        assert one.slide.same == other.slide.same == (not shift)
        assert one.slide.log_odds == pytest.approx(other.slide.log_odds, rel=1e-6)
        for found, value in zip(
            vars(one.estimate(read_uT)).values(), vars(other.estimate(read_uT)).values(), strict=True
        ):
            # The tolerance is the rounding of sums, which are in single precision.
            np.testing.assert_allclose(found, value, rtol=2e-3)


def test_calibrations_of_several_days_are_saved_and_loaded(skin, first_day, tmp_path):
    rest_uT, file = first_day
    changed_uT, later_file = pokes(skin, OTHER_SLIDE) + rest_uT, tmp_path / "later.safetensors"
    later = load_universal(file, new_day=True).zero(rest_uT + 5, keep=True).see(changed_uT, even=True)
    later.label(PLACES_MM[:2], None, changed_uT[[0, 3]]).save(later_file)
    again = load_universal(later_file)
    assert again.presses_n == later.presses_n == 16 + 6 + 16 + 2
    assert again.slide == later.slide
    for found, value in zip(
        vars(again.estimate(changed_uT)).values(), vars(later.estimate(changed_uT)).values(), strict=True
    ):
        np.testing.assert_allclose(found, value, rtol=1e-5)
    third = load_universal(later_file, new_day=True)
    assert "earlier days: 2" in repr(third)
    third.save(later_file)  # A day without presses is not saved.
    assert "earlier days: 2" in repr(load_universal(later_file, new_day=True))
    assert third.zero(rest_uT).presses_n == 0
    assert third.slide is None


def test_files_in_the_third_format_are_read_as_calibrations_of_one_day(skin, first_day):
    rest_uT, file = first_day
    tensors, header = io.read_tensors(file)
    assert header["format"] == "reskin-skin-4"
    io.write_tensors(file, tensors, header | {"format": "reskin-skin-3"})
    again = load_universal(file)
    assert again.slide is None
    for found, value in zip(
        vars(again.estimate(pokes(skin) + rest_uT)).values(),
        vars(skin.estimate(pokes(skin) + rest_uT)).values(),
        strict=True,
    ):
        np.testing.assert_allclose(found, value, rtol=1e-5)


def test_files_with_too_many_or_invalid_days_raise(first_day, monkeypatch):
    rest_uT, file = first_day
    with pytest.raises(SchemaError, match="new_day: there is no calibration of an earlier day"):
        load_universal(new_day=True)
    tensors, header = io.read_tensors(file)
    days = {f"earlier_{i}_{name}": values for i in range(4) for name, values in tensors.items()}
    io.write_tensors(file, tensors | days, header)
    # A new day begins, and the oldest of the five earlier days is dropped, because a calibration has at most five days.
    assert "earlier days: 4" in repr(load_universal(file, new_day=True))
    more = {f"earlier_4_{name}": values for name, values in tensors.items()}
    io.write_tensors(file, tensors | days | more, header)
    with pytest.raises(SchemaError, match="days must be at most 5 days with 2000 labels; got 6 with 36"):
        load_universal(file)
    io.write_tensors(file, tensors | {"earlier_1_rest_uT": tensors["rest_uT"]}, header)
    with pytest.raises(SchemaError, match="arrays must be rest_uT"):
        load_universal(file)
    io.write_tensors(file, tensors, header)
    monkeypatch.setattr(calibration, "LABELS_MAX_N", 10)
    later = load_universal(file, new_day=True)
    with pytest.raises(SchemaError, match="labels: 11 labels are too many"):
        later.label(PLACES_MM, np.ones(5), np.tile(rest_uT + 100, (5, 1)))
    assert later.presses_n == 22


def test_file_can_hold_the_greatest_number_of_days_and_labels_for_64_chips(tmp_path):
    channels_n, file = 3 * 64, tmp_path / "full.safetensors"
    full = CalibrationData.at_rest(np.zeros(channels_n))
    pressed_uT = np.ones((FULL_SET_N, channels_n))
    labels_n = calibration.LABELS_MAX_N // calibration.DAYS_MAX_N
    labels = LabelledPresses(np.zeros((labels_n, 2)), np.ones(labels_n), np.ones((labels_n, channels_n)))
    full = replace(full, presses_uT=pressed_uT, even_uT=pressed_uT, labels=labels)
    write_calibration(replace(full, earlier=(calibration.DAYS_MAX_N - 1) * (full,)), file, "large")
    assert is_calibration(file)
    again = read_calibration(file, np.array([[-10.0, -10.0], [10.0, 10.0]]), channels_n, "large")
    assert again.labels_n == calibration.LABELS_MAX_N
    assert again.presses_n == calibration.LABELS_MAX_N + calibration.DAYS_MAX_N * FULL_SET_N


def test_wrong_axes_of_the_labels_of_a_new_day_are_found(skin, first_day):
    """On the later day, all labels are mirrored. The correct labels of the first day must not hide this error."""
    rest_uT, file = first_day
    axis_mm = skin.tables.axis_mm[[4, 9, 14, 19]] + 8
    place_mm = np.stack(np.meshgrid(axis_mm, axis_mm, indexing="ij"), axis=-1).reshape(-1, 2)[[0, 3, 6, 9, 12]]
    for shift in ({}, OTHER_SLIDE):
        pressed_uT = pokes(skin, shift)[[0, 3, 6, 9, 12]] + rest_uT
        later = load_universal(file, new_day=True).zero(rest_uT, keep=True).see(pokes(skin, shift) + rest_uT)
        assert later.label_frame is None  # Labels of the later day have not been passed yet.
        assert later.label(place_mm, None, pressed_uT).label_frame.log_odds < 0
        assert later.slide.same == (not shift)
        assert later.label(place_mm * [1, -1] + [0, 16], None, pressed_uT).label_frame.log_odds > 5
        assert later.label_frame.name == "mirrored in y"
        assert later.labels_n == 6 + 5


@pytest.mark.parametrize("external_uT", [0.0, 30.0])
def test_turned_skin_has_the_same_estimates_on_a_new_day(skin, tmp_path, external_uT):
    """All fields of a turned skin have the opposite sign. If the model knows this, its estimates must not change."""
    rest_uT, file = to_chips(skin.tables.rest_uT[None]), tmp_path / "first.safetensors"
    changed_uT, found = pokes(skin, OTHER_SLIDE) + rest_uT, []
    for turned in (False, True):
        sign = -1 if turned else 1
        first = load_universal(external_uT=external_uT).zero(sign * rest_uT, turned=turned)
        first.see(sign * (pokes(skin) + rest_uT)).label([[4.0, 4.0]], 1.5, sign * (pokes(skin)[0] + rest_uT)).save(file)
        later = load_universal(file, external_uT=external_uT, new_day=True)
        later.zero(sign * rest_uT, keep=True).see(sign * changed_uT)
        assert not later.slide.same
        found.append((later.slide.log_odds, *vars(later.estimate(sign * changed_uT)).values()))
        with pytest.raises(SchemaError, match="of a skin in the other orientation"):
            later.zero(-sign * rest_uT, keep=True, turned=not turned)
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


def test_middle_of_the_skin_found_on_the_first_day_is_kept_on_a_new_day(skin, tmp_path):
    rest_uT, file = to_chips(skin.tables.rest_uT[None]), tmp_path / "first.safetensors"
    inner_uT, changed_uT = pokes(skin)[[5, 6, 9, 10]] + rest_uT, pokes(skin, OTHER_SLIDE) + rest_uT
    found_mm = []
    # All presses of the first day are on one side of the skin. Argument `even` nevertheless takes their mean place as
    # the middle of the skin, which shifts the estimates. The model must keep this shift on the new day.
    for even in (
        False,
        True,
    ):
        skin.zero(rest_uT).see(np.tile(pokes(skin)[[2, 3, 6, 7]] + rest_uT, (3, 1)), even=even).save(file)
        later = load_universal(file, new_day=True).zero(rest_uT, keep=True).see(changed_uT)
        assert not later.slide.same
        found_mm.append([each.predict(inner_uT)[:, :2].mean(axis=0) for each in (skin, later)])
    first_mm, later_mm = np.subtract(*found_mm)
    assert np.linalg.norm(first_mm) > 0.1
    np.testing.assert_allclose(later_mm, first_mm, atol=0.5 * np.linalg.norm(first_mm))


def test_command_line_option_new_day_begins_a_new_day(first_day):
    _, file = first_day
    assert read_models([file], new_day=True).slide == Slide(same=False, log_odds=0.0)
    with pytest.raises(ParamsError, match="--new-day: there is no calibration of an earlier day"):
        read_models([], new_day=True)
    with pytest.raises(ParamsError, match="later.safetensors: model file not found"):
        read_models([file.with_name("later.safetensors")], new_day=True)
