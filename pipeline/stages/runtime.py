"""Stage runtime: error against run time of a simulated scene's physics. Errors are an output, seconds stand beside."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from pipeline import io
from pipeline.evaluation.work_precision.choose import choose
from pipeline.evaluation.work_precision.integrators import study_integrators
from pipeline.evaluation.work_precision.quadrature import study_quadratures
from pipeline.evaluation.work_precision.settings import RunTime
from pipeline.evaluation.work_precision.stopwatch import race
from pipeline.evaluation.work_precision.trials import Trial, draw_trial
from pipeline.physics.board import draw_board
from pipeline.provenance import SECONDS
from pipeline.settings import Files, read_settings
from pipeline.stages._run import run, say
from pipeline.stages._simulated import synthesis_of
from pipeline.strict import parse
from pipeline.synthesis.capture import MAIN, Synthesis, roster


def runtime(scene: str, files: Files, answer: Path) -> None:
    """Compare quadratures and integrators; seconds differ between identical runs, so they are no output."""
    asked = read_settings("runtime", scene, files)
    of, seed = synthesis_of(asked), asked.seed
    tried = parse(RunTime, asked.words("runtime"), f"{asked.where}: runtime")
    rows, calls = study_quadratures(_trials(of, tried, seed), tried.quadratures.rules_of())
    more, more_calls = study_integrators(tried.integrators.sweep())
    choice = choose(rows, used=of.main_boards.quadrature.quadrature())
    io.write_json(
        SECONDS / scene / "runtime.json", [asdict(one) for one in race([*calls, *more_calls], tried.repeats_n)]
    )
    words: dict[str, Any] = {"choice": asdict(choice)}
    words |= {"quadratures": [asdict(row) for row in rows], "integrators": [asdict(row) for row in more]}
    io.write_json(answer, words)
    failed_n = sum(row.failure is not None for row in [*rows, *more])
    say(f"{scene}: {len(rows) + len(more)} ways tried, {failed_n} failed; cheapest quadrature: {choice.setting}")


def _trials(of: Synthesis, asked: RunTime, seed: int) -> list[Trial]:
    """Take the skins on the boards whose chips are nearest: there a quadrature has to be finest."""
    drawn = [
        (draw_board(of.main_boards.design, of.spreads, seed=seed, name=board), skin) for board, skin in roster(of, MAIN)
    ]
    nearest = sorted(drawn, key=lambda pair: -pair[0].chips_m[0, 2])[: asked.quadratures.skins_n]
    pokes = asked.quadratures.pokes()
    return [
        draw_trial(board, of.skin, spreads=of.spreads, seed=seed, name=skin, pokes=pokes) for board, skin in nearest
    ]


if __name__ == "__main__":
    run(runtime)
