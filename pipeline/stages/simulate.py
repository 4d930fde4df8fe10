"""Stages physics and simulate: simulate skins, and write captures (raw files, as a board would send them).

The captures have the same wire format as those of recorded boards, so that all further stages treat both alike.
"""

from collections import Counter
from pathlib import Path

from tqdm import tqdm

from pipeline.executors import make_executor
from pipeline.settings import Settings
from pipeline.simulation import simulation_settings
from pipeline.stage import say
from reskin import io
from reskin.errors import ParamsError
from reskin.layouts import with_geometry
from reskin.recordings.header import write_capture
from reskin.simulation.capture import list_captures, simulate_capture, to_files
from reskin.simulation.defaults import SHARED
from reskin.simulation.settings import SimulationSettings


def physics(settings: Settings, physics: Path) -> None:
    """Write a scene's boards, and the nominal skin, rig, chip, spreads and terms, on which several stages depend."""
    simulation_settings(settings)  # raises an error if they are invalid
    of_scene = {"boards": {name: with_geometry(kind) for name, kind in settings["simulate"]["boards"].items()}}
    io.write_json(physics, of_scene | {name: settings.shared[name] for name in SHARED})


def simulate(settings: Settings, protocol: str, raw: Path) -> None:
    """Simulate all captures of one protocol (a sequence of indentations that a robot makes), one capture per skin."""
    simulation, seed = simulation_settings(settings), settings.seed
    pairs, skins_n = list_captures(simulation, protocol), simulation.protocols[protocol].skins_n
    if len(pairs) < skins_n:
        rule = f"at most {len(pairs)}, the number of skins on the boards of the protocol"
        remedy = f"Reduce simulate.protocols.{protocol}.skins_n."
        raise ParamsError(settings.where, f"skins_n of protocol {protocol}", rule, skins_n, remedy)
    with io.replacing(raw) as folder, make_executor(len(pairs), imports="reskin.simulation.capture") as executor:
        folder.mkdir()
        futures = [executor.submit(_write_capture, simulation, protocol, pair, seed, folder) for pair in pairs]
        overruns: Counter[str] = Counter()
        for future in tqdm(futures, unit="capture"):
            overruns.update(future.result())
        if +overruns:
            counts = ", ".join(f"{what}: {n}" for what, n in (+overruns).items())
            say(f"{settings.scene}: in all simulated captures of protocol {protocol}: {counts}")


def _write_capture(
    simulation: SimulationSettings, protocol: str, pair: tuple[str, str], seed: int, folder: Path
) -> dict[str, int]:
    """Simulate and write one capture; return the number of values out of range, by their kind."""
    board, skin = pair
    capture = simulate_capture(simulation, protocol, board=board, skin=skin, seed=seed)
    write_capture(folder / capture.name, *to_files(capture, simulation))
    return capture.overruns
