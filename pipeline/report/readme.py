"""Fill in the generated parts of README.md and docs from the results in `reports/`."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from pipeline import FLOW
from pipeline.report.formatting import to_markdown
from pipeline.report.headline import labels_table, short_table
from pipeline.report.numbers import join
from pipeline.report.tables import make_tables, skins_table
from pipeline.scenes import ANALYSES
from pipeline.stages import module_name
from reskin import io
from reskin.code import ROOT, file_of
from reskin.config import read_yaml
from reskin.errors import ParamsError, SchemaError

SEVERAL_min = 100  # from here on whole minutes
TABLES = ("table2", "claims", "manual", "flexible", "single_sensor")  # of each simulated scene in docs/results.md
COMPARED = ("compare", "compare_parameters", "compare_frames")
Numbers = Mapping[str, Any]  # of one scene


def fill(texts: Mapping[str, str], blocks: Mapping[str, str]) -> dict[str, str]:
    """Put each block between its marks `<!-- name -->` and `<!-- /name -->`, in the one page that has them."""
    filled = dict(texts)
    for name, content in blocks.items():
        marks = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
        pages = {page: found for page, text in filled.items() if (found := marks.search(text))}
        if len(pages) != 1:
            got = ", ".join(pages) or "no page"
            raise SchemaError("README.md and docs", f"the block {name}", "in one page", got, "Put its marks back.")
        page, found = pages.popitem()
        # Not as a template: a backslash in the content is a backslash.
        text = filled[page]
        filled[page] = "".join([text[: found.end(1)], content.strip("\n"), "\n", text[found.start(2) :]])
    return filled


def blocks_of(
    results: Sequence[Numbers], recorded: Sequence[Numbers], stages: Mapping[str, Any], timed: Numbers | None
) -> dict[str, str]:
    """Make the blocks: results beside the paper's, skins beside recorded ones, the stages and their code.

    The last of `results` is the headline scene: README shows its scores, and its skins are compared.
    """
    labels = [_results(numbers, ("labels",)) for numbers in recorded if "labels" in numbers]
    compared = [_results(numbers, COMPARED) for numbers in recorded if "compare" in numbers]
    skins = {
        f"{numbers['provenance']['scene']} ({numbers['provenance']['source']})": next(
            iter(numbers["described"].values())
        )
        for numbers in (results[-1], *recorded)
    }
    return {
        "headline": _headline(results[-1]),
        "recorded": "\n\n".join(_recorded(numbers) for numbers in recorded if "labels" in numbers) or "None yet.",
        "results": "\n\n".join(_results(numbers, TABLES) for numbers in results),
        "time": _time(timed),
        "costs": _costs([numbers for numbers in (*results, *recorded) if "trainings" in numbers]),
        "labels": "\n\n".join(labels) or "No recorded scene asked yet.",
        "compare": "\n\n".join(compared) or "No recorded scene asked yet.",
        "skins": to_markdown(skins_table(skins)),
        "stages": _stages(stages),
    }


def _results(numbers: Numbers, names: Sequence[str]) -> str:
    provenance = numbers["provenance"]
    if "trainings" not in numbers:
        scene = provenance["scene"]
        return (
            f"Scene `{scene}`, **{provenance['source']}**: stale. `reports/{scene}` was made by code "
            f"{provenance['git']}, with other settings and before the check for collapsed networks; no number of it is "
            f"shown here. Run it again: `reskin scenes use {scene}`, `dvc repro`."
        )
    # Results that were committed before the code of other experiments changed can still be shown.
    tables = make_tables({name: part for name, part in numbers.items() if name not in ANALYSES or name in names})
    heading = (
        f"Scene `{provenance['scene']}`, **{provenance['source']}**; trained by code {provenance['trained']}, "
        f"seed {provenance['seed']}, {provenance['device']}:"
    )
    return "\n\n".join([heading] + [to_markdown(tables[name]) for name in names if name in tables])


def _headline(numbers: Numbers) -> str:
    provenance = numbers["provenance"]
    heading = f"Scene `{provenance['scene']}`, **{provenance['source']}**, code {provenance['trained']}:"
    return f"{heading}\n\n{to_markdown(short_table(numbers))}"


def _recorded(numbers: Numbers) -> str:
    provenance = numbers["provenance"]
    heading = f"Scene `{provenance['scene']}`, **{provenance['source']}**, code {provenance['trained']}:"
    return f"{heading}\n\n{to_markdown(labels_table(numbers['labels']))}"


def _time(timed: Numbers | None) -> str:
    """Write how long fresh clones took, the median of their runs."""
    if timed is None:
        return "Not timed yet: `make time-repro`."
    runs = timed["runs"]
    minutes = {
        (part, unit): median(run[part][unit] for run in runs) / 60
        for part in ("environment", "stages")
        for unit in ("wall_s", "cpu_s")
    }
    disk = f"{median(run['all_MB'] for run in runs) / 1e3:.1f} GB on disk"
    clones = "a fresh clone" + (f", stages the median of {len(runs)} runs from nothing" if len(runs) > 1 else "")
    return (
        f"Environment {minutes['environment', 'wall_s']:.1f} min, stages {minutes['stages', 'wall_s']:.1f} min "
        f"({minutes['stages', 'cpu_s']:.1f} min of CPU), {disk}, of which the environment takes "
        f"{median(run['environment_MB'] for run in runs) / 1e3:.1f} GB: {clones} on "
        f"{timed['machine']} (`make time-repro`, code {timed['git']})."
    )


def _costs(scenes: Sequence[Numbers]) -> str:
    """Write what each scene costs when all of it is computed, on the machine that computed it."""
    by_device: dict[str, list[str]] = {}
    for provenance in (numbers["provenance"] for numbers in scenes):
        minutes = provenance["seconds"] / 60
        cost = f"`{provenance['scene']}` {minutes:{'.2g' if minutes < SEVERAL_min else ',.0f'}} min"
        by_device.setdefault(provenance["device"], []).append(cost)
    costs = "; ".join(f"{', '.join(own)} ({device})" for device, own in by_device.items())
    counts = [count for numbers in scenes for count in numbers["trainings"].values()]
    trained_n, collapsed_n = (sum(count[name] for count in counts) for name in ("trainings_n", "collapsed_n"))
    return (
        f"Computed from nothing, trainings added up as if one ran after another: {costs}. Two run side by side "
        f"by default, so that less time passes. Of the {trained_n:,} trainings of these scenes {collapsed_n} collapsed."
    )


def _stages(stages: Mapping[str, Any]) -> str:
    lines = ["| stage | code | writes |", "|---|---|---|"]
    for name, stage in stages.items():
        outs = [
            out if isinstance(out, str) else next(iter(out))
            for key in ("outs", "metrics", "plots")
            for out in stage.get("do", stage).get(key, [])
        ]
        written = ", ".join(f"`{re.sub(r'[$]{[^}]*}', '…', out)}`" for out in outs) or "MLflow runs"
        code = file_of(module_name(name) if name != "code" else "pipeline.stages.code").relative_to(ROOT)
        lines.append(f"| {name} | [{code}](../{code}) | {written} |")
    return "\n".join(lines)


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
    after = fill(before, blocks_of(results, recorded, read_yaml(root / FLOW)["stages"], timed))
    changed = [page for page in after if after[page] != before[page]]
    for page in changed if write else ():
        io.write_text(Path(page), after[page])
    return changed, [result["provenance"]["scene"] for result in (*results, *recorded)]
