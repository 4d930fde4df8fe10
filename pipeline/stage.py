"""Run one stage: parse its arguments, report its errors, record its cost."""

import argparse
import inspect
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pipeline.executors import end_workers
from pipeline.provenance import COSTS, clear_cost, record_cost
from pipeline.settings import read_settings, section_of
from reskin.errors import ReskinError, explaining


def run(function: Callable[..., None], arguments: Sequence[str]) -> str:
    """Run the function of a stage; its paths are options on the command line, and its scene is option `--scene`.

    Returns the name of the scene.
    """
    stage = function.__name__
    parser = argparse.ArgumentParser(prog=f"python -m pipeline {stage}", description=function.__doc__)
    parser.add_argument("--scene", required=True)
    kinds = {name: parameter.annotation for name, parameter in inspect.signature(function).parameters.items()}
    for name, kind in kinds.items():
        if name not in ("settings", "section"):
            parser.add_argument(f"--{name.replace('_', '-')}", type=kind, required=True)
    options = vars(parser.parse_args(arguments))
    scene = options.pop("scene")
    start_s, costs, unit = time.monotonic(), COSTS / scene, _unit(stage, scene, options)
    try:
        with explaining(stage):
            clear_cost(costs, unit)
            if "settings" in kinds:
                options["settings"] = read_settings(scene)
            if model := section_of(function):
                options["section"] = options["settings"].section(model, stage)
            function(**options)
            end_workers()
            record_cost(costs, unit, time.monotonic() - start_s)
    except ReskinError as error:
        say(f"error: {error}")
        sys.exit(error.exit_code)
    return str(scene)


def _unit(stage: str, scene: str, options: Mapping[str, Any]) -> str:
    """Return the name under which the cost is recorded: the stage and, if there is one, its capture or protocol."""
    if stage == "ingest":
        return f"{stage}-{options['indentations'].stem}"
    if stage in ("simulate", "ingest_simulated"):
        protocol = options["raw"].name.removeprefix(scene).strip("-")
        return f"{stage}-{protocol}" if protocol else stage
    return stage


def say(sentence: str) -> None:
    """Print a sentence to standard error without buffering."""
    print(sentence, file=sys.stderr, flush=True)
