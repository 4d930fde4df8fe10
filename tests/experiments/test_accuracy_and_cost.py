"""Tests of experiment accuracy_and_cost: quadratures, integrators and neglected terms against closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.constants import mu_0
from scipy.integrate import quad

from pipeline.experiments import accuracy_and_cost
from pipeline.experiments.accuracy_and_cost import (
    EULER,
    EXACT,
    METHODS,
    SOLVERS,
    TERMS,
    WARMER_K,
    Integrators,
    Quadratures,
    draw_trial,
    gauss_nodes,
    hereditary,
    magpylib_change,
    midpoints,
    neglected_terms,
    study_field,
    study_relaxation,
)
from reskin.physics.aging import Prony, relaxed_share, softening
from reskin.physics.magnet import SKIN_SIDE_M, Quadrature, change_of_field
from tests.simulation.scene import GRID, synthesis, with_protocol

FEW = GRID | {"passes_n": 1}
INDENTATIONS_N = 130
TRIED = Quadratures(
    places_mm=((3.0, 1.0), (-2.0, 5.0)), depths_mm=(0.4, 1.0),
    rules={"Gauss in z": ((2.0, 3), (1.0, 4)), "midpoint": ((1.0, 2),), "magpylib.core alone": ((2.0, 3),)},
)  # fmt: skip
INTEGRATORS = Integrators(ratios=(1e3, 1e8), tolerances=(1e-3, 1e-6), euler_steps_s=(1e-2,), calls_max_n=5000)


@pytest.mark.parametrize("place", [midpoints, lambda h_m, rule: gauss_nodes(h_m, rule, 2)])
@pytest.mark.parametrize("rule", [Quadrature(2e-3, 3), Quadrature(1.3e-3, 5)])
def test_weights_of_nodes_sum_to_the_volume_of_the_skin(place, rule):
    nodes = place(2e-3, rule)
    assert nodes.volumes_m3.sum() == pytest.approx(SKIN_SIDE_M**2 * 2e-3)
    assert (np.abs(nodes.nodes_m[:, :2]) < SKIN_SIDE_M / 2).all()
    assert ((nodes.nodes_m[:, 2] > 0) & (nodes.nodes_m[:, 2] < 2e-3)).all()


def test_gauss_nodes_integrate_cubic_polynomials_exactly():
    nodes = gauss_nodes(2e-3, Quadrature(5e-3, 2), 2)
    x, _, z = (nodes.nodes_m + (SKIN_SIDE_M / 2, 0, 0)).T
    truth = SKIN_SIDE_M * SKIN_SIDE_M**4 / 4 * (2e-3) ** 4 / 4
    assert (x**3 * z**3 * nodes.volumes_m3).sum() == pytest.approx(truth, rel=1e-12)


def test_all_methods_compute_the_same_field_with_the_same_nodes():
    trial = draw_trial(synthesis(), TRIED, 1)
    rule = Quadrature(2e-3, 3)
    whole, alone, theirs = (
        METHODS[name](trial, rule)() for name in ("Gauss in z", "kernel alone", "magpylib.core alone")
    )
    np.testing.assert_allclose(alone, whole, atol=1e-9 * np.abs(whole).max())
    np.testing.assert_allclose(theirs, whole, atol=1e-7 * np.abs(whole).max())  # mu_0 of another CODATA year


@given(st.integers(0, 10**6))
def test_change_by_magpylib_is_that_of_the_textbook_formula(seed):
    rng = np.random.default_rng(seed)
    before, after = ((rng.uniform(1e-3, 5e-3, (3, 3)), 1e-5 * rng.standard_normal((3, 3))) for _ in range(2))
    chips_m = -rng.uniform(1e-3, 5e-3, (2, 3))

    def field_T(places_m, moments):
        d = chips_m[:, None] - places_m
        r = np.linalg.norm(d, axis=2, keepdims=True)
        along = (d * moments).sum(axis=2, keepdims=True)
        return mu_0 / (4 * np.pi) * (3 * d * along / r**5 - moments / r**3).sum(axis=1)

    truth_T = field_T(*after) - field_T(*before)
    np.testing.assert_allclose(magpylib_change(before, after, chips_m), truth_T, atol=1e-9 * np.abs(truth_T).max())
    np.testing.assert_allclose(change_of_field(before, after, chips_m), truth_T, atol=1e-9 * np.abs(truth_T).max())


def test_error_of_quadratures_falls_with_finer_rules(monkeypatch):
    monkeypatch.setattr(accuracy_and_cost, "FINE", Quadrature(1e-3, 5))
    monkeypatch.setattr(accuracy_and_cost, "COARSER", Quadrature(1.3e-3, 5))
    rows = {(row.method, row.setting): row for row in study_field(synthesis(), TRIED, 1, 1)}
    assert len(rows) == 5
    error = {key: row.error for key, row in rows.items()}
    assert error["reference", "upper bound of its own error"] < 0.1 * error["Gauss in z", "1 mm x 4"]
    assert error["Gauss in z", "1 mm x 4"] < error["Gauss in z", "2 mm x 3"]
    assert error["magpylib.core alone", "2 mm x 3"] == pytest.approx(error["Gauss in z", "2 mm x 3"], rel=1e-4)
    assert all((row.seconds is None) == (row.method == "reference") for row in rows.values())


def test_exact_update_is_the_only_method_that_is_exact_at_every_stiffness():
    rows = list(study_relaxation(INTEGRATORS, 1))
    assert len(rows) == 2 * (1 + 2 * len(SOLVERS) + 1)
    exact = [row for row in rows if row.method == EXACT]
    assert all(row.error < 1e-13 for row in exact)  # rounding errors of a few steps
    stiffest = {row.method: row.error for row in rows if "1e+08" in row.study}
    assert stiffest[EULER] is None  # It diverges, because its steps are longer than the fastest relaxation.
    assert all(row.seconds is None for row in rows if row.error is None)
    tight = {(row.study, row.method): row.error for row in rows if row.setting == "1e-06"}
    loose = {(row.study, row.method): row.error for row in rows if row.setting == "1e-03"}
    both = [key for key in tight if tight[key] is not None and loose[key] is not None]
    assert len(both) >= 6
    assert all(tight[key] <= loose[key] for key in both)


def test_hereditary_integral_equals_numerical_integration():
    prony = Prony(np.array([0.3, 5.0]), np.array([0.2, 0.3]))
    time_s, elastic = np.array([0.0, 0.5, 2.0]), np.array([0.0, 1.0, 0.4])
    slope = np.diff(elastic) / np.diff(time_s)

    def relaxed(t):
        return 1 - prony.share.sum() + (prony.share * np.exp(-t / prony.tau_s)).sum()

    truth = sum(
        quad(lambda s, of=of: relaxed(2.0 - s) * of, first, last)[0]
        for of, first, last in zip(slope, time_s[:-1], time_s[1:], strict=True)
    )
    assert hereditary(time_s, elastic, prony)[-1] == pytest.approx(truth, rel=1e-10)


@pytest.fixture(scope="module")
def terms():
    return {(row.method, row.unit): row for row in neglected_terms(with_protocol("grid", FEW), 1)}


def test_force_errors_of_neglected_ageing_and_relaxation_equal_closed_forms(terms):
    ageing, relaxation = TERMS["ageing"].ageing, TERMS["relaxation"].relaxation
    left = softening(np.array([INDENTATIONS_N - 1]), settling=ageing.settling, ageing=ageing.ageing)[0]
    assert terms["ageing", "% of the force"].error == pytest.approx(100 * (1 / left - 1), rel=1e-9)
    truth_pct = 100 * (1 / relaxed_share(relaxation) - 1)
    assert terms["relaxation", "% of the force"].error == pytest.approx(truth_pct, rel=1e-9)
    # The depth of a press is given, so these terms change only the force, and not the field.
    assert terms["ageing", "% of dB"].error == terms["relaxation", "% of dB"].error == 0


def test_neglecting_one_kelvin_changes_the_field_by_0_12_percent(terms):
    assert terms["temperature", f"% of dB at {WARMER_K:g} K"].error == pytest.approx(100 * (1 / 0.9988 - 1), rel=1e-6)
