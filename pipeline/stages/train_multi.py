"""Stage train_multi: pooled boards, one held out (paper section 5.1)."""

from pathlib import Path

from pipeline.stages._run import run
from pipeline.stages._train import train_arm


def train_multi(scene: str, settings: Path, indentations: Path, folds: Path, models: Path) -> None:
    """Train the recipes of section train_multi of a scene."""
    train_arm("train_multi", scene, settings, indentations, folds, models)


if __name__ == "__main__":
    run(train_multi)
