"""Settings obey: an override by DVC changes the effective value, and exactly the stages that read it."""

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from pipeline import plan
from pipeline.manage.registry import Entry, Registry
from pipeline.scenes import module_of, read_scene
from reskin import config
from reskin.config import Files, Settings, declared, read_settings, read_yaml
from reskin.errors import ParamsError
from reskin.models.recipe import adaptations, training
from reskin.simulation.fingerprint import SECTIONS
from reskin.simulation.settings import synthesis_of
from tests.stages.checkout import copy_checkout

ROOT = Path(__file__).resolve().parents[1]
FLOW = read_yaml(ROOT / "dvc.yaml")
READING = [
    stage
    for stage, words in FLOW["stages"].items()
    if "params" in words.get("do", {}) and not stage.startswith("ingest")
]
SCENE, SHARED = "pipeline/scenes/ci.yaml", "params.yaml"
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of DVC's own libraries


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    """A checkout that runs scene ci."""
    folder = copy_checkout(tmp_path_factory.mktemp("settings"))
    plan.use(folder, ["ci"])
    return folder


def files_of(root: Path) -> Files:
    return Files(root / SCENE, root / SHARED, root / config.PLAN)


def items(root: Path) -> dict[str, tuple[str, str, dict[str, Any]]]:
    """Every stage that reads settings by DVC's name of it: its module, its key and its item in the plan."""
    stages = config.read_yaml(root / config.PLAN)["stages"]
    return {f"{stage}@{key}": (stage, key, item) for stage in READING for key, item in stages[stage].items()}


def effective(stage: str, asked: Settings) -> str:
    """All that a stage gets of its settings, parsed and put together as its code does it."""
    words: dict[str, Any] = {"scene": asked.of_scene, "planned": asked.planned}
    if read := getattr(module_of(stage), "read", None):
        words["section"] = read(asked).model_dump(mode="json")
    for section in ("train_multi", "train_triplet"):  # whose networks others go on from
        if "recipe" in asked.of_scene.get(section, {}):
            words[section] = training(asked, section).model_dump(mode="json")
    if "adapt" in asked.of_scene:
        words["adapt"] = adaptations(asked).model_dump(mode="json")
    if stage in PHYSICS:
        words["physics"] = {name: asked.shared[name] for name in SECTIONS}
    elif {"skin", "spreads"} & set(asked.shared):  # else a stage takes one or two numbers of section simulate
        words["making"] = {name: repr(part) for name, part in synthesis_of(asked).__dict__.items()}
    return json.dumps(words, sort_keys=True, default=str)


def read_all(root: Path) -> dict[str, str]:
    files = files_of(root)
    return {name: effective(stage, read_settings(stage, key, files)) for name, (stage, key, _) in items(root).items()}


def stages_of(root: Path) -> list[Any]:
    """The stages as DVC makes them of dvc.yaml and the plan."""
    from dvc.repo import Repo

    with Repo(str(root)) as repo:
        return list(repo.index.stages)


def tracked(root: Path, stages: list[Any]) -> dict[str, dict[str, Any]]:
    """What DVC goes by, for every stage: its command, and the values of its parameters by file."""
    read: dict[str, dict[str, Any]] = {stage.name: {"cmd": stage.cmd} for stage in stages}
    for stage, dep in params_of(stages):
        words = config.read_yaml(Path(dep.fs_path))
        values = {key: config.find(words, key) for key in dep.params}
        read[stage.name][str(Path(dep.fs_path).relative_to(root))] = values
    return read


def params_of(stages: list[Any]) -> Iterator[tuple[Any, Any]]:
    """Every stage with each file of parameters that it depends on."""
    return ((stage, dep) for stage in stages for dep in stage.deps if hasattr(dep, "params"))


@contextmanager
def overridden(root: Path, *overrides: tuple[str, str]) -> Iterator[None]:
    """Do what `dvc exp run -S file:words` does to files, and undo it."""
    from dvc.utils.hydra import apply_overrides

    before = {file: (root / file).read_bytes() for file, _ in overrides}
    try:
        for file, words in overrides:
            apply_overrides(root / file, [words])
        yield
    finally:
        for file, content in before.items():
            (root / file).write_bytes(content)


ENTRY = Entry(board="b", skin="s", layout="lab", chips_n=5, fingerprints=("0",), copy_of=None)
CAPTURES = Registry(captures={scene: {"c0": ENTRY} for scene in ("lab", "ini", "eflesh", "eflash7")})
OWN = ("wear", "flexible", "hand", "drag", "sleeve", "glass", "grip", "press", "log")
SIMULATED = ("ci", *(f"ci-{protocol}" for protocol in OWN))
ALL_SIMULATE = {f"simulate@{key}" for key in SIMULATED}
RIGID = ALL_SIMULATE - {"simulate@ci-flexible", "simulate@ci-sleeve"}
PLAIN = {"train_single", "train_multi", "sweep_sensors", "drift", "shear", "sleeve", "ambient"}
BASED = {"adapt", "sweep_pokes", "sweep_sensors", "manual", "flexible"}
PHYSICS = {"audit", "report"}  # its fingerprint is compared with that of scene tuning
DRAWN = {"logs", "ambient", "contacts", "runtime", "left_out"}
# By override the stages that read it; None: whichever do. A stage that is named nowhere here (that of a new experiment)
# is checked for what every stage is: DVC runs it again if, and only if, its code gets something else.
OVERRIDES: list[tuple[str, str, set[str] | None]] = [
    (SHARED, "recipes.paper.rate_max=0.001", PLAIN),
    (SHARED, "recipes.paper.inputs=shape", PLAIN),
    (SHARED, "recipes.triplet.triplet_weight=0.2", {"train_triplet", "few_labels", *BASED}),
    (SHARED, "recipes.triplet.batch_n=32", {"train_triplet", "few_labels", *BASED}),
    (SHARED, "recipes.slow.rate_max=0.001", set()),  # of other scenes
    (SHARED, "adaptations.paper.rate_max=0.0005", {"few_labels", *BASED}),
    (SHARED, "labellings.few.own_weight=2.0", {"few_labels"}),
    (SHARED, "methods.tiny.ridge.alpha=2.0", {"train_classical", "few_labels"}),
    (SHARED, "methods.all.ridge.alpha=2.0", set()),
    (SHARED, "skin.modulus_kPa=300.0", ALL_SIMULATE | PHYSICS | DRAWN - {"logs"}),
    (SHARED, "chip.noise_xy_uT=4.0", ALL_SIMULATE | PHYSICS | {"logs", "ambient"}),
    (SHARED, "chip.gain_sel=5", ALL_SIMULATE | PHYSICS | {"logs", "ambient", "left_out"}),
    (SHARED, "rig.rate_hz=200.0", ALL_SIMULATE | PHYSICS),
    (SHARED, "rig.readings_n=3", ALL_SIMULATE | PHYSICS | {"logs", "ambient"}),
    (SHARED, "spreads.chip_tilt_deg=1.0", ALL_SIMULATE | PHYSICS | DRAWN),
    (SHARED, "terms.ageing.settling=0.2", {"simulate@ci-wear"}),
    (SHARED, "terms.friction.coefficient=0.5", {"simulate@ci-hand", "simulate@ci-drag"}),
    (SHARED, "terms.relaxation.hold_s=1.0", {"simulate@ci-wear", "simulate@ci-hand"}),
    (SCENE, "seed=7", None),
    (SCENE, "selection.force_min_N=0.1", None),
    (SCENE, "split.random_test_fraction=0.2", {"split"}),
    (SCENE, "split.pool_passes_n=2", {"split", "flexible"}),
    (SCENE, "simulate.protocols.grid.passes_n=3", {"simulate@ci", "left_out"}),
    (SCENE, "simulate.protocols.grid.depths_mm=[0.5]", {"simulate@ci", "left_out", "contacts"}),
    (SCENE, "simulate.protocols.drag.step_mm=1.0", {"simulate@ci-drag", "left_out"}),
    (SCENE, "simulate.protocols.glass.step_N=0.1", {"simulate@ci-glass", "sensitivity", "left_out"}),
    (SCENE, "simulate.boards.rigid.design.gap_mm=1.0", RIGID | DRAWN | {"flexible"}),
    (SCENE, "simulate.boards.flexible.design.gap_mm=0.5", {"simulate@ci-flexible", "flexible"}),
    (SCENE, "simulate.boards.sleeve.design.tiles.pitch_mm=25.0", {"simulate@ci-sleeve", "sleeve"}),
    (SCENE, "simulate.boards.rigid.quadrature.cell_mm=1.0", RIGID | DRAWN - {"logs"}),
    (SCENE, "train_single.steps_n=10", {"train_single"}),
    (SCENE, "train_multi.steps_n=10", {"train_multi", "sweep_sensors", "ambient"}),
    (SCENE, "train_multi.seeds_n=3", {"train_multi", "ambient"}),
    (SCENE, "train_triplet.steps_n=10", {"train_triplet", *BASED}),
    (SCENE, "train_triplet.seeds_n=1", {"train_triplet"}),
    (SCENE, "adapt.steps_n=4", BASED),
    (SCENE, "adapt.pokes_n=30", {"adapt", "sweep_sensors", "flexible"}),
    (SCENE, "adapt.variants.control.unlabelled_weight=0.01", {"adapt", "manual", "flexible"}),
    (SCENE, "sweep_pokes.pokes_n=[0,10]", {"sweep_pokes"}),
    (SCENE, "train_classical.rows_max_n=400", {"train_classical"}),
    (SCENE, "few_labels.adapting.steps_n=4", {"few_labels"}),
    (SCENE, "few_labels.recipes.network.inputs=raw", {"few_labels"}),
    (SCENE, "audit.settings=chosen", {"audit"}),
    (SCENE, "drift.test_n=20", {"drift"}),
    (SCENE, "drift.training.steps_n=10", {"drift"}),
    (SCENE, "variation.contacts_n=100", {"variation"}),
    (SCENE, "shear.repeats_n=1", {"shear"}),
    (SCENE, "sleeve.neighbours_n=4", {"sleeve"}),
    (SCENE, "sleeve.training.seeds_n=3", {"sleeve"}),
    (SCENE, "contacts.pairs_n=10", {"contacts"}),
    (SCENE, "ambient.iron.radius_mm=5.0", {"ambient"}),
    (SCENE, "gripper.gain_mm_N=0.1", {"gripper"}),
    (SCENE, "runtime.repeats_n=2", {"runtime"}),
]  # fmt: skip


KNOWN = set().union(*(readers for _, _, readers in OVERRIDES if readers))


@pytest.fixture(scope="module", autouse=True)
def _each_content_is_parsed_once():
    """Thirty stages read the same three files at every override, most as before; and an override may lose comments."""
    from dvc.utils.serialize import MODIFIERS

    def once(read, key_of):
        known: dict[Any, Any] = {}

        def cached(*words):
            key = key_of(*words)
            if key not in known:
                known[key] = read(*words)
            return known[key]

        return cached

    @contextmanager
    def modify(path):
        words = deepcopy(config.read_yaml(path))
        yield words
        path.write_text(json.dumps(words))  # JSON is YAML

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(config, "read_yaml", once(config.read_yaml, lambda path: (path, path.read_bytes())))
        patch.setitem(globals(), "effective", once(effective, lambda *words: repr(words)))  # a pure function of them
        patch.setitem(MODIFIERS, ".yaml", modify)
        yield


@pytest.fixture(scope="module")
def stages(root) -> list[Any]:
    return stages_of(root)


@pytest.fixture(scope="module")
def before(root, stages) -> tuple[dict[str, str], dict[str, dict[str, Any]]]:
    return read_all(root), tracked(root, stages)


def test_dvc_reads_the_same_values_of_all_parameters(stages):
    from dvc.dependency.param import read_param_file

    for _, dep in params_of(stages):
        words = config.read_yaml(Path(dep.fs_path))
        known = read_param_file(dep.repo.fs, dep.fs_path, dep.params, flatten=True)
        assert known == {key: config.find(words, key) for key in dep.params}


@pytest.mark.parametrize(("file", "words", "readers"), OVERRIDES, ids=[words for _, words, _ in OVERRIDES])
def test_an_override_changes_what_exactly_the_stages_that_read_it_get(root, stages, before, file, words, readers):
    with overridden(root, (file, words)):
        read, known = read_all(root), tracked(root, stages)
    changed = {name for name in read if read[name] != before[0][name]}  # what the code gets
    assert changed == {name for name in known if known[name] != before[1][name]}  # what DVC runs again
    assert changed or readers == set()
    if readers is not None:
        known_here = {name if "@" in name else f"{name}@ci" for name in KNOWN}
        assert changed & known_here == {name if "@" in name else f"{name}@ci" for name in readers}


def test_an_override_of_what_ingest_may_lose_re_runs_ingest_alone(root, before):
    with overridden(root, (SHARED, "lost_fraction_max=0.1")):
        known = tracked(root, stages_of(root))
    changed = {name for name in known if known[name] != before[1][name]}
    assert changed == {name for name in known if name.startswith("ingest_simulated@")} != set()


@pytest.mark.parametrize("scene", sorted(file.stem for file in (ROOT / config.SCENES).glob("*.yaml")))
def test_dvc_tracks_the_keys_that_a_stage_is_given_and_no_other(root, scene):
    own = read_scene(root / config.SCENES / f"{scene}.yaml", root / SHARED)
    made = plan.make_plan({scene: own}, CAPTURES, FLOW)
    words, shared = read_yaml(root / config.SCENES / f"{scene}.yaml"), read_yaml(root / SHARED)
    for stage in READING:
        for key, item in made["stages"][stage].items():
            for kind, source in (("scene", words), ("shared", shared), ("plan", made)):
                for template in declared(FLOW, stage)[kind]:
                    name = config.fill(template, key, item)
                    optional = name in ("split.pool_passes_n",)
                    assert optional or config.find(source, name) is not config.NOTHING, f"{stage}@{key}: {name}"


YAML_OF_DVC = [ROOT / "dvc.yaml", ROOT / SHARED, ROOT / config.PLAN, *sorted((ROOT / config.SCENES).glob("*.yaml"))]


@pytest.mark.parametrize("file", YAML_OF_DVC, ids=lambda file: file.name)
def test_no_file_that_dvc_reads_holds_an_anchor_an_alias_or_a_merge_key(file):
    # An override reaches one copy of what an alias names, or all of them.
    tokens = [type(token).__name__ for token in YAML(pure=True).scan(file.read_text())]
    assert {"AnchorToken", "AliasToken"} & set(tokens) == set()
    assert not re.search(r"^\s*<<\s*:|[{,]\s*<<\s*:", file.read_text(), re.MULTILINE)


def test_a_row_that_the_plan_does_not_know_is_refused_with_both_remedies(root):
    with overridden(root, (SCENE, "train_multi.recipe=slow")):
        with pytest.raises(
            ParamsError, match=r"train_multi.recipe must be paper, as planned; got slow. Try: reskin"
        ) as e:
            read_settings("train_multi", "ci", files_of(root))
        assert "plan.yaml:stages.train_multi.ci.train_multi.recipe=slow" in str(e.value)
        read_settings("train_single", "ci", files_of(root))  # which does not read that section


def test_a_row_that_is_planned_along_by_a_second_override_is_taken(root):
    planned = (config.PLAN, "stages.train_multi.ci.train_multi.recipe=slow")
    with overridden(root, (SCENE, "train_multi.recipe=slow"), planned):
        asked = read_settings("train_multi", "ci", files_of(root))
        assert training(asked, "train_multi").recipes["paper"].rate_max == 0.003
        assert "recipes.slow" in tracked(root, stages_of(root))["train_multi@ci"][SHARED]


def test_a_stage_that_reads_a_key_which_it_does_not_declare_is_told_so(root):
    asked = read_settings("train_single", "ci", files_of(root))
    with pytest.raises(ParamsError, match="train_multi must be given, and declared by its stage; got nothing"):
        training(asked, "train_multi")
    with pytest.raises(ParamsError, match="params.yaml: recipes.triplet must be given"):
        asked.row("recipes", "triplet")


def test_a_mistake_elsewhere_in_a_scene_does_not_stop_a_stage_but_its_own_does(root):
    with overridden(root, (SCENE, "shear.repeats_n=0")):
        training(read_settings("train_multi", "ci", files_of(root)), "train_multi")
        with pytest.raises(ParamsError, match="shear: repeats_n must be greater than or equal to 1; got 0"):
            module_of("shear").read(read_settings("shear", "ci", files_of(root)))
        with pytest.raises(ParamsError, match="shear: repeats_n must be"):
            plan.check(root)


def test_the_control_of_an_adaptation_follows_it(root):
    with overridden(root, (SHARED, "adaptations.paper.rate_max=0.5")):
        adapt = adaptations(read_settings("adapt", "ci", files_of(root)))
    assert {name: one.rate_max for name, one in adapt.recipes.items()} == {"paper": 0.5, "control": 0.5}
    assert adapt.recipes["control"].unlabelled_weight == 0
