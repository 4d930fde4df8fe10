"""Caches lie in the checkout, also for an experiment that DVC runs in a copy of it."""

from pathlib import Path

from pipeline.provenance import home, is_experiment


def test_caches_lie_in_the_checkout_even_for_dvc_experiments(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (home(), is_experiment()) == (Path(), False)
    copy = tmp_path / ".dvc/tmp/exps/standard/tmpx1"
    copy.mkdir(parents=True)
    monkeypatch.chdir(copy)
    assert (home(), is_experiment()) == (tmp_path, True)
