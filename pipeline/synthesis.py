"""The simulation of a scene, from its settings."""

from pipeline.settings import Settings
from reskin.simulation.protocols import Load
from reskin.simulation.settings import Synthesis, parse_synthesis


def synthesis_of(settings: Settings) -> Synthesis:
    """Parse section `simulate` with the skin, rig, chip, spreads and terms that scenes share."""
    return parse_synthesis(settings["simulate"], settings.shared, f"{settings.where}: simulate")


def loads_of(settings: Settings, protocol: str) -> Load:
    """Parse a protocol that loads the skin step by step."""
    load = synthesis_of(settings).protocols[protocol]
    assert isinstance(load, Load), "each experiment has protocols of its own kind"
    return load
