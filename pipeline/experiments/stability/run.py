"""Stage stability: stiff and extreme cases of skins, chips, wires and learning -> the rows of one table."""

from dataclasses import asdict
from pathlib import Path

from pipeline.core import io
from pipeline.core.config import Files, read_settings
from pipeline.core.stage import run, say
from pipeline.experiments.stability.learning import learning_cases
from pipeline.experiments.stability.survey import survey
from pipeline.synthesis.settings import synthesis_of


def stability(scene: str, files: Files, answer: Path) -> None:
    """Try every case on the scene's own skins and chips and on small trainings, and write down what happened."""
    settings = read_settings("stability", scene, files)
    of, seed = synthesis_of(settings), settings.seed
    cases = [
        *survey(of.main_boards.design, of.spreads, skin=of.skin, chip=of.chip, seed=seed),
        *learning_cases(seed),
    ]
    io.write_json(answer, [asdict(case) for case in cases])
    for case in cases:
        if not case.holds:
            say(f"warning: {scene}: {case.area}, {case.case}: {case.happened}")
    say(f"{scene}: {sum(case.holds for case in cases)} of {len(cases)} extreme cases behave as they should")


if __name__ == "__main__":
    run(stability)
