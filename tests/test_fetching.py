"""Tests of `reskin fetch`: public recordings are checked and added once; errors leave no files."""

import errno
import os
import shutil
from hashlib import sha256
from pathlib import Path
from types import SimpleNamespace

import pytest
from ruamel.yaml import YAML
from typer.testing import CliRunner

from pipeline import PLAN, SCENES, plan
from pipeline.cli import app
from pipeline.manage import add as adding
from pipeline.manage import fetch as fetching
from pipeline.manage.fetch import Origin
from pipeline.manage.registry import read_registry
from pipeline.plan import read_plan
from reskin.errors import ReskinError
from reskin.recordings import preparing
from reskin.recordings.preparing import CaptureNames
from reskin.recordings.readers import eflesh, ini, lab, leaphand
from tests import repositories
from tests.recordings.headers import DEFAULT_POLICY
from tests.recordings.readers.test_lab import PRESSES, write
from tests.scenes import recorded_scene
from tests.stages.checkout import copy_checkout, copy_without_code
from tests.test_adding import contents
from tests.test_pickled import archive_of_csv

ROOT = Path(__file__).resolve().parents[1]
SOURCES = fetching.read_sources(ROOT)


def boards(folder: Path) -> dict[str, bytes]:
    """Return two recordings, one per board, with line ends that git would convert."""
    folder.mkdir()
    text = (write(folder, *PRESSES) / lab.READINGS).read_text().replace("\n", "\r\n")
    return {"board1.csv": text.encode(), "board2.csv": text.replace("160.0000", "160.4000").encode()}


def source_of(files: dict[str, bytes], home: str, commit: str | None, **changes: object) -> dict[str, object]:
    pinned = [
        {"path": name, "at": f"data/{name}", "bytes_n": len(content), "sha256": sha256(content).hexdigest()}
        for name, content in files.items()
    ]
    recordings = [
        {"path": name, "layout": "lab", "board": Path(name).stem, "skin": f"skin-{Path(name).stem}", "options": {}}
        for name in files
    ]
    fields = {"home": home, "commit": commit, "licence": "MIT", "scene": "small", "note": None}
    return fields | {"files": pinned, "recordings": recordings} | changes


@pytest.fixture(scope="module")
def example(tmp_path_factory) -> SimpleNamespace:
    """Return a checkout without scenes, and a repository of two recordings; a later commit changes one of them."""
    root, away = copy_checkout(tmp_path_factory.mktemp("checkout")), tmp_path_factory.mktemp("away")
    plan.use(root, [])
    with (root / SCENES / "small.yaml").open("w") as stream:
        YAML().dump(recorded_scene(), stream)
    files = boards(away / "rig")
    home = {f"data/{name}": content for name, content in files.items()}
    commit = repositories.commit(away / "home", {**home, "README.md": b"A rig.\n"})
    repositories.commit(away / "home", {"data/board1.csv": b"edited\n"})
    url = repositories.bare(away / "home", away / "mirror.git", filters=True)
    return SimpleNamespace(root=root, away=away, files=files, commit=commit, url=url)


@pytest.fixture
def root(example, tmp_path) -> Path:
    """Return a checkout whose only source of recordings is the repository of `example`."""
    root = copy_without_code(example.root, tmp_path / "checkout")
    write_source(root, source_of(example.files, example.url, example.commit))
    return root


def write_source(root: Path, source: dict[str, object]) -> None:
    with (root / fetching.SOURCES).open("w") as stream:
        YAML().dump({"rig": source}, stream)


def fetch(root: Path, origin: str | Path | None = None, *, scene: str | None = None, consent: bool = False) -> str:
    output: list[str] = []
    where = None if origin is None else str(origin)
    fetching.fetch(root, "rig", where, scene, agree=lambda _: consent, say=output.append)
    return "\n".join(output)


def assert_refused(root: Path, message: str, origin: str | Path | None = None) -> None:
    before = contents(root)
    with pytest.raises(ReskinError, match=message) as caught:
        fetch(root, origin)
    assert "\n" not in str(caught.value)
    assert contents(root) == before


def fetched_files(root: Path) -> dict[str, bytes]:
    folder = root / fetching.FETCHED / "rig"
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def without_adding(monkeypatch) -> None:
    """Replace the step that adds fetched recordings, because adding takes seconds."""
    monkeypatch.setattr(fetching, "_add_all", lambda *_: None)
    monkeypatch.setattr(fetching, "_say_what_runs", lambda *_: None)


def test_recordings_are_fetched_and_added_once(root, example):
    output = fetch(root)
    assert fetched_files(root) == example.files
    assert sorted(read_registry(root).captures["small"]) == ["board1_skin-board1_board1", "board2_skin-board2_board2"]
    for board in ("board1", "board2"):
        raw = root / adding.RAW / "small" / f"{board}_skin-{board}_{board}"
        assert (raw / lab.READINGS).read_bytes() == example.files[f"{board}.csv"]
    assert list(plan.check(root).scenes) == ["small"]
    assert "added scene small to pipeline/plan.yaml (already there: none)" in output
    assert "next: dvc repro" in output
    before = contents(root)
    output = fetch(root)
    assert "already present and unchanged" in output
    assert "small/board1_skin-board1_board1: added already" in output
    assert contents(root) == before
    plan.use(root, [])
    assert "scene small is not in the plan; to run it: reskin scenes use small; dvc repro" in fetch(root)


def test_fetch_continues_after_an_interruption_while_recordings_were_added(root, monkeypatch):
    add, calls = adding.add, []

    def interrupt_second_add(*fields, **options):
        calls.append(fields)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return add(*fields, **options)

    monkeypatch.setattr(adding, "add", interrupt_second_add)
    with pytest.raises(KeyboardInterrupt):
        fetch(root)
    assert list(read_registry(root).captures["small"]) == ["board1_skin-board1_board1"]
    fetch(root)
    assert len(read_registry(root).captures["small"]) == 2
    assert len(calls) == 3


def test_recording_added_earlier_is_not_added_again(root, example, tmp_path):
    (tmp_path / "mine.csv").write_bytes(example.files["board1.csv"])
    prepared = preparing.foreign(tmp_path / "mine.csv", "lab", CaptureNames("b", "s", "mine"), {})
    adding.add(root, "small", prepared, allow_copy=False)
    assert "small/mine: added already" in fetch(root)
    assert sorted(read_registry(root).captures["small"]) == ["board2_skin-board2_board2", "mine"]


@pytest.mark.usefixtures("without_adding")
def test_recordings_can_be_fetched_from_a_mirror_or_a_folder(root, example, tmp_path):
    write_source(root, source_of(example.files, (tmp_path / "away").as_uri(), example.commit))
    assert_refused(root, "cannot read the repository")
    (tmp_path / "files/deep").mkdir(parents=True)
    for name, content in example.files.items():
        (tmp_path / "files/deep" / name).write_bytes(content)
    for origin in (example.url, example.away / "mirror.git", example.away / "home", tmp_path / "files"):
        assert f"taken from: {origin}" in fetch(root, origin)
        assert fetched_files(root) == example.files
        shutil.rmtree(root / fetching.FETCHED)


def test_missing_commit_is_an_error(root, example):
    write_source(root, source_of(example.files, example.url, "1" * 40))
    assert_refused(root, f"the repository does not have commit {'1' * 40}, from which")


@pytest.mark.usefixtures("without_adding")
def test_files_can_be_pinned_at_different_commits(root, example, tmp_path):
    first = repositories.commit(tmp_path / "home", {"data/board1.csv": example.files["board1.csv"]})
    later = {"data/board1.csv": b"edited\n", "data/board2.csv": example.files["board2.csv"]}
    second = repositories.commit(tmp_path / "home", later)
    source = source_of(example.files, str(tmp_path / "home"), first)
    source["files"][1]["commit"] = second
    write_source(root, source)
    assert f"commits {', '.join(sorted([first, second]))}" in fetch(root)
    assert fetched_files(root) == example.files


def test_recordings_can_be_added_to_another_scene(root):
    with (root / SCENES / "other.yaml").open("w") as stream:
        YAML().dump(recorded_scene(), stream)
    fetch(root, scene="other")
    assert list(read_registry(root).captures) == ["other"]
    assert len(read_registry(root).captures["other"]) == 2


def test_wrong_checksum_is_an_error(root, example):
    # If no commit is given, the newest one is fetched. One of its files differs.
    write_source(root, source_of(example.files, example.url, None))
    other, right = sha256(b"edited\n").hexdigest(), sha256(example.files["board1.csv"]).hexdigest()
    problem = f"data/board1.csv: sha256 must be {right} .*; got {other} .7 bytes"
    assert_refused(root, f"{problem}.*name a git mirror or a folder with option --from")


def test_truncated_or_missing_file_is_an_error(root, example, tmp_path):
    (tmp_path / "board1.csv").write_bytes(example.files["board1.csv"])
    (tmp_path / "board2.csv").write_bytes(example.files["board2.csv"][:-1])
    assert_refused(root, "board2.csv: sha256 must be", tmp_path)
    (tmp_path / "board2.csv").unlink()
    assert_refused(root, "no file data/board2.csv or board2.csv", tmp_path)


@pytest.mark.usefixtures("without_adding")
def test_fetched_file_that_was_changed_is_fetched_again(root, example):
    fetch(root)
    (root / fetching.FETCHED / "rig/board2.csv").write_bytes(b"changed")
    assert "all checksums match" in fetch(root)
    assert fetched_files(root) == example.files


@pytest.mark.usefixtures("without_adding")
def test_fetching_files_without_a_licence_needs_consent(root, example):
    write_source(root, source_of(example.files, example.url, example.commit, licence=None))
    assert_refused(root, "the use of files without a licence was not confirmed. Nothing was fetched.*--yes")
    output = fetch(root, consent=True)
    assert "rig: 2 files, 0.0 MB; licence: none (you may not pass the files on)" in output
    assert f"home: {example.url}, commit {example.commit}" in output
    assert fetched_files(root) == example.files


def test_consent_can_be_given_on_the_command_line(root, example, monkeypatch):
    changes = {"licence": None, "scene": None, "note": "Not added."}
    write_source(root, source_of(example.files, example.url, example.commit, **changes))
    monkeypatch.chdir(root)
    done = CliRunner().invoke(app, ["fetch", "rig"])
    assert "add --yes" in str(done.exception)
    assert not (root / fetching.FETCHED / "rig").exists()
    done = CliRunner().invoke(app, ["fetch", "rig", "--yes"])
    assert done.exit_code == 0
    assert done.stdout.endswith("Not added.\n")


def test_archive_is_converted_to_a_table_before_its_checksum_is_compared(root, tmp_path):
    rows = [
        f"{i},{phase},{4 * i},2,{','.join(f'{value * (1 + i):.4f}' for value in range(20))},0.000000,0.000000,{force}"
        for i in range(2)
        for phase, force in (("noload", "0.000000"), ("contact", "-2.000000"))
    ]
    names = "indent,phase,x_mm,y_mm," + ",".join(f"T{c},Bx{c},By{c},Bz{c}" for c in range(5)) + ",Fx,Fy,Fz"
    table = "\r\n".join([names, *rows, ""]).encode()
    archive = archive_of_csv(table.decode())
    commit = repositories.commit(tmp_path / "home", {"raw/port_1.npz": archive})
    source = source_of({"board1.csv": table}, str(tmp_path / "home"), commit)
    source["files"][0]["at"] = "raw/port_1.npz"
    write_source(root, source)
    fetch(root)
    assert fetched_files(root) == {"board1.csv": table}
    assert list(read_registry(root).captures["small"]) == ["board1_skin-board1_board1"]


@pytest.mark.usefixtures("without_adding")
def test_interrupted_fetch_leaves_no_files(root, example, monkeypatch):
    open_origin, reads = fetching.open_origin, []

    def interrupt_second_read(*fields) -> Origin:
        origin = open_origin(*fields)

        def read(path: str) -> bytes:
            reads.append(path)
            if len(reads) == 2:
                raise KeyboardInterrupt
            return origin.read(path)

        return Origin(origin.name, origin.paths, read)

    monkeypatch.setattr(fetching, "open_origin", interrupt_second_read)
    before = contents(root)
    with pytest.raises(KeyboardInterrupt):
        fetch(root)
    assert contents(root) == before
    assert list((root / fetching.FETCHED).iterdir()) == []
    fetch(root)
    assert fetched_files(root) == example.files


def test_full_disk_is_an_error(root, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
    assert_refused(root, "needs .* MB of free disk space; 0 MB are free. Free some")
    monkeypatch.undo()

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(fetching, "_read_checked", full)
    assert_refused(root, "cannot write the files: No space left on device")


def test_unknown_source_is_an_error(root):
    with pytest.raises(ReskinError, match="a source must be one of rig; got lab"):
        fetching.fetch(root, "lab", None, agree=lambda _: True, say=print)


def test_fetch_without_a_name_lists_the_sources(monkeypatch):
    monkeypatch.chdir(ROOT)
    lines = CliRunner().invoke(app, ["fetch"]).stdout.splitlines()
    assert [line.split(":")[0] for line in lines] == list(SOURCES)


@pytest.mark.parametrize("name", SOURCES)
def test_each_source_has_either_recordings_and_a_known_scene_or_a_note(name):
    source, paths = SOURCES[name], {Path(file.path) for file in SOURCES[name].files}
    assert len(paths) == len(source.files)
    for recording in source.recordings:
        assert paths & {Path(recording.path), *(path for path in paths if Path(recording.path) in path.parents)}
    if source.scene is None:
        assert not source.recordings
        assert source.note is not None
    else:
        assert source.recordings
        assert plan.scene_file(ROOT, source.scene).is_file()


@pytest.mark.parametrize("name", SOURCES)
def test_real_recordings_match_their_checksums_and_are_read(name, shared_data, tmp_path):
    folder = {"eflesh_forces": "eflesh"}.get(name, name)
    fetching.download(SOURCES[name], str(shared_data / folder), tmp_path / name)
    # The numbers of rows that data/README.md states.
    counts = {
        "lab": 7150,
        "ini": 23300,
        "eflesh": 4805,
        "leaphand": 301,
    }
    readers = {"lab": lab, "ini": ini, "eflesh": eflesh, "leaphand": leaphand}
    for recording in SOURCES[name].recordings[:1]:
        labels = CaptureNames(recording.board, recording.skin, None)
        prepared = preparing.foreign(tmp_path / name / recording.path, recording.layout, labels, recording.options)
        header = preparing.headers.write_capture(tmp_path / prepared[0].capture, *prepared)
        _, account = readers[name].read(tmp_path / header.capture, header, DEFAULT_POLICY)
        assert account["rows_read_n"] == counts[name]


@pytest.mark.timeout(600)
def test_fetched_recordings_of_real_boards_are_added_to_scene_lab(shared_data, tmp_path, monkeypatch):
    (tmp_path / "checkout").mkdir()
    root = copy_checkout(tmp_path / "checkout")
    plan.use(root, ["quick"])
    monkeypatch.chdir(root)
    done = CliRunner().invoke(app, ["fetch", "lab", "--yes", "--from", str(shared_data / "lab")])
    captures = read_registry(root).captures["lab"]
    assert {(entry.board, entry.skin) for entry in captures.values()} == {("board1", "skin1"), ("board2", "skin2")}
    assert len(captures) == 6
    assert list(read_plan(root / PLAN).scenes) == ["quick", "lab"]
    assert "added scene lab to pipeline/plan.yaml (already there: quick)" in done.stdout
    assert "next: dvc repro (runs quick, lab; to run this scene alone first: reskin scenes use lab)" in done.stdout
    again = CliRunner().invoke(app, ["fetch", "lab"])
    assert again.stdout.count("added already") == 6


@pytest.mark.parametrize("path", ["../elsewhere.csv", "/etc/elsewhere.csv", "a/../../elsewhere.csv"])
def test_paths_outside_the_folder_are_an_error(path):
    with pytest.raises(ValueError, match="a path below the folder of its source"):
        fetching.File(path=path, at="a.csv", bytes_n=1, sha256="0" * 64)
