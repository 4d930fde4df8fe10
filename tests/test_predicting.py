"""Tests of `reskin predict`, with a network whose output is constant."""

import json
import re

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from reskin import cli, draw_skin, io, load_model, load_universal, predicting, simulate_pokes
from reskin.board.wire import Frames, encode, record_type
from reskin.errors import CaptureError, ReskinError
from reskin.models.network import draw_weights, paper_layers
from reskin.predicting import predict, warnings
from reskin.recordings import clocks, fault_policy, tables
from reskin.recordings.clocks import Arrivals
from reskin.recordings.decode import decode_file, frame_columns
from reskin.recordings.header import ARRIVALS_FILE, STREAM_FILE, Clock, write_capture
from reskin.recordings.readers.sd_card import read_log, render
from reskin.seeds import rng_for
from reskin.universal.layout import paper_layout
from reskin.universal.model import FILE
from tests.recordings.headers import make_header

RATE_HZ, QUIET_N, TOUCHED_N = 250.0, 400, 100
ESTIMATE = np.array([8.0, 4.0, 1.5], np.float32)
CARD = {
    "format": "reskin-model/3", "recipe": {"inputs": "raw", "architecture": "paper"},
    "input": {"quantity": "change of field", "unit": "uT", "channels_n": 15},
    "output": {"x_mm": "mm", "y_mm": "mm", "Fz_N": "N"}, "collapsed": False,
}  # fmt: skip


@pytest.fixture
def model(tmp_path):
    weights = {name: 0 * value for name, value in draw_weights(paper_layers(15), rng_for(0, "net")).items()}
    scaler = {"input_shift": np.zeros(15, np.float32), "input_scale": np.ones(15, np.float32)}
    scaler |= {"target_shift": ESTIMATE, "target_scale": np.ones(3, np.float32)}
    io.write_model(tmp_path / "model.safetensors", weights | scaler, CARD)
    return tmp_path / "model.safetensors"


def log_of(chips_n=5):
    """Return the times, fields (with two decimals) and temperatures of the frames of a log."""
    frames_n = QUIET_N + TOUCHED_N
    touched = np.arange(frames_n) >= QUIET_N
    noise_uT = 3 * rng_for(0, "log").standard_normal((frames_n, 3 * chips_n))
    b_uT = np.round(500 + 200 * touched[:, None] + noise_uT, 2).astype(np.float32)
    return (1 + np.arange(frames_n)) / RATE_HZ, b_uT, np.full((frames_n, chips_n), 25, np.float32)


def write_log(folder, chips_n=5, scale=1.0):
    t_s, b_uT, temperature_degC = log_of(chips_n)
    (folder / "log.csv").write_text(render(t_s, b_uT * np.float32(scale), temperature_degC))
    return folder / "log.csv"


def write_stream(folder, wire):
    """Write the frames of `log_of` to a capture folder, as `reskin record` does."""
    t_s, b_uT, temperature_degC = log_of()
    stream = encode(Frames(b_uT, temperature_degC, t_s, np.zeros(len(t_s), np.int64)), wire)
    ends = np.cumsum([len(line) + 1 for line in stream.split(b"\n")[:-1]])
    if wire.startswith("binary"):
        ends = record_type(wire, 5).itemsize * np.arange(1, len(t_s) + 1)
    arrived = Arrivals(np.append(0, ends), np.append(0.0, t_s))
    clock = Clock(kind="arrivals", rate_hz=None, marks=())
    header = make_header(capture="run1", layout="native", wire=wire, chips_n=5, clock=clock)
    files = {STREAM_FILE: stream, ARRIVALS_FILE: clocks.render(arrived).encode()}
    write_capture(folder / "run1", header, files)
    return folder / "run1"


@pytest.mark.parametrize("wire", ["binary", "binary-clock", "text-xyzt"])
def test_predictions_from_a_stream_from_its_decoded_table_and_from_a_log_are_equal(tmp_path, model, wire):
    folder, table = write_stream(tmp_path, wire), tmp_path / "frames.parquet"
    decode_file(folder / STREAM_FILE, table, wire, 5)
    outs = [tmp_path / f"{name}.csv" for name in ("log_out", "folder_out", "table_out")]
    for source, out in zip((write_log(tmp_path), folder, table), outs, strict=True):
        counts = predict(source, model, out, rate_hz=RATE_HZ)
        assert counts["rows_n"] == QUIET_N + TOUCHED_N
    assert outs[0].read_text() == outs[1].read_text() == outs[2].read_text()


@pytest.mark.parametrize("external_uT", [0.0, 50.0])
def test_change_of_a_uniform_field_counts_as_contact_unless_external_fields_are_expected(tmp_path, external_uT):
    t_s, b_uT, temperature_degC = log_of()
    touched = np.arange(len(t_s)) >= QUIET_N
    # The change of 200 uT in all channels is replaced by a field that is uniform along the axes of the board.
    turning_uT = paper_layout().to_chips(np.tile([40.0, -30.0, 60.0], 5)[None]) - 200
    b_uT = (b_uT + touched[:, None] * turning_uT).astype(np.float32)
    (tmp_path / "log.csv").write_text(render(t_s, b_uT, temperature_degC))
    counts = predict(tmp_path / "log.csv", None, tmp_path / "out.csv", external_uT=external_uT)
    assert counts["contact_readings_n"] == (0 if external_uT else TOUCHED_N)


def test_predicting_with_a_network_raises_if_external_fields_are_expected(tmp_path, model):
    with pytest.raises(ReskinError, match="networks have no option for external fields"):
        predict(write_log(tmp_path), model, tmp_path / "out.csv", external_uT=50.0)


def test_fields_in_mT_are_refused(tmp_path, model):
    with pytest.raises(CaptureError, match="field must be 20 uT or more .* If the unit of the file is mT or G"):
        predict(write_log(tmp_path, scale=1e-3), model, tmp_path / "out.csv")


def test_unsuitable_tables_and_labelled_recordings_are_an_error(tmp_path, model):
    io.write_table(tmp_path / "x.parquet", pa.table({"x": [1.0]}))
    with pytest.raises(CaptureError, match="the columns x are not those that `reskin decode` writes"):
        predict(tmp_path / "x.parquet", model, tmp_path / "out.csv")
    write_capture(tmp_path / "c0", make_header(capture="c0"), {})
    with pytest.raises(CaptureError, match="cannot predict from a capture of layout"):
        predict(tmp_path / "c0", model, tmp_path / "out.csv")


def test_output_has_a_row_for_every_line_and_estimates_for_every_contact(tmp_path, model):
    counts = predict(write_log(tmp_path), model, tmp_path / "out.csv")
    names, *rows = [line.split(",") for line in (tmp_path / "out.csv").read_text().splitlines()]
    assert names == ["t_s", "x_mm", "y_mm", "F_N", "contact"]
    assert len(rows) == QUIET_N + TOUCHED_N == counts["rows_n"]
    assert all(row[1:] == ["", "", "", "0"] for row in rows[:QUIET_N])
    np.testing.assert_array_equal(
        [[float(cell) for cell in row[1:]] for row in rows[QUIET_N:]], [[*ESTIMATE, 1]] * TOUCHED_N
    )
    np.testing.assert_allclose([float(row[0]) for row in rows], (1 + np.arange(len(rows))) / RATE_HZ)


def test_collapsed_model_is_an_error(tmp_path, model):
    io.write_json(model.with_suffix(".json"), CARD | {"collapsed": True})
    with pytest.raises(ReskinError, match="the model has collapsed"):
        predict(write_log(tmp_path), model, tmp_path / "out.csv")
    assert not (tmp_path / "out.csv").exists()


def test_unsuitable_inputs_raise_an_error_before_any_file_is_written(tmp_path, model):
    log, out = write_log(tmp_path), tmp_path / "out.csv"
    four = tmp_path / "four"
    four.mkdir()
    cases = [
        (write_log(four, chips_n=4), model, out, "the log has 12 channels, but the model has 15"),
        (log, tmp_path / "other.safetensors", out, r"model file not found. Models in this folder: model\.safetensors"),
        (log, model, log, "is the log, the model or the model's card"),
        (log, model, model, "is the log, the model or the model's card"),
        (log, model, model.with_suffix(".json"), "is the log, the model or the model's card"),
        (log, model, tmp_path / "four" / ".." / "model.json", "is the log, the model or the model's card"),
        (tmp_path / "none.csv", model, out, r"none\.csv: file not found"),
    ]
    files = (log, model, model.with_suffix(".json"))
    before = [file.read_bytes() for file in files]
    for *paths, message in cases:
        with pytest.raises(ReskinError, match=message):
            predict(*paths)
    assert not out.exists()
    assert [file.read_bytes() for file in files] == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "reskin-model/1"}, "format reskin-model/1 is not supported, only reskin-model/3"),
        ({"format": 2}, "format 2 is not supported"),
        ({"output": {"x_mm": "mm", "y_mm": "mm"}}, "the model predicts x_mm, y_mm, not x_mm, y_mm, Fz_N"),
        ({"input": None}, r"model\.json: input must be"),
        ({"input": {}}, "input.quantity, input.unit, .* are missing"),
        ({"input": CARD["input"] | {"unit": "T"}}, "input.unit must be 'uT'; got 'T'"),
        ({"input": CARD["input"] | {"channels_n": "15"}}, "input.channels_n must be a valid integer; got '15'"),
        ({"input": CARD["input"] | {"channels_n": 14}}, "input.channels_n must be a multiple of 3; got 14"),
        ({"input": CARD["input"] | {"channels_n": 12}}, "the card must be the one"),
        ({"recipe": {"inputs": "raw", "architecture": "released"}}, "the card must be the one"),
        ({"seed": 3}, "the card must be the one"),
        ({"recipe": {"inputs": "spectrum", "architecture": "paper"}}, "recipe.inputs must be 'raw' or 'shape'"),
        ({"recipe": {"inputs": "raw"}}, "recipe.architecture is missing"),
    ],
)
def test_wrong_model_card_is_an_error(tmp_path, model, change, message):
    model.with_suffix(".json").write_text(json.dumps(CARD | change))
    with pytest.raises(ReskinError, match=message) as refused:
        predict(write_log(tmp_path), model, tmp_path / "out.csv")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("card", "name", "change"),
    [
        ({}, "layer3.weight", lambda values: values * np.nan), ({}, "input_scale", lambda values: values + np.inf),
        ({}, "layer6.bias", lambda values: values[:2]), ({}, "target_shift", lambda values: values.astype(float)),
        ({"input": CARD["input"] | {"channels_n": 12}}, "input_scale", lambda values: values),
        ({"recipe": {"inputs": "shape", "architecture": "paper"}}, "input_scale", lambda values: values),
    ],
)  # fmt: skip
def test_network_with_arrays_that_are_not_finite_or_do_not_fit_its_card_is_refused(tmp_path, model, card, name, change):
    tensors, _ = io.read_tensors(model)
    io.write_model(model, tensors | {name: change(tensors[name])}, CARD | card)
    with pytest.raises(ReskinError, match="array .* must be"):
        load_model(model)


@pytest.mark.parametrize("lacking", ["input", "recipe", "output", "format"])
def test_incomplete_model_card_is_an_error(tmp_path, model, lacking):
    model.with_suffix(".json").write_text(json.dumps({name: CARD[name] for name in CARD if name != lacking}))
    with pytest.raises(ReskinError, match=f"{lacking} (is missing|None is not supported)"):
        predict(write_log(tmp_path), model, tmp_path / "out.csv")


def test_model_card_that_is_not_a_mapping_is_an_error(tmp_path, model):
    model.with_suffix(".json").write_text("[1]")
    with pytest.raises(ReskinError, match="format None is not supported"):
        predict(write_log(tmp_path), model, tmp_path / "out.csv")


def test_model_without_its_card_is_an_error(tmp_path, model):
    model.with_suffix(".json").unlink()
    with pytest.raises(ReskinError, match=r"model\.json: card of the model not found"):
        predict(write_log(tmp_path), model, tmp_path / "out.csv")


@pytest.mark.parametrize(
    ("path", "remedy"),
    [
        (
            "data/models/quick/train_multi/lobo.paper.b0.seed0.safetensors",
            "`reskin scenes use quick` and then `make re",
        ),
        ("mine/one.safetensors", "Use the path of a trained"),
    ],
)
def test_error_for_a_missing_model_names_the_scene_that_trains_it(tmp_path, path, remedy):
    with pytest.raises(ReskinError, match=f"model file not found.*{remedy}"):
        load_model(tmp_path / path)


def test_error_for_a_wrong_model_file_does_not_suggest_deleting_it(tmp_path, model):
    (tmp_path / "net.pt").write_bytes(b"PK" + bytes(100))
    cases = {
        tmp_path / "net.pt": "not a trained model",
        model.with_suffix(".json"): f"not a trained model.* Use {model}",
        tmp_path: r"this is a folder.* model\.safetensors",
    }
    for file, message in cases.items():
        with pytest.raises(ReskinError, match=f"{file}: {message}") as refused:
            predict(write_log(tmp_path), file, tmp_path / "out.csv")
        assert "delete" not in str(refused.value)
    with pytest.raises(ReskinError, match="this is a universal model. Load it with reskin.load_universal"):
        load_model(FILE)


def test_several_networks_are_refused_for_one_log(tmp_path, model):
    with pytest.raises(ReskinError, match="only one network can be used for a log. Use --model only once"):
        predict(write_log(tmp_path), [model, model], tmp_path / "out.csv")
    same = predict(write_log(tmp_path), FILE, tmp_path / "out.csv")  # This is the shipped model, named explicitly.
    assert same == predict(write_log(tmp_path), None, tmp_path / "out.csv")


def test_table_with_labels_is_scored_against_them(tmp_path, capsys):
    places = np.column_stack([rng_for(0, "places").uniform(3, 13, (40, 2)), np.full(40, 1.0)])
    noload_uT, b_uT, force_N = simulate_pokes(draw_skin(seed=3), places, seed=3)
    channels = ",".join(f"B{axis}{chip}" for chip in range(5) for axis in "xyz")
    lines = [f"phase,x_mm,y_mm,{channels},Fz_N"]
    for (x_mm, y_mm, _), rest_uT, pressed_uT, f_N in zip(places, noload_uT, b_uT, force_N, strict=False):
        for phase, row_uT, newton in (("noload", rest_uT, 0.0), ("contact", pressed_uT, f_N)):
            lines.append(f"{phase},{x_mm:.3f},{y_mm:.3f},{','.join(f'{v:.3f}' for v in row_uT)},{newton:.3f}")
    (tmp_path / "table.csv").write_text("\n".join(lines) + "\n")
    cli.predict(tmp_path / "table.csv", tmp_path / "out.csv", None)
    assert re.search(r"40 readings with labels, \d+ % within 1 mm .*RMS error of the force", capsys.readouterr().out)
    estimates = np.genfromtxt(tmp_path / "out.csv", delimiter=",", names=True)
    near = (np.abs(np.column_stack([estimates["x_mm"], estimates["y_mm"]]) - places[:, :2]) <= 1).all(axis=1)
    counts = predict(tmp_path / "table.csv", None, tmp_path / "out.csv")
    assert counts["accuracy_pct"] == pytest.approx(100 * near.mean(), abs=5)  # places are rounded in the file
    assert counts["rms_force_N"] == pytest.approx(np.sqrt(np.mean((estimates["F_N"] - force_N) ** 2)), abs=0.01)


@pytest.mark.parametrize("rows_n", [37, 128, 10_000])
def test_predictions_do_not_depend_on_the_sizes_of_blocks(tmp_path, monkeypatch, rows_n):
    """The log has presses, failed reads, a stuck chip and cut numbers, which cross the edges of the blocks."""
    t_s, b_uT, temperature_degC = log_of()
    t_s, b_uT = (1 + np.arange(4 * len(t_s))) / RATE_HZ, np.tile(b_uT, (4, 1))
    b_uT[900:1000, 6:9] = b_uT[900, 6:9]
    b_uT[100::61, 3:6], b_uT[130::53, 8] = 0.0, 12.0
    (tmp_path / "log.csv").write_text(render(t_s, b_uT, np.tile(temperature_degC, (4, 1))))
    monkeypatch.setattr(fault_policy, "LOG_HEAD_FRAMES_N", 640)
    monkeypatch.setattr(fault_policy, "LOG_BLOCK_FRAMES_N", 320)
    expected = predict(tmp_path / "log.csv", None, tmp_path / "expected.csv")
    assert expected["contacts_n"] == 4
    assert min(expected[f"dropped_{name}_rows_n"] for name in ("failed_read", "stuck_chip")) > 20
    monkeypatch.setattr(tables, "BLOCK_BYTES_N", 100 * rows_n)
    monkeypatch.setattr(predicting, "ESTIMATED_AT_ONCE_N", rows_n)
    assert predict(tmp_path / "log.csv", None, tmp_path / "out.csv") == expected
    assert (tmp_path / "out.csv").read_text() == (tmp_path / "expected.csv").read_text()


def test_table_that_would_expand_beyond_the_memory_is_refused_or_read_in_parts(tmp_path, monkeypatch):
    monkeypatch.setattr(io, "TABLE_BYTES_MAX_N", 10**7)
    table = pa.table({name: np.zeros(2**16) for name in frame_columns(5)})
    pq.write_table(table, tmp_path / "x.parquet", compression="zstd")
    with pytest.raises(ReskinError, match="rows .* GB of memory"):
        io.read_table(tmp_path / "x.parquet")
    with pytest.raises(CaptureError, match="row 2: t_s"):  # all times are 0, which is found in the first block
        predict(tmp_path / "x.parquet", None, tmp_path / "out.csv")


def test_log_that_starts_in_contact_is_an_error(tmp_path, model):
    log = write_log(tmp_path)
    first, *rows = log.read_text().splitlines(keepends=True)
    log.write_text("".join([first, *rows[QUIET_N - 50 :]]))
    with pytest.raises(CaptureError, match="the start without contact lasts"):
        predict(log, model, tmp_path / "out.csv")


def test_universal_model_is_the_default(tmp_path):
    predict(write_log(tmp_path), None, tmp_path / "out.csv")
    rows = [line.split(",") for line in (tmp_path / "out.csv").read_text().splitlines()[1:]]
    touched = [row for row in rows if row[-1] == "1"]
    assert len(touched) == TOUCHED_N
    assert all(-1 < float(value) < 17 for row in touched for value in row[1:3])


def write_presses(folder, chips_on_n=0, factor=1.0):
    """Write a log of presses on a simulated skin, with rotated chips and scaled field changes."""
    places = np.column_stack([rng_for(0, "places").uniform(3, 13, (12, 2)), np.full(12, 1.0)])
    noload_uT, b_uT, _ = simulate_pokes(draw_skin(seed=3), places, seed=3)
    rest_uT = noload_uT.mean(axis=0)
    clean_uT = np.concatenate(
        [np.tile(rest_uT, (QUIET_N, 1)), np.repeat(rest_uT + factor * (b_uT - rest_uT), 10, axis=0)]
    )
    clean_uT = np.roll(clean_uT, 3 * chips_on_n, axis=1) + 3 * rng_for(0, "log").standard_normal(clean_uT.shape)
    t_s = (1 + np.arange(len(clean_uT))) / RATE_HZ
    (folder / "log.csv").write_text(render(t_s, clean_uT.astype(np.float32), np.full((len(t_s), 5), 25, np.float32)))
    return folder / "log.csv"


def test_summary_counts_readings_of_an_unknown_skin_and_forces_at_the_limit(tmp_path, model, capsys):
    log, out = write_presses(tmp_path), tmp_path / "out.csv"
    counts = predict(log, None, out)
    assert (counts["unknown_skin_readings_n"], counts["force_at_limit_readings_n"]) == (0, 0)
    assert warnings(counts) == []
    estimates = np.genfromtxt(out, delimiter=",", names=True)
    universal = load_universal()
    b_uT = read_log(log)[1]
    expected = universal.zero(b_uT[:QUIET_N]).predict(b_uT[QUIET_N:])
    np.testing.assert_allclose(estimates["F_N"][QUIET_N:], expected[:, 2], atol=0.05)
    assert out.read_text().splitlines()[0] == "t_s,x_mm,y_mm,F_N,contact"

    swapped = predict(write_presses(tmp_path, chips_on_n=1), None, out)
    assert swapped["unknown_skin_readings_n"] > 0.1 * swapped["contact_readings_n"]
    assert "Check the order of the chips" in " ".join(warnings(swapped))

    strong = write_presses(tmp_path, factor=20.0)
    cli.predict(strong, out, None)
    output = capsys.readouterr().out
    assert "120 of 120 readings in contact are at a limit of the model's force range" in output
    assert "force_at_limit_readings_n 120" in output
    assert "unknown_skin_readings_n" not in predict(log, model, out)  # Only the universal model reports this count.
