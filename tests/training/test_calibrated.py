"""Tests of experiment calibrated: a finished universal model on held-out boards of a recorded scene."""

import numpy as np
import pytest

from pipeline.stages.universal import calibrated
from pipeline.training.calibrated import Calibrated
from reskin import io
from reskin.data.rows import Selection, load_rows
from reskin.data.splits import Split, draw_folds, render_folds
from reskin.errors import ParamsError
from reskin.seeds import rng_for
from reskin.universal.law import at_rest_uT, simulate_uT
from reskin.universal.layout import paper_layout
from reskin.universal.model import FILE
from tests.data.tables import readings
from tests.scenes import scene_with, settings

PLACES_N = 40
SETUP = paper_layout().setup()
SPLIT = {"labels_pool_n": 20, "labels_draws_n": 1}


def scene(**compare: object) -> dict[str, object]:
    return scene_with("lobo", "labels", split=SPLIT) | {
        "experiments": ["lobo", "labels", "calibrated"],
        "compare": {"layout": "reskin", "labels_mirrored": False, "memory": 0.0} | compare,
        "calibrated": {"model": str(FILE), "labels_n": [0, 10], "even": False},
    }


def write_board(file, board: str, *, mirrored: bool, forces_known: bool) -> None:
    """Write a capture of simulated presses at random places of the skin for which the model was made."""
    layout = paper_layout()
    rng = rng_for(3, board)
    place_mm, force_N = rng.uniform(-5, 5, (PLACES_N, 2)), rng.uniform(0.5, 5, PLACES_N)
    rest_uT = layout.to_chips(at_rest_uT(layout.law, SETUP).reshape(1, 15))[0]
    db_uT = layout.to_chips(simulate_uT(layout.law, SETUP, place_mm, force_N).reshape(PLACES_N, 15))
    db_uT += rng.normal(0, 3, (PLACES_N, 15))
    label_mm = (place_mm * (1, -1 if mirrored else 1) + 8).astype(np.float32)
    capture = readings(
        board, board, f"{board}_s", PLACES_N, indentation=np.arange(PLACES_N, dtype=np.int32),
        pass_i=np.zeros(PLACES_N, np.int32), x_mm=label_mm[:, 0], y_mm=label_mm[:, 1],
        Fz_N=force_N.astype(np.float32) if forces_known else np.full(PLACES_N, np.nan, np.float32),
        b_uT=(rest_uT + db_uT).astype(np.float32), noload_uT=np.tile(rest_uT, (PLACES_N, 1)).astype(np.float32),
        temperature_degC=np.full((PLACES_N, 5), 25, np.float32),
    )  # fmt: skip
    io.write_readings(file, [capture], {})


def points(folder, *, mirrored: bool, forces_known: bool) -> list[dict]:
    for board in ("b0", "b1"):
        write_board(folder / f"{board}.parquet", board, mirrored=mirrored, forces_known=forces_known)
    parsed = settings(scene(labels_mirrored=mirrored))
    rows = load_rows(sorted(folder.glob("*.parquet")), parsed.section(Selection, "selection"))
    folds = draw_folds(rows, ["labels"], parsed.section(Split, "split"), parsed.seed)
    io.write_json(folder / "folds.json", render_folds(["b0", "b1"], rows, folds))
    section = parsed.section(Calibrated, "calibrated")
    calibrated(parsed, section, folder, folder / "folds.json", FILE, folder / "points.json")
    return io.read_json(folder / "points.json")


@pytest.mark.parametrize(("mirrored", "forces_known"), [(False, True), (True, False)])
def test_calibrated_model_finds_places_in_label_coordinates(tmp_path, mirrored, forces_known):
    scored = points(tmp_path, mirrored=mirrored, forces_known=forces_known)
    assert [(point["fold"], point["labels_n"]) for point in scored] == [(b, n) for b in ("b0", "b1") for n in (0, 10)]
    assert {point["method"] for point in scored} == {"universal, shipped model"}
    for point in scored:
        scores = point["scores"]["all"]
        assert scores["mse_xy_mm2"] < 1.0  # the variance of the places is 8 mm2
        assert ("mse_f_N2" in scores) == forces_known
        assert scores["half_width_mm"] > 0


def test_model_for_another_layout_is_an_error(tmp_path):
    parsed = settings(scene(layout="anyskin"))
    section = parsed.section(Calibrated, "calibrated")
    write_board(tmp_path / "b0.parquet", "b0", mirrored=False, forces_known=True)
    io.write_json(tmp_path / "folds.json", {"captures": ["b0"], "rows_n": PLACES_N, "dropped": {}, "folds": []})
    with pytest.raises(ParamsError, match="made for layout reskin, which differs from .* in skin, spreads"):
        calibrated(parsed, section, tmp_path, tmp_path / "folds.json", FILE, tmp_path / "points.json")
