"""Tests of the model shipped with the library: accuracy on simulated pokes, misfit, labels, files, invalid input."""

import inspect
import shutil
from pathlib import Path

import numpy as np
import pytest

import reskin
from reskin import io
from reskin.config import parse, read_yaml
from reskin.data.rows import Rows
from reskin.errors import SchemaError
from reskin.layouts import PAPER, geometry
from reskin.physics import slide
from reskin.physics.board import BoardDesign, Spreads, draw_board
from reskin.physics.chip import ChipDesign, read_field
from reskin.physics.magnet import Quadrature
from reskin.physics.skin import SkinDesign, changes_of_field, draw_skin
from reskin.seeds import rng_for
from reskin.simulation import defaults
from reskin.universal.calibration import CHANNELS_N, CalibrationData, check_shape, no_labels
from reskin.universal.law import to_chips
from reskin.universal.map import NOMINAL
from reskin.universal.model import FILE, PriorModel, Universal, load_universal

ROOT = Path(__file__).resolve().parents[2]
PARAMS = {name: defaults.nominal(name) for name in defaults.SHARED}
PARAMS_SKIN, SPREADS = parse(SkinDesign, PARAMS["skin"], "skin"), parse(Spreads, PARAMS["spreads"], "spreads")
CHIP = parse(ChipDesign, PARAMS["chip"], "chip")
QUICK = read_yaml(ROOT / "pipeline/scenes/quick.yaml")["simulate"]
RIGID = parse(BoardDesign, geometry(PAPER)["design"], "layout")
PLACES_MM = np.array([[8.0, 8.0], [3.0, 6.0], [12.0, 11.0], [10.0, 3.0]])


@pytest.fixture
def skin() -> Universal:
    return load_universal()


def pokes(skin: Universal, force_i: int = 3) -> np.ndarray:
    """Return field changes of presses on the nominal skin at the lattice points nearest to `PLACES_MM`.

    They are along the axes of the chips.
    """
    tables = skin.tables
    lattice_i = np.abs((PLACES_MM - 8)[:, :, None] - tables.axis_mm).argmin(axis=2)
    return to_chips(tables.mean_uT[lattice_i[:, 0], lattice_i[:, 1], force_i])


def test_error_on_the_nominal_skin_is_at_most_one_lattice_step(skin):
    tables, rest_uT = skin.tables, to_chips(skin.tables.rest_uT[None])
    found = skin.zero(rest_uT).predict(pokes(skin) + rest_uT)
    lattice_mm = tables.axis_mm[np.abs((PLACES_MM - 8)[:, :, None] - tables.axis_mm).argmin(axis=2)] + 8
    assert np.abs(found[:, :2] - lattice_mm).max() < 0.5
    assert ((found[:, 2] > tables.force_N[1]) & (found[:, 2] < tables.force_N[5])).all()


def test_labels_move_estimates_towards_the_labelled_places(skin):
    rest_uT = to_chips(skin.tables.rest_uT[None])
    read_uT, shifted_mm = pokes(skin) + rest_uT, PLACES_MM + (0.8, -0.5)
    before = skin.zero(rest_uT).predict(read_uT)
    after = skin.label(shifted_mm, np.full(4, skin.tables.force_N[3]), read_uT).predict(read_uT)
    assert np.abs(after[:, :2] - shifted_mm).mean() < 0.5 * np.abs(before[:, :2] - shifted_mm).mean()


def test_misfit_of_noise_is_ten_times_that_of_pokes(skin):
    rest_uT = to_chips(skin.tables.rest_uT[None])
    of_pokes = skin.zero(rest_uT).estimate(pokes(skin) + rest_uT).misfit
    of_noise = skin.estimate(3000 * np.random.default_rng(0).standard_normal((4, CHANNELS_N)) + rest_uT).misfit
    assert of_pokes.max() < 1
    assert of_noise.min() > 10 * of_pokes.max()


def test_model_card_describes_the_shipped_model(skin):
    assert skin.card["source"] == "simulated"
    assert skin.card["centre"]["gap_mm"] == NOMINAL.gap_mm
    assert skin.card["not_for"]
    assert len(skin.networks) == skin.card["training"]["seeds_n"]
    assert FILE.stat().st_size <= 5e6  # The limit on the size of the model's file is 5 MB.
    assert tuple(skin.card["spreads"]) == skin.tables.names


def test_readings_with_a_wrong_number_of_channels_are_refused(skin):
    for b_uT, got in ((np.zeros((2, 12)), r"shape \(2, 12\)"), (np.zeros(14), "14 numbers")):
        with pytest.raises(SchemaError, match=f"b_uT has {got}.* 15 numbers per reading"):
            skin.predict(b_uT)
    # These arguments have wrong types, which a program without type checks can pass.
    for b_uT in (["a"] * 15, [[1.0], [1.0, 2.0]]):
        with pytest.raises(SchemaError, match="b_uT: .* is not an array of numbers"):
            inspect.unwrap(check_shape)(b_uT)
    assert reskin.load_universal().tables.rest_uT.shape == (CHANNELS_N,)


def test_estimates_before_the_no_load_reading_are_refused(skin):
    read_uT = pokes(skin)
    uses = [skin.predict, skin.estimate, skin.see, skin, lambda b_uT: skin.label(PLACES_MM, np.ones(4), b_uT)]
    for use in uses:
        with pytest.raises(SchemaError, match="no no-load reading. First call zero"):
            use(read_uT)
    assert not skin.zeroed
    skin.zero(to_chips(skin.tables.rest_uT[None]))
    for use in uses:
        use(read_uT + skin.noload_uT)
    assert skin.presses_n == 8


def test_fields_in_mT_are_refused(skin):
    rest_uT = to_chips(skin.tables.rest_uT[None])
    skin.zero(1e-3 * rest_uT)
    read_mT = 1e-3 * (pokes(skin, -1) + rest_uT)
    for calibrate in (skin.see, lambda b_uT: skin.label(PLACES_MM, np.ones(4), b_uT)):
        rule = r"must be 4.5 uT or more at one chip at least; got at most 0.504 uT\. Convert fields in mT"
        with pytest.raises(SchemaError, match=rule):
            calibrate(read_mT)
    assert skin.presses_n == 0
    assert "no-load field is weaker than the earth's" in skin.warnings[0]
    assert skin.zero(rest_uT).warnings == []
    lightest_uT = pokes(skin, 0)[:1]
    assert skin.see(lightest_uT + skin.noload_uT).presses_n == 1  # A single light touch in uT is accepted.


def test_field_changes_passed_as_readings_are_refused(skin):
    rest_uT = to_chips(skin.tables.rest_uT[None])
    changes_uT = pokes(skin.zero(rest_uT))
    places = (PLACES_MM, np.ones(len(PLACES_MM)))
    for name, calibrate in (("see", skin.see), ("label", lambda b_uT: skin.label(*places, b_uT))):
        with pytest.raises(SchemaError, match=f"{name}: .* seem to be field changes.* Pass the readings"):
            calibrate(changes_uT)
    assert skin.presses_n == 0
    skin.see(changes_uT + rest_uT)
    # Some boards subtract the no-load reading themselves. Their no-load reading is zero, so field changes are accepted.
    skin.zero(np.zeros(CHANNELS_N)[None]).see(changes_uT)


@pytest.mark.parametrize(
    ("force_N", "valid"), [(0.025, False), (0.03, True), (18.9, True), (19.0, False), (1600.0, False)]
)
def test_forces_of_labels_far_outside_the_range_are_refused(skin, force_N, valid):
    rest_uT = to_chips(skin.tables.rest_uT[None])
    skin.zero(rest_uT)
    if valid:
        skin.label(PLACES_MM[:1], force_N, pokes(skin)[:1] + rest_uT)
    else:
        with pytest.raises(SchemaError, match="forces must be about 0.05 to 9.5 N, .* Convert forces in other units"):
            skin.label(PLACES_MM[:1], force_N, pokes(skin)[:1] + rest_uT)
    assert skin.presses_n == int(valid)


def test_repr_of_models_is_one_line(skin):
    skin.zero(to_chips(skin.tables.rest_uT[None]))
    skin.label(PLACES_MM, np.ones(4), pokes(skin) + skin.noload_uT).see(pokes(skin)[:2] + skin.noload_uT)
    assert repr(skin) == (
        "Universal(board reskin, 5 chips, trained on simulated skins, no-load reading taken, "
        "2 presses at unknown places, 4 labelled)"
    )
    prior = PriorModel(skin.skin, skin.networks)
    pressed = prior.calibrate(CalibrationData(skin.tables.rest_uT))
    calibrated = pressed.with_labels(no_labels())
    board, drawn = reskin.draw_board(), reskin.draw_skin()
    rows = Rows.of_labels(["b0"] * 400, ["s0"] * 400)
    for one in (prior, pressed, calibrated, skin.skin, skin.tables, skin.skin.hypotheses, board, drawn, rows):
        assert "\n" not in repr(one)
        assert len(repr(one)) < 400
    assert "chips_m=[5, 3]" in repr(board)


def test_calibration_with_presses_one_by_one_is_close_to_that_with_all_at_once(skin):
    rest_uT = to_chips(skin.tables.rest_uT[None])
    stronger_uT = np.concatenate([1.25 * pokes(skin, force_i) for force_i in (2, 3, 4)]) + rest_uT
    at_once = skin.zero(rest_uT).see(stronger_uT).skin.mean
    skin.zero(rest_uT).see(stronger_uT[:4])
    for i in range(4, len(stronger_uT)):
        skin.see(stronger_uT[i : i + 1])
    assert np.linalg.norm(skin.skin.mean - at_once) < 0.3 * np.linalg.norm(at_once)


def test_inconsistent_labels_lower_the_likelihood_power_until_they_are_replaced(skin):
    rest_uT = to_chips(skin.tables.rest_uT[None])
    read_uT, force_N = np.tile(pokes(skin), (3, 1)) + rest_uT, np.full(12, skin.tables.force_N[3])
    place_mm = np.tile(PLACES_MM, (3, 1))
    skin.zero(rest_uT).label(place_mm, force_N, read_uT)
    fits, number = skin.power, skin.skin.mean
    skin.label(place_mm + 3 * np.random.default_rng(0).standard_normal(place_mm.shape), force_N, read_uT)
    assert skin.power < fits / 2
    skin.label(place_mm, force_N, read_uT)
    np.testing.assert_allclose(skin.skin.mean, number)
    assert skin.power == pytest.approx(fits)
    skin.zero(rest_uT)
    assert skin.power == pytest.approx(skin.powers.power_for(0, 0, even=False))


def test_estimates_do_not_depend_on_the_order_of_presses_labels_and_queries(skin):
    rest_uT = to_chips(skin.tables.rest_uT[None])
    read_uT, force_N = pokes(skin) + rest_uT, np.full(4, skin.tables.force_N[3])
    off_mm = PLACES_MM + np.random.default_rng(0).standard_normal(PLACES_MM.shape)
    further_uT = np.concatenate([1.25 * pokes(skin, force_i) for force_i in (1, 2, 3, 4)]) + rest_uT
    found = skin.zero(rest_uT).see(further_uT).label(off_mm, force_N, read_uT).estimate(read_uT)
    skin.zero(rest_uT).label(off_mm, force_N, read_uT).predict(read_uT)
    after = skin.see(further_uT).estimate(read_uT)
    np.testing.assert_allclose(after.place_mm, found.place_mm)
    np.testing.assert_allclose(after.sd_mm, found.sd_mm)


@pytest.mark.parametrize(
    ("place_mm", "force_N", "rule"),
    [
        ((8.0, np.nan), 1.0, "places must be on the skin"), ((40.0, 8.0), 1.0, "mm; got 40.0"),
        ((8.0, 8.0), 0.0, "forces must be above 0 N; got 0.0"), ((8.0, 8.0), np.nan, "forces must be above 0 N"),
        ((8.0, 8.0), np.inf, "forces must be finite"), ((8.0, 8.0, 1.0), 1.0, "each press needs x and y"),
    ],
)  # fmt: skip
def test_invalid_labels_are_refused_and_change_nothing(skin, place_mm, force_N, rule):
    rest_uT = to_chips(skin.tables.rest_uT[None])
    read_uT = pokes(skin)[:1] + rest_uT
    # The arguments of a single press need not be lists.
    before = skin.zero(rest_uT).label(PLACES_MM[0], 1.0, read_uT[0]).predict(read_uT)
    with pytest.raises(SchemaError, match=rule):
        skin.label(place_mm, force_N, read_uT)
    for learn in (skin.see, skin.zero):
        with pytest.raises(SchemaError, match="must be finite numbers of uT; got nan"):
            learn(read_uT * [np.nan])
    np.testing.assert_array_equal(skin.predict(read_uT), before)


def test_model_file_that_was_modified_is_refused(skin, tmp_path):
    file = tmp_path / FILE.name
    shutil.copy(FILE.with_suffix(".json"), file.with_suffix(".json"))
    content = bytearray(FILE.read_bytes())
    content[-1] ^= 1
    for changed in (bytes(content), FILE.read_bytes().replace(b"__metadata__", b"__metad4ta__")):
        file.write_bytes(changed)
        with pytest.raises(SchemaError, match="(does not match its digest|cannot be read as a safetensors file)"):
            load_universal(file=file)


def test_model_card_in_the_previous_format_is_read(skin, tmp_path):
    file = tmp_path / FILE.name
    shutil.copy(FILE, file)
    card = dict(skin.card)
    io.write_json(
        file.with_suffix(".json"), card | {"format": "reskin-universal-3", "sureness": card["likelihood_powers"]}
    )
    assert load_universal(file=file).powers == skin.powers


def test_model_in_an_old_format_is_refused(skin, tmp_path):
    file = tmp_path / FILE.name
    shutil.copy(FILE, file)
    io.write_json(file.with_suffix(".json"), skin.card | {"format": "reskin-universal-2"})
    with pytest.raises(SchemaError, match="format must be reskin-universal-4; got reskin-universal-2"):
        load_universal(file=file)


def test_saved_skin_has_equal_estimates_and_can_be_zeroed_again_after_drift(skin, tmp_path):
    rest_uT, file = to_chips(skin.tables.rest_uT[None]), tmp_path / "s0.safetensors"
    read_uT, force_N = pokes(skin) + rest_uT, np.full(4, skin.tables.force_N[3])
    further_uT = np.concatenate([1.25 * pokes(skin, force_i) for force_i in (1, 2, 3, 4)]) + rest_uT
    before = skin.zero(rest_uT).see(further_uT).label(PLACES_MM + (0.8, -0.5), force_N, read_uT).estimate(read_uT)
    skin.save(file)
    again = reskin.load_universal(file)
    assert again.presses_n == skin.presses_n == 20
    after = again.estimate(read_uT)
    np.testing.assert_allclose(after.place_mm, before.place_mm)
    np.testing.assert_allclose(after.sd_mm, before.sd_mm)
    drifted_uT = rest_uT + np.linspace(-20, 20, CHANNELS_N)
    kept = again.zero(drifted_uT, keep=True).predict(pokes(skin) + drifted_uT)
    np.testing.assert_allclose(kept[:, :2], before.place_mm, atol=0.2)
    assert again.zero(drifted_uT).presses_n == 0


def test_saved_calibration_of_another_skin_is_reported(skin, tmp_path):
    rest_uT = to_chips(skin.tables.rest_uT[None])
    other_uT = np.roll(rest_uT.reshape(-1, 3), 1, axis=0).reshape(1, -1)
    skin.zero(rest_uT).see(pokes(skin) + rest_uT).save(tmp_path / "s0.safetensors")
    loaded = load_universal(tmp_path / "s0.safetensors")
    assert loaded.warnings == loaded.zero(1.05 * rest_uT, keep=True).warnings == []
    assert any(
        "from the no-load field in the saved calibration" in text for text in loaded.zero(other_uT, keep=True).warnings
    )
    # Without `keep`, the saved calibration is discarded, so there is nothing to report.
    assert not any("saved calibration" in text for text in loaded.zero(other_uT).warnings)


def test_earlier_labels_are_kept_on_request(skin):
    rest_uT = to_chips(skin.tables.rest_uT[None])
    read_uT, force_N, shifted_mm = pokes(skin) + rest_uT, np.full(4, skin.tables.force_N[3]), PLACES_MM + (0.8, -0.5)
    at_once = skin.zero(rest_uT).label(shifted_mm, force_N, read_uT).predict(read_uT)
    skin.zero(rest_uT).label(shifted_mm[:2], force_N[:2], read_uT[:2])
    in_turn = skin.label(shifted_mm[2:], force_N[2:], read_uT[2:], keep=True).predict(read_uT)
    np.testing.assert_allclose(in_turn, at_once, rtol=1e-6)
    assert skin.presses_n == 4
    with pytest.raises(SchemaError, match="2003 labels are too many. At most 2000"):
        skin.label(np.full((1999, 2), 8.0), np.ones(1999), rest_uT + np.full((1999, 1), 9.0), keep=True)
    assert skin.presses_n == 4
    assert skin.label(shifted_mm[2:], force_N[2:], read_uT[2:]).presses_n == 2


def test_saved_skin_includes_presses_added_one_by_one(skin, tmp_path):
    rest_uT, file = to_chips(skin.tables.rest_uT[None]), tmp_path / "s0.safetensors"
    skin.zero(rest_uT)
    for one_uT in np.concatenate([1.25 * pokes(skin, force_i) for force_i in (2, 3, 4)]) + rest_uT:
        skin.see(one_uT)
    before = skin.estimate(pokes(skin) + rest_uT)
    skin.save(file)
    after = load_universal(file).estimate(pokes(skin) + rest_uT)
    assert (np.abs(after.place_mm - before.place_mm) < 0.5 * before.sd_mm).all()


def repeated_labels(labels_n):
    """Return arrays of a saved skin with `labels_n` equal labels in the middle of the skin."""
    return {"labelled_mm": np.zeros((labels_n, 2)), "labelled_N": np.ones(labels_n)}


def test_saved_skin_gives_equal_estimates_if_some_forces_are_unknown(skin, tmp_path):
    rest_uT, read_uT = to_chips(skin.tables.rest_uT[None]), pokes(skin)
    skin.zero(rest_uT).see(rest_uT + np.tile(read_uT, (4, 1)), area=True)
    skin.label(PLACES_MM[:2], None, rest_uT + read_uT[:2])
    skin.label(PLACES_MM[2:], [1.5, 2.5], rest_uT + read_uT[2:], keep=True).save(tmp_path / "s0.safetensors")
    loaded = load_universal(tmp_path / "s0.safetensors")
    for before, after in zip(
        *(vars(each.estimate(rest_uT + read_uT)).values() for each in (skin, loaded)), strict=True
    ):
        np.testing.assert_allclose(after, before, rtol=1e-5)
    assert loaded.line.mean[0] == pytest.approx(skin.line.mean[0], rel=1e-5)


def test_skin_file_of_the_first_format_is_read(skin, tmp_path):
    rest_uT, read_uT, file = to_chips(skin.tables.rest_uT[None]), pokes(skin), tmp_path / "s0.safetensors"
    skin.zero(rest_uT).see(rest_uT + read_uT).label(PLACES_MM, [1.0, 2.0, 3.0, 4.0], rest_uT + read_uT).save(file)
    tensors, _ = io.read_tensors(file)
    old = {name: values for name, values in tensors.items() if name not in ("area_uT", "force_known")}
    io.write_tensors(file, old, {"format": "reskin-skin-1"})
    np.testing.assert_allclose(
        load_universal(file).predict(rest_uT + read_uT), skin.predict(rest_uT + read_uT), rtol=1e-5
    )


def test_invalid_skin_files_are_refused(skin, tmp_path):
    file = tmp_path / "s0.safetensors"
    with pytest.raises(SchemaError, match="save: the model has no no-load reading"):
        skin.save(file)
    assert not file.exists()
    skin.zero(to_chips(skin.tables.rest_uT[None])).save(file)
    sound, header = io.read_tensors(file)
    one_uT = np.ones((1, CHANNELS_N))
    for changed, rule in [
        ({"pokes_uT": one_uT * np.nan}, "must be finite numbers of uT; got nan"),
        ({"rest_uT": one_uT[0] * np.inf}, "must be finite numbers of uT; got inf"),
        ({"pokes_uT": one_uT * 1e7}, "must be at most 1,000,000 uT in magnitude; got 1"),
        ({"pokes_uT": np.ones((66, CHANNELS_N))}, "arrays must be"),
        ({"even_uT": np.ones((66, CHANNELS_N))}, "arrays must be"),
        ({"even_uT": one_uT[:, :12]}, "arrays must be"),
        ({"labelled_mm": np.full((1, 2), 40.0), "labelled_N": np.ones(1), "labelled_uT": one_uT}, "places must be on"),
        ({"labelled_mm": np.full((1, 2), 8.0)}, "each press needs x and y"),
        ({"force_known": np.ones(1)}, "force_known must be one value per label"),
        (
            {"labelled_uT": np.ones((2001, CHANNELS_N))} | repeated_labels(2001),
            "2001 labels are too many. At most 2000",
        ),
        ({"pokes_uT": np.ones((72000, CHANNELS_N))}, "8,64.* bytes, but a saved calibration has at most 8,388,608"),
    ]:
        io.write_tensors(file, sound | changed, header)
        with pytest.raises(SchemaError, match=rule):
            load_universal(file)
    io.write_tensors(file, {name: sound[name] for name in sound if name != "rest_uT"}, header)
    with pytest.raises(SchemaError, match="arrays must be rest_uT"):
        load_universal(file)
    with pytest.raises(SchemaError, match="this file is a universal model, not a saved calibration. .* `file`"):
        load_universal(FILE)
    with pytest.raises(
        SchemaError,
        match="its model card s0.json is missing.* If this file is a saved calibration, pass it as `calibration`",
    ):
        load_universal(file=file)
    file.write_bytes(b"no such thing")
    with pytest.raises(SchemaError, match="the file cannot be read as a safetensors file"):
        load_universal(file)
    io.write_tensors(file, sound, {"format": "reskin-skin-0"})
    with pytest.raises(SchemaError, match="format must be reskin-skin-4; got reskin-skin-0"):
        load_universal(file)


def test_empty_arrays_of_readings_give_empty_estimates():
    model = load_universal().zero(np.zeros(15))
    assert model.predict(np.empty((0, 15))).shape == (0, 3)
    assert len(model.estimate(np.empty((0, 15))).place_mm) == 0
    with pytest.raises(SchemaError, match="array of readings is empty"):
        model.zero(np.empty((0, 15)))


@pytest.mark.parametrize("force_N", [0.1, 0.5])
def test_median_force_of_light_touches_on_new_skins_is_within_40_percent(force_N):
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
    assert 0.7 * force_N < np.median(read_N) < 1.4 * force_N
