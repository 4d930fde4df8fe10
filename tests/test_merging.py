"""Tests of `reskin merge`, for clones in which two people added recordings."""

import shutil
import subprocess
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from pipeline import FLOW, PARAMS, PLAN, SCENES, plan
from pipeline.manage import merge
from pipeline.manage.registry import Entry, Registry, read_registry, with_entry, write_registry
from reskin import io
from reskin.errors import ReskinError
from tests.scenes import recorded_scene
from tests.stages.checkout import ROOT

EMPTY = Registry(captures={})
GIT_IDENTITY = ["-c", "user.name=Tester", "-c", "user.email=tester@example.org", "-c", "commit.gpgsign=false"]


def git(root: Path, *arguments: str, check: bool = True) -> str:
    done = subprocess.run(["git", *GIT_IDENTITY, *arguments], cwd=root, capture_output=True, text=True, check=check)
    return done.stdout


def entry(skin: str, board: str, *fingerprints: str) -> Entry:
    hashes = fingerprints or (f"{board}-{skin}",)
    return Entry(board=board, skin=skin, layout="table", chips_n=5, fingerprints=hashes, copy_of=None)


def add_and_commit(root: Path, name: str, skin: str, board: str, scene: str = "shared") -> None:
    """Change the files in git in the same way as `reskin add` and `dvc repro`, and commit them."""
    write_registry(root, with_entry(read_registry(root), scene, name, entry(skin, board), allow_copy=False))
    plan.use(root, sorted({*plan.read_plan(root / PLAN).scenes, scene}))
    lock = YAML(typ="safe").load((root / "dvc.lock").read_text())
    lock["stages"] |= {f"ingest@{scene}-{name}": {"cmd": "ingest"}, f"report@{scene}": {"cmd": f"with {name}"}}
    with (root / "dvc.lock").open("w") as stream:
        YAML().dump(lock, stream)
    io.write_text(root / f"reports/{scene}/tables/lobo.md", f"with {name}\n")
    git(root, "add", "--all")
    git(root, "commit", "-qm", f"Add {name}")


@pytest.fixture(scope="module")
def initial_checkout(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("start")
    for name in (FLOW, PARAMS, ".gitattributes"):
        shutil.copy(ROOT / name, root)
    (root / SCENES).mkdir(parents=True)
    with (root / SCENES / "shared.yaml").open("w") as stream:
        YAML().dump(recorded_scene(), stream)
    write_registry(root, EMPTY)
    plan.use(root, [])
    (root / "dvc.lock").write_text("schema: '2.0'\nstages:\n  report@quick:\n    cmd: as it was\n")
    git(root, "init", "-qb", "main")
    git(root, "add", "--all")
    git(root, "commit", "-qm", "Begin")
    return root


@pytest.fixture
def root(initial_checkout, tmp_path) -> Path:
    return shutil.copytree(initial_checkout, tmp_path / "clone")


def merge_two(root: Path, ours: tuple[str, ...], theirs: tuple[str, ...]) -> None:
    git(root, "checkout", "-qb", "theirs")
    add_and_commit(root, *theirs)
    git(root, "checkout", "-q", "main")
    add_and_commit(root, *ours)
    git(root, "merge", "theirs", check=False)


def test_merge_keeps_both_recordings_in_the_registry_the_plan_and_the_lock_file(root):
    merge_two(root, ("mine", "s1", "b1"), ("yours", "s2", "b2"))
    assert "2 captures" in merge.merge(root)
    assert list(read_registry(root).captures["shared"]) == ["mine", "yours"]
    assert list(plan.check(root).stages["ingest"]) == ["shared-mine", "shared-yours"]
    stages = YAML(typ="safe").load((root / "dvc.lock").read_text())["stages"]
    assert {"report@quick", "ingest@shared-mine", "ingest@shared-yours"} <= stages.keys()
    assert stages["report@shared"] == {"cmd": "with mine"}  # only our entry is kept, so DVC runs the stage again
    assert (root / "reports/shared/tables/lobo.md").read_text() == "with mine\n"
    assert git(root, "diff", "--name-only", "--diff-filter=U") == ""
    git(root, "commit", "-qm", "Merge")
    assert git(root, "status", "--porcelain") == ""


def test_report_that_one_side_deleted_stays_deleted_after_a_merge(root):
    add_and_commit(root, "first", "s0", "b0")
    git(root, "checkout", "-qb", "theirs")
    add_and_commit(root, "yours", "s2", "b2")
    git(root, "checkout", "-q", "main")
    git(root, "rm", "-q", "reports/shared/tables/lobo.md")
    git(root, "commit", "-qm", "Delete a report")
    git(root, "merge", "theirs", check=False)
    merge.merge(root)
    assert git(root, "diff", "--name-only", "--diff-filter=U") == ""
    assert not (root / "reports/shared/tables/lobo.md").exists()


def test_merge_of_contradictory_recordings_raises_and_changes_no_files(root):
    merge_two(root, ("mine", "s1", "b1"), ("yours", "s1", "b2"))
    before = {name: (root / name).read_bytes() for name in merge.RESOLVED}
    with pytest.raises(ReskinError, match="the board of skin s1 must be b1, as in mine; got b2"):
        merge.merge(root)
    assert {name: (root / name).read_bytes() for name in before} == before
    assert {*merge.RESOLVED} <= set(git(root, "diff", "--name-only", "--diff-filter=U").split())


@pytest.mark.parametrize(
    ("theirs", "message"),
    [
        ({"yours": entry("s1", "b2")}, "the board of skin s1 must be b1, as in mine; got b2"),
        ({"yours": entry("s2", "b2", "b1-s1")}, "it has the same readings as mine"),
        ({"mine": entry("s2", "b2")}, "already has a capture with the name mine"),
    ],
)
def test_merge_raises_if_the_merged_registry_would_be_invalid(theirs, message):
    ours = Registry(captures={"shared": {"mine": entry("s1", "b1")}})
    with pytest.raises(ReskinError, match=message):
        merge.merge_registries(EMPTY, ours, Registry(captures={"shared": theirs}))


def test_merged_plan_has_the_added_scenes_but_not_the_removed_ones():
    assert merge.merge_scenes(["a", "b"], ["a", "b", "mine"], ["yours", "b"]) == ["b", "mine", "yours"]
    assert merge.merge_scenes([], ["mine"], ["mine", "yours"]) == ["mine", "yours"]


def test_conflicts_in_files_written_by_hand_are_not_merged(root):
    git(root, "checkout", "-qb", "theirs")
    (root / PARAMS).write_text("theirs: 1\n")
    git(root, "commit", "-qam", "Change a parameter")
    git(root, "checkout", "-q", "main")
    (root / PARAMS).write_text("ours: 1\n")
    git(root, "commit", "-qam", "Change it otherwise")
    git(root, "merge", "theirs", check=False)
    with pytest.raises(ReskinError, match="params.yaml: resolve the conflicts in these files by hand"):
        merge.merge(root)


def test_merge_without_conflict_is_an_error(root):
    with pytest.raises(ReskinError, match="No file is in conflict"):
        merge.merge(root)


def test_merge_does_not_restore_captures_that_one_side_removed_or_replaced():
    kept, removed, old, new = (entry(name, name) for name in ("s1", "s2", "s3", "s4"))
    base = Registry(captures={"scene": {"kept": kept, "gone": removed, "replaced": old}})
    theirs = Registry(captures={"scene": {"kept": kept, "replaced": new}})
    assert merge.merge_registries(base, base, theirs) == theirs
    assert merge.merge_registries(base, theirs, base) == theirs
    assert merge.merge_registries(base, theirs, theirs) == theirs


def test_each_entry_of_the_merged_lock_file_is_copied_from_one_side():
    base, changed = {"a": {"in": 1, "out": 1}, "b": 1}, {"a": {"in": 2, "out": 2}}
    assert merge.merge_stages(base, base, changed) == (changed, [])
    assert merge.merge_stages(base, changed, base) == (changed, [])
    assert merge.merge_stages(base, {"a": 3, "b": 1}, {"a": 4, "b": 1}) == ({"a": 3, "b": 1}, ["a"])
