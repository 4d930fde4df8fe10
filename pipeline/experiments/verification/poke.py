"""The change of field under a poke, the network's input. In: designs, spreads, a seed, depths. Out: checks.

Judged on dB and never on the field at rest (PHYSICS 0). Refuses to know the chips' electronics.
"""

import numpy as np
from jaxtyping import Float
from scipy.constants import micro, milli

from pipeline.dataset.grid import CENTRE_MM, protocol
from pipeline.experiments.verification import reference
from pipeline.experiments.verification.checks import Check, apart, no_spread, worst
from pipeline.experiments.verification.magpylib_sum import field_of
from pipeline.physics.board import Board, BoardDesign, Spreads, draw_board
from pipeline.physics.nodes import Quadrature
from pipeline.physics.skin import Skin, SkinDesign, changes_of_field, draw_skin

COARSE = Quadrature(cell_m=2.2e-3, layers_n=4)  # for laws that hold for any rule
DENSE = Quadrature(cell_m=1.5e-3, layers_n=4)  # for what the table and the steps cost
EVERY_PLACE = 5  # of the protocol's 65
REFERENCE_STEPS_N = 16
UNSEEN_uT = 1.0  # a third of a chip's noise, to which it adds 5 %, as squares add
PLACES_M = np.array([[1.1, -2.3], [-4.2, 0.7], [5.3, 6.1]]) * milli  # on no node's axis


def check_poke(
    board: BoardDesign, spreads: Spreads, *, skin: SkinDesign, depths_m: tuple[float, ...], seed: int
) -> list[Check]:
    """Check dB on a scene's own first skin, and its symmetries on the design without spreads."""
    drawn = draw_board(board, spreads, seed=seed, name="b0")
    exact = no_spread(spreads)
    even = draw_skin(skin, exact, seed=seed, name="b0_s0", rule=COARSE)
    return [
        *_shortcuts(drawn, draw_skin(skin, spreads, seed=seed, name="b0_s0", rule=DENSE), depths_m),
        *_symmetries(draw_board(board, exact, seed=seed, name="b0"), even, skin.polarity),
        *_amplitude(drawn, spreads, skin=skin, seed=seed),
    ]


def check_quadrature(
    board: BoardDesign,
    spreads: Spreads,
    *,
    skin: SkinDesign,
    rule: Quadrature,
    depths_m: tuple[float, ...],
    seed: int,
) -> list[Check]:
    """Check the scene's own rule against a finer one, over places of its protocol."""
    drawn = draw_board(board, spreads, seed=seed, name="b0")
    fine_cells, fine_layers = Quadrature(rule.cell_m / 2, rule.layers_n), Quadrature(rule.cell_m, 2 * rule.layers_n)
    places_m = _grid_m()[::EVERY_PLACE]
    pokes_m = _each_depth(places_m, depths_m)
    found_T, cells_T, layers_T = (
        changes_of_field(drawn, draw_skin(skin, spreads, seed=seed, name="b0_s0", rule=one), pokes_m)[1]
        for one in (rule, fine_cells, fine_layers)
    )
    size_T = np.linalg.norm(cells_T, axis=(1, 2), keepdims=True)
    allowed_T = np.maximum(0.02 * size_T, UNSEEN_uT * micro)
    cells = f"cells of {fine_cells.cell_m / milli:g} mm for {rule.cell_m / milli:g} mm"
    few = f"{len(places_m)} places of the protocol"
    return [
        Check("dB of pokes", f"quadrature, {few}, all depths", cells, apart(found_T, cells_T), "1", 0.02,
              "2 % is what an indentation may be wrong by in all (DESIGN 6)"),
        Check("dB of pokes", f"quadrature, {few}, each channel of each poke", cells,
              float((np.abs(found_T - cells_T) / allowed_T).max()), "of the allowed", 1.0,
              f"2 % of the poke's dB, or {UNSEEN_uT:g} uT where that is more: a third of a chip's noise"),
        Check("dB of pokes", f"quadrature, {few}, all depths", f"{fine_layers.layers_n} layers for {rule.layers_n}",
              apart(found_T, layers_T), "1", 0.005, "Gauss nodes converge fast: a quarter of what the cells cost"),
    ]  # fmt: skip


def _shortcuts(board: Board, skin: Skin, depths_m: tuple[float, ...]) -> list[Check]:
    checks = []
    for depth_m, kind in ((min(depths_m), "shallowest"), (max(depths_m), "deepest")):
        pokes_m = _each_depth(PLACES_M, (depth_m,))
        _, found_T = changes_of_field(board, skin, pokes_m)
        before_T = field_of((skin.nodes_m, skin.moments_A_m2), board.chips_m)
        moved = [reference.moved_dipoles(skin, poke_m, REFERENCE_STEPS_N) for poke_m in pokes_m]
        truth_T = np.stack([field_of(one, board.chips_m) - before_T for one in moved])
        checks.append(
            Check("dB of pokes", f"table, steps and kernel, {kind} depth ({depth_m / milli:g} mm)",
                  f"each node followed in {REFERENCE_STEPS_N} steps, F = R U by SVD, magpylib's dipoles",
                  apart(found_T, truth_T), "1", 0.02,
                  "2 % is what an indentation may be wrong by in all (steps, table, kernel; DESIGN 6)")
        )  # fmt: skip
    return checks


def _symmetries(board: Board, skin: Skin, polarity: str) -> list[Check]:
    depth_m = 0.3 * skin.thickness_m
    sign = -1 if polarity == "checkerboard" else 1  # a quarter turn, or a mirror in x, swaps a checkerboard's poles
    turn, mirror = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.diag([-1.0, 1.0, 1.0])
    shift_m = np.array([0.4, -0.7, 0.0]) * milli
    pokes_m = _each_depth(PLACES_M, (depth_m,))
    here_T = _change(board.chips_m, skin, pokes_m)
    turned_T = _change(board.chips_m @ turn.T, skin, pokes_m @ turn.T)
    mirrored_T = _change(board.chips_m @ mirror, skin, pokes_m @ mirror)
    shifted = Skin(**{**skin.__dict__, "nodes_m": skin.nodes_m + shift_m, "seat_m": skin.seat_m + shift_m[:2]})
    shifted_T = _change(board.chips_m + shift_m, shifted, pokes_m + shift_m)
    rounding = "rounding; no term may know a direction"
    name = f"dB of pokes, {polarity}"
    return [
        Check(name, "a quarter turn of board and poke", "itself, turned", worst(turned_T, sign * here_T @ turn.T), "1",
              1e-9, rounding),
        Check(name, "a mirror image of board and poke", "itself, mirrored",
              worst(mirrored_T, sign * here_T @ mirror), "1", 1e-9, rounding),
        Check(name, "skin, poke and chips moved together", "itself", worst(shifted_T, here_T), "1", 1e-9, rounding),
    ]  # fmt: skip


def _amplitude(board: Board, spreads: Spreads, *, skin: SkinDesign, seed: int) -> list[Check]:
    designs = skin, skin.model_copy(update={"saturation_T": 2.5 * skin.saturation_T})
    pokes_m = _each_depth(PLACES_M, (0.3 * skin.thickness_mm * milli,))
    once_T, more_T = (
        _change(board.chips_m, draw_skin(one, spreads, seed=seed, name="b0_s0", rule=COARSE), pokes_m)
        for one in designs
    )
    return [
        Check("dB of pokes", "proportional to the magnetisation", "itself, 2.5 times", worst(more_T, 2.5 * once_T), "1",
              1e-12, "rounding")
    ]  # fmt: skip


def _change(
    chips_m: Float[np.ndarray, "k 3"], skin: Skin, pokes_m: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n k 3"]:
    eyes = np.tile(np.eye(3), (len(chips_m), 1, 1))
    return changes_of_field(Board("bare", chips_m, eyes, eyes, np.zeros_like(chips_m)), skin, pokes_m)[1]


def _grid_m() -> Float[np.ndarray, "n 2"]:
    plan = protocol((1.0,), 1)
    return np.column_stack([plan.x_mm - CENTRE_MM, plan.y_mm - CENTRE_MM]) * milli


def _each_depth(places_m: Float[np.ndarray, "p 2"], depths_m: tuple[float, ...]) -> Float[np.ndarray, "n 3"]:
    return np.column_stack([np.tile(places_m, (len(depths_m), 1)), np.repeat(depths_m, len(places_m))])
