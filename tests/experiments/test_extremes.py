"""Every law and extreme case holds, and a fault planted in the library makes a case fail."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.experiments.extremes import CASES, physics
from pipeline.experiments.extremes.cases import World
from reskin.board import stream
from reskin.config import read_yaml
from reskin.models import inputs, train
from reskin.physics import aging, chip, deformation, layer, magnet, slide
from reskin.simulation import contact
from reskin.simulation.defaults import nominal
from reskin.simulation.settings import parse_simulation

QUICK = Path(__file__).resolve().parents[2] / "pipeline/scenes/quick.yaml"
SHARED = {name: nominal(name) for name in ("rig", "skin", "chip", "spreads", "terms")}
WORLD = World(parse_simulation(read_yaml(QUICK)["simulate"], SHARED, "simulate"), 2021)
BY_NAME = {case.name: case for case in CASES}


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_case_holds(case):
    assert case.measure(WORLD) <= case.limit


def wrong_corner(original):
    return lambda from_m: -original(from_m)


def without_rotation(original):
    def move(table, rest, poke_m):
        moved = original(table, rest, poke_m)
        return replace(moved, after=(moved.after[0], moved.before[1]))

    return move


def stretched(original):
    def displacement(r_m, z_m, of):
        u = original(r_m, z_m, of)
        return replace(u, z_m=1.02 * u.z_m, z_z=1.02 * u.z_z, z_r=1.02 * u.z_r)

    return displacement


def naive_quotient(_):
    return lambda x: np.where(x > 0, (1 - np.exp(-x)) / np.where(x > 0, x, 1.0), 1.0)


def doubled(original):
    def feed(self, data):
        frames = original(self, data)
        return replace(frames, b_uT=frames.b_uT * 2)

    return feed


def unknown_depth(original):
    return lambda *args, **named: replace(original(*args, **named), depth_m=np.nan)


def unchecked(_):
    def check(self, errors, step):
        self.errors.append(errors)
        for i in range(errors.shape[1]):
            self.sound_steps_n[i] = step
            self.weights[i] = self.net.weights_of(i)
        return True

    return check


FAULTS = {
    "array": (magnet, "_corner", wrong_corner),
    "maxwell": (magnet, "array_field", lambda original: lambda *args, **named: original(*args, **named) * (1, 1, 1.01)),
    "dipoles": (magnet, "MU0_4PI", lambda _: 1.001e-7),
    "long_2011": (layer, "bonded_compliance", lambda _: np.ones_like),
    "compliance_slipping": (layer, "slipping_compliance", lambda original: lambda kh: original(1.5 * kh)),
    "sneddon": (layer, "contact_of_radius", unknown_depth),  # The first of its two errors is not NaN.
    "rings_slipping_1": (layer, "_kernel", lambda original: lambda *args: 1.1 * original(*args)),
    "far_field": (deformation, "displacement", stretched),
    "depth_0.72": (deformation, "move_dipoles", without_rotation),
    "thickness_20mm": (
        slide,
        "stiffening_factor",
        lambda _: lambda depth_m, *others: 1 + np.maximum(depth_m, 0) / 1e-3,
    ),
    "lifted_drag": (contact, "_in_series", lambda _: lambda layers, base: layers[:, None, None] * np.eye(2)),
    "stiff_relaxation": (aging, "_mean_decay", naive_quotient),
    "steps": (chip, "STEP_AT_GAIN_ONE_uT", lambda _: (0.161, 0.161, 0.294)),
    "portions": (stream.FrameStream, "feed", doubled),
    "constant_channels": (inputs, "SCALE_FLOOR", lambda _: np.float32(0)),
    "exploding": (train.Monitor, "check", unchecked),
}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", FAULTS)
def test_planted_fault_is_reported(monkeypatch, name):
    owner, attribute, fault = FAULTS[name]
    caches = (layer.contact_of_depth, layer._force_curve, physics.finite_steps)
    monkeypatch.setattr(owner, attribute, fault(getattr(owner, attribute)))
    for cached in caches:
        cached.cache_clear()
    assert not BY_NAME[name].measure(WORLD) <= BY_NAME[name].limit
    for cached in caches:
        cached.cache_clear()


@pytest.mark.parametrize("name", ["no_stiffness", "rigid", "lifted_drag"])
def test_cases_of_a_held_skin_are_measured_in_a_scene_whose_skin_is_bonded(name):
    skin = WORLD.simulation.skin.model_copy(update={"hold": None, "base": "bonded"})
    bonded = World(WORLD.simulation.model_copy(update={"skin": skin}), 2021)
    assert bonded.draw_held().hold is not None
    assert BY_NAME[name].measure(bonded) <= BY_NAME[name].limit
