"""Fill in the generated parts of README.md and docs from the results in `reports/`.

The scenes that `dvc repro` runs make no difference. Knows no wording of a part (`reporting.readme`).
"""

from pathlib import Path

from pipeline.core import config, io
from pipeline.core.config import read_yaml
from pipeline.core.errors import ParamsError
from pipeline.reporting.numbers import join
from pipeline.reporting.readme import blocks_of, fill

TIMED = "reports/time.json"  # what `make time-repro` measured
FULL_SIZE, HEADLINE = "paper", "quick"  # the simulated scenes that the pages show; README begins with the second


def fill_pages(root: Path, *, write: bool) -> tuple[list[str], list[str]]:
    """Fill in all pages, and write them if `write`; return the pages that change, and the scenes that they show.

    The pages show the simulated scenes `paper` and `quick`, and every recorded scene with results in `reports/`.
    """
    files = sorted((root / "reports").glob("*/numbers.json"))
    numbers = {
        file.parent.name: join(io.read_json(file), io.read_json(file.with_name("provenance.json"))) for file in files
    }
    for name in (FULL_SIZE, HEADLINE):
        if name not in numbers:
            raise ParamsError(
                f"reports/{name}/numbers.json is missing, and README.md and docs show its results. "
                f"Restore it: git restore reports/{name}"
            )
    recorded = [result for result in numbers.values() if result["provenance"]["source"] == "recorded"]
    results = [numbers[name] for name in (FULL_SIZE, HEADLINE)]
    timed = io.read_json(root / TIMED) if (root / TIMED).exists() else None
    texts = [root / "README.md", *sorted((root / "docs").glob("*.md"))]
    before = {str(file): file.read_text(encoding="utf-8") for file in texts}
    after = fill(before, blocks_of(results, recorded, read_yaml(root / config.FLOW)["stages"], timed))
    changed = [page for page in after if after[page] != before[page]]
    for page in changed if write else ():
        io.write_text(Path(page), after[page])
    return changed, [result["provenance"]["scene"] for result in (*results, *recorded)]
