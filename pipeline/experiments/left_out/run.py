"""Stage left_out: what the physics of a simulated scene leaves out -> what that costs, as the rows of one table.

Refuses to know what is left out: `terms` holds it.
"""

from dataclasses import asdict
from pathlib import Path

from pipeline.experiments.left_out.terms import measure
from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.synthesis import synthesis_of
from reskin import io


def left_out(settings: Settings, answer: Path) -> None:
    """Measure every term on the scene's own first skin, and name the protocols that do without it."""
    of, seed = synthesis_of(settings), settings.seed
    omissions = measure(of, seed=seed)
    io.write_json(answer, [asdict(omission) for omission in omissions])
    left = ", ".join(omission.term for omission in omissions if omission.done == "left out")
    say(f"{settings.scene}: left out by the main protocol, and measured: {left}")
