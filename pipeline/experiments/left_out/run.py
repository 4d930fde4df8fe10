"""Stage left_out: what the physics of a simulated scene leaves out -> what that costs, as the rows of one table.

Refuses to know what is left out: `terms` holds it.
"""

from dataclasses import asdict
from pathlib import Path

from pipeline.experiments.left_out.terms import measure
from pipeline.stage import run, say
from reskin import io
from reskin.config import Files, read_settings
from reskin.simulation.settings import synthesis_of


def left_out(scene: str, files: Files, answer: Path) -> None:
    """Measure every term on the scene's own first skin, and name the protocols that do without it."""
    settings = read_settings("left_out", scene, files)
    of, seed = synthesis_of(settings), settings.seed
    omissions = measure(of, seed=seed)
    io.write_json(answer, [asdict(omission) for omission in omissions])
    left = ", ".join(omission.term for omission in omissions if omission.done == "left out")
    say(f"{scene}: left out by the main protocol, and measured: {left}")


if __name__ == "__main__":
    run(left_out)
