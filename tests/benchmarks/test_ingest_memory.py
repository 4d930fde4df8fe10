"""Peak memory of ingesting a million indentations, and of ingesting a capture larger than the memory limit.

Run `RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_ingest_memory.py`, which prints frames per second and peak
memory and writes 2 GB to pytest's temporary folder.
"""

import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from reskin import io
from reskin.board.wire import Frames, encode
from reskin.recordings import probe
from reskin.recordings.header import PROBE_FILE, STREAM_FILE, Clock, Header
from reskin.recordings.ingest import read_native
from reskin.recordings.probe import LABELS, ProbeLog
from reskin.seeds import rng_for
from tests.benchmarks import FULL, size
from tests.recordings.headers import DEFAULT_POLICY, make_header

INDENTATIONS_N = size(1_000_000, 800)
TILE_N = size(4_000, 400)  # indentations in the block of bytes that is written repeatedly
QUIET_N = 400  # no-load frames before the first indentation and after the last
# The fraction of the full field change in each frame of an indentation.
SHARE = np.array([0, 0, 0, 0, 0.5, 1, 1, 1, 1, 0.5])
# The largest number of frames between indentations. The number is random, so that the clocks can be matched by it.
TRAVEL_N = 8
RATE_HZ = 400.0
# The stream has about 1 GB, which exceeds the memory limit.
ALLOWED_MB, LARGE_N, LARGE_TRAVEL_N = size(800, 2000), size(240_000, 800), 80
PEAK_MAX_MB = 1500  # 0.1 GB for the probe log of 2e6 dwells, 0.15 GB for its text, the rest for parsing


def write_capture(folder: Path, indentations_n: int = INDENTATIONS_N, travel_n: int = TRAVEL_N) -> None:
    rng = rng_for(0, "tile")
    begin_i = np.cumsum(len(SHARE) + rng.integers(0, travel_n, TILE_N + 1))
    begin_i -= begin_i[0]
    share = np.zeros((begin_i[-1], 1))
    share[begin_i[:-1, None] + np.arange(len(SHARE))] = SHARE[:, None]
    tile = encoded(share * np.repeat(rng.normal(0, 200, (TILE_N, 15)), np.diff(begin_i), axis=0), rng)
    quiet = encoded(np.zeros((QUIET_N, 15)), rng)
    with (folder / STREAM_FILE).open("wb") as file:
        file.write(quiet)
        for _ in range(indentations_n // TILE_N):
            file.write(tile)
        file.write(quiet)
    d = np.arange(2 * indentations_n, dtype=np.int32)
    start_i = QUIET_N + d // 2 // TILE_N * begin_i[-1] + begin_i[d // 2 % TILE_N] + 5 * (d % 2)
    labels = dict.fromkeys(LABELS, np.round(rng.uniform(0, 16, len(d)), 2).astype(np.float32))
    start_s, end_s = (start_i + 0.5) / RATE_HZ, (start_i + 4.5) / RATE_HZ
    log = ProbeLog(d // 2, d // 2 // 390, d % 2 == 1, start_s, end_s, **labels)
    (folder / PROBE_FILE).write_text(probe.render(log), encoding="utf-8")


def encoded(change_uT: np.ndarray, rng: np.random.Generator) -> bytes:
    f = len(change_uT)
    b_uT = (1000 + change_uT + rng.normal(0, 4, change_uT.shape)).astype(np.float32)
    return encode(Frames(b_uT, np.full((f, 5), 25, np.float32), np.zeros(f), np.zeros(f, np.int64)), "binary")


def header(marks: tuple[tuple[float, float], ...] = ((1.0, 1.0),)) -> Header:
    return make_header(layout="native", wire="binary", clock=Clock(kind="rate", rate_hz=RATE_HZ, marks=marks))


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("million")
    write_capture(path)
    return path


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("marks", [((1.0, 1.0),), ()], ids=["clock from marks", "clock from contacts"])
def test_memory_is_bounded_when_a_million_indentations_are_read(
    folder: Path, tmp_path: Path, marks: tuple[tuple[float, float], ...]
) -> None:
    capture = header(marks)
    before_mb, begin_s = peak_mb(), time.perf_counter()
    probe.parse(folder / PROBE_FILE, PROBE_FILE)
    parse_s = time.perf_counter() - begin_s
    begin_s = time.perf_counter()
    blocks, account = read_native(folder, capture, DEFAULT_POLICY)
    rows_n = sum(len(block) for block in blocks)
    read_s = time.perf_counter() - begin_s
    begin_s = time.perf_counter()
    io.write_readings(tmp_path / "c.parquet", *read_native(folder, capture, DEFAULT_POLICY))
    write_s = time.perf_counter() - begin_s
    print(
        f"\nprobe log {parse_s:.1f} s; read {account['frames_n'] / read_s:,.0f} frames/s ({read_s:.0f} s), "
        f"with Parquet {account['frames_n'] / write_s:,.0f} frames/s ({write_s:.0f} s); "
        f"peak {peak_mb():.0f} MB ({before_mb:.0f} MB before)"
    )
    assert rows_n == 4 * INDENTATIONS_N
    assert account["indentations_n"] == INDENTATIONS_N
    assert not FULL or peak_mb() < PEAK_MAX_MB


READ = """
import resource, sys
from pathlib import Path
from reskin import io
from reskin.recordings.ingest import read_native
from tests.benchmarks.test_ingest_memory import ALLOWED_MB, DEFAULT_POLICY, header, peak_mb
resource.setrlimit(resource.RLIMIT_AS, (ALLOWED_MB * 10**6,) * 2)
folder = Path(sys.argv[1])
blocks, account = read_native(folder, header(), DEFAULT_POLICY)
io.write_readings(folder / "c.parquet", blocks, account)
print(account["frames_n"], account["indentations_n"], round(peak_mb()))
"""


@pytest.mark.timeout(1800)
def test_capture_that_is_larger_than_the_memory_limit_is_read(tmp_path: Path) -> None:
    write_capture(tmp_path, LARGE_N, LARGE_TRAVEL_N)
    stream_MB = (tmp_path / STREAM_FILE).stat().st_size / 1e6
    command = [sys.executable, "-c", READ, str(tmp_path)]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    print(f"\n{stream_MB:.0f} MB, {output[0]} frames under RLIMIT_AS of {ALLOWED_MB} MB: peak {output[2]} MB resident")
    assert not FULL or stream_MB > ALLOWED_MB
    assert int(output[1]) == LARGE_N
