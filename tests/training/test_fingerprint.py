"""The fingerprint of the simulated skin: equal for equal presses, another for every setting that a capture shows."""

from copy import deepcopy
from pathlib import Path

import pytest

from pipeline.training.choice import fingerprint
from reskin.config import read_yaml
from reskin.physics import slide
from reskin.simulation.defaults import NOMINAL

ROOT = Path(__file__).resolve().parents[2]
PARAMS = read_yaml(NOMINAL)
TODAY = fingerprint(PARAMS)


def test_the_same_settings_in_another_order_have_the_same_fingerprint():
    turned = {name: dict(reversed(PARAMS[name].items())) for name in reversed(("skin", "rig", "chip", "spreads"))}
    assert fingerprint(turned) == TODAY
    assert len(TODAY) == 16


@pytest.mark.parametrize(
    ("section", "name", "value"),
    [
        ("skin", "modulus_kPa", 151.0), ("skin", "thickness_mm", 2.01), ("spreads", "skin_seat_mm", 0.31),
        ("rig", "force_noise_N", 0.0063), ("chip", "noise_z_uT", 5.1),
    ],
)  # fmt: skip
def test_another_setting_has_another_fingerprint(section, name, value):
    changed = deepcopy({name: dict(PARAMS[name]) for name in ("skin", "rig", "chip", "spreads")})
    changed[section][name] = value
    assert fingerprint(changed) != TODAY


def test_another_law_has_another_fingerprint_and_rounding_has_not(monkeypatch):
    rigid = slide.press_displacement_m
    monkeypatch.setattr(slide, "press_displacement_m", lambda *of, **how: rigid(*of, **how) * (1 + 1e-12))
    assert fingerprint(PARAMS) == TODAY
    monkeypatch.setattr(slide, "press_displacement_m", lambda *of, **how: rigid(*of, **how) * 1.02)
    assert fingerprint(PARAMS) != TODAY


def test_settings_were_chosen_on_the_skin_of_today():
    record = read_yaml(ROOT / "reports/tuning/choice.json")
    assert record["physics"] == TODAY, "run scene tuning again and commit reports/tuning/choice.json"
