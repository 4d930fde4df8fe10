"""Tests of the models of a live board: estimates, calibration from the page, and unknown skins."""

import re
import time

import numpy as np
import pytest

import reskin
from reskin.errors import ParamsError, SchemaError
from reskin.live.emulator import Script, encode_pieces
from reskin.live.models import UniversalEstimator
from reskin.live.presses import PRESSES_N, GuidedPresses, Presses
from reskin.live.session import Session
from reskin.live.tracker import UNKNOWN_SKIN, Estimates
from reskin.predicting import read_models
from reskin.seeds import rng_for
from reskin.universal.layout import paper_layout
from reskin.universal.model import load_universal
from tests.live.boards import ScriptReader, make_script, play_to_skin

QUIET_N, POKED_N = 600, 100


@pytest.fixture(scope="module")
def random_pokes():
    """Return no-load readings of a simulated skin, and fields, places (mm) and forces (N) of pokes at random places."""
    places = np.column_stack([rng_for(0, "places").uniform(3, 13, (PRESSES_N, 2)), np.full(PRESSES_N, 1.0)])
    noload_uT, b_uT, force_N = reskin.simulate_pokes(reskin.draw_skin(seed=3), places, seed=3)
    return noload_uT, b_uT, places[:, :2], force_N


def make_poke_script(pokes, rotated_n: int = 0):
    """Return a script: no contact at first, then all pokes with pauses.

    The numbers of the chips are shifted by `rotated_n`, as if chips were exchanged.
    """
    noload_uT, b_uT, _, _ = pokes
    script = make_script(pokes_n=0, quiet_s=(QUIET_N + 2 * POKED_N * len(b_uT)) / 400)
    poke_i, since_n = np.divmod(np.arange(len(script)) - QUIET_N, 2 * POKED_N)
    clean_uT = np.where(((poke_i >= 0) & (since_n < POKED_N))[:, None], b_uT[poke_i], noload_uT.mean(axis=0))
    noise_uT = script.frames.b_uT - script.frames.b_uT.mean(axis=0)
    script.frames.b_uT[:] = np.roll(clean_uT, 3 * rotated_n, axis=1) + noise_uT
    return Script("simulated", "binary", script.frames, encode_pieces(script.frames, "binary"), script.t_s)


def test_universal_model_estimates_places_and_their_standard_deviation(random_pokes):
    skin, readings = play_to_skin(make_poke_script(random_pokes), load_universal())
    estimates = np.concatenate([batch.target[batch.contact] for batch in readings])
    sd_mm = np.concatenate([batch.sd_mm[batch.contact] for batch in readings])
    true = np.repeat(random_pokes[2], POKED_N, axis=0)
    assert len(estimates) == pytest.approx(len(true), abs=20)
    error_mm = np.abs(estimates[: len(true), :2] - true[: len(estimates)])
    assert np.median(error_mm) < 1.0
    assert 0.1 < np.median(error_mm) / np.median(sd_mm) < 2.0
    sd_F_N = np.concatenate([batch.sd_F_N[batch.contact] for batch in readings])
    force_N = estimates[:, 2]
    assert (np.abs(force_N - np.repeat(random_pokes[3], POKED_N)[: len(force_N)]) < 3 * sd_F_N).mean() > 0.9
    assert skin.health.alarms == {}


def test_board_with_exchanged_chips_raises_the_alarm_unknown_skin(random_pokes):
    skin, _ = play_to_skin(make_poke_script(random_pokes, rotated_n=1), load_universal())
    assert skin.health.alarms[UNKNOWN_SKIN].count_n > 0.1 * POKED_N * PRESSES_N


def turn_in_uniform_field(script: Script, size_uT: float) -> Script:
    """Add the change of a uniform field that is seen by a turning board.

    After the start, the board turns about its x axis, once in two seconds.
    """
    angle = np.where(script.t_s < QUIET_N / 400, 0.0, np.pi * (script.t_s - QUIET_N / 400))
    change_uT = size_uT * np.column_stack([np.zeros(len(script)), np.sin(angle), np.cos(angle) - 1])
    script.frames.b_uT[:] += paper_layout().to_chips(np.tile(change_uT, 5)).astype(np.float32)
    return Script("simulated", "binary", script.frames, encode_pieces(script.frames, "binary"), script.t_s)


def test_turning_board_has_no_false_contacts_if_external_fields_are_expected(random_pokes):
    poked = (np.arange(QUIET_N + 2 * POKED_N * PRESSES_N) - QUIET_N) % (2 * POKED_N) < POKED_N
    poked[:QUIET_N] = False
    true_mm = np.repeat(random_pokes[2], POKED_N, axis=0)
    for external_uT in (0.0, 50.0):
        script = turn_in_uniform_field(make_poke_script(random_pokes), 50.0)
        skin, readings = play_to_skin(script, load_universal(external_uT=external_uT))
        contact = np.concatenate([batch.contact for batch in readings])
        target = np.concatenate([batch.target for batch in readings])
        false_fraction, found_fraction = contact[~poked][QUIET_N:].mean(), contact[poked].mean()
        assert found_fraction > 0.99
        alarms = {name.split(":")[0] for name in skin.health.alarms}
        if external_uT:
            assert false_fraction == 0.0
            assert alarms == set()
            assert np.nanmedian(np.linalg.norm(target[poked, :2] - true_mm, axis=1)) < 1.0
        else:
            assert false_fraction > 0.5
            assert "external field" in alarms


def test_external_fields_that_are_stronger_than_expected_raise_an_alarm(random_pokes):
    script = turn_in_uniform_field(make_poke_script(random_pokes), 300.0)
    skin, _ = play_to_skin(script, load_universal(external_uT=50.0))
    assert "external field" in {name.split(":")[0] for name in skin.health.alarms}


def test_model_is_adapted_after_enough_presses_were_collected(random_pokes):
    _, readings = play_to_skin(make_poke_script(random_pokes), load_universal())
    pokes = Presses()
    for batch in readings:
        pokes.add(batch)
    assert pokes.complete
    change_uT = random_pokes[1] - random_pokes[0].mean(axis=0)
    np.testing.assert_allclose(pokes.db_uT, change_uT, atol=30)  # The tolerance in uT allows for noise of 3 uT.
    estimator = UniversalEstimator(load_universal())
    estimator.set_noload(random_pokes[0].mean(axis=0))
    assert "adapted to 12 presses: median standard deviation of the places" in estimator.adapt(pokes.db_uT)
    before = estimator(pokes.db_uT.astype(np.float32))
    estimator.set_noload(random_pokes[0].mean(axis=0))  # A new no-load reading keeps the adaptation.
    np.testing.assert_allclose(estimator(pokes.db_uT.astype(np.float32)).target, before.target, rtol=1e-6)


class PressedWhileAdapting(UniversalEstimator):
    """An estimator on which the button Adapt is pressed again while an adaptation runs."""

    session: Session
    times_n: int

    def adapt(self, db_uT):
        for _ in range(self.times_n):
            self.session.press("adapt")
        return super().adapt(db_uT)


@pytest.mark.parametrize(("times_n", "instruction"), [(0, ""), (1, ""), (2, f"press 1 of {PRESSES_N}, anywhere")])
def test_presses_are_kept_if_button_adapt_is_pressed_during_an_adaptation(random_pokes, times_n, instruction):
    session = Session("played", load_universal(), "a board")
    session.skin.reader = reader = ScriptReader(make_poke_script(random_pokes))
    session.skin.estimator = estimator = PressedWhileAdapting(load_universal())
    estimator.session, estimator.times_n = session, times_n
    session.press("adapt")
    session.start()
    while not (reader.at_end and session.state()["adapted"]):
        time.sleep(0.01)
    session.stop()
    state = session.state()
    assert state["adapted"].startswith(f"adapted to {PRESSES_N} presses")
    assert state["adapting"] == instruction
    assert state["alarms"] == []


def test_presses_within_the_noise_are_refused(random_pokes):
    noload_uT, b_uT, _, _ = random_pokes
    db_uT = b_uT - noload_uT.mean(axis=0)
    estimator = UniversalEstimator(load_universal())
    estimator.set_noload(noload_uT.mean(axis=0))
    before = estimator(db_uT.astype(np.float32)).target
    for calibrate in (
        estimator.adapt,
        lambda weak_uT: estimator.label(random_pokes[2], weak_uT, np.arange(len(b_uT)) < 3),
    ):
        with pytest.raises(SchemaError, match="field changes must be 5 uT or more at one chip at least"):
            calibrate(1e-3 * db_uT)
    estimator.set_noload(noload_uT.mean(axis=0))
    np.testing.assert_array_equal(estimator(db_uT.astype(np.float32)).target, before)


def test_second_adaptation_replaces_the_presses_of_the_first_one(random_pokes):
    db_uT = random_pokes[1] - random_pokes[0].mean(axis=0)
    corrected, adapted_once = UniversalEstimator(load_universal()), UniversalEstimator(load_universal())
    for estimator in (corrected, adapted_once):
        estimator.set_noload(random_pokes[0].mean(axis=0))
    corrected.adapt(rng_for(0, "a hand").normal(0, 300, db_uT.shape))
    wrong = corrected(db_uT.astype(np.float32)).target
    for estimator in (corrected, adapted_once):
        estimator.adapt(db_uT)
    right = adapted_once(db_uT.astype(np.float32)).target
    np.testing.assert_allclose(corrected(db_uT.astype(np.float32)).target, right, rtol=1e-6)
    assert np.abs(wrong - right).max() > 1.0


@pytest.fixture(scope="module")
def guided_pokes():
    """Return data like `random_pokes`, but for pokes at the places that the page shows, in the order of the page."""
    places = np.column_stack([GuidedPresses().place_mm, np.full(GuidedPresses().presses_n, 1.0)])
    noload_uT, b_uT, force_N = reskin.simulate_pokes(reskin.draw_skin(seed=5), places, seed=5)
    return noload_uT, b_uT, places[:, :2], force_N


def test_presses_guided_by_the_page_calibrate_and_test_the_model(guided_pokes):
    _, readings = play_to_skin(make_poke_script(guided_pokes), load_universal())
    pokes, crosses = GuidedPresses(), []
    for batch in readings:
        crosses += [pokes.next_mm] if pokes.next_mm not in [None, *crosses] else []
        pokes.add(batch)
    np.testing.assert_allclose(crosses, guided_pokes[2])
    assert len(np.unique(pokes.place_mm, axis=0)) == len(pokes) == 2 * pokes.held_out.sum()
    assert pokes.next_mm is None
    estimator = UniversalEstimator(load_universal())
    estimator.set_noload(guided_pokes[0].mean(axis=0))
    message = estimator.label(pokes.place_mm, pokes.db_uT, pokes.held_out)
    before_mm, after_mm = map(float, re.findall(r"([0-9.]+) mm (?:before|after)", message))
    found = estimator(pokes.db_uT[pokes.held_out].astype(np.float32)).target[:, :2]
    held_out_mm = np.linalg.norm(found - guided_pokes[2][pokes.held_out], axis=1)
    assert after_mm == pytest.approx(np.median(held_out_mm), abs=0.006)
    assert after_mm < before_mm
    estimator.set_noload(guided_pokes[0].mean(axis=0))  # A new no-load reading keeps the calibration.
    np.testing.assert_allclose(
        estimator(pokes.db_uT[pokes.held_out].astype(np.float32)).target[:, :2], found, rtol=1e-6
    )


def test_presses_guided_by_the_page_are_added_to_the_labels_of_a_calibration(guided_pokes):
    noload_uT, b_uT, place_mm, force_N = guided_pokes
    kept, rest_uT = GuidedPresses().held_out, noload_uT.mean(axis=0)
    calibrated = load_universal().zero(noload_uT).label(place_mm[kept], force_N[kept], b_uT[kept])
    # The page shows only places, so these presses have no measured force.
    model = load_universal().zero(noload_uT).label(place_mm[kept], force_N[kept], b_uT[kept])
    expected = model.label(place_mm[~kept], None, b_uT[~kept], keep=True).predict(b_uT)
    estimator = UniversalEstimator(calibrated)
    estimator.set_noload(noload_uT.mean(axis=0))
    estimator.label(place_mm, b_uT - rest_uT, kept)
    np.testing.assert_allclose(estimator((b_uT - rest_uT).astype(np.float32)).target, expected, rtol=1e-3)
    assert calibrated.presses_n == kept.sum()


def test_contact_of_one_or_two_readings_is_not_counted_as_a_press():
    pokes, db_uT = Presses(), np.full((6, 15), 100.0, np.float32)
    contact = np.array([True, True, False, True, False, False])
    pokes.add(Estimates(np.arange(6.0), db_uT, db_uT, np.zeros((6, 3)), np.zeros((6, 2)), np.zeros(6), contact))
    assert len(pokes) == 0


def test_universal_model_is_refused_for_boards_with_another_number_of_chips():
    skin, readings = play_to_skin(make_script(pokes_n=1, chips_n=4), load_universal())
    assert skin.estimator is None
    problem = "no place or force is estimated: the universal model is for boards with 5 chips."
    assert f"{problem} Use a model for this board." in skin.alarms()
    assert all(np.isnan(batch.target).all() for batch in readings)


def test_board_opened_with_a_saved_calibration_uses_it(random_pokes, tmp_path):
    noload_uT, b_uT, place_mm, force_N = random_pokes
    calibrated = load_universal().zero(noload_uT).label(place_mm, force_N, b_uT)
    calibrated.save(tmp_path / "s3.safetensors")
    before = calibrated.predict(b_uT)
    # This file has the name of the card of model s3, but is another file of the user.
    (tmp_path / "s3.json").write_text("{}")
    for models in (calibrated, read_models([tmp_path / "s3.safetensors"])):
        _, readings = play_to_skin(make_poke_script(random_pokes), models)
        estimates = np.concatenate([batch.target[batch.contact] for batch in readings])
        true_mm = np.repeat(place_mm, POKED_N, axis=0)[: len(estimates)]
        uncalibrated = np.concatenate(
            [batch.target[batch.contact] for batch in play_to_skin(make_poke_script(random_pokes), load_universal())[1]]
        )
        assert np.abs(estimates[:, :2] - true_mm).mean() < 0.8 * np.abs(uncalibrated[:, :2] - true_mm).mean()
    # Opening a board does not change the model that the user has passed.
    np.testing.assert_array_equal(calibrated.predict(b_uT), before)


def test_calibration_is_refused_for_several_boards(random_pokes, tmp_path):
    noload_uT, b_uT, place_mm, force_N = random_pokes
    calibrated = load_universal().zero(noload_uT).label(place_mm, force_N, b_uT)
    with pytest.raises(ParamsError, match=r"to one skin \(12 presses\) and cannot be used for 2 boards"):
        reskin.open(["/dev/a", "/dev/b"], model=calibrated)
    calibrated.save(tmp_path / "s3.safetensors")
    with pytest.raises(ParamsError, match="is a calibration of the universal model, load it with reskin.load_univ"):
        reskin.load_model(tmp_path / "s3.safetensors")
    with pytest.raises(ParamsError, match="a calibration cannot be combined with other models"):
        read_models([tmp_path / "s3.safetensors"] * 2)
