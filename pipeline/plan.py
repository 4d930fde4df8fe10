"""Generate pipeline/plan.yaml: the scenes that each DVC stage iterates over."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from pipeline import PLAN, SCENES
from pipeline.manage.registry import Registry, read_registry
from pipeline.manage.running import LOCKS, need_rest
from pipeline.scenes import (
    ANALYSES,
    EXPERIMENTS,
    LEARNING,
    MAIN_PROTOCOL,
    NOT_INGESTED,
    TABLE_2,
    Plan,
    Scene,
    read_plan,
    read_scene,
    stages,
)
from reskin import io
from reskin.errors import ParamsError
from reskin.recordings.header import NAME

HEADER = """\
# Which scenes run, and over what each stage of dvc.yaml iterates. Generated from pipeline/scenes and data/captures.yaml
# by `reskin scenes use` and `reskin add`: do not edit.
"""
MANY_N = 30  # captures of a recorded scene; with more, one stage reads them all (docs/growth.md)


def make_plan(scenes: Mapping[str, Scene], registry: Registry) -> dict[str, Any]:
    """Derive the plan: what each scene runs, its recorded captures, and the items of every stage.

    A stage iterates over names of scenes; over captures by folder (simulate, ingest); or over names of scenes, each
    with the folder of readings that its experiment uses. What no scene runs has no items, and so no stage.
    """
    captures = _captures(scenes, registry)
    many = [name for name in scenes if len(captures[name]) > MANY_N]
    pairs = [(name, capture) for name in scenes if name not in many for capture in captures[name]]
    ingest = {f"{name}-{capture}": {"scene": name, "capture": capture} for name, capture in pairs}
    if len(ingest) < len(pairs):
        rule, got = "unlike any other", "two that read the same"
        raise ParamsError("stage ingest", "scene-capture", rule, got, "Rename a scene.")
    simulated = _folders(scenes)
    items: dict[str, Any] = {
        "simulate": simulated,
        "ingest_simulated": {
            folder: item
            for folder, item in simulated.items()
            if _kind(scenes[item["scene"]], item["protocol"]) not in NOT_INGESTED
        },
        "ingest": ingest,
        "ingest_many": many,
        "describe": list(scenes),
        "split": list(scenes),
    }
    for stage in stages(EXPERIMENTS, *LEARNING, "study"):
        items[stage] = [name for name, scene in scenes.items() if scene.runs(stage)]
    for name in ANALYSES:
        protocol = EXPERIMENTS[name].protocol
        running = [scene for scene in scenes if name in scenes[scene].experiments]
        if protocol is None:
            items[name] = running
        else:
            items[name] = {
                scene: scene if scenes[scene].simulate is None else _folder(scene, protocol) for scene in running
            }
    items["table2"] = [name for name, scene in scenes.items() if {*TABLE_2.values()} <= {*scene.experiments}]
    items |= {stage: list(scenes) for stage in ("report", "publish")}
    return {
        "scenes": {name: list(scene.experiments) for name, scene in scenes.items()},
        "captures": captures,
        "held_out": {name: list(scene.with_folds) for name, scene in scenes.items()},
        "models": {name: scene.modelled for name, scene in scenes.items()},
        "stages": items,
    }


def _captures(scenes: Mapping[str, Scene], registry: Registry) -> dict[str, list[str]]:
    captures = {name: sorted(registry.captures.get(name, {})) for name in scenes}
    for name, scene in scenes.items():
        if scene.source == "recorded" and not captures[name]:
            remedy = f"Try: reskin add RECORDING --scene {name} ..."
            raise ParamsError(f"scene {name}", "recorded captures", "one or more", "none", remedy)
    return captures


def _kind(scene: Scene, protocol: str) -> str:
    assert scene.simulate is not None, "only a simulated scene has folders by protocol"
    return scene.simulate.protocols[protocol].kind


def _folder(scene: str, protocol: str) -> str:
    return scene if protocol == MAIN_PROTOCOL else f"{scene}-{protocol}"


def _folders(scenes: Mapping[str, Scene]) -> dict[str, dict[str, str]]:
    """Name the folder of each protocol's captures: the scene's own for the main one."""
    folders: dict[str, dict[str, str]] = {}
    for name, scene in scenes.items():
        for protocol in scene.simulate.protocols if scene.simulate is not None else ():
            folder = _folder(name, protocol)
            if folder in folders or (folder in scenes and folder != name):
                rule = "unlike any scene and any other's protocol"
                raise ParamsError(f"scene {name}", "a protocol's folder", rule, folder, "Rename one.")
            folders[folder] = {"scene": name, "protocol": protocol}
    return folders


def scene_names(root: Path) -> list[str]:
    if not (root / SCENES).is_dir():
        raise ParamsError(root / SCENES, "the folder", "there", "nothing", "Run this in the checkout.")
    return sorted(file.stem for file in (root / SCENES).glob("*.yaml"))


def scene_file(root: Path, name: str) -> Path:
    """The file of a scene; raise if there is none."""
    known = scene_names(root)
    if name not in known:
        remedy = f"Check the name, or copy a scene: {SCENES}/{name}.yaml, or reskin add --like SCENE."
        raise ParamsError("scenes", "a scene", f"one of {', '.join(known)}", name, remedy)
    return root / SCENES / f"{name}.yaml"


@contextmanager
def copied(root: Path, name: str, like: str | None) -> Iterator[None]:
    """Write scene `name` as a copy of scene `like`, and take it away again if the block fails; without `like`, nothing.

    Comments go along, but for those above the first word, which tell of the other scene.
    """
    if like is None:
        yield
        return
    if not re.fullmatch(NAME, name):
        raise ParamsError("--scene", "a name", "1 to 64 of A-Z a-z 0-9 _ -", repr(name), "Choose another.")
    original = scene_file(root, like)
    target = original.with_name(f"{name}.yaml")
    if target.exists():
        remedy = "Leave out --like to add to it."
        raise ParamsError(f"--like {like}", "the new scene", "a free name", f"{name}, which is there", remedy)
    words = original.read_text(encoding="utf-8").splitlines(keepends=True)
    told = next(i for i, line in enumerate(words) if not line.startswith("#"))
    io.write_text(
        target, "".join([f"# Scene {name}: a copy of scene {like}, by `reskin add --like`.\n", *words[told:]])
    )
    try:
        yield
    except BaseException:
        io.remove(target)
        raise


def use(root: Path, names: Sequence[str]) -> None:
    """Let `dvc repro` run exactly these scenes; raise if it runs now, as stages read the plan when they begin."""
    need_rest(root)
    yaml = YAML()
    yaml.width = 120
    document = {key: _flow(value) for key, value in plan_of(root, names).items()}
    with io.replacing(root / PLAN) as temporary, temporary.open("w", encoding="utf-8") as stream:
        stream.write(HEADER)
        yaml.dump(document, stream)
    _keep_outputs(root)


def _keep_outputs(root: Path) -> None:
    """Let the outputs of scenes that leave the plan stay in the working tree.

    DVC lists the outputs that it wrote; `dvc checkout`, `dvc exp run` and `dvc exp apply` delete those that no stage of
    the current plan writes. Outputs that are not listed are left alone.
    """
    if not (root / LOCKS).is_dir():  # DVC has not run here
        return
    from dvc.exceptions import DvcException  # late: DVC takes a second
    from dvc.repo import Repo

    with suppress(DvcException), Repo(str(root)) as repo:  # where DVC does not start, it deletes nothing either
        repo.state.links.clear()


def check(root: Path) -> Plan:
    """Return the plan; raise if it is not that of its scenes, or if a scene or params.yaml is wrong."""
    plan = read_plan(root / PLAN)
    if plan.model_dump(mode="json") != plan_of(root, list(plan.scenes)):
        remedy = f"Try: reskin scenes use {' '.join(plan.scenes)}"
        raise ParamsError(root / PLAN, "the plan", "what its scenes ask for", "an older one", remedy)
    return plan


def plan_of(root: Path, names: Sequence[str]) -> dict[str, Any]:
    """Derive the plan of these scenes of a checkout."""
    scenes = {name: read_scene(root, scene_file(root, name).stem) for name in dict.fromkeys(names)}
    return make_plan(scenes, read_registry(root))


def _flow(value: Any) -> Any:
    """Let ruamel write short lists on one line."""
    from ruamel.yaml.comments import CommentedMap, CommentedSeq

    if isinstance(value, list):
        sequence = CommentedSeq(value)
        sequence.fa.set_flow_style()
        return sequence
    if isinstance(value, dict):
        mapping = CommentedMap({key: _flow(item) for key, item in value.items()})
        if not value:
            mapping.fa.set_flow_style()
        return mapping
    return value
