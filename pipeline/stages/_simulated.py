"""What the stages about physics share: a simulated scene's file -> how its skins are made, and its seed."""

from pathlib import Path

from pipeline.params import read_scene
from pipeline.strict import parse
from pipeline.synthesis.capture import Synthesis


def read_synthesis(settings: Path) -> tuple[Synthesis, int]:
    """Read section `simulate` of a scene, and the scene's seed."""
    asked = read_scene(settings)
    assert asked.simulate is not None, "the plan names simulated scenes only"
    return parse(Synthesis, asked.simulate.model_dump(), f"{settings}: simulate"), asked.seed
