"""Generated parts of README.md: text with marked blocks + their contents -> text. No number there is typed."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from pipeline.core.errors import SchemaError
from pipeline.reporting.shown import to_markdown
from pipeline.reporting.skins import skins_table
from pipeline.reporting.tables import make_tables


def fill(text: str, blocks: Mapping[str, str]) -> str:
    """Put each block between its marks `<!-- name -->` and `<!-- /name -->`; a missing mark is an error."""
    for name, content in blocks.items():
        pattern = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
        found = pattern.search(text)
        if not found:
            raise SchemaError("README.md", f"the block {name}", "between its two marks", "none", "Put them back.")
        # Not as a template: a backslash in the content is a backslash.
        text = "".join([text[: found.end(1)], content.strip("\n"), "\n", text[found.start(2) :]])
    return text


def blocks_of(
    results: Sequence[Mapping[str, Any]], recorded: Iterable[Mapping[str, Any]], dag: str, stages: Mapping[str, Any]
) -> dict[str, str]:
    """Make the blocks: results beside the paper's, skins beside recorded ones, the flow as DVC sees it, its code.

    The last of `results` is the scene that runs, whose skins are compared.
    """
    others = list(recorded)
    shown = [_results(numbers, ("table2", "order", "single_sensor")) for numbers in results]
    labels = [_results(numbers, ("labels",)) for numbers in others if "labels" in numbers]
    skins = to_markdown(skins_table(dict(_main_skins([results[-1], *others]))))
    blocks = {"results": "\n\n".join(shown), "costs": _costs(one for one in (*results, *others) if "trainings" in one)}
    blocks |= {"labels": "\n\n".join(labels) or "No recorded scene asked yet."}
    return blocks | {"skins": skins, "dag": dag, "stages": _stages(stages)}


def _results(numbers: Mapping[str, Any], names: Sequence[str]) -> str:
    provenance = numbers["provenance"]
    if "trainings" not in numbers:
        scene, code = provenance["scene"], provenance["git"]
        return (
            f"Scene `{scene}`, **{provenance['source']}**: stale. `reports/{scene}` was made by code {code}, with "
            "other settings and before collapsed networks were found out; no number of it is shown here. Run it again: "
            f"`reskin scenes use {scene}`, `dvc repro`."
        )
    tables = make_tables(numbers)
    words = (
        f"Scene `{provenance['scene']}`, **{provenance['source']}**; trained by code {provenance['trained']}, "
        f"seed {provenance['seed']}, {provenance['device']}:"
    )
    return "\n\n".join([words] + [to_markdown(tables[name]) for name in names if name in tables])


def _costs(scenes: Iterable[Mapping[str, Any]]) -> str:
    """Say what each scene costs when all of it is computed, on the machine that computed it."""
    by_device: dict[str, list[str]] = {}
    shown = list(scenes)
    for own in (numbers["provenance"] for numbers in shown):
        by_device.setdefault(own["device"], []).append(f"`{own['scene']}` {own['seconds'] / 60:.2g} min")
    said = "; ".join(f"{', '.join(costs)} ({device})" for device, costs in by_device.items())
    counts = [count for numbers in shown for count in numbers["trainings"].values()]
    trained_n, collapsed_n = (sum(one[name] for one in counts) for name in ("trainings_n", "collapsed_n"))
    return (
        f"Computed from nothing, trainings added up as if one ran after another: {said}. Two run side by side "
        f"by default, so that less time passes. Of the {trained_n:,} trainings of these scenes {collapsed_n} collapsed."
    )


def _main_skins(scenes: Iterable[Mapping[str, Any]]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Title the description of each scene's own captures: the grid of a simulated one, or what was recorded."""
    for numbers in scenes:
        provenance, described = numbers["provenance"], numbers["described"]
        yield f"{provenance['scene']} ({provenance['source']})", next(iter(described.values()))


def _stages(stages: Mapping[str, Any]) -> str:
    lines = ["| stage | code | writes |", "|---|---|---|"]
    for name, stage in stages.items():
        outs = [
            out if isinstance(out, str) else next(iter(out))
            for key in ("outs", "metrics", "plots")
            for out in stage["do"].get(key, [])
        ]
        written = ", ".join(f"`{re.sub(r'[$]{[^}]*}', '…', out)}`" for out in outs) or "MLflow runs"
        lines.append(f"| {name} | [pipeline/stages/{name}.py](pipeline/stages/{name}.py) | {written} |")
    return "\n".join(lines)
