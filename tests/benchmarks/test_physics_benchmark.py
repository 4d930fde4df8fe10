"""Time to simulate an indentation on one core, and time of magpylib's dipole sum in the same run.

Run `RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_physics_benchmark.py`. The test asserts only that both
fields are equal.
"""

import resource
import time
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.constants import mu_0
from scipy.spatial.transform import Rotation

from reskin.data.grid import CENTRE_MM, protocol
from reskin.physics import deformation, layer, magnet
from reskin.physics.board import Board, draw_board
from reskin.physics.magnet import change_of_field
from reskin.physics.skin import Skin, changes_of_field, draw_skin
from reskin.seeds import rng_for
from tests.benchmarks import FULL, size
from tests.physics.test_board import design as board_design
from tests.physics.test_board import no_spread, spreads
from tests.physics.test_skin import design

DEPTHS_MM = size((0.2, 0.4, 0.6, 0.8, 1.0, 1.2), (0.2,))
SKINS_N, PASSES_N = size(18, 1), size(26, 1)
BOARD = draw_board(board_design(), no_spread(), seed=0, name="b0")


def skin(name: str) -> Skin:
    return draw_skin(design(), spreads(), seed=0, name=name)


def one_pass_m() -> np.ndarray:
    plan = protocol(DEPTHS_MM, 1)
    return 1e-3 * np.column_stack([plan.x_mm - CENTRE_MM, plan.y_mm - CENTRE_MM, plan.depth_mm]).astype(np.float64)


def forget_tables() -> None:
    if not FULL:
        return  # do not clear the cached tables, because other tests in this process use them
    for cached in (
        deformation._tabulate,
        deformation._displaced,
        deformation._pressure_change,
        deformation._markers,
        layer.contact_of_depth,
    ):
        cached.cache_clear()
    for file in (deformation.PACKAGE / "__pycache__").glob("kept-*.npy"):
        file.unlink()


def best_ms(call: Callable[[], Any], repeats_n: int) -> float:
    times_s = []
    for _ in range(repeats_n):
        start_s = time.perf_counter()
        call()
        times_s.append(time.perf_counter() - start_s)
    return 1e3 * min(times_s)


def move_everything(one: Skin) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    moments = Rotation.from_rotvec([0.06, 0.08, 0.0]).apply(one.moments_A_m2)
    moved = one.nodes_m + 1e-4 * np.cos(1e3 * one.nodes_m), moments
    rest = one.nodes_m, one.moments_A_m2
    # the memory order of the arrays that `deformation.move_dipoles` returns
    return tuple(map(np.asfortranarray, rest)), tuple(map(np.asfortranarray, moved))


def core_field(dipoles: tuple[np.ndarray, np.ndarray], board: Board) -> np.ndarray:
    """Sum the dipole fields of magpylib.core, computed by one call for all pairs of node and chip."""
    from magpylib.core import dipole_Hfield

    positions_m, moments = dipoles
    away_m = (board.chips_m[:, None] - positions_m).reshape(-1, 3)
    each_T = mu_0 * dipole_Hfield(observers=away_m, moments=np.tile(moments, (len(board.chips_m), 1)))
    return each_T.reshape(len(board.chips_m), -1, 3).sum(axis=1)


@pytest.mark.timeout(600)
def test_field_change_of_all_nodes_equals_that_of_magpylib() -> None:
    magpylib = pytest.importorskip("magpylib", reason="needs magpylib, a dev dependency")
    rest, moved = move_everything(skin("s0"))
    objects = [
        [magpylib.misc.Dipole(moment=m, position=x) for x, m in zip(*dipoles, strict=True)] for dipoles in (rest, moved)
    ]

    def by_objects() -> np.ndarray:
        before_T, after_T = (magpylib.getB(one, BOARD.chips_m, sumup=True) for one in objects)
        return after_T - before_T

    calls: dict[str, tuple[Callable[[], np.ndarray], int]] = {
        "compiled": (lambda: change_of_field(rest, moved, BOARD.chips_m), 50),
        "NumPy": (lambda: magnet.field(*moved, BOARD.chips_m) - magnet.field(*rest, BOARD.chips_m), 10),
        "magpylib.core": (lambda: core_field(moved, BOARD) - core_field(rest, BOARD), 10),
        "magpylib objects": (by_objects, 3),
    }
    truth_T = calls["compiled"][0]()
    times_ms = {name: best_ms(call, repeats_n) for name, (call, repeats_n) in calls.items()}
    print(f"\nfield before and after, {len(rest[0])} moving nodes x {len(BOARD.chips_m)} chips")
    for name, (call, _) in calls.items():
        print(f"  {name:16} {times_ms[name]:8.2f} ms {times_ms[name] / times_ms['compiled']:8.1f} x")
        # The reference fields lose digits in the difference of two sums, and magpylib uses mu_0 of another CODATA year.
        np.testing.assert_allclose(call(), truth_T, atol=1e-7 * np.abs(truth_T).max())


@pytest.mark.timeout(600)
def test_time_to_simulate_pokes_with_and_without_a_cached_table() -> None:
    pokes_m, one = one_pass_m(), skin("s0")
    changes_of_field(BOARD, skin("s1"), pokes_m[:1])  # the first call compiles the kernel
    forget_tables()
    start_s = time.perf_counter()
    _, first_T = changes_of_field(BOARD, one, pokes_m)
    with_table_ms = 1e3 * (time.perf_counter() - start_s)
    poking_ms = best_ms(lambda: changes_of_field(BOARD, one, pokes_m), 3)
    tracemalloc.start()
    forget_tables()
    _, again_T = changes_of_field(BOARD, one, pokes_m)
    peak_MB = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    assert np.array_equal(first_T, again_T)
    n = len(pokes_m)
    print(
        f"\n{n} pokes of one skin: {poking_ms / n:.3f} ms each, plus {with_table_ms - poking_ms:.0f} ms for the table"
    )
    print(f"  together {with_table_ms / n:.3f} ms per poke; peak {peak_MB:.1f} MB")


@pytest.mark.timeout(600)
def test_time_to_simulate_eighteen_skins_without_cached_tables() -> None:
    pokes_m = one_pass_m()
    forget_tables()
    start_s = time.perf_counter()
    for skin_i in range(SKINS_N):
        _, changes_T = changes_of_field(BOARD, skin(f"s{skin_i}"), pokes_m)
        assert np.isfinite(changes_T).all()
    total_s = time.perf_counter() - start_s
    peak_MB = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"\n{SKINS_N} skins x {len(pokes_m)} pokes, magnets and tables included: {total_s:.1f} s,")
    print(f"  {1e3 * total_s / SKINS_N / len(pokes_m):.3f} ms per indentation; the process peaked at {peak_MB:.0f} MB")


@pytest.mark.timeout(600)
def test_time_to_simulate_as_many_irregular_pokes_as_in_the_paper() -> None:
    rng = rng_for(0, "benchmark")
    pokes_m = np.tile(one_pass_m(), (PASSES_N, 1))
    pokes_m += rng.normal(0, (0.05e-3, 0.05e-3, 0.01e-3), pokes_m.shape)
    forget_tables()
    start_s = time.perf_counter()
    for skin_i in range(min(SKINS_N, 2)):
        changes_of_field(BOARD, skin(f"s{skin_i}"), pokes_m)
    total_s = time.perf_counter() - start_s
    peak_MB = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"\n2 skins x {len(pokes_m)} pokes: {total_s:.1f} s; {SKINS_N} would take {9 * total_s:.0f} s on one core")
    print(f"  {500 * total_s / len(pokes_m):.3f} ms per indentation; the process peaked at {peak_MB:.0f} MB")
