"""Fuzz one target or all: python tests/fuzz/fuzz.py TARGET|all SECONDS [KEEP].

If atheris is installed (`pip install atheris`), code coverage guides the inputs (libFuzzer), and inputs that reach new
code are saved in the folder KEEP, if given. Without atheris, inputs are random changes of the files in the corpus and
in KEEP, which find fewer errors. An input that fails is written to the working directory as `crash-...`; move the file
to `corpus/TARGET/`.
"""

import operator
import os
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
CORPUS = Path(__file__).parent / "corpus"
BYTES_MAX_N, MEMORY_MAX_MB, HANG_S = 4096, 2048, 20
PRINT_EVERY_N = 10_000
# Comparison operators, in the order of the argument of Python's opcode COMPARE_OP.
COMPARISONS = (operator.lt, operator.le, operator.eq, operator.ne, operator.gt, operator.ge)


def fuzz_guided(name: str, seconds: int, keep: Path | None) -> None:
    """Fuzz a target with libFuzzer; save inputs that reach new code in the folder `keep` or in a temporary folder."""
    import tempfile

    import atheris

    exclude_arrays(atheris)
    with atheris.instrument_imports(include=["reskin"]):
        from tests.fuzz.targets import feed
    for file in (CORPUS / name).iterdir():
        feed(name, file.read_bytes())  # a first call imports all modules, so that slow imports do not count as a hang
    with tempfile.TemporaryDirectory() as found:
        limits = [f"-max_total_time={seconds}", f"-max_len={BYTES_MAX_N}", f"-rss_limit_mb={MEMORY_MAX_MB}"]
        if keep is not None:
            (keep / name).mkdir(parents=True, exist_ok=True)
        folders = [found if keep is None else str(keep / name), str(CORPUS / name)]
        atheris.Setup(
            [sys.argv[0], *limits, f"-timeout={HANG_S}", "-print_final_stats=1", *folders],
            lambda data: feed(name, data),
        )
        atheris.Fuzz()


def exclude_arrays(atheris: ModuleType) -> None:
    """Patch atheris 3.0 to ignore comparisons of arrays, on which it leaks memory."""

    def compare(left: object, right: object, comparison_i: int, *where: object) -> object:
        if isinstance(left, np.ndarray) or isinstance(right, np.ndarray):
            return COMPARISONS[comparison_i](left, right)
        return atheris._trace_cmp(left, right, comparison_i, *where)

    atheris.compare = compare
    atheris.instrument_bytecode._COMPARE_FUNCTION = "compare"


def resident_MB() -> float:
    """Return the resident memory of this process in MB; NaN on systems without /proc."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6 if statm.exists() else float("nan")


def fuzz_randomly(name: str, seconds: int, keep: Path | None) -> None:
    """Fuzz a target with random changes of the inputs in the corpus and in the folder `keep`."""
    from reskin.seeds import rng_for
    from tests.fuzz.targets import feed

    rng, tried_n, end_s = rng_for(time.time_ns() % 2**31, "fuzz", name), 0, time.monotonic() + seconds
    folders = [CORPUS / name, *([keep / name] if keep is not None else [])]
    seeds = [file.read_bytes() for folder in folders for file in sorted(folder.iterdir())]
    while time.monotonic() < end_s:
        data = bytearray(seeds[rng.integers(len(seeds))])
        for _ in range(rng.integers(1, 8)):
            byte_i = int(rng.integers(len(data) + 1))
            data[byte_i : byte_i + int(rng.integers(3))] = rng.bytes(int(rng.integers(4)))
        Path("crash-last").write_bytes(data)
        feed(name, bytes(data))
        if tried_n % PRINT_EVERY_N == 0:
            print(f"{name}: {tried_n} inputs, {resident_MB():.1f} MB", flush=True)
        tried_n += 1
    Path("crash-last").unlink()
    print(f"{name}: {tried_n} inputs in {seconds} s, {resident_MB():.1f} MB")


def main(name: str, seconds: int, *keep: str) -> None:
    if name == "all":
        names = sorted(folder.name for folder in CORPUS.iterdir())
        for target in names:
            subprocess.run([sys.executable, __file__, target, str(seconds // len(names)), *keep], check=True)
        return
    try:
        import atheris  # noqa: F401
    except ImportError:
        fuzz_randomly(name, seconds, Path(*keep) if keep else None)
    else:
        fuzz_guided(name, seconds, Path(*keep) if keep else None)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), *sys.argv[3:])
