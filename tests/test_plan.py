import shutil
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from pipeline import FLOW, PARAMS, PLAN, SCENES, plan
from pipeline.catalogue import ANALYSES
from pipeline.manage.new import SHIPPED, scene_text
from pipeline.manage.registry import Entry, Registry
from pipeline.plan import Plan, make_plan
from pipeline.scenes import Scene, parse_scene, scene_file
from reskin.config import parse
from reskin.errors import ParamsError
from reskin.simulation.defaults import SHARED as SIMULATED
from tests.scenes import SHARED, recorded_scene, scene_with
from tests.stages.checkout import copy_checkout, run

ROOT = Path(__file__).resolve().parents[1]
ENTRY = Entry(board="b", skin="s", layout="lab", chips_n=5, fingerprints=("0",), copy_of=None)


def scene(**changes: object) -> Scene:
    return parse_scene(recorded_scene(**changes), "scene.yaml")


def test_plan_of_the_checkout_is_up_to_date():
    plan.check(ROOT)


def test_plan_lists_no_scenes_for_stages_that_no_scene_needs():
    generated = make_plan({"lab": scene()}, Registry(captures={"lab": {"c0": ENTRY}}))["stages"]
    assert generated["train_multi"] == ["lab"]
    assert generated["train_single"] == generated["extremes"] == generated["accuracy_and_cost"] == []
    assert generated["simulate"] == generated["ingest_simulated"] == {}


ADAPTED = ("lobo", "triplet", "adapt")


@pytest.mark.parametrize(
    ("stage", "experiments"),
    [
        ("train_triplet", ("lobo", "triplet")),
        ("adapt", ADAPTED),
        ("sweep_pokes", (*ADAPTED, "pokes")),
        ("sweep_sensors", (*ADAPTED, "sensors")),
        ("audit", ("lobo", "audit")),
    ],
)
def test_stage_runs_only_for_scenes_with_its_experiment(stage, experiments):
    with_experiment, plain = (parse_scene(scene_with(*names), "scene.yaml") for names in (experiments, ("lobo",)))
    captures = Registry(captures={"one": {"c0": ENTRY}, "two": {"c0": ENTRY}})
    generated = make_plan({"one": plain, "two": with_experiment}, captures)
    parse(Plan, generated, "plan")
    assert list(generated["stages"][stage]) == ["two"]
    assert all(list(generated["stages"][every]) == ["one", "two"] for every in ("train_multi", "report"))
    assert make_plan({"one": plain}, captures)["stages"][stage] == []


def test_stage_of_an_experiment_on_recordings_depends_on_their_captures():
    with_experiment, plain = (parse_scene(scene_with(*names), "scene.yaml") for names in (("lobo", "drift"), ("lobo",)))
    captures = Registry(captures={"one": {"c0": ENTRY}, "two": {"c0": ENTRY}})
    generated = make_plan({"one": plain, "two": with_experiment}, captures)
    parse(Plan, generated, "plan")
    assert generated["stages"]["drift"] == {"two": "two"}
    assert generated["captures"] == {"one": ["c0"], "two": ["c0"]}
    assert not any(generated["stages"][experiment] for experiment in ANALYSES if experiment != "drift")


def test_each_recorded_capture_has_an_ingest_stage_of_its_own():
    generated = make_plan({"lab": scene()}, Registry(captures={"lab": {"c1": ENTRY, "c0": ENTRY}, "ini": {"x": ENTRY}}))
    parse(Plan, generated, "plan")
    assert generated["stages"]["ingest"] == {
        "lab-c0": {"scene": "lab", "capture": "c0"},
        "lab-c1": {"scene": "lab", "capture": "c1"},
    }
    assert generated["stages"]["split"] == ["lab"]
    assert generated["captures"] == {"lab": ["c0", "c1"]}


def test_recorded_scene_without_captures_is_an_error():
    with pytest.raises(ParamsError, match="reskin add RECORDING --scene lab"):
        make_plan({"lab": scene()}, Registry(captures={}))


def test_stage_new_board_depends_on_the_model_that_the_scene_names(tmp_path):
    text = scene_text("mine", ["b1", "b2"], 60, 1, "reskin")
    captures = Registry(captures={"mine": {"c0": ENTRY}})
    generated = make_plan({"mine": parse_scene(YAML(typ="safe").load(text), "mine.yaml")}, captures)["stages"]
    assert generated["new_board"] == {"mine": SHIPPED}
    root = checkout(tmp_path)
    shutil.copy(ROOT / PARAMS, root)
    (root / SCENES / "mine.yaml").write_text(text)  # This checkout contains no library, and therefore no model.
    with pytest.raises(ParamsError, match=r"universal.safetensors, which is named in section new_board, was not found"):
        plan.plan_of(root, ["mine"])


def checkout(folder: Path, planned: str = "{}") -> Path:
    (folder / SCENES).mkdir(parents=True)
    (folder / "data").mkdir()
    for name, experiments in (("one", ["lobo"]), ("two", ["lobo"])):
        with (folder / SCENES / f"{name}.yaml").open("w") as stream:
            YAML().dump(recorded_scene(experiments=experiments), stream)
    with (folder / "data/captures.yaml").open("w") as stream:
        YAML().dump({"captures": {"one": {"c0": ENTRY.model_dump()}, "two": {"c0": ENTRY.model_dump()}}}, stream)
    with (folder / PARAMS).open("w") as stream:
        YAML().dump({name: rows for name, rows in SHARED.items() if name not in SIMULATED}, stream)
    shutil.copy(ROOT / FLOW, folder)
    (folder / PLAN).write_text(f"scenes: {planned}\ncaptures: {{}}\nheld_out: {{}}\nmodels: {{}}\nstages: {{}}\n")
    return folder


def test_scenes_use_writes_only_the_plan(tmp_path):
    root = checkout(tmp_path)
    others = [root / PARAMS, *(root / SCENES).iterdir()]
    before = [file.read_bytes() for file in others]
    plan.use(root, ["two", "one", "two"])
    generated = plan.check(root)
    assert list(generated.scenes) == ["two", "one"]
    assert list(generated.stages["train_multi"]) == ["two", "one"]
    assert "Do not edit" in (root / PLAN).read_text()
    assert [file.read_bytes() for file in others] == before


def test_outdated_plan_is_an_error(tmp_path):
    root = checkout(tmp_path, "{one: [lobo]}")
    with pytest.raises(ParamsError, match="Try: reskin scenes use one"):
        plan.check(root)


def test_unknown_scene_is_an_error(tmp_path):
    with pytest.raises(ParamsError, match="no scene three. The scenes are: one, two"):
        plan.use(checkout(tmp_path), ["three"])
    with pytest.raises(ParamsError, match="no scene tow. Did you mean two"):
        scene_file(tmp_path, "tow")


def simulated_checkout(tmp_path, **changes):
    """Create a checkout with scene `one`: a copy of ci with changes in section simulate."""
    root = checkout(tmp_path)
    shutil.copy(ROOT / PARAMS, root)
    scene_settings = YAML(typ="safe").load((ROOT / SCENES / "ci.yaml").read_text())
    scene_settings["new_board"]["model"] = None  # the checkout contains no library, and therefore no model
    for path, value in changes.items():
        *sections, name = path.split("__")
        section = scene_settings["simulate"]
        for part in sections:
            section = section[part]
        section[name] = value
    with (root / SCENES / "one.yaml").open("w") as stream:
        YAML().dump(scene_settings, stream)
    return root


def test_each_protocol_is_simulated_and_ingested_by_stages_of_its_own(tmp_path):
    root = simulated_checkout(tmp_path)
    plan.use(root, ["one"])
    stages = plan.check(root).stages
    protocols = ("wear", "flexible", "hand", "drag", "sleeve", "glass", "grip", "log")
    assert set(stages["simulate"]) == {"one", *(f"one-{protocol}" for protocol in protocols)}
    # The log of an SD card has no probe log.
    assert set(stages["ingest_simulated"]) == set(stages["simulate"]) - {"one-log"}
    assert stages["describe"] == ["one"]
    assert stages["drift"] == {"one": "one-wear"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"protocols__wear__terms": ["wind"]}, r"protocols.wear.terms.0 must be 'ageing', 'friction', "),
        ({"protocols__wear__skins_n": 99}, "protocol wear: skins_n 99 is more than the 6 skins of rigid boards"),
        (
            {"protocols__glass__skins_n": 3},
            "protocol glass: skins_n must be 1, because its experiment reads only one skin, not 3",
        ),
        ({"protocols__flexible__boards": "rigid"}, "protocol flexible: boards must not be rigid"),
    ],
)
def test_invalid_simulation_is_an_error_before_any_stage(tmp_path, changes, message):
    root = simulated_checkout(tmp_path, **changes)
    before = (root / PLAN).read_text()
    with pytest.raises(ParamsError, match=message):
        plan.use(root, ["one"])
    assert (root / PLAN).read_text() == before


STAND_IN = """
import pathlib, sys
out = pathlib.Path(sys.argv[-1])  # the output of a stage
out.mkdir(parents=True, exist_ok=True)
(out / "simulate").touch()  # the digests on which the stages depend
(out / "physics").touch()
"""


def test_dvc_checkout_keeps_outputs_of_other_scenes(tmp_path):
    root = copy_checkout(tmp_path)
    (root / "pipeline/__main__.py").write_text(STAND_IN)
    plan.use(root, ["ci", "quick"])
    run(root, "dvc", "repro", "simulate@ci", "simulate@quick")
    plan.use(root, ["quick"])
    run(root, "dvc", "checkout", check=False)  # The command fails, because other stages of scene quick have never run.
    assert sorted(path.name for path in (root / "data/raw").iterdir() if path.is_dir()) == ["ci", "quick"]
