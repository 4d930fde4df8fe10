"""Caches are in the checkout, also for experiments that DVC runs in a copy."""

from pathlib import Path

from pipeline.provenance import home, is_experiment


def test_caches_are_in_the_checkout_for_dvc_experiments(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (home(), is_experiment()) == (Path(), False)
    copy = tmp_path / ".dvc/tmp/exps/standard/tmpx1"
    copy.mkdir(parents=True)
    monkeypatch.chdir(copy)
    assert (home(), is_experiment()) == (tmp_path, True)
