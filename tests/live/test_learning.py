"""Tests of calibrating a model from the page (save, load, undo), and of recording labelled presses."""

import json
import math
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from reskin import io
from reskin.board import find
from reskin.errors import CaptureError, ParamsError, SchemaError
from reskin.live import models
from reskin.live.emulator import encode_pieces
from reskin.live.models import MEASURED_FILE, NetworkEstimator, SkinFolder, UniversalEstimator
from reskin.live.presses import PRESSES_N, GuidedPresses, LabelledPress, PageRecording, PressFinder
from reskin.live.server import receive
from reskin.live.session import Session
from reskin.live.tracker import Estimates
from reskin.models.trained import read_network
from reskin.recordings import probe
from reskin.recordings.header import HEADER_FILE, PROBE_FILE, parse
from reskin.recordings.labels import Label
from reskin.universal.model import FILE, load_universal
from tests.live.boards import POKE_S, QUIET_S, ScriptReader, make_script, write_model
from tests.live.test_estimators import QUIET_N, guided_pokes, make_poke_script, random_pokes  # noqa: F401 - fixtures
from tests.live.test_record import places_of, read

LONG_S = 20.0


class PausingReader(ScriptReader):
    """A reader that pauses at given times of the script until `resume` is called, and that can write a recording.

    As in a real reader, times are unix times: the time at which the reader was started, plus the time in the script.
    """

    def __init__(self, script, pauses_s=()):
        super().__init__(script)
        self._begun_s, self._pauses_s, self._writer = time.time() + 1.0, list(pauses_s), None
        self.writer_problem, self.waiting = "", threading.Event()

    def unix_s(self):
        return self._begun_s + super().unix_s()

    def resume(self):
        self._pauses_s.pop(0)
        self.waiting.clear()  # `take` sets the event again at the next pause.

    def write_to(self, writer):
        if self._writer is not None:
            self._writer.close()
        self._writer = writer

    def take(self, wait_s):
        if super().unix_s() >= next(iter(self._pauses_s), math.inf):
            self.waiting.set()
            return []
        chunks = super().take(wait_s)
        for chunk, t_s in chunks:
            if self._writer is not None:
                self._writer.write(chunk, t_s)
        return chunks


def until(condition, session=None):
    """Wait until a condition is true. Fail if the thread of the session ends."""
    end_s = time.monotonic() + LONG_S
    while not condition():
        assert session is None or session._thread.is_alive(), session.state()["alarms"]
        assert time.monotonic() < end_s, session.state() if session else "the condition never became true"
        time.sleep(0.002)


def running(script, models, *, pauses_s=(), **options):
    """Start a session that plays a script. Return the session and its reader."""
    session = Session("played", models, "a board", **options)
    session.skin.reader = reader = PausingReader(script, pauses_s)
    session.start()
    return session, reader


def text_after(session, message, key="adapted"):
    """Send a message as the page does. Return the text that then appears under `key` in the state of the page."""
    setattr(session, f"_{key}", "")
    receive(session, json.dumps(message))
    until(lambda: session.state()[key], session)
    return session.state()[key]


def test_calibration_is_saved_undone_and_loaded(random_pokes, tmp_path):  # noqa: F811
    db_uT = (random_pokes[1] - random_pokes[0].mean(axis=0)).astype(np.float32)
    folder = tmp_path / "skins"
    session, reader = running(
        make_poke_script(random_pokes), load_universal(), pauses_s=[QUIET_N / 400 - 0.05], skins=SkinFolder(folder)
    )
    try:
        until(reader.waiting.is_set, session)
        until(lambda: session.skin.zeroed, session)
        assert "is not yet calibrated to this skin" in text_after(session, {"save": "s1"})
        assert "nothing to undo" in text_after(session, {"press": "undo"})
        assert not folder.exists()
        before = session.skin.estimator(db_uT).target
        assert session.state()["expected"].endswith("before calibration)")
        receive(session, '{"press": "adapt"}')
        reader.resume()
        until(lambda: session.state()["adapted"].startswith(f"adapted to {PRESSES_N} presses"), session)
        until(lambda: reader.at_end, session)
        adapted = session.skin.estimator(db_uT).target
        assert np.abs(adapted - before).max() > 0.1
        state = session.state()
        assert state["learnt"] == f"{PRESSES_N} presses anywhere"
        assert state["expected"].endswith(f"after {PRESSES_N} presses and 0 labels)")

        for name in ("", "../s1", "a b", "x" * 65, ".s1", 3, None, ["s1"], "s1.safetensors"):
            assert "is not a name. Use 1 to 64 letters" in text_after(session, {"save": name})
        assert (
            text_after(session, {"save": "s1"})
            == f"saved {folder / 's1.safetensors'} (presses: 12, of which labelled: 0)"
        )
        content = (folder / "s1.safetensors").read_bytes()
        assert "s1.safetensors exists already. Choose another name." in text_after(session, {"save": "s1"})
        assert (folder / "s1.safetensors").read_bytes() == content
        assert session.state()["skins"] == ["s1"]

        assert text_after(session, {"press": "undo"}) == f"undone: calibration to {PRESSES_N} presses"
        np.testing.assert_array_equal(session.skin.estimator(db_uT).target, before)
        assert "the file does not exist" in text_after(session, {"load": "s2"})
        (folder / "s3.safetensors").write_text("no calibration")
        assert "s3.safetensors" in text_after(session, {"load": "s3"})
        np.testing.assert_array_equal(session.skin.estimator(db_uT).target, before)
        assert "loaded" in text_after(session, {"load": "s1"})
        off_skin = {"label": {"x_mm": 1, "y_mm": 99, "force_N": 1, "learn": True}}
        assert "y must be a number above -2 and below 18 mm; got 99" in text_after(session, off_skin, "labelled")
        # The tolerance in mm and N is due to the file, which stores presses in single precision.
        np.testing.assert_allclose(session.skin.estimator(db_uT).target, adapted, atol=0.02)
        state = session.state()
        assert state["model"] == "universal model, shipped with reskin, with the saved skin s1"
        assert state["learnt"] == f"{PRESSES_N} presses in s1"
        assert text_after(session, {"press": "undo"}) == "undone: loading of skin s1"
        np.testing.assert_array_equal(session.skin.estimator(db_uT).target, before)
    finally:
        session.stop()
    assert sorted(file.name for file in folder.iterdir()) == ["s1.safetensors", "s3.safetensors"]


def test_folder_of_skins_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "skins").touch()
    with pytest.raises(ParamsError, match="--skins: .*skins is a file, not a folder"):
        SkinFolder(tmp_path / "skins")


def test_model_is_calibrated_to_labelled_presses(random_pokes):  # noqa: F811
    noload_uT, b_uT, place_mm, force_N = random_pokes
    db_uT = b_uT - noload_uT.mean(axis=0)
    estimator = UniversalEstimator(load_universal())
    estimator.set_noload(noload_uT.mean(axis=0))
    for i in range(3):
        unknown = i == 1
        text = estimator.add_label(tuple(place_mm[i].tolist()), math.nan if unknown else force_N[i], db_uT[i])
        assert text.startswith("calibrated to a labelled press; before, the error of its place was ")
        assert ("force" in text) != unknown
    known_N = np.where(np.arange(3) == 1, np.nan, force_N[:3])
    expected = load_universal().zero(noload_uT).label(place_mm[:3], known_N, b_uT[:3]).predict(b_uT)
    found = estimator(db_uT.astype(np.float32)).target
    np.testing.assert_allclose(found, expected, atol=0.02)  # The tolerance in mm and N is that of single precision.
    for wrong_mm, wrong_N, message in (
        ((99.0, 8.0), 1.0, "on the skin"),
        ((8.0, 8.0), 900.0, "the force range of the model"),
    ):
        with pytest.raises(SchemaError, match=message):
            estimator.add_label(wrong_mm, wrong_N, db_uT[3])
    np.testing.assert_array_equal(estimator(db_uT.astype(np.float32)).target, found)
    assert estimator.undo() == "undone: calibration to the last labelled press"
    assert estimator.model.labels_n == 2


def test_label_far_off_the_estimate_is_used_only_if_the_user_keeps_it(random_pokes):  # noqa: F811
    script = make_poke_script(random_pokes)
    slow = replace(script, t_s=10 * script.t_s)  # There are pauses of 2.5 s between the presses.
    press_s = 10 * (QUIET_N + 200 * np.arange(4)) / 400
    session, reader = running(slow, load_universal(), pauses_s=press_s - 1.9)
    right = [{"x_mm": x, "y_mm": y, "force_N": None, "learn": True} for x, y in random_pokes[2].tolist()]

    def labelled(label):
        until(reader.waiting.is_set, session)
        until(lambda: session.skin.zeroed, session)
        receive(session, json.dumps({"label": label}))
        reader.resume()
        until(lambda: session.state()["labelled"], session)
        return session.state()

    def wrong(label):
        return label | {"y_mm": label["y_mm"] + (8.3 if label["y_mm"] < 8 else -8.3)}

    try:
        assert "calibrated to a labelled press" in labelled(right[0])["labelled"]
        state = labelled(wrong(right[1]))
        assert state["doubtful"]
        assert state["labelled"] in state["alarms"]
        assert session.skin.estimator.model.labels_n == 1
        receive(session, '{"press": "discard"}')
        assert not session.state()["doubtful"]
        assert not labelled(right[2])["doubtful"]
        assert labelled(wrong(right[3]))["doubtful"]
        assert "calibrated to a labelled press" in text_after(session, {"press": "keep"}, "labelled")
        assert session.skin.estimator.model.labels_n == 3
    finally:
        session.stop()


def test_many_requests_for_changes_are_refused_and_estimates_continue(random_pokes, tmp_path):  # noqa: F811
    load_universal().zero(random_pokes[0]).see(random_pokes[1]).save(tmp_path / "s1.safetensors")
    script = make_poke_script(random_pokes)
    session, reader = running(script, load_universal(), pauses_s=[QUIET_N / 400 - 0.05], skins=SkinFolder(tmp_path))
    try:
        until(reader.waiting.is_set, session)
        until(lambda: session.skin.zeroed, session)
        for _ in range(500):
            receive(session, '{"load": "s1"}')
        assert "try again" in session.state()["adapted"]
        reader.resume()
        until(lambda: reader.at_end, session)
        assert len(session.skin.estimator._steps) < 50
    finally:
        session.stop()


def test_full_disk_ends_a_recording_with_an_alarm(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    session, reader = running(make_script(pokes_n=1), [], pauses_s=[QUIET_S - 0.2])
    try:
        until(reader.waiting.is_set, session)
        receive(session, '{"press": "record"}')
        reader.writer_problem = "cannot be written any more: No space left on device"
        assert any("No space left" in alarm for alarm in session.state()["alarms"])
        receive(session, '{"press": "record"}')
        assert "No space left" in session.state()["recorded"]
    finally:
        session.stop()


def test_refinement_needs_enough_labels_and_can_be_undone(random_pokes, monkeypatch):  # noqa: F811
    noload_uT, b_uT, place_mm, force_N = random_pokes
    db_uT = b_uT - noload_uT.mean(axis=0)
    estimator = UniversalEstimator(load_universal())
    estimator.set_noload(noload_uT.mean(axis=0))
    with pytest.raises(SchemaError, match="at least 20 labels with known forces; got 0"):
        estimator.refine()
    assert not estimator.describe("")["refinable"]
    pairs = (place_mm, place_mm), (force_N, force_N), (b_uT, b_uT + 1.0)
    estimator = UniversalEstimator(load_universal().zero(noload_uT).label(*(np.concatenate(pair) for pair in pairs)))
    estimator.set_noload(noload_uT.mean(axis=0))
    assert estimator.describe("")["refinable"]
    before = estimator(db_uT.astype(np.float32)).target
    weights = {name: value * np.float32(1.01) for name, value in estimator.model.weights.items()}
    monkeypatch.setattr("reskin.universal.making.refine", lambda *_: weights)
    assert estimator.refine().startswith("refined the network on 24 labelled presses")
    refined = estimator(db_uT.astype(np.float32)).target
    assert np.abs(refined - before).max() > 1e-3
    assert estimator.describe("")["learnt"].endswith("; network refined")
    estimator.set_noload(noload_uT.mean(axis=0))  # A new no-load reading keeps the refinement.
    np.testing.assert_allclose(estimator(db_uT.astype(np.float32)).target, refined, rtol=1e-6)
    assert estimator.undo() == "undone: refinement of the network"
    np.testing.assert_allclose(estimator(db_uT.astype(np.float32)).target, before, rtol=1e-6)


def test_labels_from_the_page_are_recorded(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    second_s = QUIET_S + POKE_S + 1.0  # The label is sent in the pause before the second press of the script.
    script = make_script(pokes_n=3)
    session, reader = running(script, [], pauses_s=[QUIET_S - 0.2, second_s])
    try:
        until(reader.waiting.is_set, session)
        until(lambda: session.skin.zeroed, session)
        place = {"x_mm": 4.0, "y_mm": 12, "force_N": 0.8, "learn": True}
        assert "neither recorded nor used" in text_after(session, {"label": place}, "labelled")
        receive(session, '{"press": "record"}')
        for wrong, message in (
            ({"x_mm": None}, "x must be a number"), ({"y_mm": "8"}, "y must be a number"),
            ({"force_N": -1}, "the force must be a number above 0"), ({"x_mm": 1e9}, "below 1000 mm; got 10000"),
            ({"y_mm": True}, "y must be a number"),
        ):  # fmt: skip
            assert message in text_after(session, {"label": place | wrong}, "labelled")
        assert "Enter x and y" in text_after(session, {"label": "here"}, "labelled")
        receive(session, json.dumps({"label": place}))
        assert session.state()["labelling"] == "press at x 4 mm, y 12 mm with 0.8 N."
        assert session.state()["label_mm"] == [4.0, 12.0]
        reader.resume()
        # The pause before the first press was too short for a no-load reading, so this press is not used for the label.
        until(reader.waiting.is_set, session)
        until(lambda: session.state()["labelling"].endswith("lift for a second, then press again"), session)
        receive(session, json.dumps({"label": place | {"force_N": None, "x_mm": 12, "y_mm": 4}}))
        reader.resume()
        until(lambda: session.state()["recording_n"] == 1, session)
        assert session.state()["labelled"] == "press at x 12 mm, y 4 mm: recorded as labelled press 1"
        until(lambda: reader.at_end, session)
        receive(session, '{"press": "record"}')
        assert session.state()["recorded"].endswith(", labelled presses: 1")
    finally:
        session.stop()
    (folder,) = (tmp_path / "captures").iterdir()
    assert parse((folder / HEADER_FILE).read_text(), "header").options["labels"] == "page"
    blocks, account = read(folder)
    assert places_of(blocks) == {(12.0, 4.0)}
    assert account["clock_residual_us"] == 0
    # The second press of the script lasts one second. Nearly all of its frames are labelled, and frames without contact
    # are not labelled.
    assert 0.9 * 400 * POKE_S < account["frames_contact_n"] <= 400 * POKE_S
    log = probe.parse(folder / PROBE_FILE, "log")
    assert np.isnan(log.Fz_N).all()
    changes_uT = np.concatenate([block.b_uT - block.noload_uT for block in blocks])
    # The limit is in uT. Each press changes the field by more than 600 uT.
    assert np.linalg.norm(changes_uT, axis=1).min() > 300


def test_guided_presses_are_recorded_with_their_places(guided_pokes, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.chdir(tmp_path)
    script = make_poke_script(guided_pokes)
    # The readings are multiples of the steps of the chips, because `reskin add` checks this.
    step_uT = np.tile([0.15, 0.15, 0.242], 5)
    script.frames.b_uT[:] = np.rint(script.frames.b_uT / step_uT) * step_uT
    # There are pauses of 1.25 s between the presses.
    slow = replace(script, pieces=encode_pieces(script.frames, "binary"), t_s=5 * script.t_s)
    session, reader = running(slow, load_universal(), pauses_s=[5 * (QUIET_N - 80) / 400])
    try:
        until(reader.waiting.is_set, session)
        until(lambda: session.skin.zeroed, session)
        receive(session, '{"press": "record"}')
        receive(session, '{"press": "places"}')
        reader.resume()
        until(lambda: session.state()["adapted"].startswith("adapted to 8 known places"), session)
        until(lambda: reader.at_end, session)
        assert session.state()["recording_n"] == GuidedPresses().presses_n
        assert session.state()["labelled"] == ""
    finally:
        session.stop()
    (folder,) = (tmp_path / "captures").iterdir()
    log = probe.parse(folder / PROBE_FILE, "log")
    np.testing.assert_allclose(np.column_stack([log.x_mm, log.y_mm])[log.contact], guided_pokes[2])
    blocks, account = read(folder)
    assert account["indentations_n"] == GuidedPresses().presses_n
    poked_uT = guided_pokes[1] - guided_pokes[0].mean(axis=0)
    changes_uT = np.concatenate([block.b_uT - block.noload_uT for block in blocks])
    place_mm = np.concatenate([np.column_stack([block.x_mm, block.y_mm]) for block in blocks])
    press_i = np.linalg.norm(place_mm[:, None] - guided_pokes[2], axis=2).argmin(axis=1)
    # The tolerance in uT allows for noise of 3 uT. Each reading must be of the press at the place of its label.
    np.testing.assert_allclose(changes_uT, poked_uT[press_i], atol=30)


def test_label_of_a_press_is_refused_if_no_no_load_readings_were_recorded(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    reader = PausingReader(make_script(pokes_n=0))
    recording = PageRecording(find.DetectedBoard("/dev/board", None, "binary", 5), reader, port_in_name=True)
    now_s = reader.unix_s()
    press = LabelledPress(Label(True, 1.0, 2.0), (now_s - 1.0, now_s), (now_s + 1.0, now_s + 2.0), np.zeros(15))
    with pytest.raises(CaptureError, match="recording has no reading without contact before this press. Press again"):
        recording.add(press)
    assert recording.end() == f"recorded {recording.folder}"
    assert recording.folder.name.endswith("-dev-board")
    assert not (recording.folder / PROBE_FILE).exists()


def presses_of(parts, rate_hz=100.0):
    """Return the presses in a stream of times with or without contact. In contact, every channel changes by 100 uT."""
    contact = np.concatenate([np.full(round(seconds * rate_hz), touched) for touched, seconds in parts])
    db_uT = np.full((len(contact), 15), 100.0, np.float32) * contact[:, None]
    none = np.zeros((len(contact), 3))
    t_s = np.arange(len(contact)) / rate_hz
    return PressFinder().add(Estimates(t_s, db_uT, db_uT, none, none[:, :2], none[:, 2], contact))


@pytest.mark.parametrize(
    ("parts", "problem"),
    [([(True, 1.0)], "begun before the label"), ([(False, 0.3), (True, 1.0)], "touched shortly before"),
     ([(False, 1.0), (True, 0.03)], "too short")],
)  # fmt: skip
def test_unusable_press_is_explained_and_the_next_press_is_used(parts, problem):
    label = Label(True, 1.0, 2.0)
    unusable, usable = presses_of([*parts, (False, 1.1), (True, 0.5), (False, 0.1)])
    with pytest.raises(CaptureError, match=problem):
        unusable.label(label)
    press = usable.label(label)
    assert press.rest_s[1] < press.held_s[0] < press.held_s[1]
    np.testing.assert_allclose(press.db_uT, 100.0)


def test_page_describes_the_universal_model_and_its_expected_accuracy(random_pokes):  # noqa: F811
    measured = io.read_json(MEASURED_FILE)
    noload_uT, b_uT, place_mm, force_N = random_pokes
    shipped = UniversalEstimator(load_universal())
    texts = shipped.describe("")
    assert texts["model"] == "universal model, shipped with reskin"
    for each in measured["places"][0]["median_mm"]:  # There is one value for each recorded board.
        assert f"{each:.1f}" in texts["expected"]
    assert all(f"{each:.2g}" in texts["least_force"] for each in measured["detection"]["lightest_N"])
    assert f"{shipped.model.layout.force_N[0]:.2g} N" in texts["least_force"]
    # For numbers of presses or labels that were not measured, the next smaller measured number is shown.
    many = (
        load_universal()
        .zero(noload_uT)
        .see(np.concatenate([b_uT + i for i in range(6)])[:65])
        .label(place_mm, force_N, b_uT)
    )
    texts = UniversalEstimator(many).describe("s1.safetensors")
    assert texts["model"] == "universal model, file s1.safetensors"
    assert texts["learnt"] == "77 presses in the file"
    assert texts["expected"].endswith("after 65 presses and 10 labels)")
    refined = load_universal().zero(noload_uT).use_refined(many.weights)
    assert UniversalEstimator(refined).describe("")["expected"] == "not measured for a refined network"
    outside = load_universal(external_uT=30.0)
    assert UniversalEstimator(outside).describe("")["expected"].endswith("not measured with external fields")
    other = replace(load_universal(), card={"name": "a model of another board"})
    texts = UniversalEstimator(other).describe("other.safetensors")
    assert texts["expected"] == "not measured for this model"
    assert texts["least_force"].startswith("not measured; trained with simulated forces from ")


def test_measured_accuracy_belongs_to_the_shipped_model(monkeypatch, tmp_path):
    measured, shipped = io.read_json(MEASURED_FILE), load_universal()
    assert measured["model_sha256"] == io.sha256(FILE)
    io.write_json(tmp_path / "measured.json", measured | {"model_sha256": "0" * 64})
    monkeypatch.setattr(models, "MEASURED_FILE", tmp_path / "measured.json")
    monkeypatch.setattr(models, "_shipped", models._shipped.__wrapped__)  # without its cache
    assert UniversalEstimator(shipped).describe("")["expected"] == "not measured for this model"


def test_page_describes_networks_by_the_scores_in_their_model_cards(tmp_path):
    network = read_network(write_model(tmp_path))
    scores = {"all": {"accuracy_pct": 71.4, "mse_xy_mm2": 0.512}}
    scored = replace(network, card=network.card | {"scores": scores, "test_boards": ["b0", "b1"]})
    texts = NetworkEstimator([scored]).describe("model.safetensors")
    assert texts["model"] == "trained network, file model.safetensors"
    assert texts["expected"] == "71 % within 1 mm, MSE_xy 0.51 mm² (scene quick, tested on boards b0, b1)"
    assert NetworkEstimator([scored] * 2).describe("")["expected"] == "not measured for their mean"
