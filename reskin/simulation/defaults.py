"""Read the nominal settings of a simulation (skin, rig, chips, boards and protocols) from `nominal.yaml`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from reskin.config import read_yaml

NOMINAL = Path(__file__).with_name("nominal.yaml")
SHARED = ("skin", "rig", "chip", "spreads", "terms")  # sections of `nominal.yaml` that all simulations use


def nominal(section: str, changes: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return a section of the nominal settings, in which `changes` replaces or adds settings."""
    return {**read_yaml(NOMINAL)[section], **(changes or {})}
