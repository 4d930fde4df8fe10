"""Tests of the curves that stage publish logs to MLflow: the metrics of an experiment, step by step."""

from pipeline.scenes import parse_scene
from pipeline.stages.report import read_curves
from reskin import io
from tests.scenes import scene_with


def test_read_curves_returns_the_metrics_of_an_experiment_by_number_of_contacts(tmp_path):
    drift = {"skins_n": 1, "each": [{"contacts_n": 10, "accuracy_pct": 90.0}, {"contacts_n": 20, "accuracy_pct": 80.0}]}
    io.write_json(tmp_path / "drift.json", {"numbers": drift, "drawn": {"true_N": [1.0]}})
    curves = read_curves(parse_scene(scene_with("lobo", "drift"), "scene.yaml"), tmp_path)
    assert curves == {  # counts such as skins_n are not metrics
        "drift": [
            ("drift.each", 10, {"accuracy_pct": 90.0}),
            ("drift.each", 20, {"accuracy_pct": 80.0}),
        ]
    }


def test_scene_without_experiments_has_no_curves(tmp_path):
    assert read_curves(parse_scene(scene_with("lobo"), "scene.yaml"), tmp_path) == {}
