"""What the paper's 18 skins x 10,140 indentations cost as raw captures: the stage itself, two processes of one thread.

`OMP_NUM_THREADS=1 pytest -s -o addopts= tests/benchmarks/test_simulate_benchmark.py`. Nothing but counts is asserted.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pipeline.core.config import read_yaml

ROOT = Path(__file__).resolve().parents[2]
PASSES_N = 26  # x 390 = 10,140 indentations


@pytest.mark.timeout(900)
def test_the_papers_captures_are_timed_from_parameters_to_bytes(tmp_path: Path) -> None:
    scene = read_yaml(ROOT / "pipeline/scenes/quick.yaml")
    scene["simulate"]["protocols"]["grid"]["passes_n"] = PASSES_N
    (tmp_path / "paper.yaml").write_text(json.dumps(scene))
    words = ["--scene", "paper", "--settings", "paper.yaml", "--protocol", "grid", "--raw", "raw"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "RESKIN_EXECUTOR": "processes:2"}
    start_s = time.perf_counter()
    command = [sys.executable, "-m", "pipeline.stages.simulate", *words]
    subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, check=True)
    took_s = time.perf_counter() - start_s
    captures = sorted((tmp_path / "raw").iterdir())
    bytes_n = sum(file.stat().st_size for capture in captures for file in capture.iterdir())
    cost = json.loads((tmp_path / ".reskin/costs/paper/simulate-raw.json").read_text())
    indentations_n = len(captures) * PASSES_N * 390
    assert len(captures) == 18
    print(f"\n{len(captures)} captures, {indentations_n} indentations, {bytes_n / 1e6:.0f} MB: {took_s:.1f} s in all,")
    print(f"  {1e3 * took_s / indentations_n:.3f} ms an indentation; a process peaked at", end=" ")
    print(f"{cost['peak_process_memory_MB']:.0f} MB")
