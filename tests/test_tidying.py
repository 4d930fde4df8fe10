"""Tests of `reskin scenes tidy`: outputs of experiments that a scene no longer has are removed."""

import shutil
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from pipeline import SCENES, plan
from pipeline.manage import tidy
from tests.scenes import scene_with
from tests.test_plan import checkout

WRITTEN = {
    "drift@one": "data/results/one/drift.json",
    "train_multi@one": "data/models/one/train_multi",
    "simulate@one-gone": "data/raw/one-gone",
    "drift@two": "data/results/two/drift.json",
    "split@one": "data/models/one/folds.json",
}


@pytest.fixture
def root(tmp_path) -> Path:
    """Return a checkout with two scenes.

    Scene `one` has run drift and protocol `gone`, and now has only lobo. Scene `two` is not in the plan.
    """
    folder = checkout(tmp_path / "checkout")
    plan.use(folder, ["one"])
    for path in WRITTEN.values():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text("made")
    stages = {name: {"cmd": "x", "outs": [{"path": path}]} for name, path in WRITTEN.items()}
    with (folder / tidy.LOCK).open("w") as stream:
        YAML().dump({"schema": "2.0", "stages": stages}, stream)
    return folder


def test_stages_that_a_scene_no_longer_has_are_listed_with_their_files(root):
    assert tidy.stale_outputs(root, plan.check(root)) == {
        "drift@one": [root / WRITTEN["drift@one"]],
        "simulate@one-gone": [root / WRITTEN["simulate@one-gone"]],
    }


def test_tidy_removes_only_stale_outputs(root):
    tidy.tidy(root, plan.check(root))
    existing = {name for name, path in WRITTEN.items() if (root / path).exists()}
    assert existing == {"train_multi@one", "drift@two", "split@one"}
    lock = YAML(typ="safe").load((root / tidy.LOCK).read_text())
    assert set(lock["stages"]) == existing
    assert lock["schema"] == "2.0"
    assert tidy.stale_outputs(root, plan.check(root)) == {}


def test_folder_that_contains_outputs_of_a_planned_stage_is_kept(root):
    lock = YAML(typ="safe").load((root / tidy.LOCK).read_text())
    # This folder also contains outputs of train_multi.
    lock["stages"]["drift@one"]["outs"] = [{"path": "data/models/one"}]
    with (root / tidy.LOCK).open("w") as stream:
        YAML().dump(lock, stream)
    assert tidy.stale_outputs(root, plan.check(root))["drift@one"] == []


def test_scenes_with_a_common_prefix_are_distinguished(root):
    shutil.copy(root / SCENES / "one.yaml", root / SCENES / "one-gone.yaml")
    assert set(tidy.stale_outputs(root, plan.check(root))) == {"drift@one"}


def test_experiment_in_the_scene_has_no_stale_outputs(root):
    with (root / SCENES / "one.yaml").open("w") as stream:
        YAML().dump(scene_with("lobo", "drift"), stream)
    plan.use(root, ["one"])
    assert set(tidy.stale_outputs(root, plan.check(root))) == {"simulate@one-gone"}


def test_stale_outputs_that_do_not_exist_on_this_machine_are_not_listed(root):
    (root / WRITTEN["drift@one"]).unlink()
    assert set(tidy.stale_outputs(root, plan.check(root))) == {"simulate@one-gone"}


def test_checkout_without_a_run_has_no_stale_outputs(root):
    (root / tidy.LOCK).unlink()
    assert tidy.stale_outputs(root, plan.check(root)) == tidy.tidy(root, plan.check(root)) == {}
