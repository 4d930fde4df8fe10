"""Time to simulate the paper's 18 skins x 10,140 indentations as raw captures, by the stage in two processes.

Run `RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_simulate_benchmark.py`. The test asserts only the number of
captures.
"""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pipeline import PARAMS, PLAN, SCENES
from reskin.config import read_yaml
from tests.benchmarks import size

ROOT = Path(__file__).resolve().parents[2]
SKINS_N, PASSES_N = size(18, 1), size(26, 1)  # 26 x 390 = 10,140 indentations
PLACES_N, DEPTHS_MM = 65, size((0.2, 0.4, 0.6, 0.8, 1.0, 1.2), (0.2,))


@pytest.mark.timeout(900)
def test_time_to_simulate_the_papers_captures(tmp_path: Path) -> None:
    scene = read_yaml(ROOT / SCENES / "quick.yaml")
    grid = scene["simulate"]["protocols"]["grid"]
    grid |= {"passes_n": PASSES_N, "skins_n": SKINS_N, "depths_mm": list(DEPTHS_MM)}
    (tmp_path / SCENES).mkdir(parents=True)
    (tmp_path / SCENES / "quick.yaml").write_text(json.dumps(scene))  # JSON is valid YAML
    for name in (PARAMS, PLAN, "dvc.yaml"):
        shutil.copy(ROOT / name, tmp_path / name)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "RESKIN_EXECUTOR": size("processes:2", "here")}
    start_s = time.perf_counter()
    command = [sys.executable, "-m", "pipeline", "simulate", "--scene", "quick", "--protocol", "grid"]
    subprocess.run(
        [*command, "--raw", "data/raw/quick"], cwd=tmp_path, env=environment, capture_output=True, check=True
    )
    took_s = time.perf_counter() - start_s
    captures = sorted((tmp_path / "data/raw/quick").iterdir())
    bytes_n = sum(file.stat().st_size for capture in captures for file in capture.iterdir())
    cost = json.loads(next((tmp_path / ".reskin/costs/quick").glob("simulate*.json")).read_text())
    indentations_n = len(captures) * PASSES_N * PLACES_N * len(DEPTHS_MM)
    assert len(captures) == SKINS_N
    print(f"\n{len(captures)} captures, {indentations_n} indentations, {bytes_n / 1e6:.0f} MB: {took_s:.1f} s in all,")
    print(f"  {1e3 * took_s / indentations_n:.3f} ms per indentation; peak memory of a process", end=" ")
    print(f"{cost['peak_process_memory_MB']:.0f} MB")
