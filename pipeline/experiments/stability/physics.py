"""Extreme skins and pokes (PHYSICS 10). In: a scene's designs. Out: cases.

Refuses to know chips' electronics, bytes and drags.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy.constants import micro, milli

from pipeline.core.seeds import rng_for
from pipeline.experiments.stability.cases import Case, measured, peak_bytes, refused, told
from pipeline.experiments.verification import reference
from pipeline.experiments.verification.checks import no_spread, worst
from pipeline.physics import dipole, layer
from pipeline.physics.board import Board, BoardDesign, Spreads, draw_board
from pipeline.physics.change import change_of_field
from pipeline.physics.force_sensor import RANGE_N, read_force
from pipeline.physics.nodes import Quadrature
from pipeline.physics.skin import Skin, SkinDesign, changes_of_field, draw_skin, forces

AREA = "physics"
COARSE = Quadrature(cell_m=2.2e-3, layers_n=4)
PLACES_M = np.array([[1.1, -2.3], [-4.2, 0.7]]) * milli
DEPTH = 0.3  # of the thickness
FLAGGED_DEPTH = 0.6  # of the thickness (PHYSICS 10)
POKES_N = 2000
BYTES_MAX_N = 1000  # a poke: 1e6 pokes in 1 GB, 120 bytes of each its result


def survey_physics(board: BoardDesign, spreads: Spreads, *, skin: SkinDesign, seed: int) -> list[Case]:
    """Try a scene's first skin on its first board, and what else it might have been."""
    drawn = draw_board(board, spreads, seed=seed, name="b0")

    def skin_of(spread: Spreads = spreads, name: str = "b0_s0", **changes: float) -> Skin:
        return draw_skin(skin.model_copy(update=changes), spread, seed=seed, name=name, rule=COARSE)

    one = skin_of()
    return [
        *_modulus(drawn, one, *(skin_of(modulus_kPa=modulus_kPa) for modulus_kPa in (0.0, 1e6))),
        *_thickness(drawn, one, skin_of(no_spread(spreads), thickness_mm=0.2)),
        *_depth(drawn, one),
        *_place(drawn, one),
        *_amplitude(drawn, one, skin_of(saturation_T=0.0), skin_of(saturation_T=5 * skin.saturation_T)),
        _single_precision(drawn, draw_skin(skin, spreads, seed=seed, name="b0_s0")),
        _same_seed(one, skin_of(), skin_of(name="b0_s1")),
        _memory(drawn, one),
    ]


def _pokes_m(skin: Skin) -> Float[np.ndarray, "n 3"]:
    return np.column_stack([PLACES_M, np.full(len(PLACES_M), DEPTH * skin.thickness_m)])


def _change(board: Board, skin: Skin) -> Float[np.ndarray, "n k 3"]:
    return changes_of_field(board, skin, _pokes_m(skin))[1]


def _modulus(board: Board, one: Skin, soft: Skin, hard: Skin) -> list[Case]:
    usual_T, soft_T, hard_T = (_change(board, skin) for skin in (one, soft, hard))
    soft_N, hard_N = (forces(skin, _pokes_m(skin)[:, 2]) for skin in (soft, hard))
    force_N = np.column_stack([np.zeros((len(hard_N), 2)), hard_N])
    read_N, clipped_n = read_force(force_N, noise_N=0.0, rng=rng_for(0, "stability"))
    soft_off_T, hard_off_T = (float(np.abs(of_T - usual_T).max()) for of_T in (soft_T, hard_T))
    held = clipped_n == len(hard_N) and bool((read_N[:, 2] == RANGE_N[2]).all())
    return [
        told(AREA, "a skin of no stiffness, E = 0", should="no force at all; dB as ever: the depth is prescribed",
             happened=f"force {np.abs(soft_N).max():g} N; dB differs by {soft_off_T:g} T",
             holds=not soft_N.any() and soft_off_T == 0),
        told(AREA, "a stiff skin, E = 1 GPa", should="dB as ever; force held at the sensor's range, and counted",
             happened=f"dB differs by {hard_off_T:g} T; {hard_N.max():.3g} N read as {read_N[:, 2].max():g} N, "
                      f"{clipped_n} of {len(hard_N)} counted as clipped",
             holds=hard_off_T == 0 and held),
    ]  # fmt: skip


def _thickness(board: Board, one: Skin, thin: Skin) -> list[Case]:
    change_T, force_N = _change(board, thin), forces(thin, _pokes_m(thin)[:, 2])
    impossible = [replace(one, thickness_m=sign * one.thickness_m) for sign in (0, -1)]
    finite = bool(np.isfinite(change_T).all() and np.isfinite(force_N).all())
    return [
        *(
            refused(AREA, f"a thickness of {skin.thickness_m / milli:.2g} mm", should="refused",
                    attempt=partial(forces, skin, np.array([1e-4])))
            for skin in impossible
        ),
        told(AREA, "a thickness of 0.2 mm", should="finite force and finite dB",
             happened=f"{force_N.max():.3g} N and at most {np.abs(change_T).max() / micro:.3g} uT at "
                      f"{_pokes_m(thin)[0, 2] / milli:g} mm; " + ("all finite" if finite else "not all finite"),
             holds=finite),
    ]  # fmt: skip


def _depth(board: Board, one: Skin) -> list[Case]:
    def poke(share: float) -> Float[np.ndarray, "n k 3"]:
        pokes_m = np.column_stack([PLACES_M, np.full(len(PLACES_M), share * one.thickness_m)])
        return changes_of_field(board, one, pokes_m)[1]

    lifted_T = float(np.abs(poke(-0.2)).max())
    lifted_N = float(np.abs(forces(one, np.array([-0.2 * one.thickness_m]))).max())
    shares = np.array([0.2, 0.59, FLAGGED_DEPTH, 0.8])
    flagged = layer.beyond_verified(shares * one.thickness_m, one.thickness_m)
    force_N = forces(one, shares * one.thickness_m)
    return [
        told(AREA, "a tip above the skin, depth < 0", should="dB and force exactly 0",
             happened=f"dB {lifted_T:g} T, force {lifted_N:g} N", holds=lifted_T == 0 and lifted_N == 0),
        told(AREA, "depths of 0.2, 0.59, 0.6 and 0.8 of the thickness",
             should="flagged from 0.6 on, where no published solution vouches; the force is given all the same",
             happened=f"flagged: {', '.join(f'{s:g}' for s in shares[flagged])}; forces "
                      f"{', '.join(f'{n:.3g}' for n in force_N)} N",
             holds=bool((flagged == (shares >= FLAGGED_DEPTH)).all() and np.isfinite(force_N).all())),
        refused(AREA, "a poke through the skin, depth 1.5 of the thickness", should="refused",
                attempt=lambda: poke(1.5)),
        _almost_through(poke, one),
    ]  # fmt: skip


def _almost_through(poke: Callable[[float], Float[np.ndarray, "n k 3"]], one: Skin) -> Case:
    case = "a poke to 0.95 of the thickness"
    if one.base == "bonded":
        return refused(AREA, case, should="refused, before the map folds or loses volume", attempt=lambda: poke(0.95))
    largest_uT = float(np.abs(poke(0.95)).max() / micro)
    beyond = bool(layer.beyond_verified(np.array([0.95 * one.thickness_m]), one.thickness_m).all())
    return told(AREA, case, should="finite, for a sliding skin keeps its volume there; counted as beyond 0.6",
                happened=f"dB of at most {largest_uT:.3g} uT; counted: {'yes' if beyond else 'no'}",
                holds=beyond and 0 < largest_uT < np.inf)  # fmt: skip


def _place(board: Board, one: Skin) -> list[Case]:
    from magpylib.magnet import Cuboid

    from pipeline.physics import magnet

    inside_m = magnet.CUBE_SIDE_M * rng_for(0, "stability", "inside").uniform(-0.5, 0.5, (500, 3))
    sides_m = (magnet.CUBE_SIDE_M,) * 3
    found_T = magnet.cuboid_field(inside_m, 1.0, sides_m=sides_m)
    error = worst(found_T, Cuboid(polarization=(0, 0, 1.0), dimension=sides_m).getB(inside_m))
    beside_m = np.array([[one.seat_m[0] + 0.51 * one.sides_m[0], one.seat_m[1], DEPTH * one.thickness_m]])
    on_dipoles = replace(board, chips_m=one.nodes_m[: len(board.chips_m)].copy())
    return [
        refused(AREA, "a poke beside the skin, 0.2 mm past its edge",
                should="refused, never extrapolated: a flagged reading would need a field",
                attempt=lambda: changes_of_field(board, one, beside_m)),
        measured(AREA, "a place inside a magnet of the array", should="the field of the box, J included: as magpylib",
                 happened=f"{len(inside_m)} places, relative error {error:.1e}", error=error, limit=1e-12),
        refused(AREA, "a chip on a dipole, r = 0", should="refused", attempt=lambda: _change(on_dipoles, one)),
    ]  # fmt: skip


def _amplitude(board: Board, one: Skin, bare: Skin, strong: Skin) -> list[Case]:
    once_T, bare_T, strong_T = (_change(board, skin) for skin in (one, bare, strong))
    error = worst(strong_T, 5 * once_T)
    left_T = float(np.abs(bare_T).max())
    return [
        told(AREA, "a skin without magnetisation", should="dB exactly 0", happened=f"at most {left_T:g} T",
             holds=left_T == 0),
        measured(AREA, "five times the magnetisation", should="five times dB", happened=f"relative error {error:.1e}",
                 error=error, limit=1e-12),
    ]  # fmt: skip


def _single_precision(board: Board, fine: Skin) -> Case:
    rest = fine.nodes_m, fine.moments_A_m2
    moved = reference.moved_dipoles(fine, np.array([*PLACES_M[0], 0.5 * fine.thickness_m]), steps_n=1)
    double_T = change_of_field(rest, moved, board.chips_m)
    (x, m), (moved_x, moved_m), chips = rest, moved, board.chips_m
    x, m, moved_x, moved_m, chips = (part.astype(np.float32) for part in (x, m, moved_x, moved_m, chips))
    # Node by node, as the product does: the difference of two large sums would lose more.
    each_T = dipole.field_of_each(moved_x, moved_m, chips) - dipole.field_of_each(x, m, chips)
    single_T = each_T.sum(axis=1)
    error_uT = float(np.abs(single_T - double_T).max() / micro)
    happened = f"{single_T.dtype}, {len(x)} dipoles: {error_uT:.1e} uT off, of {np.abs(double_T).max() / micro:.3g} uT"
    return measured(AREA, "dB in single precision", should="within 0.25 uT of double: a tenth of a chip's noise",
                    happened=happened, error=error_uT, limit=0.25)  # fmt: skip


def _same_seed(one: Skin, again: Skin, other: Skin) -> Case:
    first, second, third = (skin.nodes_m.tobytes() + skin.moments_A_m2.tobytes() for skin in (one, again, other))
    same, differs = first == second, first != third
    words = {True: "the same bytes", False: "other bytes"}
    happened = f"drawn again: {words[same]}; by another name: {words[not differs]}"
    return told(AREA, "the same seed and name", should="the same bytes; another skin for another name",
                happened=happened, holds=same and differs)  # fmt: skip


def _memory(board: Board, one: Skin) -> Case:
    rng = rng_for(0, "stability", "memory")
    places_m = np.column_stack(
        [rng.uniform(-8e-3, 8e-3, (4 * POKES_N, 2)), np.full(4 * POKES_N, DEPTH * one.thickness_m)]
    )
    changes_of_field(board, one, places_m[:1])  # the table is made once for all
    few_n, many_n = (peak_bytes(partial(changes_of_field, board, one, places_m[:n])) for n in (POKES_N, 4 * POKES_N))
    each_n = (many_n - few_n) / (3 * POKES_N)
    happened = (
        f"{POKES_N} pokes {few_n / 1e6:.2f} MB, {4 * POKES_N} pokes {many_n / 1e6:.2f} MB: {each_n:.0f} bytes a poke, "
        f"results included, {each_n:.0f} MB for 1e6"
    )
    return measured(AREA, "1e6 pokes", should=f"memory grows by no more than {BYTES_MAX_N} bytes a poke",
                    happened=happened, error=each_n, limit=float(BYTES_MAX_N))  # fmt: skip
