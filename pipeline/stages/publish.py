"""Stage publish: models and figures -> the MLflow diary. No output: nothing reads the diary back."""

from pathlib import Path

from pipeline.params import modelled, read_scene
from pipeline.server import TrackingAway
from pipeline.stages._run import run, say
from pipeline.tracking import publish as write


def publish(scene: str, settings: Path, models: Path, figures: Path) -> None:
    """Write every training of a scene to MLflow once; if the server is away, say so and go on."""
    arms = {arm: models / arm for arm in modelled(read_scene(settings))}
    try:
        say(f"{scene}: MLflow runs {write(arms, figures, scene=scene, root=Path())}")
    except TrackingAway as away:
        say(f"warning: {scene} is not in MLflow: {away}")


if __name__ == "__main__":
    run(publish)
