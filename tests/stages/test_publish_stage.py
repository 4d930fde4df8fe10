"""What of an experiment reaches the diary: its numbers, over contacts where they go over contacts."""

from pipeline.scenes import parse_scene
from pipeline.stages.report import read_curves
from reskin import io
from tests.scenes import scene_with


def test_an_experiment_is_one_run_of_its_numbers_and_what_goes_over_contacts_is_a_curve(tmp_path):
    drift = {"skins_n": 1, "each": [{"contacts_n": 10, "accuracy_pct": 90.0}, {"contacts_n": 20, "accuracy_pct": 80.0}]}
    io.write_json(tmp_path / "drift.json", {"numbers": drift, "drawn": {"true_N": [1.0]}})
    curves = read_curves(parse_scene(scene_with("lobo", "drift"), "scene.yaml"), tmp_path)
    assert curves == {
        "drift": [
            ("drift", 0, {"skins_n": 1.0}),
            ("drift.each", 10, {"accuracy_pct": 90.0}),
            ("drift.each", 20, {"accuracy_pct": 80.0}),
        ]
    }


def test_a_scene_without_experiments_has_no_curve_of_one(tmp_path):
    assert read_curves(parse_scene(scene_with("lobo"), "scene.yaml"), tmp_path) == {}
