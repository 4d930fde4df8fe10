"""Tests that training is equal bit for bit on all processors with AVX2.

Environment variables that the user has set are kept.
"""

import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reskin.models.reproducible import affine, affine_layers, exp
from reskin.numerics import BEYOND_AVX2, TOO_LATE, VARIABLES, cpu_flags, pinned
from reskin.seeds import rng_for
from tests.sizes import size

ROOT = Path(__file__).resolve().parents[1]
AVX2, NEWEST = frozenset({"avx2"}), frozenset({"avx2", *BEYOND_AVX2.values()})
needs_avx2 = pytest.mark.skipif(
    "avx2" not in cpu_flags(), reason="on a processor without AVX2, the project does not select instructions"
)


@cache
def digests_under(*settings: str) -> str:
    """Return the digests of tools.arithmetic, run in a new process with these environment variables."""
    inherited = {
        name: value for name, value in os.environ.items() if name not in VARIABLES and not name.startswith("MKL")
    }
    # Waiting threads sleep, because otherwise they would use most of the processor time. This changes no sums.
    environment = inherited | {"OMP_WAIT_POLICY": "PASSIVE"} | dict(setting.split("=") for setting in settings)
    command = [sys.executable, "-m", "tools.arithmetic"]
    return subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, check=True).stdout


@needs_avx2
def test_training_does_not_depend_on_the_processor_that_mkl_detects_or_on_threads():
    # These variables make MKL and oneDNN use their code for unknown processors, and three threads instead of one.
    other = "MKL_CBWR=COMPATIBLE", "ONEDNN_MAX_CPU_ISA=SSE41", "OMP_NUM_THREADS=3", "MKL_NUM_THREADS=3"
    assert digests_under(*other) == digests_under()


@needs_avx2
@pytest.mark.parametrize(
    "setting", size(("ATEN_CPU_CAPABILITY=default", "OPENBLAS_CORETYPE=Prescott"), ("OPENBLAS_CORETYPE=Prescott",))
)
def test_training_depends_on_the_selected_instructions(setting):
    pairs = zip(digests_under(setting).split(), digests_under().split(), strict=True)
    assert all(one != other for one, other in pairs)


def test_affine_and_its_gradients_equal_those_of_pytorch():
    rng = rng_for(0, "affine")
    for shapes in (((3, 7, 5), (3, 5, 4), (3, 1, 4)), ((3, 7, 5), (5, 4), (1, 4)), ((7, 5), (5, 4), (1, 4))):
        ours = [torch.from_numpy(rng.normal(size=shape)).requires_grad_() for shape in shapes]
        theirs = [values.detach().clone().requires_grad_() for values in ours]
        weights = torch.from_numpy(rng.normal(size=(*shapes[0][:-1], 4)))
        (affine(*ours) * weights).sum().backward()
        (torch.matmul(theirs[0], theirs[1]).add(theirs[2]) * weights).sum().backward()
        for one, other in zip(ours, theirs, strict=True):
            # The tolerance is rounding in double precision of sums of at most 21 products of about 1.
            torch.testing.assert_close(one.grad, other.grad)
        torch.testing.assert_close(affine(*ours), torch.matmul(theirs[0], theirs[1]) + theirs[2])


@pytest.mark.parametrize("last_relu", [False, True])
@pytest.mark.parametrize("frozen", [None, "inputs", "layer 2"])
def test_layers_and_their_gradients_equal_those_of_pytorch(frozen, last_relu):
    rng, relus = rng_for(0, "layers"), (True, False, last_relu)
    shapes = ((3, 7, 5), (3, 5, 6), (3, 6, 4), (3, 4, 2), (3, 1, 6), (3, 1, 4), (3, 1, 2))
    ours = [torch.from_numpy(rng.normal(size=shape)).requires_grad_() for shape in shapes]
    for i in {None: (), "inputs": (0,), "layer 2": (2, 5)}[frozen]:
        ours[i].requires_grad_(False)
    theirs = [values.detach().clone().requires_grad_(values.requires_grad) for values in ours]
    mine = affine_layers(ours[0], ours[1:4], ours[4:], relus)
    plain = theirs[0]
    for weight, bias, relu in zip(theirs[1:4], theirs[4:], relus, strict=True):
        plain = torch.relu(plain @ weight + bias) if relu else plain @ weight + bias
    torch.testing.assert_close(mine, plain)
    assert ((plain == 0).sum() > 0) == last_relu
    factors = torch.from_numpy(rng.normal(size=plain.shape))
    (mine * factors).sum().backward()
    (plain * factors).sum().backward()
    for one, other in zip(ours, theirs, strict=True):
        # The tolerance is rounding in double precision of sums of at most 21 products of about 1.
        torch.testing.assert_close(one.grad, other.grad)


def test_product_that_overflows_is_infinite():
    assert affine(torch.full((2, 3), 1e30), torch.full((3, 1), 1e30), torch.zeros(1, 1)).isinf().all()


@given(st.floats(-80, 80, width=32))
def test_exponential_function_equals_numpy_in_single_precision(value):
    # Tolerance for arguments of up to 80: 80 log2(e) = 115 is rounded to 2^-18, a relative error of at most 3e-6 of the
    # result.
    assert float(exp(torch.tensor([value]))) == pytest.approx(np.exp(np.float64(value)), rel=5e-6)


def test_import_of_numpy_before_the_variables_are_set_is_reported():
    code = "import numpy; from reskin.numerics import departures; import os; print(departures(os.environ))"
    inherited = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    done = subprocess.run(
        [sys.executable, "-c", code], env=inherited, cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert (TOO_LATE in done.stdout) == ("avx2" in cpu_flags())


def test_variables_that_the_user_has_set_are_kept():
    own_settings = {"ATEN_CPU_CAPABILITY": "default", "NPY_DISABLE_CPU_FEATURES": ""}
    assert not set(pinned(NEWEST, own_settings)) & set(own_settings)


def test_numpy_disables_only_features_that_the_processor_has():
    assert "NPY_DISABLE_CPU_FEATURES" not in pinned(AVX2, {})
    assert pinned(NEWEST, {})["NPY_DISABLE_CPU_FEATURES"].split() == list(BEYOND_AVX2)


def test_no_variables_are_set_on_processors_without_avx2():
    assert pinned(frozenset(), {}) == {}


def test_cpu_flags_are_read_from_cpuinfo(tmp_path, monkeypatch):
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    (tmp_path / "cpuinfo").write_text("processor\t: 0\nflags\t\t: fpu avx2 fma\n\nprocessor\t: 1\nflags\t\t: fpu\n")
    assert cpu_flags(tmp_path / "cpuinfo") == {"fpu", "avx2", "fma"}
    assert cpu_flags(tmp_path / "nothing") == frozenset()
    monkeypatch.setattr("platform.machine", lambda: "arm64")
    assert cpu_flags(tmp_path / "cpuinfo") == frozenset()
