"""Tests that caches are in the original checkout, even if DVC runs an experiment in a copy."""

from pathlib import Path

from pipeline.provenance import home, is_experiment


def test_dvc_experiments_use_the_caches_of_the_checkout(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (home(), is_experiment()) == (Path(), False)
    copy = tmp_path / ".dvc/tmp/exps/standard/tmpx1"
    copy.mkdir(parents=True)
    monkeypatch.chdir(copy)
    assert (home(), is_experiment()) == (tmp_path, True)
