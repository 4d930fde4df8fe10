"""Find the position of the running stage in `dvc repro`, such as `stage 5 of 39`."""

import hashlib
import os
from pathlib import Path

from pipeline import FLOW, PLAN
from pipeline.provenance import home
from reskin import io

VARIABLE = "DVC_STAGE"  # set by DVC for the command of a stage, such as `simulate@quick-wear`
ORDER = Path(".reskin/order.json")


def stage_position() -> str | None:
    """Return the position of this stage among all stages; None if DVC does not run it."""
    stage = os.environ.get(VARIABLE, "").rpartition(":")[2]  # without prefix `dvc.yaml:`, which DVC may add
    if not stage:
        return None
    try:
        order = stages_in_order()
        return f"stage {order.index(stage) + 1} of {len(order)}" if stage in order else None
    except Exception as error:  # a stage must not fail because its position is unknown
        return f"its position among all stages is unknown ({type(error).__name__} {error})"


def stages_in_order() -> list[str]:
    """Return the names of all stages in the order in which DVC runs them.

    The list is computed by DVC, and cached until `dvc.yaml` or the plan changes.
    """
    inputs_sha256 = hashlib.sha256(Path(FLOW).read_bytes() + Path(PLAN).read_bytes()).hexdigest()
    file = home() / ORDER
    cached = io.read_json(file) if file.exists() else {}
    if cached.get("made_of") != inputs_sha256:
        cached = {"made_of": inputs_sha256, "stages": _ask_dvc()}
        io.write_json(file, cached)
    return list(cached["stages"])


def _ask_dvc() -> list[str]:
    from dvc.repo import Repo  # imported here, because the import takes a second
    from dvc.repo.reproduce import get_active_graph, plan_repro

    with Repo() as repo:
        stages = plan_repro(get_active_graph(repo.index.graph))
        # DVC also counts added recordings as stages. They have no command, so they are left out.
        return [stage.addressing for stage in stages if stage.cmd]
