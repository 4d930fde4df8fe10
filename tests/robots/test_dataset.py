"""Tests of exported LeRobot datasets: contents, errors and, if RESKIN_LEROBOT is set, LeRobot itself."""

import json
import os
import subprocess
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from reskin import io
from reskin.board.faults import FAILED_B_uT, FAILED_TEMPERATURE_degC
from reskin.errors import CaptureError, ReskinError, SchemaError
from reskin.recordings.decode import decode_file
from reskin.recordings.header import HEADER_FILE, PROBE_FILE, STREAM_FILE, Clock, write_capture
from reskin.robots import dataset
from reskin.robots.dataset import export_lerobot
from reskin.schema import Readings
from tests.data.tables import readings
from tests.recordings.headers import make_header
from tests.test_predicting import RATE_HZ, log_of, write_log, write_stream

LEROBOT = os.environ.get("RESKIN_LEROBOT")  # a Python with the package lerobot
needs_lerobot = pytest.mark.skipif(
    LEROBOT is None, reason="RESKIN_LEROBOT=PYTHON is not set; PYTHON must have the package lerobot"
)
CHECK = Path(__file__).with_name("load_lerobot.py")
DWELLS = """indentation,pass_i,phase,t_start_s,t_end_s,x_mm,y_mm,depth_mm,Fx_N,Fy_N,Fz_N
0,0,noload,100.1,100.9,,,,,,0
0,0,contact,101.0,101.5,4,12,,,,0.5
"""


EXACT = {"timestamp_error_max_s": 0, "dropped_faulty_frames_n": 0}


def indentations(**changes: object) -> Readings:
    """Return the readings of 4 indentations at 100 Hz; 10 readings each, 1 s apart."""
    number = np.repeat(np.arange(4, dtype=np.int32), 10)
    t_s = number + np.tile(np.arange(10), 4) / 100
    return readings(f=40, **({"indentation": number, "t_s": t_s} | changes))


def write_readings(file: Path, **changes: object) -> Path:
    io.write_readings(file, [indentations(**changes)], {})
    return file


def read(folder: Path) -> tuple[pa.Table, pa.Table, dict, dict]:
    """Return all frames, all episodes, the information and the statistics of a dataset."""
    info, statistics = (json.loads((folder / "meta" / name).read_text()) for name in ("info.json", "stats.json"))
    return pq.read_table(folder / "data"), pq.read_table(folder / "meta/episodes"), info, statistics


def values_of(table: pa.Table, name: str) -> np.ndarray:
    return np.array(table[name].to_pylist(), float)


def load_with_lerobot(exported: Path, folder: Path, *options: str) -> list[dict]:
    """Load a dataset with LeRobot, in a separate environment; return its frames."""
    io.remove(folder)
    folder.mkdir()
    environment = {"PATH": os.environ["PATH"], "HF_HUB_OFFLINE": "1", "HF_HOME": str(folder / "hf")}
    done = subprocess.run([LEROBOT, CHECK, exported, folder, *options], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    print(done.stdout)
    return json.loads((folder / "frames.json").read_text())


def test_capture_is_exported_as_one_episode_with_all_readings(tmp_path):
    counts = export_lerobot([write_stream(tmp_path, "binary")], tmp_path / "out", task="touch")
    assert counts == {"episodes_n": 1, "frames_n": 500, "fps": 250, **EXACT}
    frames, episodes, info, statistics = read(tmp_path / "out")
    t_s, b_uT, temperature_degC = log_of()
    np.testing.assert_array_equal(values_of(frames, "observation.field_uT"), b_uT)
    np.testing.assert_array_equal(values_of(frames, "observation.temperature_degC"), temperature_degC)
    np.testing.assert_allclose(values_of(frames, "timestamp"), t_s - t_s[0], atol=1e-6)
    assert frames["frame_index"].to_pylist() == frames["index"].to_pylist() == list(range(500))
    assert info["features"]["observation.field_uT"]["names"][:4] == ["Bx0_uT", "By0_uT", "Bz0_uT", "Bx1_uT"]
    assert "label.place_mm" not in info["features"]
    for key, value in {"mean": b_uT.mean(axis=0), "std": b_uT.std(axis=0), "q50": np.median(b_uT, axis=0)}.items():
        np.testing.assert_allclose(statistics["observation.field_uT"][key], value, rtol=1e-5)
    assert statistics["observation.field_uT"]["count"] == [500]
    assert values_of(episodes, "stats/observation.field_uT/max")[0].tolist() == b_uT.max(axis=0).tolist()


def test_export_at_a_given_rate_uses_the_latest_reading_before_each_frame(tmp_path):
    t_s, b_uT, temperature_degC = log_of()
    kept = (t_s < 0.5) | (t_s > 0.9)
    io.write_text(tmp_path / "log.csv", dataset.sd_card.render(t_s[kept], b_uT[kept], temperature_degC[kept]))
    counts = export_lerobot([tmp_path / "log.csv"], tmp_path / "out", task="touch", fps=30)
    assert (counts["episodes_n"], counts["fps"]) == (2, 30)
    frames, episodes, _, _ = read(tmp_path / "out")
    b_of_frames = values_of(frames, "observation.field_uT")
    for start, end in pairwise([0, *episodes["dataset_to_index"].to_pylist()]):
        first = np.flatnonzero((b_uT == b_of_frames[start]).all(axis=1))[0]
        for i in range(end - start):
            latest = np.flatnonzero(t_s <= t_s[first] + i / 30 + 1e-9)[-1]
            np.testing.assert_array_equal(b_of_frames[start + i], b_uT[latest])
    about = json.loads((tmp_path / "out/meta/reskin.json").read_text())["episodes"]
    read_n = sum(each["skipped_readings_n"] for each in about) + counts["frames_n"]
    assert read_n == kept.sum()
    assert 0 < counts["timestamp_error_max_s"] <= 1 / RATE_HZ + 1e-6


def test_faulty_frames_are_dropped_and_counted(tmp_path):
    t_s, b_uT, temperature_degC = log_of()
    b_uT[10:14, :3], temperature_degC[10:14, 0] = FAILED_B_uT, FAILED_TEMPERATURE_degC
    io.write_text(tmp_path / "log.csv", dataset.sd_card.render(t_s, b_uT, temperature_degC))
    counts = export_lerobot([tmp_path / "log.csv"], tmp_path / "out", task="touch")
    assert (counts["frames_n"], counts["dropped_faulty_frames_n"]) == (496, 4)


def test_each_reading_becomes_one_frame_if_no_rate_is_given(tmp_path):
    t_s, b_uT, temperature_degC = log_of()
    t_s = t_s + np.where(np.arange(len(t_s)) >= 100, 0.05, 0.0)  # a gap of 0.05 s, as if frames were lost
    io.write_text(tmp_path / "log.csv", dataset.sd_card.render(t_s, b_uT, temperature_degC))
    counts = export_lerobot([tmp_path / "log.csv"], tmp_path / "out", task="touch")
    np.testing.assert_array_equal(values_of(read(tmp_path / "out")[0], "observation.field_uT"), b_uT)
    assert counts["timestamp_error_max_s"] == pytest.approx(0.05)


def test_readings_during_a_dwell_of_the_probe_log_have_its_labels(tmp_path):
    folder = write_stream(tmp_path, "binary")
    header = json.loads((folder / HEADER_FILE).read_text())
    header["clock"] = Clock(kind="arrivals", rate_hz=None, marks=((1.0, 101.0),)).model_dump(mode="json")
    (folder / HEADER_FILE).write_text(json.dumps(header))
    (folder / PROBE_FILE).write_text(DWELLS)
    export_lerobot([folder], tmp_path / "out", task="touch")
    frames, _, info, _ = read(tmp_path / "out")
    t_s = log_of()[0] + 100
    place_mm, force_N = values_of(frames, "label.place_mm"), values_of(frames, "label.force_N")
    touched, lifted = (t_s >= 101.0) & (t_s <= 101.5), (t_s >= 100.1) & (t_s <= 100.9)
    assert (place_mm[touched] == [4, 12]).all()
    assert np.isnan(place_mm[~touched]).all()
    assert (force_N[touched] == 0.5).all()
    assert (force_N[lifted] == 0).all()
    assert np.isnan(force_N[~touched & ~lifted]).all()
    assert info["features"]["label.force_N"]["names"] == ["Fz_N"]  # the log has no sideways forces
    assert "label.depth_mm" not in info["features"]


def test_each_indentation_of_ingested_readings_becomes_an_episode(tmp_path):
    files = [write_readings(tmp_path / f"c{i}.parquet", capture=f"c{i}") for i in range(2)]
    counts = export_lerobot(files, tmp_path / "out", task="touch")
    assert counts == {"episodes_n": 8, "frames_n": 80, "fps": 100, **EXACT}
    frames, episodes, info, _ = read(tmp_path / "out")
    assert episodes["length"].to_pylist() == [10] * 8
    assert episodes["tasks"].to_pylist() == [["touch"]] * 8
    assert set(info["features"]) - set(dataset.INDICES) == {
        "observation.field_uT", "observation.noload_uT", "observation.temperature_degC", "label.place_mm",
        "label.depth_mm", "label.force_N",
    }  # fmt: skip
    np.testing.assert_array_equal(values_of(frames, "label.place_mm")[:40, 0], np.arange(40))
    np.testing.assert_array_equal(values_of(frames, "episode_index"), np.repeat(np.arange(8), 10))
    tasks = pa.Table.to_pandas(pq.read_table(tmp_path / "out/meta/tasks.parquet"))
    assert tasks.loc["touch"].task_index == 0


def test_export_of_readings_without_times_raises_unless_their_rate_is_given(tmp_path):
    file = write_readings(tmp_path / "c.parquet", t_s=np.full(40, np.nan))
    stream = write_stream(tmp_path, "binary") / STREAM_FILE
    decode_file(stream, tmp_path / "frames.parquet", "binary", 5)
    for path in (file, tmp_path / "frames.parquet"):
        with pytest.raises(ReskinError, match="have no times. State their rate"):
            export_lerobot([path], tmp_path / "out", task="touch")
    with pytest.raises(ReskinError, match="has no times, so its rate cannot be changed"):
        export_lerobot([file], tmp_path / "out", task="touch", rate_hz=50, fps=30)
    assert export_lerobot([file], tmp_path / "out", task="touch", rate_hz=50)["fps"] == 50
    np.testing.assert_allclose(values_of(read(tmp_path / "out")[0], "timestamp")[:3], [0, 0.02, 0.04])
    assert export_lerobot([tmp_path / "frames.parquet"], tmp_path / "out2", task="touch", rate_hz=RATE_HZ)["fps"] == 250


def test_export_of_wrong_input_raises_and_writes_no_files(tmp_path):
    good, out = write_readings(tmp_path / "a.parquet"), tmp_path / "out"
    simulated = write_readings(tmp_path / "b.parquet", source="simulated")
    unlabelled = write_readings(tmp_path / "c.parquet", Fz_N=np.full(40, np.nan, np.float32))
    slow = write_readings(tmp_path / "d.parquet", t_s=np.arange(40) / 10.0)
    backwards = write_readings(tmp_path / "e.parquet", t_s=-np.arange(40.0))
    still = write_readings(tmp_path / "f.parquet", t_s=np.zeros(40))
    write_capture(tmp_path / "a_capture", make_header(), {})
    folder = write_stream(tmp_path, "binary")
    (folder / PROBE_FILE).write_text(DWELLS)
    for files, options, error, message in (
        ([good, simulated], {}, SchemaError, "this recording is simulated, but .*a.parquet is recorded"),
        ([good, unlabelled], {}, SchemaError, "contains Fz_N. Export these recordings to different folders"),
        ([good, slow], {}, ReskinError, "different rates, 10 to 100 Hz"),
        ([good, write_log(tmp_path)], {}, SchemaError, "only this recording or only .* contains"),
        ([backwards], {"fps": 10}, CaptureError, "the times go backwards"),
        ([folder], {}, CaptureError, "labels in probe.csv are on another clock"),
        ([good], {"fps": 0}, ReskinError, "--fps: 0 is not from 1 to"),
        ([good], {"task": " "}, ReskinError, "--task: the text is empty"),
        ([still], {}, ReskinError, "no episode has two readings at different times"),
        ([tmp_path / "a_capture"], {}, CaptureError, "a capture of layout lab cannot be exported"),
        ([tmp_path / "missing"], {}, SchemaError, "file not found"),
    ):
        with pytest.raises(error, match=message):
            export_lerobot(files, out, **({"task": "touch"} | options))
        assert not out.exists()
    export_lerobot([good], out, task="touch")
    with pytest.raises(ReskinError, match="out exists. Choose another folder"):
        export_lerobot([good], out, task="touch")
    assert not list(tmp_path.glob(".out*"))


@needs_lerobot
def test_exported_dataset_equals_the_one_that_lerobot_writes_from_the_same_frames(tmp_path):
    file = write_readings(tmp_path / "c.parquet", x_mm=np.arange(-5, 35).astype(np.float32))
    for source, name in ((file, "readings"), (write_stream(tmp_path, "binary"), "stream")):
        export_lerobot([source], tmp_path / name, task="touch")
        loaded, frames = load_with_lerobot(tmp_path / name, tmp_path / "check", "compare"), read(tmp_path / name)[0]
        for column in frames.column_names:
            np.testing.assert_array_equal([frame[column] for frame in loaded], values_of(frames, column))
        assert {frame["task"] for frame in loaded} == {"touch"}


@needs_lerobot
def test_lerobot_loads_a_dataset_with_unknown_values(tmp_path):
    place_mm = np.where(np.arange(40) < 5, np.nan, np.arange(40)).astype(np.float32)
    export_lerobot([write_readings(tmp_path / "c.parquet", x_mm=place_mm)], tmp_path / "out", task="touch")
    loaded = load_with_lerobot(tmp_path / "out", tmp_path / "check")
    np.testing.assert_array_equal([frame["label.place_mm"][0] for frame in loaded], place_mm)
    assert [frame["episode_index"] for frame in loaded] == np.repeat(np.arange(4), 10).tolist()
