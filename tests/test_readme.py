import re
import shutil
import subprocess

import pytest
from typer.testing import CliRunner

from pipeline import plan
from pipeline.cli import app
from pipeline.report.numbers import join, split
from pipeline.report.readme import blocks_of
from reskin import io
from reskin.config import read_yaml
from reskin.errors import ReskinError
from tests.report.synthetic import all_experiments, new_board
from tests.stages.checkout import ROOT, copy_checkout

INPUTS = ["reports", "params.yaml", "data/captures.yaml", "dvc.yaml", "README.md", "docs"]
FIGURE = "docs/img/headline.svg"


def test_readme_shows_the_committed_results(monkeypatch):
    status = subprocess.run(
        ["git", "status", "--porcelain", "--", *INPUTS], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if status.returncode or status.stdout:
        pytest.skip("the results or scenes of this checkout are not committed; `reskin readme` would show them")
    monkeypatch.chdir(ROOT)
    done = CliRunner().invoke(app, ["readme", "--check"])
    assert done.exit_code == 0, done.output


def reskin(*arguments):
    """Run a command in this process, in the working directory; return its output."""
    return CliRunner().invoke(app, arguments, catch_exceptions=False).stdout


def copy_results(root, scenes):
    for name in scenes:
        (root / "reports" / name).mkdir(exist_ok=True)
        for file in ("numbers.json", "provenance.json"):
            shutil.copy(ROOT / "reports" / name / file, root / "reports" / name)
        if name == "lab":
            write_new_board(root, new_board())


def write_new_board(root, rows):
    file = root / "reports/lab/numbers.json"
    io.write_json(file, io.read_json(file) | {"new_board": rows})


def test_pages_do_not_depend_on_the_planned_scene(tmp_path, monkeypatch):
    root = copy_checkout(tmp_path)
    copy_results(root, [file.parent.name for file in (ROOT / "reports").glob("*/numbers.json")])
    monkeypatch.chdir(root)
    reskin("readme")
    pages = [root / "README.md", *(root / "docs").glob("*.md")]
    before = [page.read_bytes() for page in pages]

    plan.use(root, ["ci"])
    numbers = all_experiments()
    shared, run_provenance = split(numbers | {"provenance": numbers["provenance"] | {"scene": "ci"}})
    io.write_json(root / "reports/ci/numbers.json", shared)
    io.write_json(root / "reports/ci/provenance.json", run_provenance)
    output = reskin("readme")
    assert [page.read_bytes() for page in pages] == before
    assert output.startswith("rewritten: nothing; results shown: scenes paper, quick, ")

    (root / "reports/paper/numbers.json").unlink()
    with pytest.raises(ReskinError, match="reports/paper/numbers.json is missing"):
        reskin("readme")


def test_rewritten_pages_and_scenes_are_printed(tmp_path, monkeypatch):
    root = copy_checkout(tmp_path)
    copy_results(root, ["quick", "paper"])
    readme = root / "README.md"
    readme.write_text(re.sub(r"(<!-- headline -->\n).*?(<!-- /headline)", r"\1\2", readme.read_text(), flags=re.DOTALL))
    monkeypatch.chdir(root)
    output = reskin("readme")
    assert re.fullmatch(r"rewritten: README\.md, .*; results shown: scenes paper, quick\n", output)


def test_figure_of_the_readme_shows_the_results_of_new_board(tmp_path, monkeypatch):
    root = copy_checkout(tmp_path)
    copy_results(root, ["quick", "paper", "lab"])
    monkeypatch.chdir(root)
    reskin("readme")
    before = (root / FIGURE).read_bytes()
    assert FIGURE not in reskin("readme")

    rows = new_board()
    rows[0]["accuracy_pct"] = {"mean": 56.0, "by_board": {"b0": 50.0, "b1": 62.0}}
    write_new_board(root, rows)
    assert CliRunner().invoke(app, ["readme", "--check"]).exit_code == 1
    assert FIGURE in reskin("readme")
    assert ">56<" in (root / FIGURE).read_text()
    assert b">56<" not in before


def test_readme_links_the_code_of_every_stage():
    stages = read_yaml(ROOT / "dvc.yaml")["stages"]
    numbers, provenance = (io.read_json(ROOT / f"reports/quick/{name}.json") for name in ("numbers", "provenance"))
    links = re.findall(r"\]\((\S+)\)", blocks_of([join(numbers, provenance)], [], stages, None)["stages"])
    assert len(links) == len(stages)
    assert [link for link in links if not (ROOT / "docs" / link).is_file()] == []


def test_links_in_the_docs_are_valid():
    broken = []
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), ROOT / "data/README.md"]:
        for link in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
            if "://" not in link and not (page.parent / link).exists():
                broken.append(f"{page.name}: {link}")
    assert broken == []


def test_block_recorded_shows_the_scores_on_boards_never_seen():
    quick, lab = (
        join(*(io.read_json(ROOT / f"reports/{scene}/{name}.json") for name in ("numbers", "provenance")))
        for scene in ("quick", "lab")
    )
    block = blocks_of([quick], [lab | {"new_board": new_board(("shipped",))}], {}, None)["recorded"]
    line = next(line for line in block.splitlines() if "shipped model" in line and "within 1 mm" in line)
    assert line.endswith("| 80 (79; 81) |")
    assert "2.0 (1.0; 3.0) N" in block  # the error of a constant force


def test_block_headline_shows_our_scores_next_to_those_of_the_paper():
    results = [
        join(*(io.read_json(ROOT / f"reports/{scene}/{name}.json") for name in ("numbers", "provenance")))
        for scene in ("paper", "quick")
    ]
    block = blocks_of(results, [], {}, None)["headline"]
    line = next(line for line in block.splitlines() if line.startswith("| Multi-sensor with triplet loss |"))
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    ours = [result["table2"]["triplet"]["accuracy_pct"]["mean"] for result in reversed(results)]
    assert [cell.split()[0] for cell in cells[1:4]] == [f"{ours[0]:.0f}", f"{ours[1]:.0f}", "81"]
