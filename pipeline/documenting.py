"""README.md and docs: their generated parts, filled in from the results of all scenes. In: reports. Out: pages.

Refuses to know what a part says (`reporting.readme`).
"""

from collections.abc import Sequence
from pathlib import Path

from pipeline.core import config, io
from pipeline.core.config import read_yaml
from pipeline.core.errors import ParamsError
from pipeline.reporting.numbers import join
from pipeline.reporting.readme import blocks_of, fill

TIMED = "reports/time.json"  # what `make time-repro` measured
FULL_SIZE = "paper"  # the scene whose results are shown first, where it was run


def fill_pages(root: Path, running: Sequence[str], *, write: bool) -> list[str]:
    """Fill in all pages, and write them if asked to; name those that differ from what was written."""
    if not running:
        raise ParamsError(config.PLAN, "scenes", "one or more", "none", "Try: reskin scenes use quick")
    files = sorted((root / "reports").glob("*/numbers.json"))
    numbers = {
        file.parent.name: join(io.read_json(file), io.read_json(file.with_name("provenance.json"))) for file in files
    }
    recorded = [result for result in numbers.values() if result["provenance"]["source"] == "recorded"]
    results = [numbers[name] for name in dict.fromkeys([FULL_SIZE, running[0]]) if name in numbers]
    timed = io.read_json(root / TIMED) if (root / TIMED).exists() else None
    texts = [root / "README.md", *sorted((root / "docs").glob("*.md"))]
    before = {str(file): file.read_text(encoding="utf-8") for file in texts}
    after = fill(before, blocks_of(results, recorded, read_yaml(root / config.FLOW)["stages"], timed))
    changed = [page for page in after if after[page] != before[page]]
    for page in changed if write else ():
        io.write_text(Path(page), after[page])
    return changed
