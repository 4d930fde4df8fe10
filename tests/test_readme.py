import re
import subprocess

import pytest

from pipeline.core.config import read_yaml
from pipeline.reporting.readme import blocks_of
from tests.reporting.synthetic import all_questions
from tests.stages.checkout import ROOT, run

OWN = ["reports", "params.yaml", "data/captures.yaml", "dvc.yaml", "README.md", "docs"]


def test_the_readme_shows_what_the_committed_results_say():
    status = subprocess.run(
        ["git", "status", "--porcelain", "--", *OWN], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if status.returncode or status.stdout:
        pytest.skip("this checkout has results or scenes of its own; `reskin readme` would show those")
    done = run(ROOT, "reskin", "readme", "--check", check=False)
    assert done.returncode == 0, done.stderr


def test_the_readme_links_the_code_of_every_stage():
    stages = read_yaml(ROOT / "dvc.yaml")["stages"]
    links = re.findall(r"\]\((\S+)\)", blocks_of([all_questions()], [], stages, None)["stages"])
    assert len(links) == len(stages)
    assert [link for link in links if not (ROOT / "docs" / link).is_file()] == []


def test_the_readme_is_short_and_every_link_of_readme_and_docs_leads_somewhere():
    assert len((ROOT / "README.md").read_text(encoding="utf-8")) <= 8000
    broken = []
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), ROOT / "data/README.md"]:
        for link in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
            if "://" not in link and not (page.parent / link).exists():
                broken.append(f"{page.name}: {link}")
    assert broken == []
