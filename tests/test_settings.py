"""Tests of `params` in dvc.yaml, which must list all settings on which the results of a stage depend.

Then, a changed setting makes DVC run the right stages again.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import dpath
import pytest
from ruamel.yaml import YAML

from pipeline import PARAMS, SCENES, plan
from pipeline.catalogue import module_of
from pipeline.experiments.shear import Shear
from pipeline.manage.new import scene_text
from pipeline.scenes import read_scene
from pipeline.settings import Settings, Training, read_settings, read_shared_files, section_of
from reskin.config import read_yaml
from reskin.errors import ParamsError
from reskin.simulation.defaults import NOMINAL
from tests.stages.checkout import copy_checkout

ROOT = Path(__file__).resolve().parents[1]
FLOW = read_yaml(ROOT / "dvc.yaml")["stages"]
SCENE, SKIN = f"{SCENES}/ci.yaml", str(NOMINAL.relative_to(ROOT))
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # Libraries that DVC uses cause warnings.


class RecordingMapping(Mapping[str, Any]):
    """A nested mapping that records which keys are read."""

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


def declared_sections(stage: str) -> tuple[set[str], set[str]]:
    """Return the sections of the scene and the sections of params.yaml that dvc.yaml lists for a stage."""
    scene_sections: set[str] = set()
    shared: set[str] = set()
    for entry in FLOW[stage]["do"].get("params", []):
        for file, keys in entry.items():
            if file.startswith(SCENES):
                scene_sections |= {key.partition(".")[0] for key in keys} if keys else {"*"}
            elif file in (PARAMS, SKIN):
                shared |= set(keys)
    return scene_sections, shared


MODELS = {stage: section_of(getattr(module_of(stage), stage)) for stage in FLOW if stage != "code"}


# The scene that `reskin new` writes for two boards like the paper's.
NEW_SCENE = YAML(typ="safe").load(scene_text("mine", ["b1", "b2"], 60, 2, "reskin"))


@pytest.mark.parametrize("stage", [stage for stage, model in MODELS.items() if model])
def test_params_in_dvc_yaml_cover_the_settings_that_a_stage_reads(stage):
    scenes = ("ci", "lab", "hand")
    scene = next((one for one in scenes if scene_runs(one, stage)), None)
    of_scene = NEW_SCENE if scene is None else read_settings(scene, ROOT).of_scene
    scene_mapping, shared_mapping = RecordingMapping(of_scene), RecordingMapping(read_shared_files(ROOT))
    Settings(str(scene), "scene.yaml", scene_mapping, shared_mapping).section(MODELS[stage], stage)
    scene_sections, shared = declared_sections(stage)
    assert scene_mapping.read - scene_sections == set() or "*" in scene_sections
    assert shared_mapping.read - shared == set()


def scene_runs(scene: str, stage: str) -> bool:
    return read_scene(ROOT, scene).runs(stage)


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    """Return a copy of the checkout whose plan has scene ci."""
    folder = copy_checkout(tmp_path_factory.mktemp("settings"))
    plan.use(folder, ["ci"])
    return folder


@pytest.fixture(scope="module")
def stages(root) -> list[Any]:
    """Return the stages that DVC builds from dvc.yaml and the plan."""
    from dvc.repo import Repo

    with Repo(str(root)) as repo:
        return list(repo.index.stages)


@pytest.fixture(scope="module")
def before(root, stages) -> dict[str, str]:
    """Return the parameter values of each stage without overrides."""
    return parameter_values(root, stages)


def parameter_values(root: Path, stages: list[Any]) -> dict[str, str]:
    """Return the parameter values of each stage, which DVC compares with those of the last run."""
    from dvc.dependency.param import read_param_file

    dependencies = [(stage.name, dep) for stage in stages for dep in stage.deps if hasattr(dep, "params")]
    file_systems = {dep.fs_path: dep.repo.fs for _, dep in dependencies}  # about a hundred dependencies on a few files
    files = {path: read_param_file(fs, path) for path, fs in file_systems.items()}
    values: dict[str, list[Any]] = {stage.name: [] for stage in stages}
    for name, dep in dependencies:
        # As in `read_param_file` of DVC, a stage that lists no keys of a file depends on the whole file.
        content = files[dep.fs_path]
        values[name].append([dpath.get(content, key, separator=".") for key in dep.params] if dep.params else content)
    return {name: repr(of_stage) for name, of_stage in values.items()}


@contextmanager
def override_files(root: Path, *overrides: tuple[str, str]) -> Iterator[None]:
    """Yield a function that changes a file as `dvc exp run -S file:key=value` does; restore the files at the end."""
    from dvc.utils.hydra import apply_overrides

    before = {file: (root / file).read_bytes() for file, _ in overrides}
    try:
        for file, override in overrides:
            apply_overrides(root / file, [override])
        yield
    finally:
        for file, content in before.items():
            (root / file).write_bytes(content)


FURTHER_PROTOCOLS = ("wear", "flexible", "hand", "drag", "sleeve", "glass", "grip", "log")
SIMULATE = {"simulate@ci", *(f"simulate@ci-{protocol}" for protocol in FURTHER_PROTOCOLS)}
# Stages that read section `adaptations`, section `recipes`, or the physics of the skin.
ADAPTING = {"adapt", "sweep_pokes", "sweep_sensors", "manual", "flexible", "new_board", "accuracy_and_cost"}
TRAINING = {"train_single", "train_multi", "train_triplet", "drift", "shear", "sleeve"}
# File, override, stages that DVC reruns. A stage depends on whole sections of params.yaml and of nominal.yaml.
OVERRIDES: list[tuple[str, str, set[str]]] = [
    (PARAMS, "recipes.triplet.rate_max=0.001", TRAINING | ADAPTING),
    (PARAMS, "adaptations.paper.rate_max=0.0005", ADAPTING),
    (SKIN, "skin.modulus_kPa=300.0", {"physics", "interference"}),
    (SKIN, "chip.gain_sel=4", {"physics", "interference"}),
    (SKIN, "terms.ageing.settling=0.2", {"physics"}),
    (SCENE, "split.pool_passes_n=2", {"split", "flexible"}),
    (SCENE, "simulate.protocols.drag.step_mm=1.0", {"simulate@ci-drag"}),
    (SCENE, "simulate.protocols.glass.step_N=0.1", {"simulate@ci-glass", "sensitivity"}),
    (SCENE, "simulate.protocols.grip.step_N=0.5", {"simulate@ci-grip", "gripper"}),
    (SCENE, "simulate.boards.sleeve.quadrature.cell_mm=2.5", {"physics"}),
    (SCENE, "train_single.steps_n=10", {"train_single"}),
    (SCENE, "train_multi.steps_n=10", {"train_multi", "sweep_sensors", "accuracy_and_cost"}),
    (SCENE, "adapt.steps_n=4", {*ADAPTING}),
    (SCENE, "sweep_pokes.pokes_n=[0,10]", {"sweep_pokes"}),
    (SCENE, "shear.repeats_n=1", {"shear"}),
    (SCENE, "accuracy_and_cost.repeats_n=2", {"accuracy_and_cost"}),
]


@pytest.mark.parametrize(("file", "override", "readers"), OVERRIDES, ids=[override for _, override, _ in OVERRIDES])
def test_override_of_a_setting_reruns_the_stages_that_read_the_setting(root, stages, before, file, override, readers):
    with override_files(root, (file, override)):
        after = parameter_values(root, stages)
    known = {name if "@" in name else f"{name}@ci" for name in set().union(*(named for _, _, named in OVERRIDES))}
    changed = {name for name in before if before[name] != after[name]}
    assert changed & known == {name if "@" in name else f"{name}@ci" for name in readers}


def test_edit_of_a_protocol_reruns_only_its_own_simulation(root, stages, before):
    for protocol in FURTHER_PROTOCOLS:
        with override_files(root, (SCENE, f"+simulate.protocols.{protocol}.note=1")):
            after = parameter_values(root, stages)
        assert {name for name in SIMULATE if before[name] != after[name]} == {f"simulate@ci-{protocol}"}


def test_section_states_a_recipe_or_the_name_of_a_recipe(root):
    row = read_shared_files(root)["recipes"]["triplet"]
    of_scene = read_settings("ci", root).of_scene
    for recipe in (row, "triplet"):
        section = {**of_scene["train_multi"], "recipe": recipe}
        settings = Settings("ci", "ci.yaml", {**of_scene, "train_multi": section}, read_shared_files(root))
        assert settings.section(Training, "train_multi").recipes["paper"].triplet_weight == row["triplet_weight"]


def test_stage_checks_only_the_sections_that_it_reads(root):
    with override_files(root, (SCENE, "shear.repeats_n=0")):
        read_settings("ci", root).section(Training, "train_multi")
        with pytest.raises(ParamsError, match="shear: repeats_n must be greater than or equal to 1; got 0"):
            read_settings("ci", root).section(Shear, "shear")
        with pytest.raises(ParamsError, match="shear: repeats_n must be"):
            plan.check(root)
