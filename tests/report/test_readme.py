"""Tests of the generated blocks of README.md and docs."""

import copy
import shutil
import subprocess

import pytest

from pipeline.report.readme import SHOWN, fill_blocks, fill_pages, read_results
from pipeline.stages.report import write_index
from reskin import io
from reskin.code import ROOT
from reskin.errors import SchemaError


@pytest.fixture(scope="module")
def scenes():
    return {name: read_results(ROOT, name) for name in SHOWN}


def filled(scenes) -> str:
    times = io.read_json(ROOT / "reports/time.json")
    return fill_blocks("README.md", (ROOT / "README.md").read_text(encoding="utf-8"), scenes, times)


def test_pages_show_the_committed_results():
    status = ["git", "status", "--porcelain", "--", "reports", "README.md", "docs"]
    done = subprocess.run(status, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode or done.stdout:
        pytest.skip("the results of this checkout are not committed; `reskin readme` would show them")
    assert fill_pages(ROOT, write=False) == []


def test_changed_result_changes_its_cell(scenes):
    changed = copy.deepcopy(scenes)
    changed["quick"]["table2"]["triplet"]["accuracy_pct"] = {"mean": 12.3, "n": 6, "ci95": [10.2, 14.4]}
    assert "12 [10, 14]" in filled(changed)
    assert "12 [10, 14]" not in filled(scenes)


@pytest.mark.parametrize("content", ["{}", "[1]", "5", '{"new_board": 3}', '{"a"'])
def test_broken_numbers_are_refused_in_one_sentence(tmp_path, content):
    for name in ("reports", "docs"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("*.html", "*.ipynb"))
    shutil.copy(ROOT / "README.md", tmp_path)
    (tmp_path / "reports/lab/numbers.json").write_text(content)
    with pytest.raises(SchemaError, match="numbers.json"):
        fill_pages(tmp_path, write=False)
    if content in "[1] 5":
        with pytest.raises(SchemaError, match="lab/numbers.json"):
            write_index(tmp_path / "reports")


def test_page_without_markers_is_refused(scenes):
    with pytest.raises(SchemaError, match="README.md"):
        fill_blocks("README.md", "no markers", scenes, {})
