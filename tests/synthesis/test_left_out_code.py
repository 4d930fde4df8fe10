"""What a protocol does not need does not run: the interpreter's own profile of one recording is asked."""

import sys
from pathlib import Path

import pytest

from reskin.physics import shear
from reskin.simulation.capture import record
from tests.synthesis.scene import AGEING, GRID, RELAXATION, TEMPERATURE, with_protocol

TERMS = {
    "ageing": (AGEING, {"wear.py"}),
    "friction": ({"coefficient": 0.5}, {"friction.py", "shear.py"}),
    "relaxation": (RELAXATION, {"viscoelastic.py"}),
    "temperature": (TEMPERATURE, {"warmth.py"}),
}
OF_TERMS = set().union(*(files for _, files in TERMS.values()))
FEW = GRID | {"passes_n": 1, "depths_mm": (0.6,), "skins_n": 1}


def files_run(scene):
    """Name the modules of the pipeline in which a function was called."""
    called = set()

    def note(frame, event, _):
        if event == "call":
            called.add(frame.f_code.co_filename)

    shear.tabulate_depth.cache_clear()  # what an earlier test left there would hide a call
    sys.setprofile(note)
    try:
        record(scene, "few", board="b0", skin="b0_s0", seed=1)
    finally:
        sys.setprofile(None)
    return {Path(name).name for name in called if "pipeline" in Path(name).parts}


def scene_with(*terms):
    return with_protocol("few", FEW | {"terms": list(terms)}, terms={term: TERMS[term][0] for term in terms})


def test_a_protocol_without_terms_runs_no_code_of_any_term():
    run = files_run(scene_with())
    assert {"flow_map.py", "sensor.py", "capture.py"} <= run  # or the profile would see nothing
    assert not run & OF_TERMS


@pytest.mark.parametrize("term", sorted(TERMS))
def test_a_term_that_is_asked_for_runs_its_own_code_and_no_others(term):
    assert files_run(scene_with(term)) & OF_TERMS == TERMS[term][1]
