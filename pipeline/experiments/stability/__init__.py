"""Stability: how the simulated physics, the chips, the wire formats and learning behave in extreme and faulty cases."""

from dataclasses import asdict
from pathlib import Path

from pipeline.executors import make_executor
from pipeline.experiments.stability.cases import Case
from pipeline.experiments.stability.chip import chip_cases
from pipeline.experiments.stability.extremes import extreme_cases
from pipeline.experiments.stability.physics import drag_cases, physics_cases, time_cases
from pipeline.experiments.stability.sliding import sliding_cases
from pipeline.experiments.stability.wire import wire_cases
from pipeline.settings import Settings
from pipeline.simulation import simulation_settings
from pipeline.stage import say
from reskin import io
from reskin.simulation.settings import SimulationSettings


def survey(simulation: SimulationSettings, seed: int) -> list[Case]:
    """Run all cases of physics, chips and wire formats with the settings of a scene."""
    board = simulation.main_boards.design
    chips_n = len(board.places_mm)
    return [
        *time_cases(),
        *physics_cases(board, simulation.spreads, skin=simulation.skin, seed=seed),
        *extreme_cases(board, simulation.spreads, skin=simulation.skin, seed=seed),
        *drag_cases(simulation.skin),
        *sliding_cases(board, simulation.spreads, skin=simulation.skin, seed=seed),
        *chip_cases(simulation.chip, chips_n, seed),
        *wire_cases(simulation.chip.gain_sel, chips_n, seed),
    ]


def stability(settings: Settings, results: Path) -> None:
    """Run all cases, with the scene's skins and chips and with small training runs, and write the results."""
    with make_executor(imports="pipeline.experiments.stability.learning") as executor:
        learning = executor.submit(_learning_cases, settings.seed)  # in parallel with the physics
        cases = [*survey(simulation_settings(settings), settings.seed), *learning.result()]
    io.write_json(results, [asdict(case) for case in cases])
    for case in cases:
        if not case.holds:
            say(f"warning: {settings.scene}: {case.area}, {case.case}: {case.happened}")
    say(f"{settings.scene}: {sum(case.holds for case in cases)} of {len(cases)} extreme cases behave as expected")


def _learning_cases(seed: int) -> list[Case]:
    from pipeline.experiments.stability.learning import learning_cases  # imports torch, which only the worker needs

    return learning_cases(seed)
