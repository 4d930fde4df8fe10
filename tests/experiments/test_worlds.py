"""Tests of experiment worlds, which finds the settings of scene decide on which the results of table 2 depend most.

The experiment simulates variants of the scene, which are called worlds.
"""

from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from pipeline.experiments import worlds as show
from pipeline.experiments.worlds import Residual, Worlds, rows_of, with_residual, worlds, worlds_of
from pipeline.settings import Settings, read_shared_files
from pipeline.simulation import simulation_settings
from reskin import io
from reskin.config import parse, read_yaml
from reskin.metrics import METRICS
from tests.report.synthetic import texts_of

ROOT = Path(__file__).resolve().parents[2]
RESIDUAL = Residual(sizes=(0.4,), length_mm=3.5, length_log_N=1.2, own_share=0.5)
GRID_MM = np.stack(np.meshgrid(np.linspace(-8, 8, 33), np.linspace(-8, 8, 33)), axis=-1).reshape(-1, 2)
PRESSES = np.column_stack([GRID_MM, np.zeros(len(GRID_MM))])
CHANGE_uT = 100 * np.sin(np.arange(15.0) + GRID_MM[:, :1])


def law_error(skin: str = "b0_s0", residual: Residual = RESIDUAL, size: float = 0.4) -> np.ndarray:
    return with_residual(CHANGE_uT, PRESSES, size, residual, 1, skin) - CHANGE_uT


def test_error_of_the_law_is_a_smooth_reproducible_field_of_the_given_size():
    relative_errors = [
        np.linalg.norm(law_error(f"b{i}_s0"), axis=1) / np.linalg.norm(CHANGE_uT, axis=1) for i in range(8)
    ]
    assert np.sqrt(np.mean(np.square(relative_errors))) == pytest.approx(0.4, rel=0.1)
    relative_error = law_error() / np.linalg.norm(CHANGE_uT, axis=1, keepdims=True)
    # These are the differences between places that are 0.5 mm apart.
    step = np.linalg.norm(np.diff(relative_error.reshape(33, 33, 15), axis=1), axis=2)
    assert step.mean() < 0.25 * np.linalg.norm(relative_error, axis=1).mean()
    np.testing.assert_array_equal(law_error(), law_error())
    assert not np.allclose(law_error(), law_error("b1_s0"))
    assert with_residual(CHANGE_uT, PRESSES, 0.0, RESIDUAL, 1, "b0_s0") is CHANGE_uT


def test_own_share_sets_how_much_errors_of_the_law_differ_between_skins():
    fully_shared = RESIDUAL.model_copy(update={"own_share": 0.0})
    np.testing.assert_array_equal(law_error("b0_s0", fully_shared), law_error("b1_s0", fully_shared))
    pairs = [np.corrcoef(law_error(f"b{i}_s0").ravel(), law_error(f"b{i + 1}_s0").ravel())[0, 1] for i in range(8)]
    assert np.mean(pairs) == pytest.approx(0.5, abs=0.15)


@pytest.fixture(scope="module")
def decide_settings() -> Settings:
    """Return the settings of scene decide, reduced to three boards with one skin each, and to few training steps."""
    scene = YAML(typ="safe").load((ROOT / "pipeline/scenes/decide.yaml").read_text())
    scene["simulate"]["boards"]["rigid"] |= {
        "boards_n": 3, "skins_per_board_n": 1, "quadrature": {"cell_mm": 3.0, "layers_n": 2},
    }  # fmt: skip
    scene["simulate"]["protocols"]["grid"] |= {"skins_n": 3, "passes_n": 2, "depths_mm": [0.6, 1.0]}
    scene["split"] = {"transfer_skins_n": 2, "pool_passes_n": 1}
    for section in ("train_single", "train_multi", "train_triplet"):
        scene[section]["steps_n"] = 12
    scene["adapt"] |= {"steps_n": 3, "pokes_n": 65}
    scene["worlds"] |= {"skin_modulus": [0.1], "amplitude_and_gap": [1.0], "friction": [0.8]}
    scene["worlds"]["residual"]["sizes"] = [0.0, 0.42]
    return Settings("decide", "decide.yaml", scene, read_shared_files(ROOT))


def test_scores_of_each_world_are_given_for_each_row_of_table_2(decide_settings, tmp_path):
    worlds(decide_settings, decide_settings.section(Worlds, "worlds"), results=tmp_path / "results.json")
    numbers = io.read_json(tmp_path / "results.json")["numbers"]
    assert [(one["factor"], one["value"]) for one in numbers["by_world"]] == [("default", 1.0), ("residual", 0.42)]
    for one in numbers["by_world"]:
        for row in ("single", "multi", "triplet", "adapted"):
            assert set(one[row]) == {*METRICS, "by_board"}
            assert one[row]["by_board"]
            assert set(one[row]["by_board"]) <= {"b0", "b1", "b2"}
    table = show.tables(numbers, "simulated")["worlds"]
    assert table["row"].tolist()[:2] == ["single-sensor", "multi-sensor"]
    assert len(table) == 8
    svg = show.figures(numbers, {}, "simulated")["worlds.svg"]
    for scene in ("Scores of table 2 in each world (simulated", "friction between skin and tip", "adapted"):
        assert scene in texts_of(svg)


def test_each_world_differs_from_the_default_in_one_setting(decide_settings):
    settings = decide_settings
    section = parse(Worlds, read_yaml(ROOT / "pipeline/scenes/decide.yaml")["worlds"], "worlds")
    listed = worlds_of(simulation_settings(settings), section)
    assert [world.name for world in listed] == [
        "default-1", "residual-0.21", "residual-0.42", "skin_modulus-0", "skin_modulus-0.3", "amplitude_and_gap-0",
        "amplitude_and_gap-2", "friction-0.35", "friction-1.7",
    ]  # fmt: skip
    default, with_error, slippery = (rows_of(listed[i], section, 1) for i in (0, 2, 7))
    np.testing.assert_array_equal(default.target, with_error.target)  # All worlds have the same places and forces.
    assert not np.allclose(default.db_uT, with_error.db_uT, rtol=0.05)
    np.testing.assert_array_equal(default.target, slippery.target)
    assert np.linalg.norm(default.db_uT - slippery.db_uT) > 0.01 * np.linalg.norm(default.db_uT)
