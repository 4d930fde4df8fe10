"""Tests of which stages DVC would run again after an edit.

They compare DVC's index and hashes before and after the edit. Only stage `code` is run.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline import FLOW, PLAN, SCENES, plan
from pipeline.scores import read_scores
from reskin import io
from tests.stages.checkout import ROOT, copy_checkout, run

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # Libraries that DVC uses cause warnings.
PAGE = (ROOT / "docs/extend.md").read_text(encoding="utf-8")
MODULE, ENTRY, STAGE = re.findall(r"```(?:python|yaml) experiment\n(.*?)```", PAGE, re.DOTALL)
CATALOGUE = "pipeline/catalogue.py"


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    """Return a copy of the checkout whose plan has scene ci."""
    folder = copy_checkout(tmp_path_factory.mktemp("edited"))
    plan.use(folder, ["ci"])
    return folder


@pytest.fixture(scope="module")
def before(root) -> dict[str, tuple[Any, ...]]:
    return state(root)


def state(root: Path) -> dict[str, tuple[Any, ...]]:
    """Run stage `code`. Return, for each other stage, its command, the hashes of its dependencies, and its outputs."""
    from dvc.dependency.param import read_param_file
    from dvc.repo import Repo

    run(root, "python", "-m", "pipeline", "code", "--digests", "data/code")

    hashes: dict[str, str] = {}

    def value(dep: Any) -> Any:
        if hasattr(dep, "params"):
            return repr([read_param_file(dep.repo.fs, dep.fs_path, dep.params, flatten=True)])
        if dep.fs_path not in hashes:
            hashes[dep.fs_path] = str(dep.get_hash()) if dep.exists else ""
        return hashes[dep.fs_path]

    with Repo(str(root)) as repo:
        return {
            stage.name: (
                stage.cmd,
                {dep.fs_path: value(dep) for dep in stage.deps},
                [out.fs_path for out in stage.outs],
            )
            for stage in repo.index.stages
            if stage.name != "code"
        }


def stale_stages(before: dict[str, tuple[Any, ...]], after: dict[str, tuple[Any, ...]]) -> set[str]:
    """Return the stages that DVC would run again: changed stages, and all stages that depend on their outputs."""
    stale: set[str] = set()
    more = {name for name in after if after[name] != before.get(name)}
    while more - stale:
        stale |= more
        outs = [Path(out) for name in stale for out in after[name][2]]
        more = {name for name in after if any(_overlap(Path(dep), out) for dep in after[name][1] for out in outs)}
    return stale


def _overlap(path: Path, other: Path) -> bool:
    return path.is_relative_to(other) or other.is_relative_to(path)


def test_module_of_the_page_computes_numbers_and_a_figure_from_its_scores(tmp_path):
    module: dict[str, Any] = {}
    exec(compile(MODULE, "repeat.py", "exec"), module)
    forces_N = {"b0": [[1.0, 3.0], [2.0, 2.0]], "b1": [[1.0, 5.0]]}
    module["read_captures"] = lambda _: [
        SimpleNamespace(board=board, skin=f"{board}_s{i}", Fz_N=np.array(of_skin))
        for board, of_board in forces_N.items()
        for i, of_skin in enumerate(of_board)
    ]
    module["repeat"](tmp_path, tmp_path / "scores.parquet", tmp_path / "repeat.json")
    measured = io.read_json(tmp_path / "repeat.json")["numbers"]
    numbers = module["summarise"](read_scores([tmp_path / "scores.parquet"]), measured)
    assert (numbers["captures_n"], numbers["by_board"]) == (3, {"b0": 0.5, "b1": 2.0})
    assert numbers["force_sd_N"].mean == 1.25
    assert "b1" in module["figures"](numbers, {}, "simulated")["repeat.svg"]


@contextmanager
def edited_files(root: Path, files: dict[str, str]) -> Iterator[None]:
    """Write files within the block. At its end, restore the files and the plan."""
    original = {root / name: (root / name).read_text() for name in [PLAN, *files] if (root / name).exists()}
    try:
        for name, text in files.items():
            (root / name).parent.mkdir(exist_ok=True)
            (root / name).write_text(text)
        yield
    finally:
        for name in files:
            (root / name).unlink()
        for file, text in original.items():
            file.write_text(text)


def insert_before(file: Path, line: str, text: str) -> str:
    """Return the content of a file with `text` inserted before `line`."""
    assert line in file.read_text()
    return file.read_text().replace(line, f"{text}{line}", 1)


def test_new_experiment_reruns_its_stage_and_the_report(root, before):
    scene = f"{SCENES}/ci.yaml"
    files = {
        "pipeline/experiments/repeat.py": MODULE,
        CATALOGUE: insert_before(root / CATALOGUE, '    _analysis("sensitivity"', f"    {ENTRY.strip()},\n"),
        FLOW: insert_before(root / FLOW, "  report: #", f"{STAGE}\n"),
        scene: insert_before(root / scene, "- single_random", "- repeat\n"),
    }
    with edited_files(root, files):
        run(root, "reskin", "scenes", "use", "ci")
        after = state(root)
    assert stale_stages(before, after) == {
        "repeat@ci", "report@ci",  # These stages read the numbers of all experiments.
        "new_board@ci",  # This stage reads the list of experiments.
    }  # fmt: skip


def test_edit_of_a_page_reruns_the_report_and_edits_of_comments_rerun_no_stage(root, before):
    # Both edits are made at once, because each call of `state` takes seconds.
    page, io = "pipeline/report/pages/paper.md", "reskin/io.py"
    edits = {
        page: (root / page).read_text() + "More.\n",
        io: "# More.\n" + (root / io).read_text().replace('"""', '"""More. ', 1),
    }
    with edited_files(root, edits):
        after = state(root)
    assert stale_stages(before, after) == {"report@ci"}


def test_edit_of_code_reruns_its_experiment_and_the_report(root, before):
    module = "pipeline/experiments/shear.py"
    with edited_files(root, {module: (root / module).read_text() + "\n\nMORE = 1\n"}):
        after = state(root)
    assert stale_stages(before, after) == {"shear@ci", "report@ci"}
