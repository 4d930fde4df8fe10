"""Simulation settings of a scene."""

from pipeline.settings import Settings
from reskin.simulation.protocols import Load
from reskin.simulation.settings import SimulationSettings, parse_simulation


def simulation_settings(settings: Settings) -> SimulationSettings:
    """Parse section `simulate` of a scene, with the nominal skin, rig, chip, spreads and terms."""
    return parse_simulation(settings["simulate"], settings.shared, f"{settings.where}: simulate")


def load_protocol(settings: Settings, protocol: str) -> Load:
    """Return the settings of a protocol that loads the skin step by step."""
    load = simulation_settings(settings).protocols[protocol]
    assert isinstance(load, Load), "checked by SimulationSettings"
    return load
