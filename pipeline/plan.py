"""Which stage runs for which scene, with what: scenes + recorded captures -> `pipeline/plan.yaml`.

DVC expands stages from what stands there and cannot look into a scene's questions; this module can. Refuses to
know what a stage does.
"""

from collections.abc import Mapping, Sequence
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from pipeline import io
from pipeline.asking import arms_of, described_in
from pipeline.errors import ParamsError, complain
from pipeline.params import Plan, Scene, read_plan, read_scene, read_shared
from pipeline.questions import ARMS, EXPERIMENTS, MAIN_PROTOCOL, NOT_INGESTED, STUDIED_BY, STUDIES
from pipeline.reads import IDLE, PHYSICS_OWN, PHYSICS_SHARED, READS, TERMS_N
from pipeline.registry import Registry, read_registry
from pipeline.settings import Settings
from pipeline.strict import parse, read_yaml

PLAN = "pipeline/plan.yaml"
PARAMS = "params.yaml"
SCENES = "pipeline/scenes"
HEADER = """\
# Which scenes run, what they ask, and what each stage of dvc.yaml takes. Written by `reskin scenes use` and `add`
# from pipeline/scenes and data/captures.yaml; not for hands.
"""


def make_plan(scenes: Mapping[str, Scene], registry: Registry) -> dict[str, Any]:
    """Derive `pipeline/plan.yaml`: a question that no scene asks leaves its stage without items."""
    captures = {name: sorted(registry.captures.get(name, {})) for name in scenes}
    for name, scene in scenes.items():
        if scene.source == "recorded" and not captures[name]:
            remedy = f"Try: reskin add RECORDING --scene {name} ..."
            raise ParamsError(complain(f"scene {name}", "recorded captures", "one or more", "none", remedy))
    pairs = [(name, capture) for name in scenes for capture in captures[name]]
    ingest = {f"{name}-{capture}": {"scene": name, "capture": capture} for name, capture in pairs}
    if len(ingest) < len(pairs):
        raise ParamsError(
            complain("stage ingest", "scene-capture", "unlike any other", "two that read the same", "Rename a scene.")
        )
    simulated = _folders(scenes)
    described = {name: {"scene": name, "protocol": described_in(scene)[0]} for name, scene in scenes.items()}
    split = {name: {"scene": name, "captures": captures[name]} for name in scenes}
    stages: dict[str, Any] = {
        "simulate": {key: _simulated(scenes[item["scene"]], item) for key, item in simulated.items()},
        "ingest_simulated": _ingested(scenes, simulated), "ingest": ingest, "describe": described, "split": split,
    }  # fmt: skip
    asked = {name: _stages_of(scene) for name, scene in scenes.items()}
    stages |= {stage: {name: {"scene": name} for name in scenes if stage in asked[name]} for stage in (*ARMS, *STUDIES)}
    stages |= {question: _experiments(scenes, question) for question in EXPERIMENTS}
    stages |= {stage: {name: {"scene": name} for name in scenes} for stage in ("report", "publish")}
    named = {
        stage: {key: _with_names(stage, scenes, item) for key, item in own.items()} for stage, own in stages.items()
    }
    return {"scenes": {name: list(scene.questions) for name, scene in scenes.items()}, "stages": named}


def _with_names(stage: str, scenes: Mapping[str, Scene], item: dict[str, Any]) -> dict[str, Any]:
    """Add to an item the words that its scene names: the rows of params.yaml and the boards that the stage reads."""
    if stage not in READS:
        return item
    reads, scene = READS[stage], scenes[item["scene"]]
    words = scene.model_dump(mode="json", exclude_none=True)
    item = item | {word: reduce(getitem, key.format(**item).split("."), words) for word, key in reads.named}
    if not reads.physics:
        return item
    if scene.simulate is None:  # nothing to read there: keys that it reads anyhow stand in
        return item | {"own": ["seed"] * len(PHYSICS_OWN), "shared": [IDLE] * len(PHYSICS_SHARED)}
    item |= {"boards": scene.simulate.protocols[MAIN_PROTOCOL].boards}
    return item | {"own": [key.format(**item) for key in PHYSICS_OWN], "shared": list(PHYSICS_SHARED)}


def _simulated(scene: Scene, item: dict[str, str]) -> dict[str, Any]:
    """Add the terms of a protocol: four keys, as DVC cannot take a list; `chip`, which it reads anyhow, fills up."""
    assert scene.simulate is not None, "only a simulated scene has folders by protocol"
    terms = [f"terms.{term}" for term in scene.simulate.protocols[item["protocol"]].terms]
    return {**item, "shared": terms + ["chip"] * (TERMS_N - len(terms))}


def _stages_of(scene: Scene) -> set[str]:
    return {*arms_of(scene), *(STUDIED_BY[question] for question in scene.studied)}


def _ingested(scenes: Mapping[str, Scene], folders: Mapping[str, dict[str, str]]) -> dict[str, dict[str, str]]:
    """Keep the folders whose captures become rows."""
    return {key: item for key, item in folders.items() if _kind(scenes[item["scene"]], item) not in NOT_INGESTED}


def _kind(scene: Scene, item: Mapping[str, str]) -> str:
    assert scene.simulate is not None, "only a simulated scene has folders by protocol"
    return scene.simulate.protocols[item["protocol"]].kind


def _experiments(scenes: Mapping[str, Scene], question: str) -> dict[str, dict[str, str]]:
    """Name the folder of captures that an experiment is asked of, by scene."""
    protocol = EXPERIMENTS[question]
    return {
        name: {"scene": name, "folder": name if scene.simulate is None else _folder(name, protocol or MAIN_PROTOCOL)}
        for name, scene in scenes.items()
        if question in scene.experiments
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
                raise ParamsError(complain(f"scene {name}", "a protocol's folder", rule, folder, "Rename one."))
            folders[folder] = {"scene": name, "protocol": protocol}
    return folders


def scene_names(root: Path) -> list[str]:
    """The scenes that this checkout has."""
    if not (root / SCENES).is_dir():
        raise ParamsError(complain(root / SCENES, "the folder", "there", "nothing", "Run this in the checkout."))
    return sorted(file.stem for file in (root / SCENES).glob("*.yaml"))


def scene_file(root: Path, name: str) -> Path:
    """The file of a scene; raise if there is none."""
    known = scene_names(root)
    if name not in known:
        remedy = f"Check the name, or write {SCENES}/{name}.yaml."
        raise ParamsError(complain("scenes", "a scene", f"one of {', '.join(known)}", name, remedy))
    return root / SCENES / f"{name}.yaml"


def use(root: Path, names: Sequence[str]) -> None:
    """Let `dvc repro` run exactly these scenes."""
    yaml = YAML()
    yaml.width = 120
    document = {key: _flow(value) for key, value in _plan_of(root, names).items()}
    with io.replacing(root / PLAN) as temporary, temporary.open("w", encoding="utf-8") as stream:
        stream.write(HEADER)
        yaml.dump(document, stream)


def check(root: Path) -> Plan:
    """Raise if the plan is not what its scenes ask for, or a scene or params.yaml is wrong; return it otherwise."""
    plan = read_plan(root / PLAN)
    if plan.model_dump(mode="json") != _plan_of(root, list(plan.scenes)):
        remedy = f"Try: reskin scenes use {' '.join(plan.scenes)}"
        raise ParamsError(complain(root / PLAN, "the plan", "what its scenes ask for", "an older one", remedy))
    return plan


def _plan_of(root: Path, names: Sequence[str]) -> dict[str, Any]:
    scenes = {name: _read(scene_file(root, name), root / PARAMS) for name in dict.fromkeys(names)}
    return make_plan(scenes, read_registry(root))


def _read(file: Path, params: Path) -> Scene:
    """Read a scene, and how its skins are made: the physics is imported for a simulated one only."""
    scene, shared = read_scene(file, params), read_shared(params)
    settings = Settings(file.stem, str(file), read_yaml(file), shared, {})
    if scene.simulate is not None:
        from pipeline.synthesis.capture import Synthesis

        terms = {term for protocol in scene.simulate.protocols.values() for term in protocol.terms}
        words = settings.words("simulate") | {name: shared[name] for name in ("skin", "rig", "chip", "spreads")}
        words["terms"] = {term: settings.named("terms", term) for term in sorted(terms)}
        parse(Synthesis, words, f"{file}: simulate")
    if scene.train_classical is not None or scene.few_labels is not None:
        from pipeline.learning import comparison  # scikit-learn, for a scene that compares

        if scene.train_classical is not None:
            comparison.resolve_baselines(scene.train_classical, settings.named, f"{file}: train_classical")
        if scene.few_labels is not None:
            comparison.resolve_few_labels(scene.few_labels, settings.named, f"{file}: few_labels")
    if scene.runtime is not None:
        from pipeline.evaluation.work_precision.settings import RunTime

        parse(RunTime, scene.runtime, f"{file}: runtime")
    return scene


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
