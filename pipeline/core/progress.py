"""Which stage of all this is, and how long the rest may take. In: DVC's order of stages, the costs of earlier runs.

Out: a line. Refuses to know what a stage does, and decides nothing.
"""

import hashlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from pipeline.core import io
from pipeline.core.config import FLOW, PLAN, read_yaml
from pipeline.core.provenance import COSTS, home

VARIABLE = "DVC_STAGE"  # where DVC tells a command which stage it runs, as `simulate@quick-wear`
ORDER = Path(".reskin/order.json")
AROUND_S = 1.5  # assumed: what passes around a stage's own work: its start and imports, DVC's bookkeeping


def announce() -> str | None:
    """Tell which stage of how many this is and how long the rest may take; None where it is not DVC that runs it."""
    stage = os.environ.get(VARIABLE, "").rpartition(":")[2]  # `dvc.yaml:` stands before it where there are more files
    if not stage:
        return None
    order = stages_in_order()
    return describe(stage, order, read_seconds(order)) if stage in order else None


def describe(stage: str, order: Sequence[str], took_s: Mapping[str, float]) -> str:
    """Compose the line: `order` names all stages as DVC runs them, `took_s` how long each took when it ran last.

    >>> describe("b@x", ["code", "b@x", "c@x"], {"b@x": 57.0, "c@x": 120.0})
    'stage 2 of 3; about 3 min left if none is skipped'
    >>> describe("b@x", ["code", "b@x", "c@x"], {"c@x": 120.0})
    'stage 2 of 3'
    """
    at = order.index(stage)
    place = f"stage {at + 1} of {len(order)}"
    if any(name not in took_s for name in order[at:]):
        return place
    left_s = sum(took_s[name] + AROUND_S for name in order[at:])
    return f"{place}; about {max(left_s / 60, 1):.0f} min left if none is skipped"


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
    from dvc.repo import Repo  # type: ignore[import-untyped]  # late: a second of imports
    from dvc.repo.reproduce import get_active_graph, plan_repro  # type: ignore[import-untyped]

    with Repo() as repo:
        return [stage.addressing for stage in plan_repro(get_active_graph(repo.index.graph))]


def read_seconds(order: Sequence[str]) -> dict[str, float]:
    """Read how long stages took when they ran last, here or else where the committed results were made."""
    found: dict[str, float] = {}
    for scene in read_yaml(Path(PLAN))["scenes"]:
        committed = Path("reports") / scene / "numbers.json"
        stages = io.read_json(committed)["runtime"]["stages"] if committed.exists() else {}
        took_s = {unit: cost["seconds"] for unit, cost in stages.items()}
        took_s |= {file.stem: io.read_json(file)["seconds"] for file in (home() / COSTS / scene).glob("*.json")}
        for name in order:
            stage, _, key = name.partition("@")
            if key == scene or key.startswith(f"{scene}-"):
                unit = stage + key.removeprefix(scene)
                found |= {name: took_s[unit]} if unit in took_s else {}
    return found
