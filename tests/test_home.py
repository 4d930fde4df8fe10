"""Where caches lie: in the checkout, also for an experiment that DVC runs in a copy of it."""

from pathlib import Path

from pipeline.provenance import home, is_experiment


def test_a_checkout_keeps_its_caches_itself_and_a_copy_of_dvc_in_the_checkout_around_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (home(), is_experiment()) == (Path(), False)
    copy = tmp_path / ".dvc/tmp/exps/standard/tmpx1"
    copy.mkdir(parents=True)
    monkeypatch.chdir(copy)
    assert (home(), is_experiment()) == (tmp_path, True)
