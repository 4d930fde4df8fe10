"""Size, speed and accuracy of the shipped model as C code and as ONNX, calibrated to simulated skins (docs/robots.md).

Run `RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_export_benchmark.py`, which takes two minutes. It needs a C
compiler and extra `onnx`.
"""

import re
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

import reskin
from reskin.seeds import rng_for
from reskin.universal.model import Universal
from tests.benchmarks import FULL
from tests.universal.test_export import COMPILER, NAMES, PROGRAM

KINDS = {"unlabelled": (0, 0.0), "2 labels": (2, 0.0), "40 labels": (40, 0.0), "external fields": (0, 30.0)}
PRESSES_N, UNKNOWN_N, SKINS_N = 600, 65, 3


def calibrate(seed: int, labels_n: int, external_uT: float) -> tuple[Universal, dict[str, np.ndarray]]:
    """Return a model that is calibrated to presses of a simulated skin, and readings of other kinds."""
    rng = rng_for(seed, "export benchmark")
    presses = np.column_stack([rng.uniform(2, 14, (PRESSES_N, 2)), rng.uniform(0.3, 1.5, PRESSES_N)])
    noload_uT, b_uT, force_N = reskin.simulate_pokes(reskin.draw_skin(seed=seed), presses, seed=seed)
    model = reskin.load_universal(external_uT=external_uT).zero(noload_uT).see(b_uT[:UNKNOWN_N])
    if labels_n:
        labels = slice(UNKNOWN_N, UNKNOWN_N + labels_n)
        model.label(presses[labels, :2], force_N[labels], b_uT[labels])
    noise_uT = 3000 * rng.standard_normal((PRESSES_N, 15))
    return model, {"presses": b_uT, "no contact": noload_uT, "noise of 3 mT": model.noload_uT + noise_uT}


def run_c(folder: Path, b_uT: np.ndarray, *options: str) -> tuple[np.ndarray, float]:
    """Compile and run the program of docs/robots.md; return its estimates and the time per reading in ms."""
    command = [COMPILER, "-std=c99", "-O2", *options, "-o", folder / "main", folder / "main.c", "-lm"]
    subprocess.run(command, check=True)
    text = "\n".join(" ".join(map(repr, row)) for row in b_uT.tolist())
    start_s = time.perf_counter()
    done = subprocess.run([folder / "main"], input=text, capture_output=True, text=True, check=True)
    ms = 1e3 * (time.perf_counter() - start_s) / len(b_uT)
    return np.array([line.split() for line in done.stdout.splitlines()], float), ms


@pytest.mark.skipif(not FULL or COMPILER is None, reason="needs RESKIN_BENCHMARKS=full and a C compiler")
def test_estimates_of_exported_models_equal_those_of_python(tmp_path):
    runtime = pytest.importorskip("onnxruntime", reason="extra `onnx` is not installed")
    (tmp_path / "main.c").write_text(PROGRAM)
    largest: dict[tuple[str, str], float] = {}
    for kind, options in KINDS.items():
        for seed in range(SKINS_N):
            model, readings = calibrate(seed, *options)
            model.export_c(tmp_path / "skin.h", readings["no contact"])
            model.export_onnx(tmp_path / "skin.onnx", readings["no contact"])
            b_uT = np.concatenate(list(readings.values()))
            of_kind = np.repeat(list(readings), [len(rows) for rows in readings.values()])
            start_s = time.perf_counter()
            estimate = model.estimate(b_uT)
            ms = {"Python": 1e3 * (time.perf_counter() - start_s) / len(b_uT)}
            found = {}
            for name, flag in (("C, double", ()), ("C, single", ("-DRESKIN_SINGLE",))):
                rows, ms[name] = run_c(tmp_path, b_uT, *flag)
                found[name] = dict(zip(NAMES, (rows[:, :2], rows[:, 2:4], *rows.T[4:7]), strict=True))
            session = runtime.InferenceSession(tmp_path / "skin.onnx", providers=["CPUExecutionProvider"])
            start_s = time.perf_counter()
            outputs = session.run(list(NAMES), {"db_uT": b_uT - model.noload_uT})
            ms["ONNX"] = 1e3 * (time.perf_counter() - start_s) / len(b_uT)
            found["ONNX"] = dict(zip(NAMES, outputs, strict=True))
            for name, values in found.items():
                off = np.abs(values["place_mm"] - estimate.place_mm).max(axis=1)
                off = np.maximum(off, np.abs(values["force_N"] - estimate.force_N))
                for what in readings:
                    key = (name, what)
                    largest[key] = max(largest.get(key, 0.0), float(off[of_kind == what].max()))
        compiled = [COMPILER, "-std=c99", "-O2", "-c", "-o", tmp_path / "main.o", tmp_path / "main.c"]
        bytes_n = {}
        for name, flag in (("double", ()), ("single", ("-DRESKIN_SINGLE",))):
            subprocess.run([*compiled, *flag], check=True)
            sections = subprocess.run(["size", "-A", tmp_path / "main.o"], capture_output=True, text=True, check=True)
            bytes_n[name] = dict(re.findall(r"^\.(rodata|bss) +(\d+)", sections.stdout, re.MULTILINE))
        onnx_MB = (tmp_path / "skin.onnx").stat().st_size / 1e6
        print(f"\n{kind}: constants and variables in bytes {bytes_n}; ONNX file {onnx_MB:.1f} MB")
        print("ms per reading: " + ", ".join(f"{name} {value:.2f}" for name, value in ms.items()))
    for (name, what), value in largest.items():
        print(f"largest difference from Python in mm or N, {name}, {what}: {value:.1e}")
    for (name, what), value in largest.items():
        if what == "presses" or (what == "no contact" and name != "C, single"):  # other differences are rounding errors
            assert value < 5e-5, (name, what)
