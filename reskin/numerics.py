"""Set environment variables so that numerical libraries give identical results on every x86-64 processor with AVX2.

PyTorch, NumPy, OpenBLAS and Numba choose their code according to the instruction sets of the processor. OpenBLAS also
splits matrix products among threads. Both affect the order of summation, and thereby the rounding errors, which
training amplifies. The function `pin` sets environment variables that prescribe the code and the number of threads.
With these variables, and with the operations of `reskin.models.reproducible` instead of Intel's library MKL, all bits
of the results are identical on all processors with AVX2 (tests/test_numerics.py).

The libraries read the variables when they are loaded. Therefore, `pin` must run before NumPy is imported, and this
module must not import NumPy.
"""

import os
import platform
import sys
from collections.abc import Mapping
from pathlib import Path

from reskin.errors import ParamsError

CPUINFO = Path("/proc/cpuinfo")
PINNED = {
    "ATEN_CPU_CAPABILITY": "avx2",  # PyTorch: sums and elementwise functions
    "OPENBLAS_CORETYPE": "Haswell",  # NumPy and SciPy: matrix products, LAPACK
    "OPENBLAS_NUM_THREADS": "1",
    "NUMBA_CPU_NAME": "haswell",
}
# NumPy's features that must be disabled, because they use instructions beyond AVX2. For each feature, the value is the
# CPU flag of the newest instructions that it uses. NumPy warns if a disabled feature is not available on the processor.
# Therefore, a feature is disabled only if the processor has this flag.
BEYOND_AVX2 = {"X86_V4": "avx512vl", "AVX512_ICL": "avx512_vbmi2", "AVX512_SPR": "avx512_fp16"}
VARIABLES = (*PINNED, "NPY_DISABLE_CPU_FEATURES", "NUMBA_CPU_FEATURES")
TOO_LATE = "NumPy was imported before pipeline"

_loaded_before: list[str] = []  # contains TOO_LATE if `pin` ran too late


def pin() -> None:
    """Set the environment variables in this process, and thereby also in the processes that it starts.

    If the user has set one of the variables, it is not changed. On processors without AVX2, no variable is set.
    """
    chosen = pinned(cpu_flags(), os.environ)
    if "numpy" in sys.modules and not chosen.keys().isdisjoint({"OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES"}):
        _loaded_before[:] = [TOO_LATE]
    os.environ.update(chosen)


def pinned(flags: frozenset[str], environment: Mapping[str, str]) -> dict[str, str]:
    """Return the variables that `pin` must set on a processor with these CPU flags.

    Variables that are already set in `environment` are left out.

    >>> pinned(frozenset({"neon"}), {})
    {}
    >>> pinned(frozenset({"avx2"}), {"OPENBLAS_CORETYPE": "Zen"})["OPENBLAS_NUM_THREADS"]
    '1'
    """
    if "avx2" not in flags:
        return {}
    chosen = dict(PINNED)
    if beyond := [name for name, flag in BEYOND_AVX2.items() if flag in flags]:
        chosen["NPY_DISABLE_CPU_FEATURES"] = " ".join(beyond)
    empty = {name for name in PINNED if not environment.get(name)}  # libraries treat an empty variable as unset
    return {name: value for name, value in chosen.items() if name not in environment or name in empty}


def departures(environment: Mapping[str, str]) -> list[str]:
    """List the variables whose values differ from those that `pin` sets.

    Such values may change the last bits of results. If NumPy was imported before `pin` ran, the list also contains a
    note about this.

    >>> departures({"ATEN_CPU_CAPABILITY": "default", "NUMBA_CPU_NAME": "haswell"})
    ['ATEN_CPU_CAPABILITY=default']
    """
    pinned_to = {name: {value} for name, value in PINNED.items()}
    features = " ".join(BEYOND_AVX2)  # depending on the processor, `pinned` disables all of them or the first few
    pinned_to["NPY_DISABLE_CPU_FEATURES"] = {features[:end].rstrip() for end in range(len(features) + 1)}
    values = {name: environment.get(name, "") for name in VARIABLES}
    changed = [f"{name}={value}" for name, value in values.items() if value and value not in pinned_to.get(name, set())]
    return changed + _loaded_before


def signature() -> tuple[str, ...]:
    """Return the settings of this process on which the last bits of a trained network depend.

    They are part of cache keys, so that a result is not reused in a process with other settings.
    """
    return ("pinned" if "avx2" in cpu_flags() else "not pinned", *departures(os.environ))


def cpu_flags(cpuinfo: Path = CPUINFO) -> frozenset[str]:
    """Read the flags of this processor's instruction sets; return an empty set if the processor is not x86-64."""
    if platform.machine().lower() not in ("x86_64", "amd64") or not cpuinfo.is_file():
        return frozenset()
    lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
    return frozenset(next((line.partition(":")[2] for line in lines if line.startswith("flags")), "").split())


DEVICE_VARIABLE = "RESKIN_DEVICE"
DEVICES = ("cpu", "cuda")


def device() -> str:
    """Return the device on which networks run, `cpu` or `cuda`.

    It is the value of the environment variable RESKIN_DEVICE, or `cpu` if the variable is not set.
    """
    name = os.environ.get(DEVICE_VARIABLE, DEVICES[0])
    if name not in DEVICES:
        raise ParamsError(
            DEVICE_VARIABLE, "the device", f"one of {DEVICES}", repr(name), "Unset this variable to use the CPU."
        )
    return name
