"""The same sums with AVX2 and AVX-512: variables that libraries read when they load. In: the environment. Out: same.

AVX2 and AVX-512 code paths add in another order, and training amplifies the rounding. With these variables a training
gives the same bits on both (tests/test_numerics.py). Imports nothing that needs NumPy, as it must run before it.
Refuses to overrule a variable that the user has set.
"""

import os
import platform
from collections.abc import Mapping
from pathlib import Path

CPUINFO = Path("/proc/cpuinfo")
VARIABLES = (
    "MKL_CBWR",
    "MKL_ENABLE_INSTRUCTIONS",
    "ATEN_CPU_CAPABILITY",
    "ONEDNN_MAX_CPU_ISA",
    "OPENBLAS_CORETYPE",
    "NPY_DISABLE_CPU_FEATURES",
    "NUMBA_CPU_NAME",
)  # all that this module sets, or that changes its effect
PINNED = {
    "MKL_CBWR": "AUTO,STRICT",  # products of matrices: a fast code path, in the same order of sums on all
    "ATEN_CPU_CAPABILITY": "avx2",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "OPENBLAS_CORETYPE": "Haswell",
    "NUMBA_CPU_NAME": "haswell",
}
# NumPy's names of what it must not use, and the processor's flag of the newest of their instructions. NumPy warns of a
# name that the processor lacks, so only those are named that it has.
BEYOND_AVX2 = {"X86_V4": "avx512vl", "AVX512_ICL": "avx512_vbmi2", "AVX512_SPR": "avx512_fp16"}


def pin() -> None:
    """Set what is not set yet, in this process and those that it starts; nothing on processors without AVX2.

    What the user has set stays as it is.
    """
    for name, value in pinned(cpu_flags(), os.environ).items():
        os.environ[name] = value


def pinned(flags: frozenset[str], environment: Mapping[str, str]) -> dict[str, str]:
    """Choose values for the variables that `environment` lacks.

    >>> pinned(frozenset({"neon"}), {})
    {}
    >>> pinned(frozenset({"avx2"}), {"MKL_CBWR": "COMPATIBLE"})["OPENBLAS_CORETYPE"]
    'Haswell'
    """
    if "avx2" not in flags:
        return {}
    chosen = dict(PINNED)
    if beyond := [name for name, flag in BEYOND_AVX2.items() if flag in flags]:
        chosen["NPY_DISABLE_CPU_FEATURES"] = " ".join(beyond)
    return {name: value for name, value in chosen.items() if name not in environment}


def departures(environment: Mapping[str, str]) -> list[str]:
    """Name the variables that hold libraries to other code paths than `pin` does: results may differ in the last bits.

    >>> departures({"MKL_CBWR": "COMPATIBLE", "NUMBA_CPU_NAME": "haswell"})
    ['MKL_CBWR=COMPATIBLE']
    """
    pinned_to = {name: {value} for name, value in PINNED.items()}
    features = " ".join(BEYOND_AVX2)  # a processor that has some of them only: a part
    pinned_to["NPY_DISABLE_CPU_FEATURES"] = {features[:end].rstrip() for end in range(len(features) + 1)}
    values = {name: environment.get(name, "") for name in VARIABLES}
    return [f"{name}={value}" for name, value in values.items() if value and value not in pinned_to.get(name, set())]


def signature() -> tuple[str, ...]:
    """What may give a training other bits on this machine: variables that set how matrix products are summed."""
    sums = (os.environ.get(name, "") for name in ("MKL_CBWR", "ATEN_CPU_CAPABILITY"))
    return (*sums, *departures(os.environ))


def cpu_flags(cpuinfo: Path = CPUINFO) -> frozenset[str]:
    """Read the instruction sets of this processor; empty where the system does not list them, or it is no x86."""
    if platform.machine().lower() not in ("x86_64", "amd64") or not cpuinfo.is_file():
        return frozenset()
    lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
    return frozenset(next((line.partition(":")[2] for line in lines if line.startswith("flags")), "").split())
