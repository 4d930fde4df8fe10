"""Which stage runs for which scene, with what: scenes + recorded captures -> `pipeline/plan.yaml`.

DVC expands stages from what stands there and cannot look into a scene's questions; this module can. Refuses to
know what a stage does.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from pipeline.manage.registry import Registry, read_registry
from pipeline.manage.running import LOCKS, need_rest
from pipeline.scenes import (
    EXPERIMENTS,
    LEARNING,
    MAIN_PROTOCOL,
    NOT_INGESTED,
    QUESTIONS,
    TABLE_2,
    OnBoards,
    Plan,
    Scene,
    read_plan,
    read_scene,
    stages,
)
from reskin import io
from reskin.config import FLOW, NOTHING, PARAMS, PLACE, PLAN, SCENES, declared, fill, find, put, read_yaml
from reskin.errors import ParamsError
from reskin.recordings.header import NAME

HEADER = """\
# Which scenes run, what they ask, and what each stage of dvc.yaml takes. Written by `reskin scenes use` and `add`
# from pipeline/scenes and data/captures.yaml; not for hands.
"""
MANY_N = 30  # captures of a recorded scene; with more, one stage reads them all (docs/growth.md)
TERMS_N = 4  # terms of physics that a protocol may name
IDLE = "lost_fraction_max"  # a key of params.yaml that re-runs what a stage rests on anyhow
# What stage contacts reads of a simulated scene, and a recorded one does not have.
PHYSICS_OF_SCENE = tuple(
    key.replace("MAIN", f"simulate.protocols.{MAIN_PROTOCOL}")
    for key in ("MAIN.boards", "MAIN.depths_mm", "MAIN.skins_n", "simulate.boards.${item.MAIN.boards}")
)
PHYSICS_SHARED = ("skin", "spreads")


def make_plan(scenes: Mapping[str, Scene], registry: Registry, flow: Mapping[str, Any]) -> dict[str, Any]:
    """Derive `pipeline/plan.yaml`: a question that no scene asks leaves its stage without items.

    `flow` is dvc.yaml: words of a scene that its stages name (`${item.train_multi.recipe}`) are copied into the plan.
    """
    captures = _captures(scenes, registry)
    many = {name for name in scenes if len(captures[name]) > MANY_N}
    pairs = [(name, capture) for name in scenes if name not in many for capture in captures[name]]
    ingest = {f"{name}-{capture}": {"scene": name, "capture": capture} for name, capture in pairs}
    if len(ingest) < len(pairs):
        rule, got = "unlike any other", "two that read the same"
        raise ParamsError("stage ingest", "scene-capture", rule, got, "Rename a scene.")
    simulated = _folders(scenes)
    items: dict[str, Any] = {
        "simulate": {key: _simulated(scenes[item["scene"]], item) for key, item in simulated.items()},
        "ingest_simulated": {
            key: item
            for key, item in simulated.items()
            if _protocol(scenes[item["scene"]], item).kind not in NOT_INGESTED
        },
        "ingest": ingest,
        "ingest_many": {name: {"scene": name} for name in scenes if name in many},
        "describe": {name: {"scene": name, "protocol": scene.described} for name, scene in scenes.items()},
        "split": {name: {"scene": name, "folds": list(scene.with_folds)} for name, scene in scenes.items()},
    }
    for stage in stages(QUESTIONS, *LEARNING, "study"):
        items[stage] = {name: {"scene": name} for name, scene in scenes.items() if scene.runs(stage)}
    items |= {question: _experiments(scenes, question) for question in EXPERIMENTS}
    items["table2"] = {
        name: {"scene": name} for name, scene in scenes.items() if {*TABLE_2.values()} <= {*scene.questions}
    }
    items |= {stage: {name: {"scene": name} for name in scenes} for stage in ("report", "publish")}
    for stage, of_stage in items.items():
        for item in of_stage.values():
            scene = scenes[item["scene"]]
            item |= _more(stage, item["scene"], scene, captures[item["scene"]])
            for name, word in _words(flow, stage, item, scene.model_dump(mode="json", exclude_none=True)):
                put(item, name, word)
    return {"scenes": {name: list(scene.questions) for name, scene in scenes.items()}, "stages": items}


def _captures(scenes: Mapping[str, Scene], registry: Registry) -> dict[str, list[str]]:
    captures = {name: sorted(registry.captures.get(name, {})) for name in scenes}
    for name, scene in scenes.items():
        if scene.source == "recorded" and not captures[name]:
            remedy = f"Try: reskin add RECORDING --scene {name} ..."
            raise ParamsError(f"scene {name}", "recorded captures", "one or more", "none", remedy)
    return captures


def _more(stage: str, name: str, scene: Scene, captures: list[str]) -> dict[str, Any]:
    """Give what a stage needs of the scene beyond its settings."""
    match stage:
        case (
            "ingest_many"
            | "describe"
            | "split"
            | "drift"
            | "variation"
            | "compare"
            | "touches"
            | "universal"
            | "rivals"
        ):
            return {"captures": captures}
        case "audit":
            return {"models": scene.modelled}
        case "contacts":
            return _physics(scene)
        case "report" | "publish":
            # What stands in for models where a scene trains none: a file that these stages rest on anyhow.
            described = f"answers/{name}/described/{scene.described}.json"
            return {"questions": list(scene.questions), "learnt": f"models/{name}" if scene.modelled else described}
    return {}


def _words(
    flow: Mapping[str, Any], stage: str, item: Mapping[str, Any], scene: Mapping[str, Any]
) -> Iterator[tuple[str, Any]]:
    """Find the words of a scene that a stage's parameters name in dvc.yaml: rows of params.yaml, kinds of boards."""
    for template in chain.from_iterable(declared(flow, stage).values()):
        for match in PLACE.finditer(template):
            if match[1] and find(item, match[2]) is NOTHING:
                yield match[2], find(scene, match[2])


def _physics(scene: Scene) -> dict[str, list[str]]:
    if scene.simulate is None:  # nothing to read there: keys that it reads anyhow stand in
        return {"of_scene": ["seed"] * len(PHYSICS_OF_SCENE), "shared": [IDLE] * len(PHYSICS_SHARED)}
    words = scene.model_dump(mode="json")
    return {"of_scene": [fill(key, "", words) for key in PHYSICS_OF_SCENE], "shared": list(PHYSICS_SHARED)}


def _simulated(scene: Scene, item: dict[str, str]) -> dict[str, Any]:
    """Add a protocol's boards and terms: four keys, as DVC cannot take a list; `chip`, which it reads too, fills up."""
    protocol = _protocol(scene, item)
    terms = [f"terms.{term}" for term in protocol.terms]
    return {**item, "boards": protocol.boards, "shared": terms + ["chip"] * (TERMS_N - len(terms))}


def _protocol(scene: Scene, item: Mapping[str, str]) -> OnBoards:
    assert scene.simulate is not None, "only a simulated scene has folders by protocol"
    return scene.simulate.protocols[item["protocol"]]


def _experiments(scenes: Mapping[str, Scene], question: str) -> dict[str, dict[str, Any]]:
    """Name the folder of captures that an experiment is asked of, by scene."""
    protocol = QUESTIONS[question].protocol or MAIN_PROTOCOL
    return {
        name: {"scene": name, "folder": name if scene.simulate is None else _folder(name, protocol)}
        for name, scene in scenes.items()
        if question in scene.questions
    }


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
    document = {key: _flow(value) for key, value in _plan_of(root, names).items()}
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
    """Raise if the plan is not what its scenes ask for, or a scene or params.yaml is wrong; return it otherwise."""
    plan = read_plan(root / PLAN)
    if plan.model_dump(mode="json") != _plan_of(root, list(plan.scenes)):
        remedy = f"Try: reskin scenes use {' '.join(plan.scenes)}"
        raise ParamsError(root / PLAN, "the plan", "what its scenes ask for", "an older one", remedy)
    return plan


def _plan_of(root: Path, names: Sequence[str]) -> dict[str, Any]:
    scenes = {name: read_scene(scene_file(root, name), root / PARAMS) for name in dict.fromkeys(names)}
    return make_plan(scenes, read_registry(root), read_yaml(root / FLOW))


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
