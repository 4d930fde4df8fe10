"""Time to simulate an indentation on one core, compared with magpylib's dipole sum in the same run."""

from collections.abc import Callable
from time import perf_counter

import magpylib
import numpy as np
from magpylib.core import dipole_Hfield
from scipy.constants import mu_0
from scipy.spatial.transform import Rotation

import reskin
from reskin.data.grid import CENTRE_MM, protocol
from reskin.physics import deformation, layer, magnet
from reskin.physics.board import Board
from reskin.physics.skin import changes_of_field
from tools.benchmarks.common import best_s

DEPTHS_MM = (0.2, 0.4, 0.6, 0.8, 1.0, 1.2)
Dipoles = tuple[np.ndarray, np.ndarray]  # positions and moments


def core_field(dipoles: Dipoles, board: Board) -> np.ndarray:
    """Sum the dipole fields of magpylib.core, computed by one call for all pairs of node and chip."""
    positions_m, moments = dipoles
    away_m = (board.chips_m[:, None] - positions_m).reshape(-1, 3)
    each_T = mu_0 * dipole_Hfield(observers=away_m, moments=np.tile(moments, (len(board.chips_m), 1)))
    return each_T.reshape(len(board.chips_m), -1, 3).sum(axis=1)


def compare_with_magpylib(board: Board, rest: Dipoles, moved: Dipoles, repeats_n: int) -> None:
    objects = [
        [magpylib.misc.Dipole(moment=m, position=x) for x, m in zip(*dipoles, strict=True)] for dipoles in (rest, moved)
    ]

    def by_objects() -> np.ndarray:
        before_T, after_T = (magpylib.getB(one, board.chips_m, sumup=True) for one in objects)
        return after_T - before_T

    calls: dict[str, Callable[[], np.ndarray]] = {
        "compiled": lambda: magnet.change_of_field(rest, moved, board.chips_m),
        "NumPy": lambda: magnet.field(*moved, board.chips_m) - magnet.field(*rest, board.chips_m),
        "magpylib.core": lambda: core_field(moved, board) - core_field(rest, board),
        "magpylib objects": by_objects,
    }
    truth_T = calls["compiled"]()
    times_s = {name: best_s(call, repeats_n) for name, call in calls.items()}
    print(f"field before and after, {len(rest[0])} moving nodes x {len(board.chips_m)} chips")
    for name, call in calls.items():
        print(f"  {name:16} {1e3 * times_s[name]:8.2f} ms {times_s[name] / times_s['compiled']:8.1f} x")
        # The reference fields lose digits in the difference of two sums, and magpylib uses mu_0 of another CODATA year.
        np.testing.assert_allclose(call(), truth_T, atol=1e-7 * np.abs(truth_T).max())


def forget_tables() -> None:
    """Delete the tables of deformation, which are otherwise computed once for all skins of a kind."""
    functions = (deformation._tabulate, deformation._displaced, deformation._pressure_change, deformation._markers)
    for cached in (*functions, layer.contact_of_depth):
        cached.cache_clear()
    for file in (deformation.PACKAGE / "__pycache__").glob("kept-*.npy"):
        file.unlink()


def main(repeats_n: int = 10, depths_mm: tuple[float, ...] = DEPTHS_MM, *, forget: bool = True) -> None:
    board, skin = reskin.draw_board("b0"), reskin.draw_skin("b0_s0")
    moments = Rotation.from_rotvec([0.06, 0.08, 0.0]).apply(skin.moments_A_m2)
    # the memory order of the arrays that `deformation.move_dipoles` returns
    rest = np.asfortranarray(skin.nodes_m), np.asfortranarray(skin.moments_A_m2)
    moved = np.asfortranarray(skin.nodes_m + 1e-4 * np.cos(1e3 * skin.nodes_m)), np.asfortranarray(moments)
    compare_with_magpylib(board, rest, moved, repeats_n)
    plan = protocol(depths_mm, 1)
    pokes_m = 1e-3 * np.column_stack([plan.x_mm - CENTRE_MM, plan.y_mm - CENTRE_MM, plan.depth_mm]).astype(np.float64)
    if forget:
        forget_tables()
    start_s = perf_counter()
    changes_of_field(board, skin, pokes_m)
    first_s, again_s = perf_counter() - start_s, best_s(lambda: changes_of_field(board, skin, pokes_m), repeats_n)
    print(f"{len(pokes_m)} pokes of a skin: {1e3 * again_s / len(pokes_m):.3f} ms each,", end=" ")
    print(f"and {first_s - again_s:.1f} s for the tables")


if __name__ == "__main__":
    main()
