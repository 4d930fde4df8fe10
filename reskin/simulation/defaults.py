"""Settings of the nominal skin, rig, chips and boards: `nominal.yaml`, beside this module."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from reskin.config import read_yaml

NOMINAL = Path(__file__).with_name("nominal.yaml")
SHARED = ("skin", "rig", "chip", "spreads", "terms")  # sections that every simulation takes from there


def nominal(section: str, changes: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Read a section of the nominal settings, with changes by name."""
    return {**read_yaml(NOMINAL)[section], **(changes or {})}
