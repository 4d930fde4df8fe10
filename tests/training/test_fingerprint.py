"""Tests of the fingerprint of the simulated skin, which changes with every setting that changes a capture."""

from copy import deepcopy

import pytest

from pipeline.training.choice import fingerprint
from reskin.physics import slide
from reskin.simulation.defaults import SHARED, nominal

PARAMS = {name: nominal(name) for name in SHARED}
CURRENT = fingerprint(PARAMS)


@pytest.mark.parametrize(
    ("section", "name", "value"),
    [
        ("skin", "modulus_kPa", 151.0), ("skin", "thickness_mm", 2.01), ("spreads", "skin_seat_mm", 0.31),
        ("rig", "force_noise_N", 0.0063), ("chip", "noise_z_uT", 5.1),
    ],
)  # fmt: skip
def test_every_setting_changes_the_fingerprint(section, name, value):
    changed = deepcopy({name: dict(PARAMS[name]) for name in ("skin", "rig", "chip", "spreads")})
    changed[section][name] = value
    assert fingerprint(changed) != CURRENT


def test_fingerprint_changes_with_the_physics_but_not_by_rounding(monkeypatch):
    rigid = slide.press_displacement_m
    monkeypatch.setattr(slide, "press_displacement_m", lambda *args, **kwargs: rigid(*args, **kwargs) * (1 + 1e-12))
    assert fingerprint(PARAMS) == CURRENT
    monkeypatch.setattr(slide, "press_displacement_m", lambda *args, **kwargs: rigid(*args, **kwargs) * 1.02)
    assert fingerprint(PARAMS) != CURRENT
