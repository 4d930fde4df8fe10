"""Where caches lie: in the checkout, also for an experiment that DVC runs in a copy of it."""

import os
import subprocess
from pathlib import Path

from pipeline.provenance import home, is_experiment

ROOT = Path(__file__).resolve().parents[1]


def test_a_checkout_keeps_its_caches_itself_and_a_copy_of_dvc_in_the_checkout_around_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (home(), is_experiment()) == (Path(), False)
    copy = tmp_path / ".dvc/tmp/exps/standard/tmpx1"
    copy.mkdir(parents=True)
    monkeypatch.chdir(copy)
    assert (home(), is_experiment()) == (tmp_path, True)


def script(folder: Path, path: str) -> subprocess.CompletedProcess[str]:
    command = ["/bin/sh", str(ROOT / "pipeline/run.sh"), "split", "--scene", "two words"]
    return subprocess.run(command, cwd=folder, env={"PATH": path}, capture_output=True, text=True, check=False)


def fake(file: Path, words: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f'#!/bin/sh\necho {words} "$@"\n')
    file.chmod(0o755)


def test_a_stage_runs_with_the_nearest_environment_above_it(tmp_path):
    fake(tmp_path / ".venv/bin/python", "of the checkout")
    copy = tmp_path / ".dvc/tmp/exps/standard/tmpx1"
    copy.mkdir(parents=True)
    for folder in (tmp_path, copy):
        assert script(folder, os.defpath).stdout == "of the checkout -m pipeline.stages.split --scene two words\n"


def test_without_one_an_activated_environment_serves_and_without_any_it_is_one_sentence(tmp_path):
    tools = ":".join(str(Path(folder)) for folder in ("/usr/bin", "/bin"))
    fake(tmp_path / "bin/python3", "activated")
    assert script(tmp_path, f"{tmp_path}/bin:{tools}").stdout.endswith(
        "activated -m pipeline.stages.split --scene two words\n"
    )
    for name in ("python3", "python"):
        fake(tmp_path / "bin" / name, "none >&2; exit 1 #")
    refused = script(tmp_path, f"{tmp_path}/bin:{tools}")
    assert refused.returncode == 2
    assert "must be in .venv or on the PATH; got none. Try: make repro" in refused.stderr
