"""A training gives the same bits whatever instructions the processor has, and the user's own settings stand."""

import hashlib
import os
import subprocess
import sys
from functools import cache

import pytest

from pipeline.core.numerics import BEYOND_AVX2, PINNED, cpu_flags, pinned

AVX2, NEWEST = frozenset({"avx2"}), frozenset({"avx2", *BEYOND_AVX2.values()})
TRAIN = """
from pipeline.experiments.stability.learning import _trial, _changed, _rows
from pipeline.learning.train import train_stack
import hashlib, sys
trials = [_changed(_trial(i), triplet_weight=0.1) for i in range(3)]
digest = hashlib.sha256()
for one in train_stack(trials, _rows(0)):
    for name, value in sorted(one.weights.items()):
        digest.update(value.tobytes())
    digest.update(one.predicted.tobytes())
print(digest.hexdigest())
"""


@cache
def weights_under(**setting: str) -> str:
    kept = {name: value for name, value in os.environ.items() if name not in PINNED and not name.startswith("MKL")}
    done = subprocess.run(
        [sys.executable, "-c", TRAIN], env={**kept, **setting}, capture_output=True, text=True, check=True
    )
    assert len(done.stdout.strip()) == 2 * hashlib.sha256().digest_size
    return done.stdout


@pytest.mark.skipif("avx512f" not in cpu_flags(), reason="needs a processor with AVX-512, to leave it unused")
def test_a_training_has_the_same_bits_with_the_instructions_of_older_processors():
    assert weights_under(MKL_ENABLE_INSTRUCTIONS="AVX2") == weights_under()


@pytest.mark.skipif("avx2" not in cpu_flags(), reason="needs a processor with AVX2, to leave it unused")
def test_a_users_own_setting_takes_effect():
    assert weights_under(MKL_CBWR="COMPATIBLE") != weights_under()


def test_what_the_user_has_set_is_left_alone():
    mine = {"MKL_CBWR": "COMPATIBLE", "NPY_DISABLE_CPU_FEATURES": ""}
    assert not set(pinned(NEWEST, mine)) & set(mine)


def test_numpy_is_told_only_of_instructions_that_are_there():
    assert "NPY_DISABLE_CPU_FEATURES" not in pinned(AVX2, {})
    assert pinned(NEWEST, {})["NPY_DISABLE_CPU_FEATURES"].split() == list(BEYOND_AVX2)


def test_another_kind_of_processor_is_left_alone():
    assert pinned(frozenset(), {}) == {}


def test_flags_are_read_where_the_system_lists_them(tmp_path, monkeypatch):
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    (tmp_path / "cpuinfo").write_text("processor\t: 0\nflags\t\t: fpu avx2 fma\n\nprocessor\t: 1\nflags\t\t: fpu\n")
    assert cpu_flags(tmp_path / "cpuinfo") == {"fpu", "avx2", "fma"}
    assert cpu_flags(tmp_path / "nothing") == frozenset()
    monkeypatch.setattr("platform.machine", lambda: "arm64")
    assert cpu_flags(tmp_path / "cpuinfo") == frozenset()
