"""Which stage runs for which scene: scenes + recorded captures -> section `stages` of params.yaml.

DVC expands stages from lists in params.yaml and cannot look into a scene's questions; this module can. Refuses to
know what a stage does.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from pipeline import io
from pipeline.errors import ParamsError, complain
from pipeline.params import Params, Scene, arms_of, described_in, read_params, read_scene
from pipeline.questions import ARMS, EXPERIMENTS, MAIN_PROTOCOL, NOT_INGESTED, STUDIED_BY, STUDIES
from pipeline.registry import Registry, read_registry
from pipeline.strict import parse, read_yaml

PARAMS = "params.yaml"
SCENES = "pipeline/scenes"


def make_plan(scenes: Mapping[str, Scene], registry: Registry) -> dict[str, Any]:
    """Derive the section `stages`: a question that no scene asks leaves its stage with an empty list."""
    captures = {name: sorted(registry.captures.get(name, {})) for name in scenes}
    for name, scene in scenes.items():
        if scene.source == "recorded" and not captures[name]:
            raise ParamsError(
                complain(
                    f"scene {name}",
                    "recorded captures",
                    "one or more",
                    "none",
                    f"Try: reskin add RECORDING --scene {name} ...",
                )
            )
    asked = {name: _stages_of(scene) for name, scene in scenes.items()}
    pairs = [(name, capture) for name in scenes for capture in captures[name]]
    ingest = {f"{name}-{capture}": {"scene": name, "capture": capture} for name, capture in pairs}
    if len(ingest) < len(pairs):
        raise ParamsError(
            complain("stage ingest", "scene-capture", "unlike any other", "two that read the same", "Rename a scene.")
        )
    simulated = _folders(scenes)
    described = {name: {"scene": name, "protocol": described_in(scene)[0]} for name, scene in scenes.items()}
    plan: dict[str, Any] = {
        "simulate": simulated, "ingest_simulated": _ingested(scenes, simulated), "ingest": ingest,
        "describe": described, "split": captures,
    }  # fmt: skip
    plan |= {stage: [name for name in scenes if stage in asked[name]] for stage in (*ARMS, *STUDIES)}
    plan |= {question: _experiments(scenes, question) for question in EXPERIMENTS}
    return plan | {"report": list(scenes), "publish": list(scenes)}


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
        for protocol, own in scene.simulate.protocols.items() if scene.simulate is not None else ():
            folder = _folder(name, protocol)
            if folder in folders or (folder in scenes and folder != name):
                rule = "unlike any scene and any other's protocol"
                raise ParamsError(complain(f"scene {name}", "a protocol's folder", rule, folder, "Rename one."))
            folders[folder] = {"scene": name, "protocol": protocol, "boards": own.boards}
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
    """Let `params.yaml` run exactly these scenes."""
    plan = _plan_of(root, names)
    file = root / PARAMS
    read_yaml(file)  # says in one sentence what a broken file has wrong
    yaml = YAML()  # round trip: comments stay
    yaml.width = 120
    document = yaml.load(file.read_text(encoding="utf-8"))
    document["scenes"] = _flow(list(dict.fromkeys(names)))
    document["stages"] = {key: _flow(value) for key, value in plan.items()}
    with io.replacing(file) as temporary, temporary.open("w", encoding="utf-8") as stream:
        yaml.dump(document, stream)


def check(root: Path) -> Params:
    """Raise if `params.yaml` is not what its scenes ask for; return it otherwise."""
    params = read_params(root / PARAMS)
    written = params.stages.model_dump(mode="json")
    if written != _plan_of(root, params.scenes):
        raise ParamsError(
            complain(
                root / PARAMS, "section stages", "what its scenes ask for", "an older plan",
                f"Try: reskin scenes use {' '.join(params.scenes)}",
            )
        )  # fmt: skip
    return params


def _plan_of(root: Path, names: Sequence[str]) -> dict[str, Any]:
    scenes = {name: _read(scene_file(root, name)) for name in dict.fromkeys(names)}
    return make_plan(scenes, read_registry(root))


def _read(file: Path) -> Scene:
    """Read a scene, and how its skins are made: the physics is imported for a simulated one only."""
    scene = read_scene(file)
    if scene.simulate is not None:
        from pipeline.synthesis.capture import Synthesis

        parse(Synthesis, scene.simulate.model_dump(), f"{file}: simulate")
    if scene.train_classical is not None or scene.few_labels is not None:
        from pipeline.learning.comparison import Baselines, FewLabels  # scikit-learn, for a scene that compares

        for model, section in ((Baselines, "train_classical"), (FewLabels, "few_labels")):
            if getattr(scene, section) is not None:
                parse(model, getattr(scene, section), f"{file}: {section}")
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
