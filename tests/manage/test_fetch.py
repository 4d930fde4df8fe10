"""Tests of `reskin fetch`: public recordings are checked and added once; errors leave no wrong files."""

import threading
from collections.abc import Iterator
from functools import partial
from hashlib import sha256
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace

import pytest
from ruamel.yaml import YAML
from typer.testing import CliRunner

from pipeline import SCENES, plan
from pipeline.cli import app
from pipeline.manage import fetch as fetching
from pipeline.manage.registry import read_registry
from reskin.errors import ReskinError
from reskin.recordings import preparing
from reskin.recordings.preparing import CaptureNames
from reskin.recordings.readers import READERS, lab
from tests.manage.test_add import contents
from tests.recordings.headers import DEFAULT_POLICY
from tests.recordings.readers.test_lab import PRESSES, write
from tests.scenes import recorded_scene
from tests.stages.checkout import copy_checkout, copy_without_code
from tests.test_pickled import archive_of_csv

ROOT = Path(__file__).resolve().parents[2]
SOURCES = fetching.read_sources(ROOT)


class QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(scope="module")
def example(tmp_path_factory) -> Iterator[SimpleNamespace]:
    """Yield a checkout without scenes, and a server with two recordings."""
    root, away = copy_checkout(tmp_path_factory.mktemp("checkout")), tmp_path_factory.mktemp("away")
    plan.use(root, [])
    with (root / SCENES / "small.yaml").open("w") as stream:
        YAML().dump(recorded_scene(), stream)
    (away / "rig").mkdir()
    text = (write(away / "rig", *PRESSES) / lab.READINGS).read_text()
    files = {"board1.csv": text.encode(), "board2.csv": text.replace("160.0000", "160.4000").encode()}
    for name, content in files.items():
        (away / name).write_bytes(content)
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(QuietHandler, directory=str(away)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield SimpleNamespace(root=root, away=away, files=files, url=f"http://127.0.0.1:{server.server_port}")
    server.shutdown()
    server.server_close()


@pytest.fixture
def root(example, tmp_path) -> Path:
    """Return a checkout whose only source of recordings is the server of `example`."""
    root = copy_without_code(example.root, tmp_path / "checkout")
    write_source(root, example)
    return root


def write_source(root: Path, example: SimpleNamespace, **changes: object) -> None:
    source = {
        "home": "https://rig.example", "base": example.url, "licence": "MIT", "scene": "small",
        "files": {name: sha256(content).hexdigest() for name, content in example.files.items()},
        "recordings": [
            {"path": name, "layout": "lab", "board": name[:6], "skin": f"skin-{name[:6]}"} for name in example.files
        ],
    }  # fmt: skip
    with (root / fetching.SOURCES).open("w") as stream:
        YAML().dump({"rig": source | changes}, stream)


def fetch(root: Path, origin: str | Path | None = None, *, scene: str | None = None, consent: bool = False) -> str:
    output: list[str] = []
    where = None if origin is None else str(origin)
    fetching.fetch(root, "rig", where, scene, agree=lambda _: consent, say=output.append)
    return "\n".join(output)


def fetched_files(root: Path) -> dict[str, bytes]:
    folder = root / fetching.FETCHED / "rig"
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_recordings_are_downloaded_and_added_once(root, example):
    assert "next: reskin scenes use small; dvc repro" in fetch(root)
    assert fetched_files(root) == example.files
    captures = ["board1_skin-board1_board1", "board2_skin-board2_board2"]
    assert sorted(read_registry(root).captures["small"]) == captures
    before = contents(root)
    assert f"small/{captures[0]}: added already" in fetch(root)
    assert contents(root) == before
    (root / fetching.FETCHED / "rig/board2.csv").write_bytes(b"changed")
    fetch(root)
    assert fetched_files(root) == example.files


def test_recording_added_under_another_name_does_not_prevent_the_others(root, example):
    prepared = preparing.foreign(example.away / "board1.csv", "lab", CaptureNames("b", "s", "mine"), {})
    fetching.add.add(root, "small", prepared, allow_copy=False)
    assert "not added. capture board1_skin-board1_board1: it has the same readings as mine" in fetch(root)
    assert sorted(read_registry(root).captures["small"]) == ["board2_skin-board2_board2", "mine"]


@pytest.mark.parametrize("place", ["folder", "mirror"])
def test_recordings_can_be_taken_from_another_place_and_added_to_another_scene(root, example, place):
    write_source(root, example, base="http://127.0.0.1:9/none", urls={"board1.csv": "http://127.0.0.1:9/none"})
    with (root / SCENES / "other.yaml").open("w") as stream:
        YAML().dump(recorded_scene(), stream)
    fetch(root, example.away if place == "folder" else example.url, scene="other")
    assert fetched_files(root) == example.files
    assert {scene: len(captures) for scene, captures in read_registry(root).captures.items()} == {"other": 2}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"base": "http://127.0.0.1:9/none"}, "cannot fetch the file: .* Check the network"),
        ({"files": {"board1.csv": "0" * 64}}, "board1.csv: cannot fetch the file: SHA256 hash .* does not match"),
        ({"files": {"board3.csv": "0" * 64}}, "board3.csv: cannot fetch the file: 404"),
        ({"base": None, "how": "Clone it by hand."}, "https://rig.example: Clone it by hand."),
    ],
)
def test_file_that_cannot_be_downloaded_is_an_error(root, example, changes, message):
    write_source(root, example, **changes)
    with pytest.raises(ReskinError, match=message):
        fetch(root)
    assert fetched_files(root) == {}


def test_truncated_file_in_a_folder_is_an_error(root, example, tmp_path):
    (tmp_path / "board1.csv").write_bytes(example.files["board1.csv"][:-1])
    with pytest.raises(ReskinError, match="no file board1.csv with SHA-256 .* truncated"):
        fetch(root, tmp_path)
    assert fetched_files(root) == {}


def test_files_without_a_licence_need_consent(root, example, monkeypatch):
    write_source(root, example, licence=None, scene=None)
    monkeypatch.chdir(root)
    done = CliRunner().invoke(app, ["fetch", "rig"])
    assert "add --yes" in str(done.exception)
    assert fetched_files(root) == {}
    assert CliRunner().invoke(app, ["fetch", "rig", "--yes"]).exit_code == 0
    assert fetched_files(root) == example.files


def test_archive_is_converted_to_a_table_before_its_hash_is_compared(root, example, tmp_path):
    rows = [
        f"{i},{phase},{4 * i},2,{','.join(f'{value * (1 + i):.4f}' for value in range(20))},0.000000,0.000000,{force}"
        for i in range(2)
        for phase, force in (("noload", "0.000000"), ("contact", "-2.000000"))
    ]
    names = "indent,phase,x_mm,y_mm," + ",".join(f"T{c},Bx{c},By{c},Bz{c}" for c in range(5)) + ",Fx,Fy,Fz"
    table = "\r\n".join([names, *rows, ""]).encode()
    (tmp_path / "clone/raw").mkdir(parents=True)
    (tmp_path / "clone/raw/port_1.npz").write_bytes(archive_of_csv(table.decode()))
    files, archives = {"board1.csv": sha256(table).hexdigest()}, {"board1.csv": "port_1.npz"}
    write_source(root, example, base=None, scene=None, files=files, archives=archives)
    fetch(root, tmp_path / "clone")
    assert fetched_files(root) == {"board1.csv": table}


def test_unknown_source_is_an_error_and_no_source_lists_all(monkeypatch):
    with pytest.raises(ReskinError, match="a source must be one of lab, .*; got elsewhere"):
        fetching.fetch(ROOT, "elsewhere", None, agree=lambda _: True, say=print)
    monkeypatch.chdir(ROOT)
    lines = CliRunner().invoke(app, ["fetch"]).stdout.splitlines()
    assert [line.split(":")[0] for line in lines] == list(SOURCES)


@pytest.mark.parametrize("name", SOURCES)
def test_real_recordings_match_their_hashes_and_are_read(name, shared_data, tmp_path):
    folder = shared_data / {"eflesh_forces": "eflesh"}.get(name, name)
    for path in SOURCES[name].files:
        fetching._copy(SOURCES[name], path, folder, tmp_path / name / path)
    # The numbers of rows that data/README.md states.
    counts = {"lab": 7150, "ini": 23300, "eflesh": 4805, "leaphand": 301}
    for recording in SOURCES[name].recordings[:1]:
        labels = CaptureNames(recording.board, recording.skin, None)
        prepared = preparing.foreign(tmp_path / name / recording.path, recording.layout, labels, recording.options)
        header = preparing.headers.write_capture(tmp_path / prepared[0].capture, *prepared)
        _, account = READERS[recording.layout].read(tmp_path / header.capture, header, DEFAULT_POLICY)
        assert account["rows_read_n"] == counts[name]
