"""Laws of the change of field under a poke, the network's input. In: boards, skins, depths. Out: checks.

Judged on dB and never on the field at rest (PHYSICS 0). Refuses to know the chips' electronics.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.constants import micro, milli

from pipeline.experiments.verification import kinematics
from pipeline.experiments.verification.checks import Check, apart, no_spread, worst
from pipeline.experiments.verification.field import TURN, field_of
from reskin.data.grid import CENTRE_MM, protocol
from reskin.physics.board import Board, BoardDesign, Spreads, draw_board
from reskin.physics.magnet import Polarity, Quadrature
from reskin.physics.skin import Skin, SkinDesign, changes_of_field, draw_skin

COARSE = Quadrature(cell_m=2.2e-3, layers_n=4)  # for laws that hold for any rule
DENSE = Quadrature(cell_m=1.5e-3, layers_n=4)  # for what the table and the steps cost
EVERY_PLACE = 5  # of the protocol's 65
REFERENCE_STEPS_N = 16
UNSEEN_uT = 1.0  # a third of a chip's noise, to which it adds 5 %, as squares add
PLACES_M = np.array([[1.1, -2.3], [-4.2, 0.7], [5.3, 6.1]]) * milli  # on no node's axis
Places = Float[np.ndarray, "p 2"]


def check_poke(
    board: BoardDesign, spreads: Spreads, *, skin: SkinDesign, rule: Quadrature, depths_m: tuple[float, ...], seed: int
) -> list[Check]:
    """Check dB on a scene's own first skin, and its symmetries on the design without spreads."""
    drawn, exact = draw_board(board, spreads, seed=seed, name="b0"), no_spread(spreads)

    def skin_of(rule: Quadrature, design: SkinDesign = skin, spreads: Spreads = spreads) -> Skin:
        return draw_skin(design, spreads, seed=seed, name="b0_s0", rule=rule)

    cells, layers = Quadrature(rule.cell_m / 2, rule.layers_n), Quadrature(rule.cell_m, 2 * rule.layers_n)
    fine, stronger = (
        (skin_of(cells), skin_of(layers)),
        skin.model_copy(update={"saturation_T": 2.5 * skin.saturation_T}),
    )
    dense = skin_of(DENSE)
    # A rig's arm gives in one direction: no symmetry is to be expected of that.
    even = (
        skin
        if skin.hold is None
        else skin.model_copy(update={"hold": skin.hold.model_copy(update={"give_um": (0.0, 0.0)})})
    )
    return [
        *quadrature(drawn, skin_of(rule), fine, rules=(rule, cells, layers), pokes_m=each_depth(_grid_m(), depths_m)),
        shortcuts(drawn, dense, min(depths_m), "shallowest"), shortcuts(drawn, dense, max(depths_m), "deepest"),
        *symmetries(draw_board(board, exact, seed=seed, name="b0"), skin_of(COARSE, even, exact), skin.polarity),
        amplitude(drawn, skin_of(COARSE), skin_of(COARSE, stronger),
                  pokes_m=each_depth(PLACES_M, (0.3 * skin.thickness_mm * milli,))),
    ]  # fmt: skip


def quadrature(
    board: Board,
    skin: Skin,
    fine: tuple[Skin, Skin],
    *,
    rules: tuple[Quadrature, Quadrature, Quadrature],
    pokes_m: Float[np.ndarray, "n 3"],
    unseen_uT: float = UNSEEN_uT,
) -> list[Check]:
    """Compare dB of a skin with that of the same skin on narrower cells, and on more layers."""
    found_T, cells_T, layers_T = (changes_of_field(board, each, pokes_m)[1] for each in (skin, *fine))
    size_T = np.linalg.norm(cells_T, axis=(1, 2), keepdims=True)
    allowed_T = np.maximum(0.02 * size_T, unseen_uT * micro)
    used, cells, layers = rules
    narrower = f"cells of {cells.cell_m / milli:g} mm for {used.cell_m / milli:g} mm"
    few = f"{len(np.unique(pokes_m[:, :2], axis=0))} places of the protocol"
    return [
        Check("dB of pokes", f"quadrature, {few}, all depths", narrower, apart(found_T, cells_T), "1", 0.02,
              "2 % is what an indentation may be wrong by in all (DESIGN 6)"),
        Check("dB of pokes", f"quadrature, {few}, each channel of each poke", narrower,
              float((np.abs(found_T - cells_T) / allowed_T).max()), "of the allowed", 1.0,
              f"2 % of the poke's dB, or {unseen_uT:g} uT where that is more: a third of a chip's noise"),
        Check("dB of pokes", f"quadrature, {few}, all depths", f"{layers.layers_n} layers for {used.layers_n}",
              apart(found_T, layers_T), "1", 0.005, "Gauss nodes converge fast: a quarter of what the cells cost"),
    ]  # fmt: skip


def shortcuts(board: Board, skin: Skin, depth_m: float, kind: str, places_m: Places = PLACES_M) -> Check:
    """Compare dB with that of magpylib's dipoles, each followed by itself."""
    pokes_m = each_depth(places_m, (depth_m,))
    _, found_T = changes_of_field(board, skin, pokes_m)
    before_T = field_of((skin.nodes_m, skin.moments_A_m2), board.chips_m)
    depths_m = kinematics.descent(depth_m + skin.depth_zero_m, REFERENCE_STEPS_N)
    moved = [kinematics.followed(skin, place_m, depths_m) for place_m in places_m]
    truth_T = np.stack([field_of(dipoles, board.chips_m) - before_T for dipoles in moved])
    return Check("dB of pokes", f"table, steps and kernel, {kind} depth ({depth_m / milli:g} mm)",
                 f"each node followed in {REFERENCE_STEPS_N} steps, F = R U by SVD, magpylib's dipoles",
                 apart(found_T, truth_T), "1", 0.02,
                 "2 % is what an indentation may be wrong by in all (steps, table, kernel; DESIGN 6)")  # fmt: skip


def symmetries(board: Board, skin: Skin, polarity: Polarity, places_m: Places = PLACES_M) -> list[Check]:
    """Turn, mirror and shift board, skin and pokes without spreads; the shift holds for any skin."""
    sign = -1 if polarity == "checkerboard" else 1  # a quarter turn, or a mirror in x, swaps a checkerboard's poles
    mirror, shift_m = np.diag([-1.0, 1.0, 1.0]), np.array([0.4, -0.7, 0.0]) * milli
    pokes_m = each_depth(places_m, (0.3 * skin.thickness_m,))
    here_T = _change(board.chips_m, skin, pokes_m)
    turned_T = _change(board.chips_m @ TURN.T, skin, pokes_m @ TURN.T)
    mirrored_T = _change(board.chips_m @ mirror, skin, pokes_m @ mirror)
    shifted = replace(skin, nodes_m=skin.nodes_m + shift_m, seat_m=skin.seat_m + shift_m[:2])
    shifted_T = _change(board.chips_m + shift_m, shifted, pokes_m + shift_m)
    rounding = "rounding; no term may know a direction"
    name = f"dB of pokes, {polarity}"
    return [
        Check(name, "a quarter turn of board and poke", "itself, turned", worst(turned_T, sign * here_T @ TURN.T), "1",
              1e-9, rounding),
        Check(name, "a mirror image of board and poke", "itself, mirrored",
              worst(mirrored_T, sign * here_T @ mirror), "1", 1e-9, rounding),
        Check(name, "skin, poke and chips moved together", "itself", worst(shifted_T, here_T), "1", 1e-9, rounding),
    ]  # fmt: skip


def amplitude(
    board: Board, skin: Skin, stronger: Skin, *, pokes_m: Float[np.ndarray, "n 3"], factor: float = 2.5
) -> Check:
    """Compare dB with that of a skin that is magnetised so many times as strongly."""
    once_T, more_T = (_change(board.chips_m, each, pokes_m) for each in (skin, stronger))
    return Check("dB of pokes", "proportional to the magnetisation", f"itself, {factor:g} times",
                 worst(more_T, factor * once_T), "1", 1e-12, "rounding")  # fmt: skip


def _change(
    chips_m: Float[np.ndarray, "k 3"], skin: Skin, pokes_m: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n k 3"]:
    eyes = np.tile(np.eye(3), (len(chips_m), 1, 1))
    return changes_of_field(Board("bare", chips_m, eyes, eyes, np.zeros_like(chips_m)), skin, pokes_m)[1]


def _grid_m() -> Places:
    plan = protocol((1.0,), 1)
    return (np.column_stack([plan.x_mm - CENTRE_MM, plan.y_mm - CENTRE_MM]) * milli)[::EVERY_PLACE]


def each_depth(places_m: Places, depths_m: tuple[float, ...]) -> Float[np.ndarray, "n 3"]:
    """List every place at every depth, depth after depth."""
    return np.column_stack([np.tile(places_m, (len(depths_m), 1)), np.repeat(depths_m, len(places_m))])
