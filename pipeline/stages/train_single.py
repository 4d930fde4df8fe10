"""Stage train_single: one skin at a time: same-sensor splits, and one skin to others (paper sections 4 and 5.1)."""

from pathlib import Path

from pipeline.stages._run import run
from pipeline.stages._train import train_arm


def train_single(scene: str, settings: Path, indentations: Path, folds: Path, models: Path) -> None:
    """Train the recipes of section train_single of a scene."""
    train_arm("train_single", scene, settings, indentations, folds, models)


if __name__ == "__main__":
    run(train_single)
