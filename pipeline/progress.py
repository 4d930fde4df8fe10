"""Tell which stage of `dvc repro` runs, and how long the rest may take.

A time is given only where every stage that is left ran in this checkout with the settings that its scene has now. Knows
no stage by name, and decides nothing.
"""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline import FLOW, PLAN
from pipeline.provenance import COSTS, home, read_costs
from pipeline.settings import read_settings
from reskin import io
from reskin.config import read_yaml

VARIABLE = "DVC_STAGE"  # where DVC tells a command which stage it runs, as `simulate@quick-wear`
ORDER = Path(".reskin/order.json")
AROUND_S = 3.0  # a stage's start and imports, and DVC's bookkeeping: 117 s of 39 stages of scene quick, 4 busy cores


def announce() -> str | None:
    """Tell which stage of how many this is and how long the rest may take; None if DVC does not run it."""
    stage = os.environ.get(VARIABLE, "").rpartition(":")[2]  # `dvc.yaml:` stands before it where there are more files
    if not stage:
        return None
    try:
        order = stages_in_order()
        return describe(stage, order, read_seconds(order)) if stage in order else None
    except Exception as error:  # of DVC or of a file that is no longer whole: no stage ends for the sake of this line
        return f"which of all stages this is cannot be told ({type(error).__name__} {error})"


def describe(stage: str, order: Sequence[str], took_s: Mapping[str, float]) -> str:
    """Compose the line: `order` names all stages as DVC runs them, `took_s` those whose time is known.

    >>> describe("b@x", ["code", "b@x", "c@x"], {"b@x": 57.0, "c@x": 120.0})
    'stage 2 of 3; at most about 3 min left, by what it took here with these settings'
    >>> describe("b@x", ["code", "b@x", "c@x"], {"c@x": 120.0})
    'stage 2 of 3'
    """
    at = order.index(stage)
    place, left = f"stage {at + 1} of {len(order)}", order[at:]
    if any(name not in took_s for name in left):
        return place
    minutes = max(sum(took_s[name] + AROUND_S for name in left) / 60, 1)
    return f"{place}; at most about {minutes:.0f} min left, by what it took here with these settings"


def settings_of(scene: str) -> str:
    """Digest all settings that decide what a scene costs: its own, what scenes share, and its captures."""
    settings = read_settings(scene)
    return _hash([settings.of_scene, settings.shared, settings.captures])


def _hash(values: Any) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()


def stages_in_order() -> list[str]:
    """Name all stages in the order in which DVC runs them; asked of DVC once, until the flow or the plan changes."""
    made_of = hashlib.sha256(Path(FLOW).read_bytes() + Path(PLAN).read_bytes()).hexdigest()
    file = home() / ORDER
    known = io.read_json(file) if file.exists() else {}
    if known.get("made_of") != made_of:
        known = {"made_of": made_of, "stages": _ask_dvc()}
        io.write_json(file, known)
    return list(known["stages"])


def _ask_dvc() -> list[str]:
    from dvc.repo import Repo  # late: a second of imports
    from dvc.repo.reproduce import get_active_graph, plan_repro

    with Repo() as repo:
        stages = plan_repro(get_active_graph(repo.index.graph))
        return [stage.addressing for stage in stages if stage.cmd]  # added recordings are stages that run nothing


def read_seconds(order: Sequence[str]) -> dict[str, float]:
    """Read how long stages took here when they last ran, of those whose scene still has the settings of that run.

    If trainings of that run were taken from an earlier one, the time without them is not known: all trainings are added
    up, as if one ran after another.
    """
    found: dict[str, float] = {}
    for scene in read_yaml(Path(PLAN))["scenes"]:
        settings = settings_of(scene)
        for unit, cost in read_costs(home() / COSTS / scene).items():
            stage, _, part = unit.partition("-")
            name = f"{stage}@{scene}-{part}" if part else f"{stage}@{scene}"
            if name in order and cost.get("settings") == settings:
                computed_s = cost["other_s"] + sum(cost["trainings_s"].values())
                found[name] = computed_s if cost["reused_n"] else cost["seconds"]
    return found
