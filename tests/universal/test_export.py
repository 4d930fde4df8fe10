"""Tests that exported models (C code, which is compiled here, and ONNX files) give the same estimates as Python."""

import re
import shutil
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from reskin.data.contact import contact_threshold_uT, magnitudes_uT, noise_uT
from reskin.errors import ParamsError, SchemaError
from reskin.seeds import rng_for
from reskin.universal import export
from reskin.universal.model import Universal, load_universal
from reskin.universal.network import LAYERS_N, WIDTH

ROOT = Path(__file__).resolve().parents[2]
COMPILER = shutil.which("cc") or shutil.which("gcc")
STRICT = ["-std=c99", "-Wall", "-Wextra", "-pedantic-errors", "-Werror"]
# The example program of docs/robots.md. It reads one reading per line, and prints one estimate per line.
PROGRAM = re.search(r"```c\n(.*?)```", (ROOT / "docs/robots.md").read_text(encoding="utf-8"), re.DOTALL)[1]
NAMES = ("place_mm", "sd_mm", "force_N", "sd_log_N", "misfit")
LABELS_N = {"unlabelled": 0, "few forces, moving, two networks": 3, "labels, turned": 6}
# Tolerance in mm and in N for readings of presses and for readings without contact. The model in Python computes in
# single precision, so its estimates are no more exact than this.
EXACT = 1e-5


@cache
def whole() -> Universal:
    return load_universal()


@cache
def coarse(kind: str) -> Universal:
    """Return a calibrated model whose lattice has only every third place, so that its C code compiles quickly.

    To calibrate the model, presses are made up: the field change of each press is the one that the prior expects,
    multiplied by a random factor. The factors differ, so that the misfit of the model is not zero.
    """
    tables = whole().tables
    tables = replace(
        tables, axis_mm=tables.axis_mm[::3], mean_uT=tables.mean_uT[::3, ::3], slope_uT=tables.slope_uT[::3, ::3]
    )
    networks = [narrow(first) for first in ((0, 24) if "two" in kind else (0,))]
    external_uT = 30.0 if "moving" in kind else 0.0
    model = Universal(tables, networks, whole().powers, whole().layout, external_uT=external_uT)
    place_mm, force_N, db_uT = presses(60)
    model.zero(sign(kind) * quiet(), turned="turned" in kind).see(sign(kind) * (db_uT[:30] + rest_uT()))
    labels_n = LABELS_N[kind]
    if labels_n:
        model.label(place_mm[30:][:labels_n], force_N[30:][:labels_n], sign(kind) * (db_uT[30:][:labels_n] + rest_uT()))
    return model


def narrow(first: int, width: int = 24) -> dict[str, np.ndarray]:
    """Return `width` units of each layer of the shipped network, beginning with unit `first`."""
    weights, kept = dict(whole().networks[0]), np.arange(first, first + width)
    for i in range(LAYERS_N):
        weight, both = weights[f"layer{i}_weight"][kept], np.concatenate([kept, WIDTH + kept])
        weights[f"layer{i}_weight"] = weight[:, kept] if i else weight
        weights[f"layer{i}_bias"] = weights[f"layer{i}_bias"][kept]
        weights |= {name: weights[name][both] for name in (f"film{i}_weight", f"film{i}_bias")}
    return weights | {"answer_weight": weights["answer_weight"][:, kept]}


def sign(kind: str) -> int:
    return -1 if "turned" in kind else 1


def rest_uT() -> np.ndarray:
    return whole().layout.to_chips(whole().tables.rest_uT[None])


def quiet() -> np.ndarray:
    return rest_uT() + 3 * rng_for(1, "export").standard_normal((50, 15))


def presses(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return places, forces and field changes of `n` presses.

    The places are points of the model's lattice. The field changes are those of the mean of the prior, each multiplied
    by a random factor between 0.8 and 1.2.
    """
    rng, tables = rng_for(2, "export"), whole().tables
    i, j = rng.integers(6, len(tables.axis_mm) - 6, (2, n))
    q = rng.integers(2, len(tables.force_N), n)
    db_uT = whole().layout.to_chips(tables.mean_uT[i, j, q]) * rng.uniform(0.8, 1.2, (n, 1))
    return 8 + tables.axis_mm[np.stack([i, j], axis=1)], tables.force_N[q], db_uT


def readings(kind: str) -> dict[str, np.ndarray]:
    """Return field changes by kind (presses, light presses, no change, ...), one reading per row."""
    rng = rng_for(3, "export")
    db_uT = presses(200)[2] + 3 * rng.standard_normal((200, 15))
    changes = {"presses": db_uT, "light": 0.02 * db_uT, "none": np.zeros((1, 15)), "strong": 10 * db_uT}
    changes["nonsense"] = 3000 * rng.standard_normal((100, 15))
    changes["far beyond the chips' range"] = 1e5 * rng.standard_normal((100, 15))
    return {name: sign(kind) * value for name, value in changes.items()}


@cache
def run_c(kind: str, *options: str) -> dict[str, np.ndarray]:
    """Export a model to C, compile it and run it for all readings. The last reading is NaN in all channels."""
    with TemporaryDirectory() as name:
        folder, program = Path(name), Path(name) / "main"
        coarse(kind).export_c(folder / "skin.h", sign(kind) * quiet())
        (folder / "main.c").write_text(PROGRAM)
        subprocess.run([COMPILER, *STRICT, *options, "-o", program, folder / "main.c", "-lm"], check=True)
        b_uT = with_nan(readings(kind)) + coarse(kind).noload_uT
        text = "\n".join(" ".join(map(repr, row)) for row in b_uT.tolist())
        done = subprocess.run([program], input=text, capture_output=True, text=True, check=True)
    rows = np.array([line.split() for line in done.stdout.splitlines()], float)
    found = dict(zip(("force_N", "sd_log_N", "misfit", "change_uT", "contact"), rows.T[4:], strict=True))
    return {"place_mm": rows[:, :2], "sd_mm": rows[:, 2:4], **found}


def with_nan(changes: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([*changes.values(), np.full((1, 15), np.nan)])


def run_onnx(file: Path, db_uT: np.ndarray) -> dict[str, np.ndarray]:
    runtime = pytest.importorskip("onnxruntime", reason="extra `onnx` is not installed")
    session = runtime.InferenceSession(file, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(None, {"db_uT": db_uT}), strict=True))


def check_equal(model: Universal, found: dict[str, np.ndarray], changes: dict[str, np.ndarray]) -> None:
    """Check that exported estimates equal those of the model in Python.

    Python sums chi^2 in single precision, so its rounding errors grow with chi^2. They change an estimate only if two
    distant hypotheses have large and nearly equal chi^2, which can happen for readings that are not presses. For such
    readings, 90 % of the estimates must agree to the usual tolerance, and the others to a larger tolerance.
    """
    expected = model.estimate(np.concatenate(list(changes.values())) + model.noload_uT)
    kind_of = np.repeat(list(changes), [len(rows) for rows in changes.values()])
    for name in NAMES:
        assert np.isnan(found[name][-1]).all()
        error = np.abs(found[name][:-1] - getattr(expected, name))
        scale = np.maximum(1, np.abs(getattr(expected, name))) if name == "misfit" else 1.0
        error = (error / scale).reshape(len(kind_of), -1).max(axis=1)
        assert np.isfinite(error).all()
        real = np.isin(kind_of, ("presses", "light", "none"))
        assert error[real].max() < 2 * EXACT, name
        assert np.quantile(error[~real], 0.9) < EXACT, name
        assert error.max() < 5e-3, name


@pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")
@pytest.mark.parametrize("kind", LABELS_N)
def test_estimates_of_the_c_code_equal_those_of_python(kind):
    found = run_c(kind)
    check_equal(coarse(kind), found, readings(kind))
    db_uT, quiet_uT = with_nan(readings(kind)), sign(kind) * quiet() - coarse(kind).noload_uT
    suppressor = coarse(kind).suppressor(noise_uT(quiet_uT))
    change_uT = magnitudes_uT(db_uT, suppressor)
    np.testing.assert_allclose(found["change_uT"], change_uT, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(found["contact"], change_uT > contact_threshold_uT(quiet_uT, suppressor))
    assert found["contact"][:200].all()  # The first 200 readings are presses.
    # Reading 400 has no field change, and the last reading is NaN. Neither is a contact.
    assert not found["contact"][[400, -1]].any()


@pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")
def test_estimates_of_c_code_in_single_precision_equal_those_of_python():
    kind = "few forces, moving, two networks"
    check_equal(coarse(kind), run_c(kind, "-DRESKIN_SINGLE", "-Wdouble-promotion"), readings(kind))


@pytest.mark.parametrize("kind", LABELS_N)
def test_estimates_of_the_onnx_model_equal_those_of_python(tmp_path, kind):
    pytest.importorskip("onnx", reason="extra `onnx` is not installed")
    model, changes = coarse(kind), readings(kind)
    model.export_onnx(tmp_path / "skin.onnx", sign(kind) * quiet())
    found = run_onnx(tmp_path / "skin.onnx", with_nan(changes))
    check_equal(model, found, changes)
    assert len(run_onnx(tmp_path / "skin.onnx", np.zeros((0, 15)))["place_mm"]) == 0
    # The C code and the ONNX model compute the same function in double precision, so they agree up to rounding.
    if COMPILER is not None:
        for name, values in run_c(kind).items():
            np.testing.assert_allclose(found[name], values, rtol=1e-9, atol=1e-9, err_msg=name)


def test_estimates_of_the_whole_shipped_model_in_onnx_equal_those_of_python(tmp_path):
    pytest.importorskip("onnx", reason="extra `onnx` is not installed")
    model, changes = load_universal().zero(quiet()), {"presses": presses(50)[2]}
    model.export_onnx(tmp_path / "skin.onnx")
    found = run_onnx(tmp_path / "skin.onnx", changes["presses"])
    assert "contact" not in found
    expected = model.estimate(changes["presses"] + model.noload_uT)
    for name in NAMES:
        np.testing.assert_allclose(found[name], getattr(expected, name), atol=EXACT, rtol=0, err_msg=name)


def test_failed_export_is_explained_and_writes_no_file(tmp_path, monkeypatch):
    with pytest.raises(SchemaError, match="no no-load reading. First call zero"):
        load_universal().export_c(tmp_path / "skin.h")
    model = coarse("unlabelled")
    with pytest.raises(SchemaError, match="14 numbers"):
        model.export_c(tmp_path / "skin.h", np.zeros(14))
    with pytest.raises(SchemaError, match="1 readings are too few to estimate the noise"):
        model.export_c(tmp_path / "skin.h", quiet()[:1])
    assert not list(tmp_path.iterdir())
    monkeypatch.setitem(__import__("sys").modules, "onnx", None)
    with pytest.raises(ParamsError, match=r"pip install.*\[onnx\]"):
        export.build_onnx(export.skin_function(model, None))
