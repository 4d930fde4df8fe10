"""Places told before their touch: all of them by a scan that repeats, none by one in a random order."""

from pathlib import Path

import numpy as np

from pipeline.core import io
from pipeline.core.config import Settings
from pipeline.core.seeds import rng_for
from pipeline.dataset.rows import Selection, gather
from pipeline.dataset.splits import Split, draw_folds
from pipeline.trials.before_touch import score_before_touch
from pipeline.trials.training import SceneData
from tests.dataset.tables import readings

PASSES_N, PLACES_N = 4, 64
WORDS = {"seed": 0, "selection": {"force_min_N": 0.0}}
BY_CHANCE_PCT = 15.0  # one of 64 places is right by chance, neighbours' means a little more often


def scored(folder: Path, *, snake: bool, memory: float) -> dict[str, float]:
    """Score a scan of a 14 mm grid in four passes, the last tested; `memory` of each poke stays in the next field."""
    rng = rng_for(0, "scan")
    order = [np.arange(PLACES_N) if snake else rng.permutation(PLACES_N) for _ in range(PASSES_N)]
    at = np.concatenate(order)
    x_mm, y_mm = (2 * (at // 8)).astype(np.float32), (2 * (at % 8)).astype(np.float32)
    db_uT = np.stack([x_mm, y_mm, x_mm * y_mm], axis=1) * np.float32(10)
    noise_uT = 0.01 * rng.standard_normal(db_uT.shape)
    noload_uT = (100 + memory * np.roll(db_uT, 1, axis=0) + noise_uT).astype(np.float32)
    one = readings(
        f=len(at), x_mm=x_mm, y_mm=y_mm, noload_uT=noload_uT, b_uT=noload_uT + db_uT,
        pass_i=np.repeat(np.arange(PASSES_N, dtype=np.int32), PLACES_N),
    )  # fmt: skip
    io.write_readings(folder / "c0.parquet", [one], {})
    rows = gather([one], Selection(force_min_N=0.0))
    folds = draw_folds(rows, ["single_temporal"], Split(temporal_test_fraction=0.25), 0)
    table = score_before_touch(
        SceneData("test", Settings("test", "test.yaml", WORDS, {}, {}), rows, folds), folder, ["c0"]
    )
    return dict(zip(table["told_by"].to_pylist(), table["accuracy_pct"].to_pylist(), strict=True))


def test_a_snake_tells_every_place_by_its_number_and_with_a_memory_by_the_no_load_reading(tmp_path):
    found = scored(tmp_path, snake=True, memory=0.1)
    assert found["scan"] == 100.0
    assert found["noload"] > 95.0


def test_a_snake_without_memory_is_told_by_its_number_alone(tmp_path):
    found = scored(tmp_path, snake=True, memory=0.0)
    assert found["scan"] == 100.0
    assert found["noload"] < BY_CHANCE_PCT


def test_a_random_order_tells_nothing_even_where_the_skin_remembers(tmp_path):
    assert max(scored(tmp_path, snake=False, memory=0.1).values()) < BY_CHANCE_PCT
