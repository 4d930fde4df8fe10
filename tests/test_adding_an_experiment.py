"""Tests of which stages DVC would run again after an edit.

They compare DVC's index and hashes before and after the edit. Only stage `code` is run.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from pipeline import FLOW, PLAN, SCENES, plan
from reskin import code
from reskin.models.job import CODE_MODULES, JobKeys
from tests.models.example_jobs import example_data, pooled
from tests.stages.checkout import ROOT, copy_checkout, run

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # Libraries that DVC uses cause warnings.
STAGE = """\
  repeat: # how much force differs from reading to reading
    foreach: ${stages.repeat}
    do:
      cmd: >-
        python -m pipeline repeat --scene ${item} --indentations data/indentations/${item}
        --results data/results/${item}/repeat.json
      deps: [data/code/repeat, "data/indentations/${item}"]
      outs: ["data/results/${item}/repeat.json"]

"""
FILES = {
    "repeat.yaml": "experiment: {recorded: true}\n",
    "repeat.py": '''"""How much force differs from reading to reading."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from pipeline.experiments.results import read_captures, write_results


def repeat(indentations: Path, results: Path) -> None:
    """Write the standard deviation of force by capture."""
    write_results(results, {one.capture: float(one.Fz_N.std()) for one in read_captures(indentations)}, {})


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Show a row for each capture."""
    lines = [{"capture": name, "sd of force, N": f"{sd_N:.3g}", "source": source} for name, sd_N in numbers.items()]
    return {"repeat": pd.DataFrame(lines)}
''',
}


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
    files = {f"pipeline/experiments/{name}": text for name, text in FILES.items()} | {
        FLOW: insert_before(root / FLOW, "  report: #", STAGE),
        scene: insert_before(root / scene, "single_random,", "repeat, "),
    }
    with edited_files(root, files):
        run(root, "reskin", "scenes", "use", "ci")
        after = state(root)
    assert stale_stages(before, after) == {
        "repeat@ci", "table2@ci", "report@ci",  # These stages read the numbers of all experiments.
        "contacts@ci",  # This stage reads the whole file of the scene.
    }  # fmt: skip


def test_edit_of_a_caption_reruns_the_stages_that_show_it_and_edits_of_comments_rerun_no_stage(root, before):
    # Both edits are made at once, because each call of `state` takes seconds.
    captions, io = "pipeline/experiments/shear.yaml", "reskin/io.py"
    edits = {
        captions: (root / captions).read_text().replace("title: ", "title: More ", 1),
        io: "# More.\n" + (root / io).read_text().replace('"""', '"""More. ', 1),
    }
    with edited_files(root, edits):
        after = state(root)
    assert stale_stages(before, after) == {"table2@ci", "report@ci"}  # Table2 depends on the captions of all tables.


def test_edit_of_code_reruns_its_experiment_and_the_report(root, before):
    module = "pipeline/experiments/shear.py"
    with edited_files(root, {module: (root / module).read_text() + "\n\nMORE = 1\n"}):
        after = state(root)
    assert stale_stages(before, after) == {"shear@ci", "table2@ci", "report@ci"}


def test_edited_comments_do_not_change_the_keys_of_cached_training_runs(tmp_path, monkeypatch):
    files = {name: f"{name.replace('.', '/')}.py" for name in CODE_MODULES}
    sources = {name: (ROOT / file).read_text() for name, file in files.items()}
    (tmp_path / "reskin/models").mkdir(parents=True)
    monkeypatch.setattr(code, "ROOT", tmp_path)

    def key(sources: dict[str, str]) -> str:
        for name, text in sources.items():
            (tmp_path / files[name]).write_text(text)
        code.digest.cache_clear()
        return JobKeys(example_data()).key(pooled())

    commented = {name: "# More.\n" + text.replace('"""', '"""More. ', 1) for name, text in sources.items()}
    assert (
        key(commented)
        == key(sources)
        != key(sources | {"reskin.models.train": sources["reskin.models.train"] + "\nWEIGHT = 1.0\n"})
    )
    code.digest.cache_clear()
