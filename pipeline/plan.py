"""Generate pipeline/plan.yaml, which lists the scenes that DVC runs and the items for which each DVC stage runs."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from pipeline import PLAN, SCENES
from pipeline.catalogue import ANALYSES, EXPERIMENTS
from pipeline.manage.registry import Registry, read_registry
from pipeline.scenes import MAIN_PROTOCOL, TABLE_2, Plan, Scene, read_plan, read_scene, stages
from reskin import io
from reskin.errors import ParamsError, did_you_mean
from reskin.recordings.header import NAME, NAME_RULE

HEADER = """\
# The scenes that `dvc repro` runs, and the items (scenes, captures or folders) for which each stage of dvc.yaml runs.
# Do not edit: `reskin scenes use` and `reskin add` write this file from pipeline/scenes and data/captures.yaml.
"""
MANY_N = 30  # recorded scenes with more captures than this are ingested by a single stage (docs/growth.md)
NOT_INGESTED = {"walk"}  # kinds of protocols without a log of the robot; their experiments read the raw captures


def make_plan(scenes: Mapping[str, Scene], registry: Registry) -> dict[str, Any]:
    """Derive the plan: the experiments of each scene, its recorded captures, and the items of every stage.

    DVC runs a stage once for each of its items:
    - For most stages, the items are names of scenes.
    - For `simulate` and `ingest_simulated`, the items are folders of captures. Each protocol of a scene has one folder.
    - For `ingest`, the items are recorded captures.
    - An experiment such as `drift` reads the captures of its own protocol in a simulated scene, and the main captures
      in a recorded scene. The items of such an experiment are pairs of a scene and the folder with these captures.
    """
    captures = {name: sorted(registry.captures.get(name, {})) for name in scenes}
    for name, scene in scenes.items():
        if scene.simulate is None and not captures[name]:
            remedy = f"Add recordings to the scene: reskin add RECORDING --scene {name} ..."
            raise ParamsError(f"scene {name} has no recorded captures. {remedy}")
    many = [name for name in scenes if len(captures[name]) > MANY_N]
    pairs = [(name, capture) for name in scenes if name not in many for capture in captures[name]]
    ingest = {f"{name}-{capture}": {"scene": name, "capture": capture} for name, capture in pairs}
    if len(ingest) < len(pairs):
        raise ParamsError(
            "stage ingest: two captures have the same name, which is made from scene and capture (SCENE-CAPTURE). "
            "Rename one of the scenes."
        )
    simulate: dict[str, dict[str, str]] = {}
    ingest_simulated: dict[str, str] = {}
    for name, scene in scenes.items():
        protocols = scene.simulate.protocols if scene.simulate else {}
        for protocol, settings in protocols.items():
            if protocol not in scene.protocols:
                continue
            folder = _folder(name, protocol)
            if folder in simulate or (folder in scenes and folder != name):
                what = f"protocol {protocol} would use folder {folder}, which another scene or protocol uses too"
                raise ParamsError(f"scene {name}: {what}. Rename one of the two.")
            simulate[folder] = {"scene": name, "protocol": protocol}
            if settings.kind not in NOT_INGESTED:
                ingest_simulated[folder] = name
    items: dict[str, Any] = {
        "simulate": simulate, "ingest_simulated": ingest_simulated, "ingest": ingest, "ingest_many": many,
        "describe": list(scenes), "split": list(scenes),
    }  # fmt: skip
    for stage in (*stages(EXPERIMENTS, "models", "files", "curve"), *ANALYSES):
        items[stage] = [name for name, scene in scenes.items() if scene.runs(stage)]
    for experiment in EXPERIMENTS.values():
        if experiment.protocol is not None and experiment.recorded:
            items[experiment.stage] = {
                name: _folder(name, experiment.protocol) if scenes[name].simulate else name
                for name in items[experiment.stage]
            }
        if experiment.file is not None:
            items[experiment.stage] = {
                name: scenes[name].named_file(experiment.name) for name in items[experiment.stage]
            }
    items["table2"] = [name for name, scene in scenes.items() if {*TABLE_2.values()} <= {*scene.experiments}]
    items["report"] = list(scenes)
    return {
        "scenes": {name: list(scene.experiments) for name, scene in scenes.items()},
        "captures": captures,
        "held_out": {name: list(scene.with_folds) for name, scene in scenes.items()},
        "models": {name: scene.model_stages for name, scene in scenes.items()},
        "stages": items,
    }


def _folder(scene: str, protocol: str) -> str:
    return scene if protocol == MAIN_PROTOCOL else f"{scene}-{protocol}"


def scene_names(root: Path) -> list[str]:
    if not (root / SCENES).is_dir():
        raise ParamsError(f"{root / SCENES}: folder not found. Run the command in the folder of the checkout.")
    return sorted(file.stem for file in (root / SCENES).glob("*.yaml"))


def scene_file(root: Path, name: str, *, remedy: str = "To create one, see docs/add-a-scene.md.") -> Path:
    """Return the file of a scene; raise `ParamsError` if there is none."""
    known = scene_names(root)
    if name not in known:
        guess = did_you_mean(name, known)
        raise ParamsError(f"no scene {name}.{guess} The scenes are: {', '.join(known)}. {remedy}")
    return root / SCENES / f"{name}.yaml"


@contextmanager
def scene_copy(root: Path, name: str, like: str | None) -> Iterator[None]:
    """Create scene `name` as a copy of scene `like`; delete the copy if the `with` block fails.

    If `like` is None, nothing is created. Comments are copied, except those above the first setting, because they
    describe scene `like`.
    """
    if like is None:
        yield
        return
    if not re.fullmatch(NAME, name):
        raise ParamsError("--scene", "a name", NAME_RULE, repr(name), "Choose another name.")
    original = scene_file(root, like)
    target = original.with_name(f"{name}.yaml")
    if target.exists():
        remedy = "To add the recording to this scene, omit --like."
        raise ParamsError(f"--like {like}: scene {name} exists already. {remedy}")
    lines = original.read_text(encoding="utf-8").splitlines(keepends=True)
    first_i = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    header = f"# Scene {name}: a copy of scene {like}, by `reskin add --like`.\n"
    io.write_text(target, "".join([header, *lines[first_i:]]))
    try:
        yield
    except BaseException:
        io.remove(target)
        raise


def use(root: Path, names: Sequence[str]) -> None:
    """Write the plan for exactly these scenes."""
    yaml = YAML()
    yaml.width = 120
    document = {key: _in_flow_style(value) for key, value in plan_of(root, names).items()}
    with io.replacing(root / PLAN) as temporary, temporary.open("w", encoding="utf-8") as stream:
        stream.write(HEADER)
        yaml.dump(document, stream)
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


def check(root: Path) -> Plan:
    """Read the plan; raise `ParamsError` if the plan is out of date, or if a scene or params.yaml is invalid."""
    plan = read_plan(root / PLAN)
    if plan.model_dump(mode="json") != plan_of(root, list(plan.scenes)):
        remedy = f"Try: reskin scenes use {' '.join(plan.scenes)}"
        problem = "is out of date, because scenes or captures have changed since it was written"
        raise ParamsError(f"{root / PLAN} {problem}. {remedy}")
    return plan


def plan_of(root: Path, names: Sequence[str]) -> dict[str, Any]:
    """Derive the plan for these scenes of a checkout."""
    scenes = {name: read_scene(root, scene_file(root, name).stem) for name in dict.fromkeys(names)}
    for name, scene in scenes.items():
        for experiment in scene.entries:
            if experiment.file is not None and not (root / scene.named_file(experiment.name)).is_file():
                file = scene.named_file(experiment.name)
                remedy = f"Make the file with: reskin model make --layout {SCENES}/{name}.yaml --out {file}"
                problem = f"file {file}, which is named in section {experiment.stage}, was not found"
                raise ParamsError(
                    f"{scene_file(root, name)}: {problem}. {remedy}, or remove {experiment.name} from the experiments."
                )
    return make_plan(scenes, read_registry(root))


def unused_settings(root: Path, names: Sequence[str]) -> list[str]:
    """Describe, for each of these scenes, the settings that none of its experiments reads."""
    unused = {name: read_scene(root, name).unused for name in names}
    return [f"{scene_file(root, name)}: no experiment reads {', '.join(keys)}" for name, keys in unused.items() if keys]


def _in_flow_style(value: Any) -> Any:
    """Make ruamel write lists, and mappings whose values are all strings, in flow style (`[a, b]`, `{a: b}`)."""
    from ruamel.yaml.comments import CommentedMap, CommentedSeq

    if isinstance(value, list):
        sequence = CommentedSeq(value)
        sequence.fa.set_flow_style()
        return sequence
    if isinstance(value, dict):
        mapping = CommentedMap({key: _in_flow_style(item) for key, item in value.items()})
        if all(isinstance(item, str) for item in value.values()):
            mapping.fa.set_flow_style()
        return mapping
    return value
