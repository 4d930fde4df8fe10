"""Tests, by profiling a simulation, that physics terms which a protocol does not use are not computed."""

import sys
from pathlib import Path

import pytest

from reskin.physics import shear
from reskin.simulation.capture import simulate_capture
from tests.simulation.scene import AGEING, GRID, RELAXATION, TEMPERATURE, with_protocol

TERMS = {
    "ageing": (AGEING, {"softening", "fading", "baseline_walk"}),
    "friction": (
        {"coefficient": 0.5},
        {"drag_force", "slip_traction", "stick_traction", "shear_displacement", "shear_in_steps", "tabulate_depth"},
    ),
    "relaxation": (RELAXATION, {"relax"}),
    "temperature": (TEMPERATURE, {"temperature_rise_K", "relative_remanence"}),
}
TERM_FUNCTIONS = set().union(*(names for _, names in TERMS.values()))
FEW = GRID | {"passes_n": 1, "depths_mm": (0.6,), "skins_n": 1}


def functions_run(scene):
    """Simulate a capture. Return the names of the functions of the library that are called."""
    called = set()

    def note(frame, event, _):
        if event == "call":
            called.add((frame.f_code.co_filename, frame.f_code.co_name))

    simulate_capture(scene, "few", board="b0", skin="b0_s0", seed=1)  # The first run computes the deformation tables.
    shear.tabulate_depth.cache_clear()  # Without this, a result from the cache would hide a call.
    sys.setprofile(note)
    try:
        simulate_capture(scene, "few", board="b0", skin="b0_s0", seed=1)
    finally:
        sys.setprofile(None)
    return {name for file, name in called if "reskin" in Path(file).parts}


def scene_with(*terms):
    return with_protocol("few", FEW | {"terms": list(terms)}, terms={term: TERMS[term][0] for term in terms})


def test_protocol_without_optional_terms_computes_none_of_them():
    run = functions_run(scene_with())
    assert {"simulate_capture", "read_field"} <= run  # This checks that the profiler works.
    assert not run & TERM_FUNCTIONS


@pytest.mark.parametrize("term", sorted(TERMS))
def test_each_physics_term_calls_only_the_functions_that_it_needs(term):
    run = functions_run(scene_with(term)) & TERM_FUNCTIONS
    assert run
    assert run <= TERMS[term][1]
