"""Stage runtime: error against run time of a simulated scene's physics. Errors are an output, seconds stand beside.

Refuses to let a time decide anything.
"""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from pipeline.experiments.runtime.integrators import Integrators, study_integrators
from pipeline.experiments.runtime.quadrature import Quadratures, study_quadratures
from pipeline.experiments.runtime.rows import choose, race
from pipeline.experiments.runtime.trials import Trial, draw_trial
from pipeline.provenance import SECONDS
from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.synthesis import synthesis_of
from reskin import io
from reskin.config import Strict
from reskin.physics.board import draw_board
from reskin.simulation.capture import roster
from reskin.simulation.settings import MAIN, Synthesis


class RunTime(Strict):
    """Section `runtime`: both studies, and how often each call is timed."""

    quadratures: Quadratures
    integrators: Integrators
    repeats_n: Annotated[int, Field(ge=1, le=1000)]


def read(settings: Settings) -> RunTime:
    """Read section runtime."""
    return settings.section(RunTime, "runtime")


def runtime(settings: Settings, answer: Path) -> None:
    """Compare quadratures and integrators; seconds differ between identical runs, so they are no output."""
    of, tried = synthesis_of(settings), read(settings)
    rows, calls = study_quadratures(_trials(of, tried.quadratures, settings.seed), tried.quadratures.rules_of())
    more, more_calls = study_integrators(tried.integrators)
    choice = choose(rows, used=of.main_boards.quadrature.quadrature())
    seconds = race([*calls, *more_calls], tried.repeats_n)
    io.write_json(SECONDS / settings.scene / "runtime.json", [asdict(row) for row in seconds])
    words: dict[str, Any] = {"choice": asdict(choice)}
    words |= {"quadratures": [asdict(row) for row in rows], "integrators": [asdict(row) for row in more]}
    io.write_json(answer, words)
    failed_n = sum(row.failure is not None for row in [*rows, *more])
    say(
        f"{settings.scene}: {len(rows) + len(more)} ways tried, {failed_n} failed; "
        f"cheapest quadrature: {choice.setting}"
    )


def _trials(of: Synthesis, tried: Quadratures, seed: int) -> list[Trial]:
    """Take the skins on the boards whose chips are nearest: there a quadrature has to be finest."""
    drawn = [
        (draw_board(of.main_boards.design, of.spreads, seed=seed, name=board), skin) for board, skin in roster(of, MAIN)
    ]
    nearest = sorted(drawn, key=lambda pair: -pair[0].chips_m[0, 2])[: tried.skins_n]
    return [
        draw_trial(board, of.skin, spreads=of.spreads, seed=seed, name=skin, pokes=tried) for board, skin in nearest
    ]
