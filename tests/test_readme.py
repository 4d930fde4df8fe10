import re
import shutil
import subprocess

import pytest
from typer.testing import CliRunner

from pipeline import plan
from pipeline.cli import app
from pipeline.report.numbers import join, split
from pipeline.report.readme import HALVES, blocks_of
from reskin import io
from reskin.config import read_yaml
from reskin.errors import ReskinError
from tests.report.synthetic import all_experiments
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


def test_figure_of_the_readme_shows_the_committed_results(tmp_path, monkeypatch):
    root = copy_checkout(tmp_path)
    copy_results(root, ["quick", "paper", "lab"])
    (root / FIGURE).unlink(missing_ok=True)
    monkeypatch.chdir(root)
    assert FIGURE in reskin("readme")
    assert (root / FIGURE).read_bytes() == (ROOT / FIGURE).read_bytes()
    assert FIGURE not in reskin("readme")

    file = root / "reports/lab/numbers.json"
    numbers = io.read_json(file)
    for row in numbers["random_presses"]["rows"]:
        row["accuracy_pct"]["values"] = [50.0, 62.125]
    io.write_json(file, numbers)
    assert CliRunner().invoke(app, ["readme", "--check"]).exit_code == 1
    reskin("readme")
    assert "= 62.12" in (root / FIGURE).read_text()
    assert "= 62.12" not in (ROOT / FIGURE).read_text()


def test_readme_links_the_code_of_every_stage():
    stages = read_yaml(ROOT / "dvc.yaml")["stages"]
    numbers, provenance = (io.read_json(ROOT / f"reports/quick/{name}.json") for name in ("numbers", "provenance"))
    links = re.findall(r"\]\((\S+)\)", blocks_of([join(numbers, provenance)], [], stages, None)["stages"])
    assert len(links) == len(stages)
    assert [link for link in links if not (ROOT / "docs" / link).is_file()] == []


def test_readme_is_short_and_links_in_the_docs_are_valid():
    assert len((ROOT / "README.md").read_text(encoding="utf-8")) <= 8000
    broken = []
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), ROOT / "data/README.md"]:
        for link in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
            if "://" not in link and not (page.parent / link).exists():
                broken.append(f"{page.name}: {link}")
    assert broken == []


def test_block_recorded_shows_the_scores_of_presses_at_random_places():
    """Compares cells of the table with the committed results of scene lab, and then with results that are set here."""
    quick, lab = (
        join(*(io.read_json(ROOT / f"reports/{scene}/{name}.json") for name in ("numbers", "provenance")))
        for scene in ("quick", "lab")
    )
    block = blocks_of([quick], [lab], {}, None)["recorded"]
    (row,) = (
        row
        for row in lab["random_presses"]["rows"]
        if (row["tested"], row["presses_n"], row["method"], row["labels"])
        == ("places without labels (checkerboard)", 65, "universal, simulated alone", "40")
    )
    mean, values = row["accuracy_pct"]["mean"], row["accuracy_pct"]["values"]
    line = next(line for line in block.splitlines() if "shipped model" in line and "within 1 mm" in line)
    assert line.endswith(f"| {mean:.0f} ({values[0]:.0f}; {values[1]:.0f}) |")

    # If forces 1 and 3 N (board 1), and 2 and 8 N (board 2), were estimated as their means, the errors were 1 and 3 N.
    for row in lab["random_presses"]["rows"]:
        row |= {"mse_f_N2": {"values": [0.5, 18.0]}, "r2_f": {"values": [0.5, -1.0]}}
        row["mse_f_N2"]["mean"] = row["r2_f"]["mean"] = 0.0
        if row["tested"] == HALVES:
            row["accuracy_pct"]["mean"] = 31.4
    block = blocks_of([quick], [lab], {}, None)["recorded"]
    assert "The mean force as estimate would give an R² of 0 and an error of 2.0 (1.0; 3.0) N." in block
    assert re.search(
        r"31 % \(shipped model\) and 31 % \(model trained with .*\) of the presses on the other half", block
    )


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
