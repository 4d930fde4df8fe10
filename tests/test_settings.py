"""The params of a stage cover the settings that its code reads; an override runs the stages again that read it."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from pipeline import PARAMS, PLAN, SCENES, plan
from pipeline.experiments.shear import Shear
from pipeline.scenes import SECTIONS, read_scene
from pipeline.settings import Adaptations, Settings, Training, read_settings, section_of
from pipeline.stages import module_of
from reskin.config import read_yaml
from reskin.errors import ParamsError
from reskin.simulation.defaults import NOMINAL
from tests.stages.checkout import copy_checkout

ROOT = Path(__file__).resolve().parents[1]
FLOW = read_yaml(ROOT / "dvc.yaml")["stages"]
SCENE, SKIN = f"{SCENES}/ci.yaml", str(NOMINAL.relative_to(ROOT))
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of DVC's own libraries


class Noting(Mapping[str, Any]):
    """A mapping that records which keys are read."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.values_by_key, self.read = values, set[str]()

    def __getitem__(self, key: str) -> Any:
        self.read.add(key)
        return self.values_by_key[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self.values_by_key)

    def __len__(self) -> int:
        return len(self.values_by_key)

    def __contains__(self, key: object) -> bool:
        return key in self.values_by_key


def declared(stage: str) -> tuple[set[str], set[str]]:
    """The sections of a scene, and the sections that scenes share, which dvc.yaml lists for a stage."""
    of_scene: set[str] = set()
    shared: set[str] = set()
    for entry in FLOW[stage]["do"].get("params", []):
        for file, keys in entry.items():
            if file.startswith(SCENES):
                of_scene |= {key.partition(".")[0] for key in keys} if keys else {"*"}
            elif file in (PARAMS, SKIN):
                shared |= set(keys)
    return of_scene, shared


MODELS = {stage: section_of(getattr(module_of(stage), stage)) for stage in FLOW if stage != "code"}


def test_the_stages_that_take_a_section_are_those_of_which_a_scene_holds_settings():
    assert {stage for stage, model in MODELS.items() if model} == SECTIONS | {"split"}


@pytest.mark.parametrize("stage", [stage for stage, model in MODELS.items() if model])
def test_the_params_of_a_stage_cover_the_settings_that_it_reads(stage):
    scene = next(one for one in ("ci", "lab", "eflash7", "decide", "universal") if stage_of(one, stage))
    given = read_settings(scene, ROOT)
    asked = Settings(scene, given.where, Noting(given.of_scene), Noting(given.shared), given.captures)
    asked.section(MODELS[stage], stage)
    of_scene, shared = declared(stage)
    assert asked.of_scene.read - of_scene == set() or "*" in of_scene
    assert asked.shared.read - shared == set()


def stage_of(scene: str, stage: str) -> bool:
    return read_scene(ROOT, scene).runs(stage)


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    """A checkout that runs scene ci."""
    folder = copy_checkout(tmp_path_factory.mktemp("settings"))
    plan.use(folder, ["ci"])
    return folder


@pytest.fixture(scope="module")
def stages(root) -> list[Any]:
    """The stages as DVC makes them of dvc.yaml and the plan."""
    from dvc.repo import Repo

    with Repo(str(root)) as repo:
        return list(repo.index.stages)


def tracked(root: Path, stages: list[Any]) -> dict[str, str]:
    """The values of its parameters that DVC compares, for every stage."""
    from dvc.dependency.param import read_param_file

    return {
        stage.name: repr([
            read_param_file(dep.repo.fs, dep.fs_path, dep.params, flatten=True)
            for dep in stage.deps
            if hasattr(dep, "params")
        ])
        for stage in stages
    }  # fmt: skip


@contextmanager
def overridden(root: Path, *overrides: tuple[str, str]) -> Iterator[None]:
    """Do what `dvc exp run -S file:key=value` does to files, and undo it."""
    from dvc.utils.hydra import apply_overrides

    before = {file: (root / file).read_bytes() for file, _ in overrides}
    try:
        for file, words in overrides:
            apply_overrides(root / file, [words])
        yield
    finally:
        for file, content in before.items():
            (root / file).write_bytes(content)


OWN = ("wear", "flexible", "hand", "drag", "sleeve", "glass", "grip", "press", "log")
SIMULATE = {"simulate@ci", *(f"simulate@ci-{protocol}" for protocol in OWN)}
BASED = {"adapt", "sweep_pokes", "sweep_sensors", "manual", "flexible"}
RECIPES = {"train_single", "train_multi", "train_triplet", "few_labels", "drift", "shear", "sleeve", "ambient", *BASED}
PHYSICS = {"audit", "report"}  # its fingerprint is compared with that of scene tuning
DRAWN = {"flexible", "sensitivity", "logs", "sleeve", "contacts", "ambient", "gripper", "runtime", "neglected_effects"}
# By override the stages that DVC runs again. Sections of params.yaml are taken whole: finished trainings are cached.
OVERRIDES: list[tuple[str, str, set[str]]] = [
    (PARAMS, "recipes.slow.rate_max=0.001", RECIPES),
    (PARAMS, "adaptations.paper.rate_max=0.0005", {"few_labels", *BASED}),
    (PARAMS, "labellings.few.own_weight=2.0", {"few_labels"}),
    (PARAMS, "methods.tiny.ridge.alpha=2.0", {"train_classical", "few_labels"}),
    (SKIN, "skin.modulus_kPa=300.0", SIMULATE | PHYSICS | DRAWN),
    (SKIN, "terms.ageing.settling=0.2", SIMULATE | DRAWN),
    (SCENE, "split.pool_passes_n=2", {"split", "flexible", "contacts"}),
    (SCENE, "simulate.protocols.drag.step_mm=1.0", {"simulate@ci-drag", *DRAWN}),
    (SCENE, "train_single.steps_n=10", {"train_single", "contacts"}),
    (SCENE, "train_multi.steps_n=10", {"train_multi", "sweep_sensors", "ambient", "contacts"}),
    (SCENE, "adapt.steps_n=4", {*BASED, "contacts"}),
    (SCENE, "sweep_pokes.pokes_n=[0,10]", {"sweep_pokes", "contacts"}),
    (SCENE, "shear.repeats_n=1", {"shear", "contacts"}),
    (SCENE, "runtime.repeats_n=2", {"runtime", "contacts"}),
]


@pytest.mark.parametrize(("file", "words", "readers"), OVERRIDES, ids=[words for _, words, _ in OVERRIDES])
def test_an_override_runs_the_stages_again_that_read_it(root, stages, file, words, readers):
    before = tracked(root, stages)
    with overridden(root, (file, words)):
        after = tracked(root, stages)
    known = {name if "@" in name else f"{name}@ci" for name in set().union(*(named for _, _, named in OVERRIDES))}
    changed = {name for name in before if before[name] != after[name]}
    assert changed & known == {name if "@" in name else f"{name}@ci" for name in readers}


def test_an_edit_of_a_protocol_simulates_that_protocol_again_and_no_other(root, stages):
    before = tracked(root, stages)
    for protocol in OWN:
        with overridden(root, (SCENE, f"+simulate.protocols.{protocol}.note=1")):
            after = tracked(root, stages)
        assert {name for name in SIMULATE if before[name] != after[name]} == {f"simulate@ci-{protocol}"}


def test_the_code_reads_what_an_override_sets(root):
    with overridden(root, (SCENE, "train_multi.recipe=slow")):
        assert read_settings("ci", root).section(Training, "train_multi").recipes["paper"].rate_max == 0.003


YAML_OF_DVC = [ROOT / "dvc.yaml", ROOT / PARAMS, NOMINAL, ROOT / PLAN, *sorted((ROOT / SCENES).glob("*.yaml"))]


@pytest.mark.parametrize("file", YAML_OF_DVC, ids=lambda file: file.name)
def test_no_file_that_dvc_reads_holds_an_anchor_an_alias_or_a_merge_key(file):
    # An override reaches one copy of what an alias names, or all of them.
    tokens = [type(token).__name__ for token in YAML(pure=True).scan(file.read_text())]
    assert {"AnchorToken", "AliasToken"} & set(tokens) == set()
    assert not re.search(r"^\s*<<\s*:|[{,]\s*<<\s*:", file.read_text(), re.MULTILINE)


def test_a_stage_fails_on_mistakes_in_its_own_sections_only(root):
    with overridden(root, (SCENE, "shear.repeats_n=0")):
        read_settings("ci", root).section(Training, "train_multi")
        with pytest.raises(ParamsError, match="shear: repeats_n must be greater than or equal to 1; got 0"):
            read_settings("ci", root).section(Shear, "shear")
        with pytest.raises(ParamsError, match="shear: repeats_n must be"):
            plan.check(root)


def test_the_control_of_an_adaptation_follows_it(root):
    with overridden(root, (PARAMS, "adaptations.paper.rate_max=0.5")):
        adapt = read_settings("ci", root).section(Adaptations, "adapt")
    assert {name: one.rate_max for name, one in adapt.recipes.items()} == {"paper": 0.5, "control": 0.5}
    assert adapt.recipes["control"].unlabelled_weight == 0
