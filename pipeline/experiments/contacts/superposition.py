"""How far the field of two contacts is from the sum of their own. In: a scene's synthesis, distances. Out: numbers.

The second contact displaces material that the first has moved; tips that would touch each other, or lower the surface
under each other, are not followed. Nor is the slide of the skin as one (`slide`): what two tips that hold it do is not
known. Refuses to know readings, noise and networks.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.constants import milli

from reskin.physics import flow_map
from reskin.physics.board import Board, draw_board
from reskin.physics.magnet import change_of_field
from reskin.physics.skin import Dipoles, Skin, draw_skin
from reskin.seeds import rng_for
from reskin.simulation.capture import roster
from reskin.simulation.settings import MAIN, Synthesis

PAIRS_N = 6  # of each distance, drawn
MIDDLE_MM = 2.0  # a pair's middle lies so near the skin's, each axis
HEIGHTS_N = 9  # over the thickness, between which the second contact's flow is interpolated linearly


def superposition(of: Synthesis, separations_mm: Sequence[float], *, seed: int) -> list[dict[str, Any]]:
    """Press the scene's first skin twice, half as deep as its protocol goes and all: rms error of the sum."""
    board_name, skin_name = roster(of, MAIN)[0]
    board = draw_board(of.main_boards.design, of.spreads, seed=seed, name=board_name)
    rule = of.main_boards.quadrature.quadrature()
    skin = draw_skin(of.skin, of.spreads, seed=seed, name=skin_name, rule=rule)
    rng = rng_for(seed, "superposition")
    middles_mm, angles = rng.uniform(-MIDDLE_MM, MIDDLE_MM, (PAIRS_N, 2)), rng.uniform(0, np.pi, PAIRS_N)
    ways = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rows = []
    for depth_mm in (max(of.main.depths_mm) / 2, max(of.main.depths_mm)):
        depth_m = np.full(PAIRS_N, depth_mm * milli + skin.depth_zero_m)
        for separation_mm in separations_mm:
            half_mm = separation_mm / 2 * ways
            ends_m = [
                np.column_stack([at_mm * milli, depth_m]) for at_mm in (middles_mm - half_mm, middles_mm + half_mm)
            ]
            changes_T = np.array([_together(board, skin, *pair) for pair in zip(*ends_m, strict=True)])
            words = {"depth_mm": depth_mm, "separation_mm": separation_mm, "pairs_n": PAIRS_N}
            rows.append(words | _errors(changes_T))
    return rows


def press_on(skin: Skin, dipoles: Dipoles, poke_m: Float[np.ndarray, "3"]) -> Dipoles:
    """Displace and turn dipoles, moved or at rest, as a poke (x, y, true depth) displaces what lies where they are."""
    nodes_m, moments_A_m2 = dipoles
    heights = np.linspace(0, 1, HEIGHTS_N)
    at = nodes_m[:, 2] / skin.thickness_m * (HEIGHTS_N - 1)
    low = np.clip(at.astype(np.intp), 0, HEIGHTS_N - 2)
    share = (at - low)[:, None]
    table = flow_map.tabulate(
        skin.thickness_m, skin.tip_radius_m, float(poke_m[2]), heights=tuple(heights.tolist()), base=skin.base
    )
    below, above = (
        flow_map.move(table, flow_map.Rest(nodes_m, moments_A_m2, low + i, tuple(heights)), poke_m) for i in (0, 1)
    )
    after_m, turned_A_m2 = nodes_m.copy(), moments_A_m2.copy()
    near = share[below.i]
    after_m[below.i] = (1 - near) * below.after[0] + near * above.after[0]
    turned_A_m2[below.i] = (1 - near) * below.after[1] + near * above.after[1]
    return after_m, turned_A_m2


def _together(
    board: Board, skin: Skin, a_m: Float[np.ndarray, "3"], b_m: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 k 3"]:
    # What a and b change alone, then a before b and b before a.
    rest = skin.nodes_m, skin.moments_A_m2
    only_a, only_b = press_on(skin, rest, a_m), press_on(skin, rest, b_m)
    pressed = (only_a, only_b, press_on(skin, only_a, b_m), press_on(skin, only_b, a_m))
    return np.stack([change_of_field(rest, after, board.chips_m) for after in pressed])


def _errors(changes_T: Float[np.ndarray, "p 4 k 3"]) -> dict[str, float]:
    a, b, ab, ba = np.moveaxis(changes_T, 1, 0)
    together = (ab + ba) / 2
    size = np.sqrt((together**2).mean())
    return {
        "error_pct": 100 * float(np.sqrt(((a + b - together) ** 2).mean()) / size),
        "orders_differ_pct": 100 * float(np.sqrt(((ab - ba) ** 2).mean()) / size),
    }
