"""Generated parts of README.md: text with marked blocks + their contents -> text. No number there is typed."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.core.code import ROOT
from pipeline.core.errors import SchemaError
from pipeline.reporting.shown import to_markdown
from pipeline.reporting.skins import skins_table
from pipeline.reporting.tables import make_tables

Numbers = Mapping[str, Any]  # of one scene


def fill(text: str, blocks: Mapping[str, str]) -> str:
    """Put each block between its marks `<!-- name -->` and `<!-- /name -->`; a missing mark is an error."""
    for name, content in blocks.items():
        found = re.search(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", text, re.DOTALL)
        if not found:
            raise SchemaError("README.md", f"the block {name}", "between its two marks", "none", "Put them back.")
        # Not as a template: a backslash in the content is a backslash.
        text = "".join([text[: found.end(1)], content.strip("\n"), "\n", text[found.start(2) :]])
    return text


def blocks_of(
    results: Sequence[Numbers], recorded: Sequence[Numbers], dag: str, stages: Mapping[str, Any]
) -> dict[str, str]:
    """Make the blocks: results beside the paper's, skins beside recorded ones, the flow as DVC sees it, its code.

    The last of `results` is the scene that runs, whose skins are compared.
    """
    labels = [_results(numbers, ("labels",)) for numbers in recorded if "labels" in numbers]
    skins = {
        f"{numbers['provenance']['scene']} ({numbers['provenance']['source']})": next(
            iter(numbers["described"].values())
        )
        for numbers in (results[-1], *recorded)
    }
    return {
        "results": "\n\n".join(_results(numbers, ("table2", "order", "single_sensor")) for numbers in results),
        "costs": _costs([numbers for numbers in (*results, *recorded) if "trainings" in numbers]),
        "labels": "\n\n".join(labels) or "No recorded scene asked yet.",
        "skins": to_markdown(skins_table(skins)),
        "dag": dag,
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
    tables = make_tables(numbers)
    heading = (
        f"Scene `{provenance['scene']}`, **{provenance['source']}**; trained by code {provenance['trained']}, "
        f"seed {provenance['seed']}, {provenance['device']}:"
    )
    return "\n\n".join([heading] + [to_markdown(tables[name]) for name in names if name in tables])


def _costs(scenes: Sequence[Numbers]) -> str:
    """Write what each scene costs when all of it is computed, on the machine that computed it."""
    by_device: dict[str, list[str]] = {}
    for provenance in (numbers["provenance"] for numbers in scenes):
        cost = f"`{provenance['scene']}` {provenance['seconds'] / 60:.2g} min"
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
        homes = (f"pipeline/stages/{name}.py", f"pipeline/experiments/{name}/run.py")
        code = next(home for home in homes if (ROOT / home).exists())
        lines.append(f"| {name} | [{code}]({code}) | {written} |")
    return "\n".join(lines)
