"""Which stage of all this is, and how long the rest may take. In: DVC's order of stages, the costs of earlier runs.

Out: a line. Refuses to know what a stage does, and decides nothing.
"""

import hashlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from pipeline.core import io
from pipeline.core.config import FLOW, PLAN, read_yaml
from pipeline.core.provenance import COSTS, home, read_costs

VARIABLE = "DVC_STAGE"  # where DVC tells a command which stage it runs, as `simulate@quick-wear`
ORDER = Path(".reskin/order.json")
AROUND_S = 1.5  # assumed: what passes around a stage's own work: its start and imports, DVC's bookkeeping


def announce() -> str | None:
    """Tell which stage of how many this is and how long the rest may take; None where it is not DVC that runs it."""
    stage = os.environ.get(VARIABLE, "").rpartition(":")[2]  # `dvc.yaml:` stands before it where there are more files
    if not stage:
        return None
    try:
        order = stages_in_order()
        return describe(stage, order, read_seconds(order)) if stage in order else None
    except Exception as error:  # of DVC or of a file that is no longer whole: no stage ends for the sake of this line
        return f"which of all stages this is cannot be told ({type(error).__name__} {error})"


def describe(stage: str, order: Sequence[str], took_s: Mapping[str, float]) -> str:
    """Compose the line: `order` names all stages as DVC runs them, `took_s` how long each took when it ran last.

    >>> describe("b@x", ["code", "b@x", "c@x"], {"b@x": 57.0, "c@x": 120.0})
    'stage 2 of 3; about 3 min left if none is skipped'
    >>> describe("b@x", ["code", "b@x", "c@x"], {"c@x": 120.0})
    'stage 2 of 3; about 2 min left if none is skipped, and 1 that never ran'
    """
    at = order.index(stage)
    left = [took_s[name] for name in order[at:] if name in took_s]
    if not left:
        return f"stage {at + 1} of {len(order)}"
    minutes = max((sum(left) + AROUND_S * len(left)) / 60, 1)
    unknown_n = len(order) - at - len(left)
    beside = f", and {unknown_n} that never ran" if unknown_n else ""
    return f"stage {at + 1} of {len(order)}; about {minutes:.0f} min left if none is skipped{beside}"


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
    """Read how long stages took when they ran last, here or else where the committed results were made.

    Half of what their trainings took when computed, if that is more: of two side by side, and some may be reused.
    """
    found: dict[str, float] = {}
    for scene in read_yaml(Path(PLAN))["scenes"]:
        committed = Path("reports") / scene / "provenance.json"
        stages = io.read_json(committed)["runtime"]["stages"] if committed.exists() else {}
        costs = {unit: cost for unit, cost in stages.items() if "computed_s" in cost}  # of older code: without
        took_s = {unit: max(cost["seconds"], cost["computed_s"] / 2) for unit, cost in costs.items()}
        for unit, cost in read_costs(home() / COSTS / scene).items():
            took_s[unit] = max(cost["seconds"], sum(cost["trainings_s"].values()) / 2)
        for name in order:
            stage, _, key = name.partition("@")
            if key == scene or key.startswith(f"{scene}-"):
                unit = stage + key.removeprefix(scene)
                found |= {name: took_s[unit]} if unit in took_s else {}
    return found
