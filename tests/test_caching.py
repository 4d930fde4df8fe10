"""Tests of `reskin check-cache`, which moves damaged objects (cached files) out of DVC's cache.

It restores an object if an undamaged copy exists.
"""

import hashlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from ruamel.yaml import YAML
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.manage import cache
from pipeline.manage.tidy import LOCK

WEIGHTS, FOLDS, RECORDED = "data/models/one/train_multi", "data/models/one/folds.json", "data/raw/rig/b1"


def md5(content: bytes) -> str:
    return hashlib.md5(content).hexdigest()


@pytest.fixture(scope="module")
def empty(tmp_path_factory) -> Path:
    """Return a folder in which git and DVC work."""
    folder = tmp_path_factory.mktemp("empty")
    subprocess.run(["git", "init", "-q"], cwd=folder, check=True)
    subprocess.run([sys.executable, "-m", "dvc", "init", "-q"], cwd=folder, check=True)
    return folder


@pytest.fixture
def root(empty, tmp_path, monkeypatch) -> Path:
    """Return a checkout with a folder of two files, a file and a recording, all of which are in DVC's cache."""
    shutil.copytree(empty, tmp_path, dirs_exist_ok=True)
    (tmp_path / "dvc.yaml").write_text("stages: {}\n")
    monkeypatch.chdir(tmp_path)
    folder = {"a.safetensors": b"weights", "a.json": b"card"}
    listed = json.dumps([{"md5": md5(content), "relpath": name} for name, content in folder.items()]).encode()
    outs = {"train_multi@one": (WEIGHTS, f"{md5(listed)}.dir"), "split@one": (FOLDS, md5(b"folds"))}
    stages = {name: {"cmd": "x", "outs": [{"path": path, "md5": digest}]} for name, (path, digest) in outs.items()}
    files = {FOLDS: b"folds", RECORDED: b"recorded"} | {
        f"{WEIGHTS}/{name}": content for name, content in folder.items()
    }
    for path, content in files.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_bytes(content)
    for content in (*files.values(), listed):
        put_in_cache(tmp_path, md5(content) + (".dir" if content is listed else ""), content)
    with (tmp_path / LOCK).open("w") as stream:
        YAML().dump({"schema": "2.0", "stages": stages}, stream)
    with (tmp_path / f"{RECORDED}.dvc").open("w") as stream:
        YAML().dump({"outs": [{"path": "b1", "md5": md5(b"recorded")}]}, stream)
    return Path()


def cache_file(root: Path, name: str) -> Path:
    return root / ".dvc/cache/files/md5" / name[:2] / name[2:]


def put_in_cache(root: Path, name: str, content: bytes) -> None:
    cache_file(root, name).parent.mkdir(parents=True, exist_ok=True)
    cache_file(root, name).unlink(missing_ok=True)
    cache_file(root, name).write_bytes(content)
    cache_file(root, name).chmod(0o444)


def check(root: Path) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["check-cache"])
    return done.exit_code, done.output


def test_check_of_an_undamaged_cache_finds_no_damaged_objects(root):
    # This temporary file was left by DVC when it was killed.
    next(root.glob(".dvc/cache/files/md5/??")).joinpath(".tmpXYZ.tmp").write_bytes(b"ha")
    assert check(root) == (0, "DVC's cache: 5 objects, 0 of them damaged\n")


def test_damaged_object_and_its_copies_in_the_checkout_are_removed(root):
    put_in_cache(root, md5(b"weights"), b"w3ights")
    (root / WEIGHTS / "a.safetensors").write_bytes(b"w3ights")
    status, output = check(root)
    assert status == 1
    assert "is damaged: its MD5 differs from its name" in output
    assert f"removed from {WEIGHTS}/a.safetensors. Run: dvc repro train_multi@one" in output
    assert not cache_file(root, md5(b"weights")).exists()
    assert [file.name for file in (root / WEIGHTS).iterdir()] == ["a.json"]
    assert (root / cache.DAMAGED / md5(b"weights")).read_bytes() == b"w3ights"
    assert check(root) == (0, "DVC's cache: 4 objects, 0 of them damaged\n")


def test_damaged_object_is_restored_from_an_undamaged_output(root):
    put_in_cache(root, md5(b"folds"), b"f0lds")
    assert f"It was restored from {FOLDS}." in check(root)[1]
    assert cache_file(root, md5(b"folds")).read_bytes() == (root / FOLDS).read_bytes() == b"folds"
    assert cache_file(root, md5(b"folds")).stat().st_mode & 0o777 == 0o444
    assert check(root)[0] == 0


def test_output_that_the_user_has_edited_is_kept(root):
    put_in_cache(root, md5(b"folds"), b"f0lds")
    (root / FOLDS).write_bytes(b"by hand")
    assert check(root)[0] == 1
    assert (root / FOLDS).read_bytes() == b"by hand"


def test_folder_is_kept_if_the_list_of_its_files_is_damaged_in_the_cache(root):
    name = cache.read_yaml(root / LOCK)["stages"]["train_multi@one"]["outs"][0]["md5"]
    put_in_cache(root, name, b"[")
    assert f"It was moved to {cache.DAMAGED}/{name}. Run: dvc repro train_multi@one" in check(root)[1]
    assert len(list((root / WEIGHTS).iterdir())) == 2


def test_damaged_recording_is_moved_but_not_deleted(root):
    put_in_cache(root, md5(b"recorded"), b"rec0rded")
    (root / RECORDED).write_bytes(b"rec0rded")
    assert f"dvc pull {RECORDED}.dvc, or add the recording again" in check(root)[1]
    assert (root / cache.DAMAGED / md5(b"recorded")).read_bytes() == b"rec0rded"


def test_damaged_object_that_no_output_uses_is_moved_out_of_the_cache(root):
    put_in_cache(root, "0" * 32, b"of an older run")
    assert "No output in dvc.lock uses it" in check(root)[1]
