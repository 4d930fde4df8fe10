"""Tests of the final model, which stage train_multi trains on all boards of a scene."""

from dataclasses import replace

import numpy as np
import pytest

import reskin
from pipeline.report.tables import final_model
from pipeline.settings import Training
from pipeline.stages.train import train_multi
from pipeline.training import jobs
from pipeline.training.final import FILE, final_numbers
from reskin import io
from reskin.data.rows import Selection, load_rows
from reskin.data.splits import Split, draw_folds, render_folds
from tests.experiments.test_audit import capture
from tests.scenes import TRAINING, recorded_scene, settings

SKINS = ("b0_s0", "b1_s0")
SCENE = recorded_scene(train_multi=TRAINING | {"variants": {"shape": {"inputs": "shape"}}})


@pytest.mark.parametrize("forces_known", [True, False])
def test_final_model_is_trained_on_all_boards(tmp_path, monkeypatch, forces_known):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(jobs, "code_version_of", lambda modules: "abc")
    force_N = np.linspace(0.5, 3.0, 64, dtype=np.float32) if forces_known else np.full(64, np.nan, np.float32)
    for skin in SKINS:
        io.write_readings(tmp_path / f"{skin}.parquet", [replace(capture(skin), Fz_N=force_N)], {})
    parsed = settings(SCENE)
    rows = load_rows([tmp_path / f"{skin}.parquet" for skin in SKINS], parsed.section(Selection, "selection"))
    folds = draw_folds(rows, ["lobo"], parsed.section(Split, "split"), parsed.seed)
    io.write_json(tmp_path / "folds.json", render_folds(SKINS, rows, folds))
    models = tmp_path / "models"
    section = parsed.section(Training, "train_multi")
    folders = (models / "train_multi", models / "final")
    outputs = (*folders, tmp_path / "scores.parquet", tmp_path / "plots")
    train_multi(parsed, section, tmp_path, tmp_path / "folds.json", *outputs)

    model = reskin.load_model(models / "final" / FILE).zero(np.full(15, 100.0))
    assert model.card["train_boards"] == ["b0", "b1"]
    assert model.card["train_rows_n"] == len(rows)
    assert np.isfinite(model.predict(rows.db_uT + 100)).all(axis=0).tolist() == [True, True, forces_known]
    tested = {
        fold: io.read_json(models / f"train_multi/lobo.paper.{fold}.seed0.json")["scores"]["all"]["mse_xy_mm2"]
        for fold in ("b0", "b1")
    }
    assert {board: scores["mse_xy_mm2"] for board, scores in model.card["held_out"].items()} == pytest.approx(tested)
    assert all(("mse_f_N2" in scores) == forces_known for scores in model.card["held_out"].values())
    numbers = final_numbers(models, "tiny")
    assert numbers["final_model"]["forces_known"] == forces_known
    assert final_model(numbers)["file"].tolist() == ["data/models/tiny/final/final.safetensors"]
