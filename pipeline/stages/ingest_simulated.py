"""Stage ingest_simulated: all captures of a simulated scene -> indentations/<scene>/, one file a capture.

Refuses to know that they are simulated, but for the folder.
"""

from pathlib import Path

from pipeline.stage import run
from pipeline.stages.ingest import ingest
from reskin import io
from reskin.config import Files


def ingest_simulated(scene: str, files: Files, raw: Path, lost_fraction_max: float, indentations: Path) -> None:
    """Read every capture that the stage `simulate` wrote for a scene, through the same door as recorded ones."""
    with io.replacing(indentations) as folder:
        folder.mkdir()
        for capture in sorted(child for child in raw.iterdir() if child.is_dir()):
            ingest(scene, files, capture, lost_fraction_max, folder / f"{capture.name}.parquet")


if __name__ == "__main__":
    run(ingest_simulated)
