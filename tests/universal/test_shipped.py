"""Tests of the model shipped with the library: accuracy on simulated skins, alarms, labels, files, invalid input."""

import shutil

import numpy as np
import pytest

import reskin
from reskin import io
from reskin.config import parse
from reskin.errors import SchemaError
from reskin.layouts import PAPER, geometry
from reskin.physics import slide
from reskin.physics.board import BoardDesign, Spreads, draw_board
from reskin.physics.chip import ChipDesign, read_field
from reskin.physics.magnet import Quadrature
from reskin.physics.skin import SkinDesign, changes_of_field, draw_skin
from reskin.seeds import rng_for
from reskin.simulation import defaults
from reskin.universal.calibration import LABELS_MAX_N
from reskin.universal.episodes import NOISE_uT
from reskin.universal.model import FILE, Universal, folds_of, load_universal, thin
from tests.universal.skins import draw

CHANNELS_N = 15

PARAMS = {name: defaults.nominal(name) for name in defaults.SHARED}
PARAMS_SKIN, SPREADS = parse(SkinDesign, PARAMS["skin"], "skin"), parse(Spreads, PARAMS["spreads"], "spreads")
CHIP = parse(ChipDesign, PARAMS["chip"], "chip")
RIGID = parse(BoardDesign, geometry(PAPER)["design"], "layout")
SEEN_N, LABELS_N, TESTED = 65, 20, slice(85, None)


@pytest.fixture
def model() -> Universal:
    return load_universal()


def calibrated(model, skin, seen_n=SEEN_N, labels_n=0):
    model.zero(skin.rest_uT).see(skin.b_uT[:seen_n])
    if labels_n:
        labels = slice(SEEN_N, SEEN_N + labels_n)
        model.label(skin.place_mm[labels], skin.force_N[labels], skin.b_uT[labels])
    return model


def test_errors_on_new_simulated_skins_shrink_with_what_is_known(model):
    skins = draw(12)

    def error_mm(**known):
        found = [calibrated(model, skin, **known).predict(skin.b_uT[TESTED])[:, :2] for skin in skins]
        off_mm = [skin.place_mm[TESTED] - place_mm for skin, place_mm in zip(skins, found, strict=True)]
        return np.linalg.norm(off_mm, axis=-1).mean()

    nothing_mm, seen_mm, labelled_mm = error_mm(seen_n=0), error_mm(), error_mm(labels_n=LABELS_N)
    assert nothing_mm < 1.5
    assert seen_mm < 0.8 * nothing_mm
    assert labelled_mm < 0.95 * seen_mm


def test_estimates_say_whether_anything_touches_the_skin(model):
    (skin,) = draw(1)
    quiet_uT = skin.rest_uT + 0.5 * rng_for(0, "quiet").standard_normal((200, 15))
    untouched_uT = skin.rest_uT + 0.5 * rng_for(1, "quiet").standard_normal((200, 15))
    model.zero(quiet_uT)
    assert model.estimate(skin.b_uT).contact.mean() > 0.95
    assert model.estimate(untouched_uT).contact.mean() < 0.01
    assert model.zero(quiet_uT[0]).estimate(skin.b_uT).contact is None  # the noise is unknown


def test_intervals_cover_most_true_values(model):
    covered = []
    for skin in draw(12):
        for labels_n in (0, LABELS_N):
            found = calibrated(model, skin, labels_n=labels_n).estimate(skin.b_uT[TESTED])
            place = (np.abs(found.place_mm - skin.place_mm[TESTED]) <= 1.645 * found.sd_mm).mean()
            covered.append((place, (np.abs(found.force_N - skin.force_N[TESTED]) <= 1.645 * found.sd_N).mean()))
    assert (np.mean(covered, axis=0) > 0.8).all()


def test_known_skins_cause_no_alarm_and_wrong_ones_do(model):
    skins = draw(12)
    assert sum(bool(calibrated(model, skin, labels_n=10).warnings) for skin in skins) <= 1
    first, by_chip = skins[0], np.arange(CHANNELS_N).reshape(5, 3)
    exchanged = by_chip[[2, 1, 0, 3, 4]].ravel()
    alive = np.arange(CHANNELS_N) >= 3
    swapped = [skin._replace(rest_uT=skin.rest_uT[exchanged], b_uT=skin.b_uT[:, exchanged]) for skin in skins]
    assert sum("unlike the skins" in " ".join(calibrated(model, skin).warnings) for skin in swapped) >= 9
    noise_uT = rng_for(0, "silent").standard_normal(first.b_uT.shape)
    silent = first._replace(b_uT=np.where(alive, first.b_uT, first.rest_uT + noise_uT))
    assert any("chip 0 does not respond" in text for text in calibrated(model, silent).warnings)
    mirrored = first._replace(place_mm=[16.0, 0.0] + [-1.0, 1.0] * first.place_mm)
    assert any("labels contradict" in text for text in calibrated(model, mirrored, labels_n=10).warnings)
    in_cm = first._replace(place_mm=first.place_mm / 10)
    assert any("in cm or m" in text for text in calibrated(model, in_cm, labels_n=10).warnings)
    assert (calibrated(model, first).misfit(first.b_uT[TESTED]) > 1).mean() < 0.1
    noise_uT = first.rest_uT + np.random.default_rng(0).normal(0, 500, (50, CHANNELS_N))
    assert (model.misfit(noise_uT) > 1).mean() > 0.3


def test_reversed_magnets_do_not_matter(model):
    skin = draw(12)[0]
    found = calibrated(model, skin, labels_n=10).estimate(skin.b_uT[TESTED])
    reversed_skin = skin._replace(rest_uT=-skin.rest_uT, b_uT=-skin.b_uT)
    again = calibrated(model, reversed_skin, labels_n=10).estimate(reversed_skin.b_uT[TESTED])
    for name in ("place_mm", "sd_mm", "force_N", "sd_N"):
        np.testing.assert_allclose(getattr(found, name), getattr(again, name), rtol=1e-5, atol=1e-5)


def test_one_known_weight_moves_all_forces(model):
    skin = draw(12)[1]
    before = calibrated(model, skin).predict(skin.b_uT[TESTED])[:, 2]
    true_N = 2 * float(model.predict(skin.b_uT[:1])[0, 2])
    after = model.label(skin.place_mm[0], true_N, skin.b_uT[0]).predict(skin.b_uT[TESTED])[:, 2]
    assert np.median(after / before) > 1.1


def test_estimates_do_not_depend_on_the_order_of_calls(model):
    skin = draw(12)[2]
    first = calibrated(model, skin, labels_n=10).estimate(skin.b_uT[TESTED])
    labels = slice(SEEN_N, SEEN_N + 10)
    model.zero(skin.rest_uT).label(skin.place_mm[labels][:5], skin.force_N[labels][:5], skin.b_uT[labels][:5])
    model.predict(skin.b_uT[TESTED])
    model.label(skin.place_mm[labels][5:], skin.force_N[labels][5:], skin.b_uT[labels][5:], keep=True)
    for reading_uT in skin.b_uT[:SEEN_N]:
        model.see(reading_uT)
    again = model.estimate(skin.b_uT[TESTED])
    np.testing.assert_allclose(again.place_mm, first.place_mm, atol=1e-5)
    # Labels are compared with estimates only when they are given, so intervals and forces differ a little.
    np.testing.assert_allclose(again.force_N, first.force_N, rtol=0.3)
    assert model.presses_n == SEEN_N + 10
    # Without `keep`, earlier labels are replaced.
    assert model.label(skin.place_mm[0], None, skin.b_uT[0]).labels_n == 1


@pytest.mark.parametrize(
    ("place_mm", "force_N", "rule"),
    [
        ((8.0, np.nan), 1.0, "places must be on the skin"), ((40.0, 8.0), 1.0, "mm; got 40.0"),
        ((8.0, 8.0), 0.0, "forces must be above 0 N; got 0.0"), ((8.0, 8.0), np.inf, "forces must be finite"),
        ((8.0, 8.0), 500.0, "force range of the model"), ((8.0, 8.0, 1.0), 1.0, "each press needs x and y"),
    ],
)  # fmt: skip
def test_invalid_labels_are_refused_and_change_nothing(model, place_mm, force_N, rule):
    skin = draw(12)[0]
    before = model.zero(skin.rest_uT).label(skin.place_mm[0], 1.0, skin.b_uT[0]).predict(skin.b_uT)
    with pytest.raises(SchemaError, match=rule):
        model.label(place_mm, force_N, skin.b_uT[0])
    for learn in (model.see, model.zero):
        with pytest.raises(SchemaError, match="must be finite numbers of uT; got nan"):
            learn(skin.b_uT * np.nan)
    with pytest.raises(SchemaError, match="seem to be field changes"):
        model.see(skin.b_uT - skin.rest_uT)
    with pytest.raises(SchemaError, match=f"labels are too many. At most {LABELS_MAX_N}"):
        model.label(
            np.full((LABELS_MAX_N + 1, 2), 8.0), np.ones(LABELS_MAX_N + 1), np.tile(skin.b_uT[0], (LABELS_MAX_N + 1, 1))
        )
    np.testing.assert_array_equal(model.predict(skin.b_uT), before)


def test_many_labels_are_thinned_and_every_label_is_held_out_once(model):
    skin = draw(12)[0]
    again_uT = skin.b_uT + rng_for(0, "again").standard_normal(skin.b_uT.shape)
    b_uT = np.concatenate([skin.b_uT, again_uT])
    model.zero(skin.rest_uT).label(np.tile(skin.place_mm, (2, 1)), np.tile(skin.force_N, 2), b_uT)
    labels = model.skin.data.labels
    assert (model.labels_n, len(thin(labels, 100))) == (260, 100)
    assert sorted(np.concatenate([tested for _, tested in folds_of(260)])) == list(range(260))
    assert not any(np.isin(kept, tested).any() for kept, tested in folds_of(260))
    assert np.isfinite(model.predict(skin.b_uT)).all()


# --- Wrong data ---


def quiet_readings(skin, n=100):
    return skin.rest_uT + np.tile(NOISE_uT, 5) * rng_for(0, "no load").standard_normal((n, CHANNELS_N))


@pytest.fixture
def skin():
    return draw(12)[1]


def test_no_load_readings_with_contacts_or_a_dead_chip_are_refused(model, skin):
    quiet_uT, first = quiet_readings(skin), np.arange(CHANNELS_N) < 3
    for wrong_uT, rule in (
        (np.concatenate([quiet_uT, skin.b_uT[:20]]), "20 of 120 readings differ"),
        (quiet_uT * ~first, "chip 0 does not answer"),
        (quiet_uT[0] * ~first, "chip 0 does not answer"),
        (np.where(first, quiet_uT[0], quiet_uT), "chip 0 does not answer"),
    ):
        with pytest.raises(SchemaError, match=rule):
            model.zero(wrong_uT)
    assert model.zero(quiet_uT).zeroed
    assert model.zero(np.concatenate([quiet_uT, quiet_uT + 0.1, skin.b_uT[:1]])).zeroed  # one wrong reading in 201


def test_readings_without_contact_are_not_learnt_as_presses(model, skin):
    model.zero(quiet_readings(skin))
    mixed_uT = np.concatenate([skin.b_uT[:10], quiet_readings(skin, 5)])
    for learn in (model.see, lambda b_uT: model.label(skin.place_mm[:15], skin.force_N[:15], b_uT)):
        with pytest.raises(SchemaError, match="5 of 15 readings are not of presses; the first is reading 10"):
            learn(mixed_uT)
    assert model.presses_n == 0


def test_labels_with_forces_of_twice_the_range_are_refused(model, skin):
    with pytest.raises(SchemaError, match="force range of the model"):
        model.zero(skin.rest_uT).label(skin.place_mm[0], 18.0, skin.b_uT[0])


def test_repeated_press_counts_once(model, skin):
    place_mm, force_N, b_uT = np.tile(skin.place_mm[0], (40, 1)), np.full(40, skin.force_N[0]), skin.b_uT[:1]
    model.zero(quiet_readings(skin)).label(place_mm[:1], force_N[:1], b_uT)
    once = model.estimate(skin.b_uT[TESTED])
    for repeated_uT in (np.tile(b_uT, (40, 1)), quiet_readings(skin, 40) - skin.rest_uT + b_uT):
        repeated_uT[0] = b_uT
        again = model.label(place_mm, force_N, repeated_uT).estimate(skin.b_uT[TESTED])
        assert model.labels_n == 1
        np.testing.assert_array_equal(again.sd_N, once.sd_N)
    assert model.zero(skin.rest_uT).see(np.tile(b_uT, (40, 1))).presses_n == 1


def test_equal_readings_at_different_places_are_refused(model, skin):
    model.zero(skin.rest_uT)
    with pytest.raises(SchemaError, match="equal readings but different labels"):
        model.label(skin.place_mm[:12], skin.force_N[:12], np.tile(skin.b_uT[0], (12, 1)))


@pytest.mark.parametrize("chip_i", range(5))
def test_reading_in_which_a_chip_does_not_answer_is_not_usable(model, skin, chip_i):
    calibrated(model, skin, labels_n=10)
    chip = np.arange(CHANNELS_N) // 3 == chip_i
    for wrong_uT in (skin.b_uT[0] * ~chip, np.where(chip, np.nan, skin.b_uT[0])):
        found = model.estimate(np.stack([skin.b_uT[1], wrong_uT]))
        assert found.usable.tolist() == [True, False]
        assert np.isnan(model.predict(wrong_uT)).all()
    stuck_uT = np.where(chip, skin.rest_uT, skin.b_uT)
    assert not model.estimate(stuck_uT).usable.any()
    assert model.estimate(skin.b_uT).usable.all()
    with pytest.raises(SchemaError, match=f"chip {chip_i} does not answer"):
        model.see(stuck_uT)


# --- Files ---


def test_saved_skin_has_equal_estimates_and_can_be_zeroed_again_after_drift(model, tmp_path):
    skin, file = draw(12)[0], tmp_path / "s0.safetensors"
    with pytest.raises(SchemaError, match="save: the model has no no-load reading"):
        model.save(file)
    calibrated(model, skin, labels_n=10).label(skin.place_mm[:3], None, skin.b_uT[:3], keep=True).save(file)
    again = reskin.load_universal(file)
    np.testing.assert_allclose(again.predict(skin.b_uT), model.predict(skin.b_uT), rtol=1e-6)
    assert (again.presses_n, again.labels_n) == (SEEN_N + 13, 13)
    drift_uT = np.linspace(-20, 20, CHANNELS_N)
    kept = again.zero(skin.rest_uT + drift_uT, keep=True).predict(skin.b_uT + drift_uT)
    np.testing.assert_allclose(kept[:, :2], model.predict(skin.b_uT)[:, :2], atol=0.3)
    assert again.zero(skin.rest_uT).presses_n == 0


def test_saved_skin_of_another_skin_is_reported(model, tmp_path):
    skin, other = draw(12)[:2]
    calibrated(model, skin).save(tmp_path / "s0.safetensors")
    loaded = load_universal(tmp_path / "s0.safetensors")
    assert not any("saved skin" in text for text in loaded.zero(1.05 * skin.rest_uT, keep=True).warnings)
    assert any("of the saved skin" in text for text in loaded.zero(1.6 * other.rest_uT, keep=True).warnings)
    # Without `keep`, the saved skin is discarded, so there is nothing to report.
    assert not any("saved skin" in text for text in loaded.zero(1.6 * other.rest_uT).warnings)


def test_invalid_skin_files_are_refused(model, tmp_path):
    skin, file = draw(12)[0], tmp_path / "s0.safetensors"
    calibrated(model, skin).save(file)
    sound, header = io.read_tensors(file)
    one_uT = np.ones((1, CHANNELS_N))
    label = {"labelled_mm": np.zeros((1, 2)), "labelled_N": np.ones(1), "labelled_uT": one_uT}
    for changed, rule in [
        ({"presses_uT": one_uT * np.nan}, "must be finite numbers of uT; got nan"),
        ({"presses_uT": one_uT * 1e7}, "must be at most 1,000,000 uT in magnitude; got 1"),
        ({"presses_uT": np.ones((66, CHANNELS_N))}, "arrays must be"),
        ({"rest_uT": one_uT[0, :12]}, "arrays must be"),
        (label | {"labelled_mm": np.full((1, 2), 40.0)}, "places must be on"),
        (label | {"labelled_N": np.full(1, 1e30)}, "force range of the model"),
        ({"labelled_mm": np.full((1, 2), 8.0)}, "arrays must be"),
        ({"refined.empty": np.zeros(96, np.float32)}, "array .* must be of shape"),
    ]:
        io.write_tensors(file, sound | changed, header)
        with pytest.raises(SchemaError, match=rule):
            load_universal(file)
    for header_of, rule in (
        ({"format": "reskin-skin-0"}, "format must be reskin-skin-5; got reskin-skin-0"),
        ({"format": "reskin-skin-4"}, "format must be reskin-skin-5.* calibrate again"),
        (header | {"board": "mine"}, "the board must be reskin, the board of the model; got mine"),
    ):
        io.write_tensors(file, sound, {name: value for name, value in header_of.items() if name != "digest"})
        with pytest.raises(SchemaError, match=rule):
            load_universal(file)
    with pytest.raises(SchemaError, match="its model card s0.json is missing.* pass it as `skin`"):
        load_universal(file=file)


def changed_model(tmp_path, card=None, **tensors):
    """Write the shipped model with some changes."""
    file = tmp_path / FILE.name
    arrays, metadata = io.read_tensors(FILE)
    io.write_tensors(file, arrays | tensors, metadata)
    io.write_json(file.with_suffix(".json"), io.read_json(FILE.with_suffix(".json")) | (card or {}))
    return file


def test_damaged_and_edited_models_are_refused(model, tmp_path):
    weights = model.weights
    for card, tensors, rule in (
        ({"format": "reskin-universal-4"}, {}, "format must be reskin-universal-5; got reskin-universal-4"),
        ({"name": "mine"}, {}, "the card must be the one that was written with universal.safetensors"),
        (None, {"likeness.means": np.zeros((2, CHANNELS_N), np.float32)}, "array likeness.means must be of shape"),
        (None, {"likeness.scales": np.full((3, 2), np.inf, np.float32)}, "array likeness.scales must be finite"),
        (None, {"network.empty": weights["empty"] * np.float32(np.nan)}, "finite float32 numbers"),
        (None, {"network.empty": weights["empty"].astype(float)}, "finite float32 numbers"),
        (None, {"network.empty": weights["empty"][:5]}, "must be of shape .96,."),
        (None, {"network.more": weights["empty"]}, "must be of shape None"),
    ):
        with pytest.raises(SchemaError, match=rule):
            load_universal(file=changed_model(tmp_path / str(rule[:12].replace("/", "")), card, **tensors))
    file = tmp_path / FILE.name
    shutil.copy(FILE.with_suffix(".json"), file.with_suffix(".json"))
    content = bytearray(FILE.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    with pytest.raises(SchemaError, match="does not match its digest"):
        load_universal(file=file)


def test_model_card_and_repr_describe_the_model(model):
    skin = draw(12)[0]
    assert model.card["source"] == "simulated"
    assert model.card["not_for"]
    assert repr(calibrated(model, skin, labels_n=4)) == (
        "Universal(board reskin, 5 chips, no-load reading taken, 65 presses at unknown places, 4 labelled)"
    )
    for one in (model.skin, model.estimate(skin.b_uT)):
        assert "\n" not in repr(one)
        assert len(repr(one)) < 400


def test_empty_arrays_of_readings_give_empty_estimates(model):
    model.zero(np.ones(15))
    assert model.predict(np.empty((0, 15))).shape == (0, 3)
    with pytest.raises(SchemaError, match="array of readings is empty"):
        model.zero(np.empty((0, 15)))


def test_external_fields_cost_less_if_they_are_expected():
    rng, skin = np.random.default_rng(0), draw(12)[0]
    turned_uT = skin.b_uT + np.tile(rng.normal(0, 100, (len(skin.b_uT), 3)), 5) @ load_universal().layout.to_chips(
        np.eye(15)
    )
    errors_mm = []
    for external_uT in (0.0, 100.0):
        found = calibrated(load_universal(external_uT=external_uT), skin).predict(turned_uT[TESTED])[:, :2]
        errors_mm.append(np.median(np.linalg.norm(found - skin.place_mm[TESTED], axis=1)))
    assert errors_mm[1] < errors_mm[0]
    assert load_universal().suppressor(1.0) is None
    assert load_universal(external_uT=30.0).suppressor(1.0).shape == (15, 15)
    with pytest.raises(SchemaError, match="external_uT must be 0 to 1,000 uT"):
        load_universal(external_uT=-1.0)


@pytest.mark.parametrize("force_N", [0.1, 0.5])
def test_median_force_of_light_touches_on_new_skins_is_within_50_percent(force_N):
    model, read_N, rng = load_universal(), [], rng_for(0, "light")
    for name in ("b0", "b1", "b2", "b3"):
        board = draw_board(RIGID, SPREADS, seed=5, name=name)
        skin = draw_skin(PARAMS_SKIN, SPREADS, seed=5, name=f"{name}_s0", rule=Quadrature(0.8e-3, 5))
        names = ("thickness_m", "tip_radius_m", "modulus_Pa", "stiffening")
        layer = {name: getattr(skin, name) for name in names}
        depth_m = slide.depth_at(np.full(10, force_N), **layer) - skin.depth_zero_m
        rest_T, change_T = changes_of_field(board, skin, np.column_stack([rng.uniform(-7e-3, 7e-3, (10, 2)), depth_m]))
        noload_uT, _ = read_field(np.repeat(rest_T[None], 50, axis=0), board, design=CHIP, rng=rng)
        touch_uT, _ = read_field(rest_T + change_T, board, design=CHIP, rng=rng)
        read_N += model.zero(noload_uT).estimate(touch_uT).force_N.tolist()
    assert 0.5 * force_N < np.median(read_N) < 1.5 * force_N
