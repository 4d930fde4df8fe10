from pathlib import Path

import pytest
from ruamel.yaml import YAML

from pipeline import plan
from pipeline.errors import ParamsError
from pipeline.params import Scene, Stages, check_planned, read_params, read_scene
from pipeline.questions import EXPERIMENTS
from pipeline.registry import Entry, Registry
from pipeline.strict import parse
from tests.scenes import asking, recorded

ROOT = Path(__file__).resolve().parents[1]
ENTRY = Entry(board="b", skin="s", layout="lab", chips_n=5, fingerprints=("0",), copy_of=None)


def scene(**changes: object) -> Scene:
    return parse(Scene, recorded(**changes), "scene.yaml")


def test_the_plan_of_the_checkout_is_what_its_scenes_ask_for():
    plan.check(ROOT)


def test_a_question_that_no_scene_asks_has_no_stage():
    made = plan.make_plan({"lab": scene()}, Registry(captures={"lab": {"c0": ENTRY}}))
    assert made["train_multi"] == ["lab"]
    assert made["train_single"] == made["verify"] == made["runtime"] == []
    assert made["simulate"] == made["ingest_simulated"] == {}


ADAPTED = ("lobo", "triplet", "adapt")


@pytest.mark.parametrize(
    ("stage", "questions"),
    [
        ("train_triplet", ("lobo", "triplet")),
        ("adapt", ADAPTED),
        ("sweep_pokes", (*ADAPTED, "pokes")),
        ("sweep_sensors", (*ADAPTED, "sensors")),
        ("train_classical", ("lobo", "baselines")),
        ("few_labels", ("lobo", "labels")),
        ("audit", ("lobo", "audit")),
    ],
)
def test_a_stage_about_learning_runs_for_the_scenes_that_ask_it_and_for_no_other(stage, questions):
    asked, plain = (parse(Scene, asking(*own), "scene.yaml") for own in (questions, ("lobo",)))
    captures = Registry(captures={"one": {"c0": ENTRY}, "two": {"c0": ENTRY}})
    made = plan.make_plan({"one": plain, "two": asked}, captures)
    assert made[stage] == ["two"]
    assert made["train_multi"] == made["report"] == made["publish"] == ["one", "two"]
    parse(Stages, made, "plan")
    assert plan.make_plan({"one": plain}, captures)[stage] == []


def test_an_experiment_of_a_recorded_scene_is_asked_of_its_own_captures_and_of_no_other_scene():
    asked, plain = (parse(Scene, asking(*own), "scene.yaml") for own in (("lobo", "drift"), ("lobo",)))
    captures = Registry(captures={"one": {"c0": ENTRY}, "two": {"c0": ENTRY}})
    made = plan.make_plan({"one": plain, "two": asked}, captures)
    assert made["drift"] == {"two": {"scene": "two", "folder": "two"}}
    assert all(made[question] == {} for question in EXPERIMENTS if question != "drift")
    parse(Stages, made, "plan")


def test_a_choice_of_settings_needs_no_stage_of_its_own():
    chosen, plain = (parse(Scene, asking(*own), "scene.yaml") for own in ((*ADAPTED, "choice"), ADAPTED))
    captures = Registry(captures={"lab": {"c0": ENTRY}})
    assert plan.make_plan({"lab": chosen}, captures) == plan.make_plan({"lab": plain}, captures)


def test_a_question_that_was_added_since_is_noticed_by_the_stages(tmp_path):
    root = checkout(tmp_path, EMPTY)
    plan.use(root, ["one"])
    params = read_params(root / plan.PARAMS)
    check_planned("one", scene(), params, "one.yaml")
    asked = parse(Scene, asking("lobo", "baselines", "audit"), "one.yaml")
    with pytest.raises(ParamsError, match="train_classical, audit only in one. Try: reskin scenes use one"):
        check_planned("one", asked, params, "one.yaml")


def test_every_recorded_capture_has_an_ingest_of_its_own():
    made = plan.make_plan({"lab": scene()}, Registry(captures={"lab": {"c1": ENTRY, "c0": ENTRY}, "ini": {"x": ENTRY}}))
    assert made["ingest"] == {
        "lab-c0": {"scene": "lab", "capture": "c0"},
        "lab-c1": {"scene": "lab", "capture": "c1"},
    }
    assert made["split"] == {"lab": ["c0", "c1"]}
    parse(Stages, made, "plan")


def test_a_recorded_scene_without_recordings_says_how_to_add_one():
    with pytest.raises(ParamsError, match="reskin add RECORDING --scene lab"):
        plan.make_plan({"lab": scene()}, Registry(captures={}))


def checkout(folder: Path, params: str) -> Path:
    (folder / plan.SCENES).mkdir(parents=True)
    (folder / "data").mkdir()
    for name, questions in (("one", ["lobo"]), ("two", ["lobo"])):
        with (folder / plan.SCENES / f"{name}.yaml").open("w") as stream:
            YAML().dump(recorded(questions=questions), stream)
    with (folder / "data/captures.yaml").open("w") as stream:
        YAML().dump({"captures": {"one": {"c0": ENTRY.model_dump()}, "two": {"c0": ENTRY.model_dump()}}}, stream)
    (folder / plan.PARAMS).write_text(params)
    return folder


EMPTY = """\
# a comment that stays
scenes: []
lost_fraction_max: 0.05
stages:
  {simulate: {}, ingest_simulated: {}, ingest: {}, describe: {}, split: {}, train_single: [], train_multi: [],
   train_triplet: [], adapt: [], sweep_pokes: [], sweep_sensors: [], train_classical: [], few_labels: [], audit: [],
   drift: {}, variation: {}, shear: {}, manual: {}, flexible: {}, sleeve: {}, sensitivity: {}, logs: {}, contacts: {},
   ambient: {}, dynamics: {}, verify: [], stability: [], runtime: [], leave_out: [], report: [], publish: []}
"""


def test_use_writes_the_plan_and_keeps_comments(tmp_path):
    root = checkout(tmp_path, EMPTY)
    plan.use(root, ["two", "one", "two"])
    params = plan.check(root)
    assert params.scenes == ("two", "one")
    assert params.stages.train_multi == ("two", "one")
    assert "# a comment that stays" in (root / plan.PARAMS).read_text()


def test_a_plan_that_is_behind_its_scenes_is_refused_with_the_remedy(tmp_path):
    root = checkout(tmp_path, EMPTY.replace("scenes: []", "scenes: [one]"))
    with pytest.raises(ParamsError, match="Try: reskin scenes use one"):
        plan.check(root)


def test_an_unknown_scene_is_named_beside_the_known_ones(tmp_path):
    with pytest.raises(ParamsError, match="a scene must be one of one, two; got three"):
        plan.use(checkout(tmp_path, EMPTY), ["three"])


def simulated(tmp_path, **changes):
    """A checkout whose scene `one` is the tiny one, changed."""
    root = checkout(tmp_path, EMPTY)
    scene_of = YAML(typ="safe").load((ROOT / plan.SCENES / "ci.yaml").read_text())
    for path, value in changes.items():
        section = scene_of["simulate"]
        *sections, name = path.split("__")
        for part in sections:
            section = section[part]
        section[name] = value
    with (root / plan.SCENES / "one.yaml").open("w") as stream:
        YAML().dump(scene_of, stream)
    return root


def test_every_protocol_has_a_folder_and_stages_of_its_own(tmp_path):
    root = simulated(tmp_path)
    plan.use(root, ["one"])
    stages = plan.check(root).stages
    protocols = ("wear", "flexible", "hand", "drag", "sleeve", "glass", "press", "log")
    assert set(stages.simulate) == {"one", *(f"one-{protocol}" for protocol in protocols)}
    assert stages.simulate["one-flexible"].boards == "flexible"
    assert set(stages.ingest_simulated) == set(stages.simulate) - {"one-log"}  # an SD card has no probe to join
    assert set(stages.describe) == {"one"}
    assert stages.drift["one"].folder == "one-wear"


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"skin__base": "glued"}, "skin.base must be 'bonded' or 'slipping'; got 'glued'"),
        ({"protocols__wear__terms": ["ageing"]}, r"terms holds exactly what a protocol needs, .*; it holds"),
        ({"protocols__wear__skins_n": 99}, "protocol wear: skins_n 99 is more than rigid boards have, 6"),
        ({"protocols__press__skins_n": 3}, "protocol press: skins_n is 1, as its question reads one skin, not 3"),
        ({"protocols__flexible__boards": "rigid"}, "protocol flexible: boards is another kind than that of grid"),
    ],
)
def test_a_scene_that_cannot_be_simulated_is_refused_before_anything_runs(tmp_path, changes, sentence):
    root = simulated(tmp_path, **changes)
    before = (root / plan.PARAMS).read_text()
    with pytest.raises(ParamsError, match=sentence):
        plan.use(root, ["one"])
    assert (root / plan.PARAMS).read_text() == before


def test_a_protocol_that_was_added_since_is_noticed_by_the_stages(tmp_path):
    root = simulated(tmp_path)
    plan.use(root, ["one"])
    params, scene_of = read_params(root / plan.PARAMS), read_scene(root / plan.SCENES / "one.yaml")
    check_planned("one", scene_of, params, "one.yaml")
    fewer = {name: own for name, own in scene_of.simulate.protocols.items() if name != "drag"}
    edited = scene_of.model_copy(update={"simulate": scene_of.simulate.model_copy(update={"protocols": fewer})})
    with pytest.raises(ParamsError, match="protocol drag only in one. Try: reskin scenes use one"):
        check_planned("one", edited, params, "one.yaml")
