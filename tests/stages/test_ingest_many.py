"""Tests of the stage that ingests all recorded captures of a scene: only new or changed captures are read."""

import pytest

from pipeline.settings import Settings
from pipeline.stages import ingest as stage
from reskin import io
from reskin.errors import CaptureError


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Return a function that runs the stage on three captures and returns the names of the captures that it read."""
    monkeypatch.chdir(tmp_path)
    read, shared = [], {"faults": {"stuck": "drop"}, "lost_fraction_max": 0.05}
    names = ["c0", "c1", "c2"]

    def ingest(settings, raw, indentations):
        if io.read_bytes(raw / "stream.bin") == b"broken":
            raise CaptureError("stream.bin")
        read.append(raw.name)
        io.write_text(indentations, raw.name)

    monkeypatch.setattr(stage, "ingest", ingest)
    io.write_text(tmp_path / "code", "1")
    for name in names:
        io.write_text(tmp_path / "raw" / name / "stream.bin", name)

    def run(**changed):
        read.clear()
        shared.update(changed)
        settings = Settings("lab", "lab.yaml", {}, dict(shared), tuple(names))
        stage.ingest_many(settings, tmp_path / "raw", tmp_path / "code", tmp_path / "out")
        assert {file.stem: file.read_text() for file in (tmp_path / "out").iterdir()} == {name: name for name in names}
        return read

    run.names, run.folder = names, tmp_path
    return run


def test_only_captures_that_are_not_cached_are_read(run):
    assert run() == ["c0", "c1", "c2"]
    assert run() == []
    run.names.remove("c1")
    assert run() == []
    assert len(list((run.folder / stage.CACHE / "lab").iterdir())) == 2
    run.names.append("c1")
    assert run() == ["c1"]


def test_captures_are_read_again_if_their_bytes_the_settings_or_the_code_change(run):
    run()
    io.write_text(run.folder / "raw/c1/stream.bin", "other")
    assert run() == ["c1"]
    assert run(faults={"stuck": "flag"}) == ["c0", "c1", "c2"]
    io.write_text(run.folder / "code", "2")
    assert run() == ["c0", "c1", "c2"]


def test_captures_that_were_read_stay_cached_if_another_capture_is_broken(run):
    io.write_text(run.folder / "raw/c2/stream.bin", "broken")
    with pytest.raises(CaptureError):
        run()
    io.write_text(run.folder / "raw/c2/stream.bin", "repaired")
    assert run() == ["c2"]


def test_capture_is_read_again_if_its_cached_file_is_damaged(run, capsys):
    run()
    (cached,) = [file for file in (run.folder / stage.CACHE / "lab").iterdir() if file.read_text() == "c1"]
    cached.write_text("c9")
    assert run() == ["c1"]
    assert f"{cached.name} are damaged, because the file has changed since it was written" in capsys.readouterr().err
    assert run() == []
