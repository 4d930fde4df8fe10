"""Tests of the curves that stage publish logs to MLflow: the metrics of an experiment, step by step."""

from pipeline.scenes import parse_scene
from pipeline.scores import make_table, write_scores
from pipeline.stages.report import read_curves
from reskin import io
from tests.scenes import scene_with


def test_read_curves_returns_the_metrics_of_an_experiment_by_number_of_contacts(tmp_path):
    row = {"experiment": "drift", "method": "each", "board": "b0", "skin": "s0", "recipe": "paper", "seed": 0}
    windows = ((0, 10, 90.0), (1, 20, 80.0))
    rows = [row | {"window_i": i, "contacts_n": n, "accuracy_pct": pct, "noload_off_uT": 1.0} for i, n, pct in windows]
    write_scores(tmp_path / "drift.parquet", make_table(rows))
    write_scores(tmp_path / "train_multi.parquet", make_table([]))
    io.write_json(tmp_path / "drift.json", {"numbers": {"skins_n": 1}, "drawn": {"late": {}}})
    curves = read_curves(parse_scene(scene_with("lobo", "drift"), "scene.yaml"), tmp_path, tmp_path)
    assert curves["drift"][:4] == [  # counts such as skins_n are not metrics
        ("drift.each", 10, {"accuracy_pct": 90.0}),
        ("drift.each", 10, {"noload_off_uT": 1.0}),
        ("drift.each", 20, {"accuracy_pct": 80.0}),
        ("drift.each", 20, {"noload_off_uT": 1.0}),
    ]


def test_scene_without_experiments_has_no_curves(tmp_path):
    write_scores(tmp_path / "train_multi.parquet", make_table([]))
    assert read_curves(parse_scene(scene_with("lobo"), "scene.yaml"), tmp_path, tmp_path) == {}
