"""What every stage does around its work: argv, one-sentence errors, its cost.

In: the stage's function; its parameters are its options. Refuses to know what the stage does.
"""

import argparse
import inspect
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

from pipeline.executors import end_workers
from pipeline.progress import announce, settings_of
from pipeline.provenance import COSTS, begin_cost, note_cost
from reskin.config import Files
from reskin.errors import ReskinError, explaining


def run(work: Callable[..., None]) -> None:
    """Call `work` with options of its own names (`--scene quick`), all required; `files` follows from the scene."""
    stage = work.__name__
    parser = argparse.ArgumentParser(prog=f"sh pipeline/run.sh {stage}", description=work.__doc__)
    kinds = {name: parameter.annotation for name, parameter in inspect.signature(work).parameters.items()}
    for name, kind in kinds.items():
        if kind is not Files:
            parser.add_argument(f"--{name.replace('_', '-')}", type=kind, required=True)
    arguments = vars(parser.parse_args())
    arguments |= {name: Files.of(arguments["scene"]) for name, kind in kinds.items() if kind is Files}
    if place := announce():
        say(f"{stage}: {place}")
    settings = settings_of(arguments["scene"]) if place else None  # read now: they may be edited while it runs
    start_s, costs, unit = time.monotonic(), COSTS / arguments["scene"], _unit(stage, arguments)
    try:
        with explaining(stage):
            begin_cost(costs, unit)
            work(**arguments)
            end_workers()
            note_cost(costs, unit, time.monotonic() - start_s, settings)
    except ReskinError as error:
        say(f"error: {error}")
        sys.exit(error.exit_code)


def _unit(stage: str, arguments: Mapping[str, Any]) -> str:
    """Name what ran: some stages run for each recorded capture, or for each protocol's folder."""
    if stage == "ingest":
        return f"{stage}-{arguments['indentations'].stem}"
    of = {"ingest_simulated": "indentations", "describe": "indentations", "simulate": "raw"}
    if stage not in of:
        return stage
    part = arguments[of[stage]].stem.removeprefix(arguments["scene"]).strip("-")
    return f"{stage}-{part}" if part else stage


def say(sentence: str) -> None:
    """Print a sentence to standard error at once."""
    print(sentence, file=sys.stderr, flush=True)
