"""Stage leave_out: what the physics of a simulated scene leaves out -> what that costs, as the rows of one table."""

from dataclasses import asdict
from pathlib import Path

from pipeline import io
from pipeline.evaluation.left_out import measure
from pipeline.settings import Files, read_settings
from pipeline.stages._run import run, say
from pipeline.stages._simulated import synthesis_of


def leave_out(scene: str, files: Files, answer: Path) -> None:
    """Measure every term on the scene's own first skin, and name the protocols that do without it."""
    asked = read_settings("leave_out", scene, files)
    of, seed = synthesis_of(asked), asked.seed
    omissions = measure(of, seed=seed)
    io.write_json(answer, [asdict(omission) for omission in omissions])
    left = ", ".join(omission.term for omission in omissions if omission.done == "left out")
    say(f"{scene}: left out by the main protocol, and measured: {left}")


if __name__ == "__main__":
    run(leave_out)
