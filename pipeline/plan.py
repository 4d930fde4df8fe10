"""Generate pipeline/plan.yaml, which lists the scenes that DVC runs and the items for which each DVC stage runs."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from pipeline import PLAN, SCENES
from pipeline.catalogue import ANALYSES, EXPERIMENTS, Experiment, stages
from pipeline.manage.registry import Registry, read_registry
from pipeline.scenes import MAIN_PROTOCOL, Scene, read_scene, scene_file
from reskin import io
from reskin.config import Strict, parse, read_yaml
from reskin.errors import ParamsError

HEADER = """\
# The scenes that `dvc repro` runs, and the items (scenes, captures or folders) for which each stage of dvc.yaml runs.
# Do not edit: `reskin scenes use` writes this file from pipeline/scenes and data/captures.yaml.
"""
MANY_N = 30  # recorded scenes with more captures than this are ingested by a single stage (docs/teams.md)
NOT_INGESTED = {"walk"}  # kinds of protocols without a log of the robot; their experiments read the raw captures


class Plan(Strict):
    """Content of `pipeline/plan.yaml`, which states what `dvc repro` runs.

    - scenes: the experiments of each planned scene.
    - captures: the recorded captures of each scene.
    - held_out: the experiments of each scene for which folds are drawn.
    - models: the stages of each scene that write models.
    - stages: the items for which each stage runs: names of scenes, recorded captures (`ingest`), folders with the
      captures of a simulated protocol (`simulate`, `ingest_simulated`), or scenes with a folder or file (`drift`).
    """

    scenes: dict[str, tuple[str, ...]]
    captures: dict[str, tuple[str, ...]]
    held_out: dict[str, tuple[str, ...]]
    models: dict[str, tuple[str, ...]]
    stages: dict[str, Any]


def make_plan(scenes: Mapping[str, Scene], registry: Registry) -> dict[str, Any]:
    """Derive the plan for these scenes."""
    captures = {name: sorted(registry.captures.get(name, {})) for name in scenes}
    for name, scene in scenes.items():
        if scene.simulate is None and not captures[name]:
            remedy = f"Add recordings to the scene: reskin add RECORDING --scene {name} ..."
            raise ParamsError(f"scene {name} has no recorded captures. {remedy}")
    simulate = _protocols(scenes)
    items: dict[str, Any] = {
        "physics": [name for name, scene in scenes.items() if scene.simulate],
        "simulate": {folder: {"scene": name, "protocol": protocol} for folder, (name, protocol, _) in simulate.items()},
        "ingest_simulated": {folder: name for folder, (name, _, kind) in simulate.items() if kind not in NOT_INGESTED},
        "ingest": _recorded({name: of_scene for name, of_scene in captures.items() if len(of_scene) <= MANY_N}),
        "ingest_many": [name for name, of_scene in captures.items() if len(of_scene) > MANY_N],
        "describe": list(scenes),
        "split": list(scenes),
    }
    for stage in (*stages(EXPERIMENTS, "models", "files", "curve"), *ANALYSES):
        items[stage] = [name for name, scene in scenes.items() if scene.runs(stage)]
    for experiment in EXPERIMENTS.values():
        if experiment.file is not None or (experiment.protocol is not None and experiment.recorded):
            items[experiment.stage] = {name: _input(name, scenes[name], experiment) for name in items[experiment.stage]}
    items["report"] = list(scenes)
    return {
        "scenes": {name: list(scene.experiments) for name, scene in scenes.items()},
        "captures": captures,
        "held_out": {name: list(scene.with_folds) for name, scene in scenes.items()},
        "models": {name: scene.model_stages for name, scene in scenes.items()},
        "stages": items,
    }


def _protocols(scenes: Mapping[str, Scene]) -> dict[str, tuple[str, str, str]]:
    """Return the folder of each simulated protocol, with its scene, its name and its kind."""
    found: dict[str, tuple[str, str, str]] = {}
    for name, scene in scenes.items():
        of_scene = scene.simulate.protocols if scene.simulate else {}
        for protocol in [protocol for protocol in of_scene if protocol in scene.protocols]:
            folder = _folder(name, protocol)
            if folder in found or (folder in scenes and folder != name):
                what = f"protocol {protocol} would use folder {folder}, which another scene or protocol uses too"
                raise ParamsError(f"scene {name}: {what}. Rename one of the two.")
            found[folder] = (name, protocol, of_scene[protocol].kind)
    return found


def _recorded(captures: Mapping[str, Sequence[str]]) -> dict[str, dict[str, str]]:
    pairs = [(name, capture) for name, of_scene in captures.items() for capture in of_scene]
    named = {f"{name}-{capture}": {"scene": name, "capture": capture} for name, capture in pairs}
    if len(named) < len(pairs):
        problem = "two captures have the same name, which is made from scene and capture (SCENE-CAPTURE)"
        raise ParamsError(f"stage ingest: {problem}. Rename one of the scenes.")
    return named


def _folder(scene: str, protocol: str) -> str:
    return scene if protocol == MAIN_PROTOCOL else f"{scene}-{protocol}"


def _input(name: str, scene: Scene, experiment: Experiment) -> str:
    """Return the file that a scene names for an experiment, or the folder of the captures that the experiment reads."""
    if experiment.file is not None:
        return scene.named_file(experiment)
    assert experiment.protocol is not None
    return _folder(name, experiment.protocol) if scene.simulate else name


def plan_of(root: Path, names: Sequence[str]) -> dict[str, Any]:
    """Derive the plan for these scenes of a checkout."""
    scenes = {name: read_scene(root, scene_file(root, name).stem) for name in dict.fromkeys(names)}
    for name, scene in scenes.items():
        for one in (one for one in scene.entries if one.file is not None):
            if not (root / (file := scene.named_file(one))).is_file():
                problem = f"file {file}, which is named in section {one.stage}, was not found"
                remedy = f"Make the file with: reskin model make --layout {SCENES}/{name}.yaml --out {file}"
                raise ParamsError(
                    f"{scene_file(root, name)}: {problem}. {remedy}, or remove {one.name} from the experiments."
                )
    return make_plan(scenes, read_registry(root))


def use(root: Path, names: Sequence[str]) -> None:
    """Write the plan for exactly these scenes."""
    plan = plan_of(root, names)
    with io.replacing(root / PLAN) as temporary, temporary.open("w", encoding="utf-8") as stream:
        stream.write(HEADER)
        YAML().dump(plan, stream)
    _keep_outputs(root)


def _keep_outputs(root: Path) -> None:
    """Keep DVC from deleting the outputs of scenes that are no longer in the plan.

    DVC keeps a list of the outputs that it wrote. `dvc checkout`, `dvc exp run` and `dvc exp apply` delete listed
    outputs that no stage of the current plan writes. This function therefore empties the list.
    """
    if not (root / ".dvc/tmp").is_dir():  # DVC has not run in this checkout
        return
    from dvc.exceptions import DvcException  # imported here, because the import takes a second
    from dvc.repo import Repo

    with suppress(DvcException), Repo(str(root)) as repo:  # if DVC cannot start here, it cannot delete outputs
        repo.state.links.clear()


def read_plan(path: Path) -> Plan:
    return parse(Plan, read_yaml(path), str(path))


def check(root: Path) -> Plan:
    """Read the plan; raise `ParamsError` if the plan is out of date, or if a scene or params.yaml is invalid."""
    plan = read_plan(root / PLAN)
    if plan.model_dump(mode="json") != plan_of(root, list(plan.scenes)):
        remedy = f"Try: reskin scenes use {' '.join(plan.scenes)}"
        problem = "is out of date, because scenes or captures have changed since it was written"
        raise ParamsError(f"{root / PLAN} {problem}. {remedy}")
    return plan


def next_command(root: Path, scene: str) -> str:
    """Return the command that runs a scene: plain `dvc repro` if the scene is in the plan."""
    return "dvc repro" if scene in read_plan(root / PLAN).scenes else f"reskin scenes use {scene} && dvc repro"
