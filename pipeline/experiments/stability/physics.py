"""Cases of extreme skins, indentations, drags and time steps."""

from dataclasses import asdict, replace
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy.constants import kilo, micro, milli

from pipeline.experiments.stability.cases import Case, condition_case, error_case, peak_bytes, rejection_case
from pipeline.experiments.verification import mechanics, signals
from pipeline.experiments.verification.checks import scaled_error
from pipeline.experiments.verification.mechanics import force_N
from pipeline.experiments.verification.signals import inside_a_box
from reskin.physics import layer, magnet, shear
from reskin.physics.aging import SKIN_RELAXATION, advance
from reskin.physics.board import Board, BoardDesign, Spreads, draw_board
from reskin.physics.deformation import depth_scale
from reskin.physics.layer import IndentedLayer
from reskin.physics.magnet import CUBE_SIDE_M, Quadrature, change_of_field
from reskin.physics.skin import Skin, SkinDesign, changes_of_field, draw_skin, forces
from reskin.seeds import rng_for
from reskin.simulation.rig import FORCE_RANGE_N, read_force

AREA = "physics"
COARSE = Quadrature(cell_m=2.2e-3, layers_n=4)
PLACES_M = np.array([[1.1, -2.3], [-4.2, 0.7]]) * milli
DEPTH = 0.3  # depth / thickness of the indentations
FLAGGED_DEPTH = 0.6  # depth / thickness; published solutions do not cover larger depths, which are therefore flagged
POKES_N = 2000
BYTES_MAX_N = 1000  # largest memory per poke in bytes (1 GB for 1e6 pokes); the result alone takes 120 bytes
PATH_MM = (0.0, 0.1, 0.5, 4.0)  # displacements at the stops of a straight drag
STICKY = 1e6  # friction coefficient at which the tip never slips
STIFF = signals.stiff(1e8)  # its slowest relaxation time is 1e8 times its fastest


def time_cases() -> list[Case]:
    """Run cases of time steps: steps at which explicit integrators diverge, steps of zero length, and invalid steps."""
    state = np.array([1 / 3, -2e-308, 7e15, 0.0, -0.1])
    same_n = int(np.count_nonzero(advance(state, 0.0, 0.0, SKIN_RELAXATION).view(np.int64) == state.view(np.int64)))
    return [
        _step("tau_max / tau_min 1e8, dt / tau_min 1e8", 1e8, "finite, and the same as with 50 digits (mpmath)"),
        _step("dt / tau_min 1e-16", 1e-16,
              "the same as with 50 digits, because expm1 is used; 1 - exp(-x) would cause an error of 11 %"),
        condition_case("time", "dt = 0", should="the state is unchanged, bit for bit",
                       happened=f"{same_n} of {len(state)} values identical bit for bit", holds=same_n == len(state)),
        *(
            rejection_case("time", f"a time step of {dt_s:g} s", should="an error that states the time step",
                           attempt=partial(advance, signals.STATE, 1.0, dt_s, STIFF))
            for dt_s in (-1 * micro, np.nan, np.inf)
        ),
    ]  # fmt: skip


def _step(case: str, dt_over_fastest: float, should: str) -> Case:
    dt_s = dt_over_fastest * float(STIFF.tau_s[0])
    state, error = advance(signals.STATE, 1.3, dt_s, STIFF), signals.step_error(dt_s, STIFF)
    observed = f"relative error {error:.1e}, {np.count_nonzero(np.isfinite(state))} of {len(state)} values finite"
    return error_case("time", case, should=should, happened=observed, error=error, limit=signals.ROUNDING)


def physics_cases(board: BoardDesign, spreads: Spreads, *, skin: SkinDesign, seed: int) -> list[Case]:
    """Run cases with extreme variants of a scene's first skin, on the scene's first board."""
    drawn_board = draw_board(board, spreads, seed=seed, name="b0")

    def skin_of(spread: Spreads = spreads, name: str = "b0_s0", **changes: float) -> Skin:
        return draw_skin(skin.model_copy(update=changes), spread, seed=seed, name=name, rule=COARSE)

    usual = skin_of()
    return [
        *modulus(drawn_board, usual, *(skin_of(modulus_kPa=modulus_kPa) for modulus_kPa in (0.0, 1e6))),
        *thickness(usual),
        *depth(drawn_board, usual),
        *place(drawn_board, usual),
        *amplitude(drawn_board, usual, skin_of(saturation_T=0.0), skin_of(saturation_T=5 * skin.saturation_T)),
        single_precision(drawn_board, draw_skin(skin, spreads, seed=seed, name="b0_s0")),
        same_seed(usual, skin_of(), skin_of(name="b0_s1")),
        memory(drawn_board, usual),
    ]


def poke(board: Board, skin: Skin, share: float = DEPTH) -> Float[np.ndarray, "n k 3"]:
    """Return dB in tesla of the indentations at `PLACES_M`, to the depth `share` * thickness."""
    return changes_of_field(board, skin, _pokes_m(skin, share))[1]


def _pokes_m(skin: Skin, share: float = DEPTH) -> Float[np.ndarray, "n 3"]:
    return np.column_stack([PLACES_M, np.full(len(PLACES_M), share * skin.thickness_m)])


def modulus(board: Board, usual: Skin, soft: Skin, hard: Skin) -> list[Case]:
    """Run cases of skins with a Young's modulus of zero and with a very high modulus.

    The depth is prescribed, so the modulus affects dB only through the friction under the tip.
    """
    free = replace(usual, hold=None)
    firm = usual if usual.hold is None else replace(usual, hold=replace(usual.hold, friction=1e12))
    free_T, firm_T, soft_T, hard_T = (poke(board, skin) for skin in (free, firm, soft, hard))
    soft_N, hard_N = (forces(skin, _pokes_m(skin)[:, 2]) for skin in (soft, hard))
    pushed_N = np.column_stack([np.zeros((len(hard_N), 2)), hard_N])
    read_N, clipped_n = read_force(pushed_N, noise_N=0.0, rng=rng_for(0, "stability"))
    soft_off_T, hard_off_T = float(np.abs(soft_T - free_T).max()), float(np.abs(hard_T - firm_T).max())
    clipped = clipped_n == len(hard_N) and bool((read_N[:, 2] == FORCE_RANGE_N[2]).all())
    return [
        condition_case(AREA, "a skin without stiffness, E = 0",
                       should="no force, so that the skin does not slide: dB only from the layer's deformation",
                       happened=f"force {np.abs(soft_N).max():g} N; dB differs by {soft_off_T:g} T",
                       holds=not soft_N.any() and soft_off_T == 0),
        condition_case(AREA, "a stiff skin, E = 1 GPa",
                       should="dB as if the tip never slipped; force clipped to the sensor's range and counted as "
                              "clipped",
                       happened=f"dB differs by {hard_off_T:g} T; {hard_N.max():.3g} N read as "
                                f"{read_N[:, 2].max():g} N, {clipped_n} of {len(hard_N)} counted as clipped",
                       holds=hard_off_T == 0 and clipped),
    ]  # fmt: skip


def thickness(usual: Skin) -> list[Case]:
    """Run cases of skins whose thickness is zero or negative."""
    return [
        rejection_case(AREA, f"a thickness of {skin.thickness_m / milli:.2g} mm", should="an error",
                       attempt=partial(forces, skin, np.array([1e-4])))
        for skin in (replace(usual, thickness_m=sign * usual.thickness_m) for sign in (0, -1))
    ]  # fmt: skip


def depth(board: Board, skin: Skin) -> list[Case]:
    """Run cases of a tip above the skin, of deep indentations, and of an indentation through the skin."""
    lifted_T = float(np.abs(poke(board, skin, -0.2)).max())
    lifted_N = float(np.abs(forces(skin, np.array([-0.2 * skin.thickness_m]))).max())
    shares = np.array([0.2, 0.59, FLAGGED_DEPTH, 0.8])
    flagged = layer.beyond_verified(shares * skin.thickness_m, skin.thickness_m)
    given_N = forces(skin, shares * skin.thickness_m)
    return [
        condition_case(AREA, "a tip above the skin, depth < 0", should="dB and force exactly 0",
                       happened=f"dB {lifted_T:g} T, force {lifted_N:g} N", holds=lifted_T == 0 and lifted_N == 0),
        condition_case(AREA, "depths of 0.2, 0.59, 0.6 and 0.8 of the thickness",
                       should="depths of 0.6 or more are flagged, because published solutions do not cover them; the "
                              "force is computed anyway",
                       happened=f"flagged: {', '.join(f'{s:g}' for s in shares[flagged])}; forces "
                                f"{', '.join(f'{n:.3g}' for n in given_N)} N",
                       holds=bool((flagged == (shares >= FLAGGED_DEPTH)).all() and np.isfinite(given_N).all())),
        rejection_case(AREA, "a poke through the skin, depth 1.5 of the thickness", should="an error",
                       attempt=lambda: poke(board, skin, 1.5)),
        _almost_through(board, skin),
    ]  # fmt: skip


def _almost_through(board: Board, skin: Skin) -> Case:
    case, attempt = "a poke to 0.95 of the thickness", partial(poke, board, skin, 0.95)
    followed_m = skin.thickness_m * depth_scale(skin.tip_radius_m / skin.thickness_m)
    if skin.base == "bonded" or 0.95 * skin.thickness_m + skin.depth_zero_m > followed_m:
        should = "an error, because the deformation cannot be computed"
        return rejection_case(AREA, case, should=should, attempt=attempt)
    largest_uT = float(np.abs(attempt()).max() / micro)
    beyond = bool(layer.beyond_verified(np.array([0.95 * skin.thickness_m]), skin.thickness_m).all())
    return condition_case(AREA, case, should="finite on a sliding base; counted as deeper than 0.6 of the thickness",
                          happened=f"dB at most {largest_uT:.3g} uT; counted: {'yes' if beyond else 'no'}",
                          holds=beyond and 0 < largest_uT < np.inf)  # fmt: skip


def place(board: Board, skin: Skin) -> list[Case]:
    """Run cases of a poke beside the skin, a place inside a magnet, and a chip at the position of a dipole."""
    inside_m = CUBE_SIDE_M * rng_for(0, "stability", "inside").uniform(-0.5, 0.5, (500, 3))
    error = inside_a_box(inside_m, CUBE_SIDE_M)
    beside_m = np.array([[skin.seat_m[0] + 0.51 * skin.sides_m[0], skin.seat_m[1], DEPTH * skin.thickness_m]])
    on_dipoles = replace(board, chips_m=skin.nodes_m[: len(board.chips_m)].copy())
    return [
        rejection_case(AREA, "a poke beside the skin, 0.2 mm past its edge",
                       should="an error, because no field can be computed there",
                       attempt=lambda: changes_of_field(board, skin, beside_m)),
        error_case(AREA, "a place inside a magnet of the array", should="the same field as magpylib",
                   happened=f"{len(inside_m)} places, relative error {error:.1e}", error=error, limit=1e-12),
        rejection_case(AREA, "a chip on a dipole, r = 0", should="an error", attempt=lambda: poke(on_dipoles, skin)),
    ]  # fmt: skip


def amplitude(board: Board, usual: Skin, bare: Skin, strong: Skin) -> list[Case]:
    """Run cases of a skin without magnetisation, and of a skin with five times the usual magnetisation."""
    once_T, bare_T, strong_T = (poke(board, skin) for skin in (usual, bare, strong))
    error, left_T = scaled_error(strong_T, 5 * once_T), float(np.abs(bare_T).max())
    return [
        condition_case(AREA, "a skin without magnetisation", should="dB is exactly 0", happened=f"at most {left_T:g} T",
                       holds=left_T == 0),
        error_case(AREA, "five times the magnetisation", should="dB is five times as large",
                   happened=f"relative error {error:.1e}", error=error, limit=1e-12),
    ]  # fmt: skip


def single_precision(board: Board, fine: Skin) -> Case:
    """Run a case that compares dB computed in float32 with dB computed in float64."""
    rest = fine.nodes_m, fine.moments_A_m2
    depths_m = mechanics.descent(0.5 * fine.thickness_m + fine.depth_zero_m, 1)
    moved = mechanics.follow_dipoles(fine, PLACES_M[0], depths_m)
    double_T = change_of_field(rest, moved, board.chips_m)
    x, m, moved_x, moved_m, chips = (array.astype(np.float32) for array in (*rest, *moved, board.chips_m))
    # Fields are subtracted node by node, as in the simulator, because the difference of two large sums would lose more
    # digits.
    each_T = magnet.field_of_each(moved_x, moved_m, chips) - magnet.field_of_each(x, m, chips)
    single_T = each_T.sum(axis=1)
    error_uT = float(np.abs(single_T - double_T).max() / micro)
    largest_uT = np.abs(double_T).max() / micro
    observed = f"{single_T.dtype}, {len(x)} dipoles: error {error_uT:.1e} uT, largest dB {largest_uT:.3g} uT"
    should = "within 0.25 uT of double precision, which is a tenth of a chip's noise"
    return error_case(AREA, "dB in single precision", should=should,
                      happened=observed, error=error_uT, limit=0.25)  # fmt: skip


def same_seed(first: Skin, again: Skin, renamed: Skin) -> Case:
    """Run a case of three skins drawn from one seed: two have the same name, and one has another name."""
    bytes_of = [skin.nodes_m.tobytes() + skin.moments_A_m2.tobytes() for skin in (first, again, renamed)]
    same, differs = bytes_of[0] == bytes_of[1], bytes_of[0] != bytes_of[2]
    words = {True: "the same bytes", False: "other bytes"}
    return condition_case(AREA, "a skin drawn twice with the same seed and name",
                          should="the same skin, bit for bit; another skin for another name",
                          happened=f"same name: {words[same]}; another name: {words[not differs]}",
                          holds=same and differs)  # fmt: skip


def memory(board: Board, skin: Skin) -> Case:
    """Run a case of the memory per poke, from the peak memories for `POKES_N` and for 4 * `POKES_N` pokes."""
    rng = rng_for(0, "stability", "memory")
    pokes_m = np.column_stack(
        [rng.uniform(-8e-3, 8e-3, (4 * POKES_N, 2)), np.full(4 * POKES_N, DEPTH * skin.thickness_m)]
    )
    changes_of_field(board, skin, pokes_m[:1])  # computes and caches tables, whose memory must not be counted
    few_n, many_n = (peak_bytes(partial(changes_of_field, board, skin, pokes_m[:n])) for n in (POKES_N, 4 * POKES_N))
    per_poke_n = float(round((many_n - few_n) / (3 * POKES_N)))  # rounded, because the total varies by a few bytes
    observed = (
        f"{POKES_N} pokes {few_n / 1e6:.2f} MB, {4 * POKES_N} pokes {many_n / 1e6:.2f} MB: {per_poke_n:.0f} bytes per "
        f"poke including the results, or {per_poke_n:.0f} MB for 1e6 pokes"
    )
    return error_case(AREA, "memory for 1e6 pokes", should=f"memory grows by at most {BYTES_MAX_N} bytes per poke",
                      happened=observed, error=per_poke_n, limit=float(BYTES_MAX_N))  # fmt: skip


def drag_cases(skin: SkinDesign) -> list[Case]:
    """Run cases of drags along a line: without friction, and with so much friction that the tip never slips."""
    press = IndentedLayer(skin.thickness_mm * milli, skin.tip_radius_mm * milli, skin.base)
    depth_m, modulus_Pa = DEPTH * press.thickness_m, skin.modulus_kPa * kilo
    stiffness = modulus_Pa / 3 * shear.tabulate_depth(depth_m, **asdict(press)).stiffness_m
    normal_N = force_N(np.full(len(PATH_MM), depth_m), press, modulus_Pa)
    path_m = np.column_stack([np.array(PATH_MM) * milli, np.zeros(len(PATH_MM))])
    smooth, sticky = (
        shear.drag_force(path_m, normal_N, stiffness_N_per_m=stiffness, friction=mu).force_N for mu in (0.0, STICKY)
    )
    error = float(np.abs(sticky[:, 0] - stiffness * path_m[:, 0]).max() / sticky.max())
    return [
        condition_case(AREA, "a drag without friction", should="the tangential force is exactly 0",
                       happened=f"at most {np.abs(smooth).max():g} N over {PATH_MM[-1]:g} mm", holds=not smooth.any()),
        error_case(AREA, f"a drag with a coefficient of friction of {STICKY:g}",
                   should="the tip sticks: force is stiffness times displacement",
                   happened=f"{sticky.max():.3g} N over {PATH_MM[-1]:g} mm, relative error {error:.1e}",
                   error=error, limit=1e-12),
    ]  # fmt: skip
