"""Read a scene's simulation settings, and check that its experiments can use them."""

from pipeline.settings import Settings
from reskin.data.grid import SKIN_MM
from reskin.errors import ParamsError
from reskin.simulation.protocols import Load
from reskin.simulation.settings import MAIN, SimulationSettings, parse_simulation

# The protocols that experiments read, and the kind that each of these protocols must have.
KINDS = {
    "wear": "grid", "flexible": "grid", "drag": "drag", "hand": "hand", "sleeve": "scatter", "glass": "load",
    "grip": "load", "log": "walk",
}  # fmt: skip
# Protocols on the main boards. Their captures are compared with the captures of the main protocol, or are used to test
# networks that were trained on the main boards.
ON_MAIN_BOARDS = ("wear", "drag", "hand", "glass", "grip", "log")
ON_OTHER_BOARDS = ("flexible",)  # protocols on boards other than the main ones
OF_ONE_SKIN = ("wear", "glass", "log")  # protocols whose experiments read one capture


def simulation_settings(settings: Settings) -> SimulationSettings:
    """Parse section `simulate` of a scene, with the nominal skin, rig, chip, spreads and terms."""
    where = f"{settings.where}: simulate"
    simulation = parse_simulation(settings["simulate"], settings.shared, where)
    check_protocols(simulation, where)
    return simulation


def check_protocols(simulation: SimulationSettings, where: str) -> None:
    """Raise `ParamsError` if an experiment cannot use one of the protocols; the error names `where`."""
    main = simulation.main.boards
    if simulation.main_boards.skin_mm != SKIN_MM:  # the studies of the physics assume the size of the authors' skin
        rule = f"skin_mm of the boards of protocol {MAIN} must be {list(SKIN_MM)}"
        raise ParamsError(f"{where}: {rule}. Correct skin_mm of these boards.")
    for name, protocol in simulation.protocols.items():
        kind, boards, skins_n = KINDS.get(name, protocol.kind), protocol.boards, protocol.skins_n
        faults = {
            f"kind must be {kind}, which its experiment reads, not {protocol.kind}": protocol.kind != kind,
            f"boards must be {main}, as in protocol {MAIN}, not {boards}": name in ON_MAIN_BOARDS and boards != main,
            f"boards must not be {boards}, the boards of protocol {MAIN}": name in ON_OTHER_BOARDS and boards == main,
            f"skins_n must be 1, because its experiment reads only one skin, not {skins_n}": name in OF_ONE_SKIN
            and skins_n != 1,
        }
        for fault in (rule for rule, is_broken in faults.items() if is_broken):
            raise ParamsError(f"{where}: protocol {name}: {fault}. Correct this setting of the protocol.")


def load_protocol(settings: Settings, protocol: str) -> Load:
    """Return the settings of a protocol that increases the load on the skin in steps."""
    load = simulation_settings(settings).protocols[protocol]
    assert isinstance(load, Load), "checked by check_protocols"
    return load
