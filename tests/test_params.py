from pathlib import Path

import pytest

from pipeline.errors import ParamsError
from pipeline.params import Scene, read_params, read_scene
from pipeline.strict import parse, read_yaml
from tests.scenes import RECIPE, recorded

ROOT = Path(__file__).resolve().parents[1]
TRAINING = {"seeds_n": 1, "recipes": {"paper": RECIPE}}


@pytest.mark.parametrize("file", sorted((ROOT / "pipeline/scenes").glob("*.yaml")), ids=lambda file: file.stem)
def test_every_scene_of_the_checkout_is_legal(file):
    read_scene(file)


def test_the_params_of_the_checkout_are_legal():
    read_params(ROOT / "params.yaml")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"sead": 3}, "scene.yaml: sead must be a known parameter; got 3"),
        ({"seed": "3"}, "scene.yaml: seed must be a valid integer; got '3'"),
        ({"seed": -1}, "seed must be greater than or equal to 0; got -1"),
        ({"questions": ["lobbo"]}, r"questions.0 must be 'lobo'.*; got 'lobbo'"),
        ({"questions": []}, "questions must"),
        ({"source": "simulated"}, "section simulate stands in a scene if and only if its source is simulated"),
        ({"train_single": TRAINING}, "section train_single stands in a scene if and only if it asks one of"),
        ({"questions": ["lobo", "transfer"], "train_single": TRAINING}, "split holds exactly what the questions need"),
        ({"split": {"transfer_skins_n": 3}}, "split holds exactly what the questions need"),
        ({"train_multi": {"seeds_n": 1, "recipes": {"other": RECIPE}}}, "a recipe named paper"),
        (
            {"train_multi": {"seeds_n": 1, "recipes": {"paper": RECIPE | {"rate_max": 0}}}},
            "rate_max must be greater than 0",
        ),
    ],
)
def test_a_wrong_scene_is_one_sentence_that_names_the_parameter(changes, sentence):
    with pytest.raises(ParamsError, match=sentence):
        parse(Scene, recorded(**changes), "scene.yaml")


def test_what_is_not_written_is_an_error_and_no_default():
    scene = recorded()
    del scene["seed"]
    with pytest.raises(ParamsError, match="scene.yaml: seed must be given; got nothing"):
        parse(Scene, scene, "scene.yaml")


def test_a_misspelt_parameter_is_named_as_it_was_written():
    recipe = {name: value for name, value in RECIPE.items() if name != "steps_n"} | {"step_n": 4}
    scene = recorded(train_multi={"seeds_n": 1, "recipes": {"paper": recipe}})
    with pytest.raises(ParamsError, match=r"recipes.paper.step_n must be a known parameter; got 4"):
        parse(Scene, scene, "scene.yaml")


def test_yaml_reads_exponents_as_numbers(tmp_path):
    (tmp_path / "a.yaml").write_text("rate: 1e-3\n")
    assert read_yaml(tmp_path / "a.yaml") == {"rate": 0.001}


@pytest.mark.parametrize("content", [b"a: [1", b"a: 1\na: 2\n", b"\xff\xfe\x00"])
def test_broken_yaml_is_one_sentence(tmp_path, content):
    (tmp_path / "a.yaml").write_bytes(content)
    with pytest.raises(ParamsError, match="a.yaml: the file must be YAML"):
        read_yaml(tmp_path / "a.yaml")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ParamsError, match="none.yaml: the file must be there"):
        read_yaml(tmp_path / "none.yaml")
