"""Tests of experiment runtime, which compares errors and run times of numerical methods.

The methods are quadratures (sums over the nodes of a skin) and integrators (of the relaxation over time). They are
compared with closed forms.
"""

from dataclasses import replace
from itertools import accumulate

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.constants import mu_0
from scipy.integrate import quad

from pipeline.experiments import runtime
from pipeline.experiments.runtime import (
    ALL,
    CANDIDATES,
    ERROR_MAX,
    EULER,
    EXACT,
    METHODS,
    REFERENCE,
    SOLVERS,
    Indentations,
    Integrators,
    NodePath,
    Precision,
    Reference,
    TimedCall,
    Trial,
    box_m,
    choose,
    draw_trial,
    errors,
    gauss_everywhere,
    midpoints,
    paths,
    prepare,
    repeated_presses,
    rule_name,
    study_integrators,
    study_quadratures,
    time_calls,
    with_nodes,
)
from pipeline.experiments.verification.signals import hereditary
from reskin.errors import ParamsError
from reskin.physics import deformation, layer
from reskin.physics.aging import SKIN_RELAXATION
from reskin.physics.magnet import DEFAULT_QUADRATURE, SKIN_SIDE_M, Quadrature, cuboid_field, place_nodes
from reskin.physics.skin import draw_skin
from tests.physics.test_board import design as board_design
from tests.physics.test_board import draw_board, no_spread, spreads
from tests.physics.test_skin import design

BOARD = draw_board(board_design(), no_spread(), seed=0, name="b0")
POKES = Indentations(places_mm=((6.35, 0.0), (-2.0, 5.0)), depths_mm=(0.6, 1.2))
COARSE = Quadrature(1e-3, 4)


def trial(board=BOARD, pokes=POKES, name="s0", **spread) -> Trial:
    return draw_trial(board, design(), spreads=spreads(**spread), seed=0, name=name, pokes=pokes)


def rules(*sizes) -> tuple[Quadrature, ...]:
    return tuple(Quadrature(1e-3 * cell_mm, layers_n) for cell_mm, layers_n in sizes)


TRIED = {
    "Gauss in z": rules((2, 6), (1, 6), (0.5, 4), (0.5, 6)),
    "midpoint": rules((0.5, 4), (0.5, 8)),
    "Gauss in x, y and z": rules((2, 6), (1, 6)),
    "kernel alone": rules((1, 4)),
    "magpylib.core dipoles": rules((1, 4)),
    "magpylib dipoles": rules((1, 4)),
    "magpylib cuboids": rules((2, 2), (1, 4)),
}


@pytest.fixture(scope="module")
def quadratures():
    reference = Reference(coarser=Quadrature(1e-3, 8), finer=Quadrature(0.7e-3, 8), per_cell_n=3)
    return study_quadratures([trial()], TRIED, reference)


def error_of(rows, method, cell_mm=None, layers_n=None) -> float:
    setting = None if cell_mm is None else rule_name(Quadrature(1e-3 * cell_mm, layers_n))
    (row,) = [row for row in rows if row.method == method and setting in (None, row.setting)]
    return row.error


def test_skin_built_with_a_quadrature_equals_the_simulated_skin():
    even = spreads(skin_amplitude=0.0, skin_filler=0.0, skin_rotation_deg=0.0)
    drawn = draw_skin(design(), even, seed=0, name="s3", rule=COARSE)
    ours = with_nodes(trial(name="s3"), place_nodes(drawn.thickness_m, COARSE))
    np.testing.assert_array_equal(ours.nodes_m, drawn.nodes_m)
    # Without spreads, all factors of the amplitude are 1.
    np.testing.assert_allclose(ours.moments_A_m2, drawn.moments_A_m2, rtol=1e-14)
    assert (ours.seat_m == drawn.seat_m).all()
    assert ours.depth_zero_m == drawn.depth_zero_m


def test_pokes_are_at_fixed_places_relative_to_the_shifted_skin():
    one = trial(skin_seat_mm=1.0)
    assert np.abs(one.skin.seat_m).min() > 0
    places_mm = 1e3 * (one.pokes_m[:, :2] - one.skin.seat_m)
    np.testing.assert_allclose(places_mm, POKES.places_mm * 2, atol=1e-12)
    np.testing.assert_allclose(1e3 * one.pokes_m[:, 2], [0.6, 0.6, 1.2, 1.2])


def test_poke_that_does_not_touch_the_skin_is_refused():
    with pytest.raises(ParamsError, match="skin s0: true depth of every poke must be above 0 m"):
        trial(pokes=Indentations.model_construct(places_mm=((0.0, 0.0),), depths_mm=(0.0,)), skin_depth_zero_mm=0.0)


@pytest.mark.parametrize(("cell_mm", "layers_n"), [(0.5, 4), (3.0, 1)])
def test_error_of_the_midpoint_rule_is_quadratic_in_the_box_size(cell_mm, layers_n):
    """The integral of x^2 over the skin is known. The midpoint rule misses it by the fraction 1 / n^2 for n boxes."""
    rest = midpoints(2e-3, Quadrature(1e-3 * cell_mm, layers_n))
    volume_m3, boxes_n = SKIN_SIDE_M**2 * 2e-3, np.ceil(1e3 * SKIN_SIDE_M / cell_mm)
    assert rest.volumes_m3.sum() == pytest.approx(volume_m3, rel=1e-12)
    for axis, (size_m, parts_n) in enumerate([(SKIN_SIDE_M, boxes_n), (SKIN_SIDE_M, boxes_n), (2e-3, layers_n)]):
        off_m = rest.nodes_m[:, axis] - (1e-3 if axis == 2 else 0.0)
        mean_m2 = rest.volumes_m3 @ off_m**2 / volume_m3
        assert mean_m2 == pytest.approx(size_m**2 / 12 * (1 - 1 / parts_n**2), rel=1e-9, abs=1e-18)


def test_boxes_around_midpoints_fill_the_skin_without_gaps():
    rule = Quadrature(0.7e-3, 5)
    rest, sides_m = midpoints(2e-3, rule), box_m(2e-3, rule)
    for places_m, side_m in zip(rest.nodes_m.T, sides_m, strict=True):
        np.testing.assert_allclose(np.diff(np.unique(np.round(places_m, 12))), side_m, rtol=1e-6)
    np.testing.assert_allclose(rest.volumes_m3, np.prod(sides_m))


def test_field_change_of_a_lifted_box_equals_that_of_its_charged_faces(monkeypatch):
    # The skin is a single box, for which the dipole approximation would be wrong. It was magnetised between equal
    # poles, so its magnetisation is along z.
    whole_skin, lift_m = Quadrature(SKIN_SIDE_M, 1), np.array([0.0, 0.0, 1e-3])
    like = design(polarity="same")
    one = draw_trial(
        BOARD,
        like,
        spreads=no_spread(),
        seed=0,
        name="s0",
        pokes=Indentations(places_mm=((0.0, 0.0),), depths_mm=(1.0,)),
    )
    skin = with_nodes(one, midpoints(one.skin.thickness_m, whole_skin))
    lifted = NodePath(skin.nodes_m[None] + lift_m, np.zeros((1, 1, 3)))
    monkeypatch.setattr(runtime, "paths", lambda *_: lifted)
    found_T = runtime.magpylib_cuboids(one, whole_skin).call()[0]
    sides_m = (SKIN_SIDE_M, SKIN_SIDE_M, one.skin.thickness_m)
    jx_T, jy_T, jz_T = mu_0 * skin.moments_A_m2[0] / np.prod(sides_m)
    assert max(abs(jx_T), abs(jy_T)) < 1e-12 * abs(jz_T)
    before_m = BOARD.chips_m - skin.nodes_m
    after_T, before_T = (cuboid_field(at_m, jz_T, sides_m=sides_m) for at_m in (before_m - lift_m, before_m))
    np.testing.assert_allclose(found_T, after_T - before_T, atol=1e-9 * abs(jz_T))


def test_gauss_nodes_integrate_polynomials_exactly():
    rest = gauss_everywhere(2e-3, Quadrature(5e-3, 3), per_cell_n=3)
    x, y, z = 2 * rest.nodes_m.T / np.array([[SKIN_SIDE_M], [SKIN_SIDE_M], [4e-3]])
    share = rest.volumes_m3 / (SKIN_SIDE_M**2 * 2e-3)
    for power_x, power_y, power_z in ((0, 0, 0), (4, 4, 5), (2, 4, 4), (1, 2, 3)):
        mean = (power_x % 2 == 0) / (power_x + 1) / (power_y + 1) / (power_z + 1)
        assert share @ (x**power_x * y**power_y * z**power_z) == pytest.approx(mean, rel=1e-12, abs=1e-15)


def test_tabulated_paths_of_material_points_equal_the_computed_flow():
    one = trial()
    skin = with_nodes(one, place_nodes(one.skin.thickness_m, COARSE))
    path, poke_m, material = paths(one, skin), one.pokes_m[3], slice(700, 1100, 40)
    away_m = skin.nodes_m[material, :2] - poke_m[:2]
    r_m, z_m, depths_m = (
        np.linalg.norm(away_m, axis=1),
        skin.nodes_m[material, 2],
        one.pokes_m[:, 2] + skin.depth_zero_m,
    )
    press = layer.IndentedLayer(skin.thickness_m, skin.tip_radius_m, skin.base)
    followed = deformation.follow(r_m, z_m, deformation.depth_steps(tuple(np.unique(depths_m)), press), press=press)[-1]
    outward_m = (path.nodes_m[3, material, :2] - poke_m[:2]) * away_m / r_m[:, None]
    assert np.abs(followed.r_m - r_m).max() > 20e-6
    # The tolerance of 2 um is the error of the spline between the nodes of the flow, while the material moves by up to
    # 1 mm.
    np.testing.assert_allclose(outward_m.sum(axis=1), followed.r_m, atol=2e-6)
    np.testing.assert_allclose(path.nodes_m[3, material, 2], followed.z_m, atol=2e-6)
    # These are the horizontal components of the axis about which z rotates towards r.
    turn_rad = np.cross(path.turns_rad[3, material], [0.0, 0.0, 1.0])[:, :2]
    angle_rad = (turn_rad * away_m / r_m[:, None]).sum(axis=1)
    np.testing.assert_allclose(angle_rad, deformation.rotation_angle(followed.f), atol=5e-3)


def test_error_of_a_rule_is_the_largest_over_skins_and_depths():
    trials = [trial(), trial(name="s1")]
    truth_T = [np.ones((4, 5, 3)), 2 * np.ones((4, 5, 3))]
    factors = [np.array([1.1, 0.9, 1.0, 1.0]), np.array([1.0, 1.0, 1.3, 1.3])]
    found_T = [one * factor[:, None, None] for one, factor in zip(truth_T, factors, strict=True)]
    parts = errors(trials, found_T, truth_T)
    assert parts == {
        "0.6 mm": pytest.approx(0.1),
        "1.2 mm": pytest.approx(0.3),
        ALL: pytest.approx(np.sqrt((2 * 0.1**2 + 2 * 0.6**2) / (4 + 16))),
    }


def test_error_of_the_midpoint_rule_is_within_the_specified_range(quadratures):
    rows, _ = quadratures
    # The specified error is 9 to 74 % with boxes of 0.5 mm in 4 layers, and about 1 % with six Gauss nodes over the
    # height.
    assert 0.09 < error_of(rows, "midpoint", 0.5, 4) < 0.74
    assert error_of(rows, "Gauss in z", 0.5, 6) < 0.02
    assert error_of(rows, "midpoint", 0.5, 8) > 2 * error_of(rows, "Gauss in z", 0.5, 4)


def test_finer_quadratures_have_smaller_errors(quadratures):
    rows, _ = quadratures
    widths = [error_of(rows, "Gauss in z", cell_mm, 6) for cell_mm in (2, 1, 0.5)]
    assert widths[0] > 2 * widths[1] > 4 * widths[2]
    assert error_of(rows, "Gauss in z", 0.5, 4) > error_of(rows, "Gauss in z", 0.5, 6)
    assert error_of(rows, "midpoint", 0.5, 4) > 2 * error_of(rows, "midpoint", 0.5, 8)
    assert error_of(rows, "Gauss in x, y and z", 2, 6) > 2 * error_of(rows, "Gauss in x, y and z", 1, 6)
    assert error_of(rows, "magpylib cuboids", 2, 2) > error_of(rows, "magpylib cuboids", 1, 4)


def test_error_of_the_reference_is_below_a_tenth_of_the_error_limit(quadratures):
    rows, _ = quadratures
    assert rows[0].method == REFERENCE
    assert 0 < rows[0].error < 0.1 * ERROR_MAX


def test_fields_of_magpylib_equal_those_of_our_kernel(quadratures):
    _, calls = quadratures
    calls = {one.key[1]: one.call for one in calls if one.key[2] == rule_name(COARSE)}
    kernel_T = calls["kernel alone"]()
    for name in ("magpylib.core dipoles", "magpylib dipoles"):
        # Tolerance: magpylib's field changes are differences of two sums, and magpylib uses the value of mu_0 of
        # another CODATA year.
        np.testing.assert_allclose(calls[name](), kernel_T, atol=1e-7 * np.abs(kernel_T).max())


def test_field_computed_by_the_flow_equals_that_computed_by_paths():
    one = trial()
    ours_T, theirs_T = (METHODS[name](one, COARSE).call() for name in ("Gauss in z", "kernel alone"))
    # The tolerance is 0.5 %, because the two methods interpolate between different nodes. If the moments were not
    # rotated, the error would be larger than the field change dB itself.
    assert np.linalg.norm(ours_T - theirs_T) < 0.005 * np.linalg.norm(ours_T)


def test_field_of_distant_boxes_equals_that_of_dipoles():
    deep = replace(BOARD, chips_m=BOARD.chips_m - (0.0, 0.0, 40e-3))
    one = trial(deep)
    boxes_T = METHODS["magpylib cuboids"](one, Quadrature(2e-3, 2)).call()
    dipoles_T = prepare(one, midpoints(one.skin.thickness_m, Quadrature(2e-3, 2))).call()
    # The tolerance is 1 %: the dipole approximation of boxes has an error of (cell / distance)^2 = 0.2 %, and the two
    # flows are interpolated between different nodes.
    assert np.linalg.norm(boxes_T - dipoles_T) < 0.01 * np.linalg.norm(dipoles_T)


def test_each_rule_has_one_row_and_is_timed_once(quadratures):
    rows, calls = quadratures
    expected = {(method, rule_name(rule)) for method, rules_of_method in TRIED.items() for rule in rules_of_method}
    assert {(row.method, row.setting) for row in rows[1:]} == expected
    assert len(rows) == 1 + len(expected)
    assert [one.key for one in calls] == [row.key for row in rows[1:]]
    assert all(row.error == max(row.parts.values()) for row in rows)
    nodes_n = {row.setting: row.work_n for row in rows if row.method == CANDIDATES}
    assert nodes_n[rule_name(DEFAULT_QUADRATURE)] == len(place_nodes(1e-3, DEFAULT_QUADRATURE).nodes_m)


def test_unknown_method_is_an_error():
    with pytest.raises(ParamsError, match="methods must be among"):
        study_quadratures([trial()], {"Simpson": rules((1, 4))})


def row(method, cell_mm, layers_n, nodes_n, error) -> Precision:
    return Precision("dB", method, f"{cell_mm:g} mm x {layers_n}", nodes_n, error)


GOOD, BETTER = row(CANDIDATES, 0.5, 5, 8820, 0.015), row(CANDIDATES, 0.5, 6, 10584, 0.004)
ROWS = [
    row(CANDIDATES, 1, 4, 1936, 0.08),
    BETTER,
    GOOD,
    row("midpoint", 2, 9, 900, 0.001),  # A midpoint rule is not a candidate.
]


def test_cheapest_rule_with_an_error_below_the_limit_is_chosen():
    choice = choose(ROWS, used=DEFAULT_QUADRATURE)
    assert (choice.setting, choice.nodes_n, choice.error) == ("0.5 mm x 5", 8820, 0.015)
    assert (choice.used_setting, choice.used_nodes_n, choice.used_error) == ("0.5 mm x 6", 10584, 0.004)
    assert choice.differs
    assert not choose(ROWS, used=DEFAULT_QUADRATURE, error_max=0.01).differs


def test_no_rule_is_chosen_if_all_errors_are_above_the_limit():
    choice = choose(ROWS, used=DEFAULT_QUADRATURE, error_max=0.001)
    assert choice.setting is None
    assert choice.differs


def test_error_of_the_quadrature_in_use_is_missing_if_it_was_not_tried():
    assert choose(ROWS, used=Quadrature(0.1e-3, 20)).used_error is None


@given(
    st.lists(st.tuples(st.integers(1, 10**5), st.floats(0, 1)), max_size=8),
    st.floats(0, 1),
    st.floats(0, 1),
)
def test_larger_error_limit_never_leads_to_a_slower_rule(points, strict, extra):
    rows = [row(CANDIDATES, i, 1, nodes_n, error) for i, (nodes_n, error) in enumerate(points)]
    strictly, loosely = (choose(rows, used=DEFAULT_QUADRATURE, error_max=most) for most in (strict, strict + extra))
    if strictly.nodes_n is not None:
        assert strictly.error < strict
        assert loosely.nodes_n <= strictly.nodes_n


def test_methods_are_timed_in_alternating_order():
    ran = []
    calls = [TimedCall(("study", name, ""), lambda name=name: ran.append(name), 1) for name in "abc"]
    assert [one.method for one in time_calls(calls, 3)] == ["a", "b", "c"]
    assert "".join(ran) == "abc" + "cba" + "abc"


def test_times_are_medians_divided_by_the_number_of_indentations(monkeypatch):
    # The clock is read before and after each of three calls. Its readings are the running sums of these numbers.
    now_s = accumulate([0.0, 0.005, 1.0, 0.5, 1.0, 0.005])
    monkeypatch.setattr("pipeline.experiments.runtime.perf_counter", lambda: next(now_s))
    (slow,) = time_calls([TimedCall(("study", "naps", "x"), lambda: None, 5)], 3)
    assert slow.key == ("study", "naps", "x")
    assert slow.median_s == pytest.approx(0.001)
    assert slow.repeats_n == 3


def test_timing_with_zero_rounds_is_refused():
    with pytest.raises(ParamsError, match="repeats_n must be 1 or more"):
        time_calls([], 0)


RATIOS = (1e3, 1e4, 1e5, 1e6, 1e7, 1e8)
STEPS = {"tolerances": (1e-3, 1e-6), "euler_steps_s": (1e-2, 1e-3)}
SMALL = Integrators(ratios=RATIOS, **STEPS, pokes_n=1, calls_per_poke_max_n=5000)


def settings(**changes) -> Integrators:
    return SMALL.model_copy(update=changes)


@pytest.fixture(scope="module")
def relaxations():
    return study_integrators(SMALL)


def select(rows, ratio, method) -> list[Precision]:
    return [row for row in rows if row.study == runtime.study_name(ratio) and row.method == method]


def test_relaxation_times_of_the_skin_have_a_ratio_of_1e7():
    np.testing.assert_allclose(runtime.stiff(1e7).tau_s, SKIN_RELAXATION.tau_s, rtol=1e-12)


@pytest.mark.parametrize("ratio", RATIOS)
def test_stiffness_ratio_is_the_ratio_of_the_longest_and_shortest_relaxation_time(ratio):
    prony = runtime.stiff(ratio)
    assert prony.tau_s.max() / prony.tau_s.min() == pytest.approx(ratio, rel=1e-9)
    assert prony.tau_s.max() == SKIN_RELAXATION.tau_s.max()
    assert (prony.share == SKIN_RELAXATION.share).all()


def test_exact_force_equals_a_convolution_integral():
    # Reference: the convolution of the force with the relaxation function (Lee & Radok, 1960), by adaptive quadrature.
    prony, (time_s, elastic) = runtime.stiff(1e5), repeated_presses(2)
    speeds = np.diff(elastic) / np.diff(time_s)

    def relaxation(t_s):
        return 1 - (prony.share * -np.expm1(-t_s / prony.tau_s)).sum()

    for end_i, force in enumerate(hereditary(time_s, elastic, prony)[1:], start=1):
        end_s = time_s[end_i]
        pieces = zip(time_s[:end_i], time_s[1 : end_i + 1], speeds[:end_i], strict=True)
        parts = [v * quad(lambda s, t=end_s: relaxation(t - s), a, b, epsabs=1e-13)[0] for a, b, v in pieces]
        assert force == pytest.approx(sum(parts), rel=1e-10, abs=1e-12)


def test_twenty_simulated_pokes_last_thirty_seconds():
    time_s, elastic = repeated_presses(20)
    assert time_s[-1] == pytest.approx(30.0)
    assert len(time_s) == 61
    assert (np.diff(time_s) > 0).all()
    assert (elastic[1:4] == [1.0, 1.0, 0.0]).all()


@pytest.mark.parametrize("ratio", RATIOS)
def test_exact_update_has_only_rounding_errors_at_any_stiffness(relaxations, ratio):
    (exact,) = select(relaxations[0], ratio, EXACT)
    assert exact.error < 1e-14
    assert exact.work_n == 0


def test_every_integrator_has_a_row_per_stiffness_and_setting(relaxations):
    rows, calls = relaxations
    expected = [(EXACT, 1), *((name, 2) for name in SOLVERS), (EULER, 2)]
    for ratio in RATIOS:
        for method, settings_n in expected:
            assert len(select(rows, ratio, method)) == settings_n
    assert len({row.key for row in rows}) == len(rows) == 11 * len(RATIOS)
    assert {one.key for one in calls} == {row.key for row in rows if row.failure is None}
    assert all((row.error is None) == (row.failure is not None) for row in rows)


@pytest.mark.parametrize("method", SOLVERS)
def test_smaller_tolerance_needs_more_calls_and_reduces_the_error(relaxations, method):
    # The ratio 1e3 is excluded, because the loose tolerance already reaches the rounding error there.
    for ratio in RATIOS[1:5]:
        loose, tight = select(relaxations[0], ratio, method)
        assert tight.error < loose.error
        assert tight.work_n > loose.work_n


def test_euler_method_converges_with_first_order(relaxations):
    # The tolerance of 20 % allows for the term of second order.
    wide, narrow = select(relaxations[0], 1e3, EULER)
    assert wide.error / narrow.error == pytest.approx(10, rel=0.2)


@pytest.mark.parametrize(("step_over_fastest", "stable"), [(1.9, True), (2.1, False)])
def test_euler_method_diverges_if_steps_exceed_twice_the_shortest_relaxation_time(step_over_fastest, stable):
    sweep = settings(ratios=(1e7,), tolerances=(), euler_steps_s=(1e-3 * step_over_fastest,), pokes_n=4)
    rows, calls = study_integrators(sweep)
    (euler,) = select(rows, 1e7, EULER)
    if stable:
        assert euler.error < 1e-2
    else:
        assert euler.error is None
        assert euler.failure.startswith("diverged: the error")
        assert euler.key not in {one.key for one in calls}


def test_overflow_of_the_euler_method_is_reported_as_divergence(relaxations):
    assert select(relaxations[0], 1e8, EULER)[0].failure.startswith("diverged")


@pytest.mark.parametrize("method", [*SOLVERS, EULER])
def test_solver_that_needs_too_many_calls_is_stopped(method):
    rows, _ = study_integrators(settings(ratios=(1e6,), calls_per_poke_max_n=20))
    for stopped in select(rows, 1e6, method):
        assert (stopped.error, stopped.work_n) == (None, 20)
        assert stopped.failure == "stopped after 20 evaluations of the right-hand side"


def test_at_high_stiffness_only_the_explicit_solver_is_stopped(relaxations):
    failed = {name for name in SOLVERS for one in select(relaxations[0], 1e8, name) if one.failure}
    assert failed == {"RK45"}


def test_message_of_a_failed_solver_is_reported(monkeypatch):
    class Failed:
        success, message = False, "Required step size is less than spacing between numbers."

    monkeypatch.setattr(runtime, "solve_ivp", lambda *_, **__: Failed)
    rows, _ = study_integrators(settings(ratios=(1e7,)))
    assert {one.failure for one in select(rows, 1e7, "BDF")} == {Failed.message}


def test_errors_of_integrators_hardly_depend_on_the_number_of_pokes():
    # The tolerance is a factor of two. This is strict enough, because the errors of the methods span ten powers of ten.
    once, thrice = (
        study_integrators(settings(ratios=(1e7,), tolerances=(1e-5,), pokes_n=pokes_n))[0] for pokes_n in (2, 6)
    )
    for one, other in zip(once[1:], thrice[1:], strict=True):
        if one.failure is None:
            assert 0.5 < other.error / one.error < 2
            assert 0.8 < other.work_n / one.work_n / 3 < 1.25


def test_study_of_integrators_is_reproducible(relaxations):
    again, study = study_integrators(settings(ratios=(1e6,)))[0], runtime.study_name(1e6)
    assert again == [row for row in relaxations[0] if row.study == study]
