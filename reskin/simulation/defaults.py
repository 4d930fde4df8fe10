"""Settings of the nominal skin, rig, chips and boards, from `nominal.yaml` in this folder."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from reskin.config import read_yaml

NOMINAL = Path(__file__).with_name("nominal.yaml")
SHARED = ("skin", "rig", "chip", "spreads", "terms")  # sections that all simulations take from `nominal.yaml`


def nominal(section: str, changes: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return a section of the nominal settings, with some settings replaced by `changes`."""
    return {**read_yaml(NOMINAL)[section], **(changes or {})}
