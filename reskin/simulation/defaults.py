"""Read the nominal settings of a simulation (skin, rig, chips, boards and protocols) from `nominal.yaml`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from reskin.config import read_yaml
from reskin.layouts import skin_design, with_geometry

NOMINAL = Path(__file__).with_name("nominal.yaml")
SHARED = ("skin", "rig", "chip", "spreads", "terms")  # sections of `nominal.yaml` that all simulations use


def nominal(section: str, changes: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return a section of the nominal settings, in which `changes` replaces or adds settings.

    The geometry in sections `skin` and `boards` is that of the layouts (`reskin.layouts`).
    """
    content = read_yaml(NOMINAL)[section]
    if section == "skin":
        content = skin_design(content)
    elif section == "boards":
        content = {name: with_geometry(kind) for name, kind in content.items()}
    return {**content, **(changes or {})}


def filler() -> dict[str, Any]:
    """Return section `skin` of `nominal.yaml` itself: the material, without the geometry of a layout."""
    return dict(read_yaml(NOMINAL)["skin"])
