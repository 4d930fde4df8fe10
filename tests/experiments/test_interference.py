"""Tests of experiment interference: contacts and places in external fields that change after the no-load reading."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import reskin
from pipeline.experiments import interference as experiment
from pipeline.experiments.interference import JOINTS, REFERENCE_CHIP, SHIPPED, Interference, Pad, Presses, Sensor
from pipeline.report.tables import interference_contacts, interference_places
from pipeline.settings import Settings, read_settings
from pipeline.stages.ingest import ingest
from pipeline.statistics import as_json
from reskin.data.contact import contact_threshold_uT
from reskin.errors import ParamsError
from reskin.physics import external
from reskin.recordings.header import HEADER_FILE, render
from reskin.recordings.readers import leaphand
from reskin.seeds import rng_for
from reskin.universal.layout import paper_layout
from reskin.universal.model import load_universal
from tests.recordings.headers import make_header

ROOT = Path(__file__).resolve().parents[2]
RECORDED = ROOT.parent / "shared/data/leaphand"
NOISE_uT = 4.0
LAYOUT = paper_layout()
MODELS = {size_uT: load_universal(external_uT=size_uT) for size_uT in (0.0, 100.0)}
CI = read_settings("ci", ROOT)


def noise(n: int, name: str) -> np.ndarray:
    return NOISE_uT * rng_for(1, name).standard_normal((n, 15))


def sensor(**changes_uT: np.ndarray) -> Sensor:
    changes = {(field, SHIPPED): change_uT for field, change_uT in changes_uT.items()}
    return Sensor("pad", "pad", {SHIPPED: noise(400, "quiet")}, changes)


def uniform_uT(n: int, size_uT: float) -> np.ndarray:
    return LAYOUT.to_chips(np.tile(size_uT * rng_for(0, "uniform").standard_normal((n, 3)), len(LAYOUT.chips)))


# --- Contacts ---


def contacts(of: Sensor, touches_uT: np.ndarray) -> dict:
    presses = Presses("board", "skin", np.zeros(15), touches_uT, np.zeros((len(touches_uT), 3)))
    rows = experiment.contact_rows(of, [presses], MODELS, rng_for(0, "draws"))
    return {(row["field"], row["external_uT"]): row for row in rows}


def test_option_removes_false_contacts_in_the_fields_that_it_describes_and_keeps_presses():
    cov = external.covariance(LAYOUT.chips_mm, 100.0)
    dipoles_uT = LAYOUT.to_chips(rng_for(0, "dipoles").multivariate_normal(np.zeros(15), cov, 300, method="eigh"))
    of = sensor(
        none=noise(4000, "none"), uniform=noise(300, "a") + uniform_uT(300, 50.0), magnets=noise(300, "b") + dipoles_uT
    )
    found = contacts(of, 400 * rng_for(0, "touches").standard_normal((500, 15)))
    # The threshold is six standard deviations of a channel above the median length, which noise does not reach.
    assert found["none", 0.0]["false_pct"] == found["none", 100.0]["false_pct"] == 0
    for field in ("uniform", "magnets"):
        assert found[field, 0.0]["false_pct"] > 90
        assert found[field, 100.0]["false_pct"] < 5
        assert found[field, 100.0]["detected_pct"] == 100
    assert found["uniform", 0.0]["rms_uT"] == pytest.approx(50, rel=0.1)


def test_threshold_is_that_of_the_library_for_the_no_load_readings():
    quiet_uT = noise(400, "quiet")
    limit_uT = contact_threshold_uT(quiet_uT, None)
    direction = np.eye(15)[:1]
    of = sensor(below=0.999 * limit_uT * direction, above=1.001 * limit_uT * direction)
    found = contacts(of, np.zeros((1, 15)))
    assert [found[field, 0.0]["false_pct"] for field in ("below", "above")] == [0, 100]


def test_regression_from_joints_predicts_fields_that_depend_on_them():
    slopes, pads = rng_for(0, "slopes").normal(size=15), []
    for name in ("first", "second"):
        joints = np.full((300, 8), 2000.0)  # joints at rest, except one
        joints[:, 1] += rng_for(0, name).uniform(0, 500, 300)
        pads.append(Pad("pad", name, joints[:, 1:2] / 5 * slopes + noise(300, name), noise(5, "quiet"), joints))
    rest_uT = pads[1].db_uT - experiment.predict_changes(pads[0], pads[1].joint_counts)
    assert np.sqrt((rest_uT**2).mean()) < 1.1 * NOISE_uT < pads[1].db_uT.std() / 3
    with pytest.raises(ParamsError, match="no joint moves in a recording of pad"):
        experiment.predict_changes(replace(pads[0], joint_counts=0 * joints), joints)


def test_no_place_is_in_both_parts_of_a_split():
    place_mm = rng_for(0, "places").integers(0, 5, (200, 2)).astype(float)
    known, tested = experiment.split_places(place_mm, rng_for(0, "split"))
    assert sorted([*known, *tested]) == list(range(200))
    assert not {tuple(place) for place in place_mm[known]} & {tuple(place) for place in place_mm[tested]}


# --- The whole experiment ---


def results(settings: Settings, section: Interference, folder: Path) -> dict:
    scores = experiment.run(settings, section, folder / "raw", folder / "indentations")
    numbers = as_json(experiment.summarise(scores, {"draws_n": section.draws_n}))
    for make, key in ((interference_contacts, "contacts"), (interference_places, "places")):
        assert len(make({"interference": numbers})) == len(numbers[key])
    assert experiment.figures(numbers, {}, "recorded")["interference.svg"].startswith("<svg")
    return {(row["field"], row["method"], row["external_uT"], row.get("labels_n")): row
            for row in numbers["contacts"] + numbers["places"]}  # fmt: skip


def test_simulated_scene_shows_that_both_compensations_remove_a_uniform_field(tmp_path):
    section = CI.section(Interference, "interference")
    found = results(CI, section, tmp_path)
    false_pct = {key[:3]: row["false_pct"]["mean"] for key, row in found.items() if key[3] is None}
    assert false_pct["uniform_50_uT", SHIPPED, 0.0] > 90
    assert false_pct["uniform_50_uT", REFERENCE_CHIP, 0.0] == false_pct["uniform_50_uT", SHIPPED, 30.0] == 0
    fields = {"none", "uniform_50_uT", "iron_5_mm"}
    assert {key[::3] for key in found} == {(field, n) for field in fields for n in (None, *section.labels_n)}


@pytest.mark.skipif(not RECORDED.is_dir(), reason="the recordings of the hand are not here")
def test_recorded_hand_has_no_false_contacts_with_the_option(tmp_path):
    settings = replace(read_settings("hand", ROOT), captures=())
    reskin.simulate_recording(tmp_path / "raw/presses", depths_mm=[1.0])
    for name in ("0skin", "1skinnocontact"):
        folder = tmp_path / "raw" / name
        folder.mkdir()
        shutil.copy(RECORDED / f"{name}.txt", folder / leaphand.READINGS)
        header = make_header(capture=name, board="pad1", skin="two1", layout="leaphand", options={"pad": "1"})
        (folder / HEADER_FILE).write_text(render(header))
    for folder in (tmp_path / "raw").iterdir():
        ingest(settings, folder, tmp_path / "indentations" / f"{folder.name}.parquet")
    section = settings.section(Interference, "interference")
    pads = {"situations": {"pads_alone": (("0skin", "1skinnocontact"),)}, "labels_mirrored": False}
    less = {"draws_n": 1, "external_uT": (0.0, 30.0)}
    section = section.model_copy(update=less | {"hand": section.hand.model_copy(update=pads)})
    found = results(settings, section, tmp_path)
    assert found["pads_alone", SHIPPED, 0.0, None]["false_pct"]["mean"] > 10
    assert found["pads_alone", SHIPPED, 30.0, None]["false_pct"]["mean"] == 0
    assert found["pads_alone", JOINTS, 0.0, None]["rms_uT"]["mean"] < 6  # the noise of a channel is 4 uT
    wrong = section.hand.model_copy(update={"situations": {"pads_alone": (("0skin", "other"),)}})
    with pytest.raises(
        ParamsError, match="no recording other of layout leaphand in scene hand.* reskin fetch leaphand"
    ):
        results(settings, section.model_copy(update={"hand": wrong}), tmp_path)
    (tmp_path / "indentations/presses.parquet").unlink()
    with pytest.raises(ParamsError, match="no recordings of presses.* reskin fetch lab --scene hand"):
        results(settings, section, tmp_path)
