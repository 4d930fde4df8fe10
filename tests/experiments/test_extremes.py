"""Every law and extreme case holds."""

from pathlib import Path

import pytest

from pipeline.experiments.extremes import CASES
from pipeline.experiments.extremes.cases import World
from reskin.config import read_yaml
from reskin.simulation.defaults import nominal
from reskin.simulation.settings import parse_simulation

QUICK = Path(__file__).resolve().parents[2] / "pipeline/scenes/quick.yaml"
SHARED = {name: nominal(name) for name in ("rig", "skin", "chip", "spreads", "terms")}
WORLD = World(parse_simulation(read_yaml(QUICK)["simulate"], SHARED, "simulate"), 2021)
BY_NAME = {case.name: case for case in CASES}


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_case_holds(case):
    assert case.measure(WORLD) <= case.limit


@pytest.mark.parametrize("name", ["no_stiffness", "rigid", "lifted_drag"])
def test_cases_of_a_held_skin_are_measured_in_a_scene_whose_skin_is_bonded(name):
    skin = WORLD.simulation.skin.model_copy(update={"hold": None, "base": "bonded"})
    bonded = World(WORLD.simulation.model_copy(update={"skin": skin}), 2021)
    assert bonded.draw_held().hold is not None
    assert BY_NAME[name].measure(bonded) <= BY_NAME[name].limit
