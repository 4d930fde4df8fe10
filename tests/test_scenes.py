from pathlib import Path

import pytest

from pipeline.manage.registry import Registry
from pipeline.plan import make_plan, read_plan
from pipeline.scenes import Scene, parse_scene, read_scene, read_shared
from reskin.config import read_yaml
from reskin.errors import ParamsError
from tests.scenes import ADAPTATIONS, TRAINING, check, recorded_scene, scene_with

ROOT = Path(__file__).resolve().parents[1]
ADAPTED = ("lobo", "triplet", "adapt")  # Adaptation, and the experiments that it needs.


@pytest.mark.parametrize("file", sorted((ROOT / "pipeline/scenes").glob("*.yaml")), ids=lambda file: file.stem)
def test_scenes_are_valid(file):
    read_scene(ROOT, file.stem)


def test_params_and_plan_are_valid():
    read_shared(ROOT / "params.yaml")
    read_plan(ROOT / "pipeline/plan.yaml")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sead": 3}, "scene.yaml: sead is not a known parameter .its value: 3.*Did you mean seed"),
        ({"seed": "3"}, "scene.yaml: seed must be a valid integer; got '3'"),
        ({"seed": -1}, "seed must be greater than or equal to 0; got -1"),
        ({"experiments": ["lobbo"]}, r"experiments.0 must be .*'lobo'.*; got 'lobbo'.*Did you mean lobo"),
        ({"train_multi": TRAINING | {"recipe": "papr"}}, "train_multi.recipe must be .*Did you mean paper"),
        ({"experiments": []}, "experiments must"),
        ({"source": "simulated"}, "a simulated scene must have a section simulate"),
        ({"experiments": ["lobo", "transfer"], "train_single": TRAINING}, "split lacks transfer_skins_n"),
        ({"train_multi": TRAINING | {"recipe": "other"}}, r"train_multi\.recipe must be one of .*; got 'other'"),
        (
            {"train_multi": TRAINING | {"steps_n": 0}},
            "train_multi: recipes.paper.steps_n must be greater than or equal to 1; got 0",
        ),
        (
            {"train_multi": TRAINING | {"variants": {"fast": {"rate_max": 0}}}},
            "recipes.fast.rate_max must be greater than 0",
        ),
        ({"train_multi": TRAINING | {"variants": {"paper": {}}}}, "a variant's name must be other than paper"),
        (
            {"train_multi": TRAINING | {"variants": None}},
            "train_multi.variants: the variants must be a mapping.*got None",
        ),
        ({"train_multi": TRAINING | {"variants": {"fast": 3}}}, "train_multi.variants: the variants must be a mapping"),
        ({"train_multi": TRAINING | {"recipes": {"a": {}}}}, "train_multi: unknown key recipes"),
        ({"train_multi": TRAINING | {"recipe": ["paper"]}}, r"train_multi\.recipe must be one of"),
    ],
)
def test_error_for_an_invalid_scene_names_the_parameter(changes, message):
    with pytest.raises(ParamsError, match=message):
        check(recorded_scene(**changes))


def scene(*experiments: str, **changes: object) -> Scene:
    return check(scene_with(*experiments, **changes))


@pytest.mark.parametrize(
    ("experiment", "others"),
    [
        ("triplet", ("lobo",)),
        ("adapt", ("lobo", "triplet")),
        ("pokes", ADAPTED),
        ("sensors", ADAPTED),
        ("new_board", ("lobo", "triplet")),
        ("audit", ("lobo",)),
        ("choice", ADAPTED),
    ],
)
def test_missing_required_experiment_is_an_error(experiment, others):
    assert experiment in scene(*others, experiment).experiments
    with pytest.raises(ParamsError) as error:
        scene(*others[:-1], experiment)
    message = f"scene.yaml: experiment {experiment} needs {others[-1]} in the same scene. Correct these settings."
    assert str(error.value) == message


def test_simulated_experiment_needs_a_simulated_scene():
    with pytest.raises(ParamsError, match="only a simulated scene can run experiments sensitivity"):
        parse_scene(recorded_scene(experiments=["lobo", "sensitivity"]), "scene.yaml")


def test_removed_experiment_may_leave_its_settings_and_its_protocol_is_not_simulated():
    settings = read_yaml(ROOT / "pipeline/scenes/ci.yaml")
    settings["experiments"].remove("shear")
    assert (
        "ci-drag"
        not in make_plan({"ci": parse_scene(settings, "ci.yaml")}, Registry(captures={}))["stages"]["simulate"]
    )


ALL = (*ADAPTED, "transfer", "pokes", "sensors", "new_board", "audit", "choice")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"audit": {"settings": "guessed"}}, "audit: settings must be 'chosen' or 'for speed'; got 'guessed'"),
        ({"adapt": ADAPTATIONS | {"pokes_n": 0}}, "adapt: pokes_n must be greater than or equal"),
        ({"adapt": ADAPTATIONS | {"adaptation": "other"}}, r"adapt\.adaptation must be one of .*; got 'other'"),
        ({"sweep_pokes": {"pokes_n": [], "boards_n": 1}}, "sweep_pokes: pokes_n must"),
        ({"sweep_pokes": {"pokes_n": [8], "boards_n": 0}}, "sweep_pokes: boards_n must be greater than or equal to 1"),
    ],
)
def test_invalid_experiment_setting_is_an_error(changes, message):
    with pytest.raises(ParamsError, match=message):
        scene(*ALL, **changes)


def test_missing_setting_is_an_error_because_settings_have_no_defaults():
    settings = recorded_scene()
    del settings["seed"]
    with pytest.raises(ParamsError, match="scene.yaml: seed is missing"):
        parse_scene(settings, "scene.yaml")


def test_numbers_with_an_exponent_in_yaml_are_read_as_numbers(tmp_path):
    (tmp_path / "a.yaml").write_text("rate: 1e-3\n")
    assert read_yaml(tmp_path / "a.yaml") == {"rate": 0.001}


@pytest.mark.parametrize("content", [b"a: [1", b"a: 1\na: 2\n", b"\xff\xfe\x00"])
def test_broken_yaml_is_an_error(tmp_path, content):
    (tmp_path / "a.yaml").write_bytes(content)
    with pytest.raises(ParamsError, match="a.yaml: the file is not valid YAML"):
        read_yaml(tmp_path / "a.yaml")
