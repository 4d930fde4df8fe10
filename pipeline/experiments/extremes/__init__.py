"""Extremes: laws of physics with independent references, and stiff, extreme and broken cases.

Each case is written once, in the list `CASES`: what is measured, the reference, the largest accepted error with its
reason, and the function that measures the error. This experiment measures all cases in the world of a scene. The tests
of the project (tests/experiments/test_extremes.py) measure the same list.
"""

from pathlib import Path

from pipeline.experiments.extremes import chips, learning, physics, serial
from pipeline.experiments.extremes.cases import Case, World
from pipeline.experiments.results import write_results
from pipeline.settings import Settings
from pipeline.simulation import simulation_settings
from pipeline.stage import say
from reskin.config import Strict

CASES: tuple[Case, ...] = (*physics.CASES, *chips.CASES, *serial.CASES, *learning.CASES)


class Extremes(Strict):
    """Settings section `extremes`. full: whether the cases of the full sweep are measured too."""

    full: bool


def extremes(settings: Settings, section: Extremes, results: Path) -> None:
    """Measure the error of every case with the boards, skins and chips of the scene."""
    world = World(simulation_settings(settings), settings.seed)
    rows = [case.row(world) for case in CASES if section.full or not case.full]
    write_results(results, {"cases": rows}, {})
    for row in rows:
        if not row["holds"]:
            found = row["message"] or f"error {row['error']:.3g}, limit {row['limit']:.3g}"
            say(f"warning: {settings.scene}: {row['case']} ({row['what']}): {found}")
    say(f"{settings.scene}: {sum(bool(row['holds']) for row in rows)} of {len(rows)} cases hold")
