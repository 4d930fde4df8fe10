"""Run one stage: parse its arguments, report its errors, record its cost."""

import argparse
import inspect
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pipeline.executors import end_workers
from pipeline.provenance import COSTS, record_cost
from pipeline.settings import read_settings, section_of
from reskin.errors import ReskinError, explaining

WATCH_s, CLEAN_UP_MAX_s = 0.2, 5.0


def run(function: Callable[..., None], arguments: Sequence[str]) -> str:
    """Run the function of a stage; its paths are options on the command line, and its scene is option `--scene`.

    Returns the name of the scene.
    """
    end_with_dvc()
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


def end_with_dvc() -> None:
    """End this process and its workers on SIGTERM, and also when DVC, which started it, has ended.

    DVC does not end the stage that it runs when DVC itself is terminated or killed.
    """
    parent = os.getppid()

    def terminate(number: int, frame: object) -> None:
        for worker in multiprocessing.active_children():
            worker.terminate()  # otherwise, the stage would wait for the results of running calls
        sys.exit(128 + number)  # an exception, so that temporary files are removed

    def watch_parent() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_s)
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(CLEAN_UP_MAX_s)
        os._exit(128 + signal.SIGTERM)  # perhaps the main thread is in a long computation outside Python

    signal.signal(signal.SIGTERM, terminate)
    if "DVC_STAGE" in os.environ:  # set by DVC for the command of a stage
        threading.Thread(target=watch_parent, daemon=True).start()


def say(sentence: str) -> None:
    """Print a sentence to standard error without buffering."""
    print(sentence, file=sys.stderr, flush=True)
