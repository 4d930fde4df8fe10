"""Stage simulate: parameters -> raw captures of skins that do not exist, in the wire format of those that do."""

from pathlib import Path

from pipeline import io
from pipeline.capture.folder import write_capture
from pipeline.dataset.synthetic import Synthesis, record_skin, roster
from pipeline.dataset.synthetic_files import to_files
from pipeline.params import read_scene
from pipeline.stages._run import run, say
from pipeline.strict import parse


def simulate(scene: str, settings: Path, raw: Path) -> None:
    """Record every skin of a simulated scene."""
    asked = read_scene(settings)
    synthesis = parse(Synthesis, asked.simulate, f"{settings}: simulate")
    pairs = roster(synthesis)
    with io.replacing(raw) as folder:
        folder.mkdir()
        for i, (board, skin) in enumerate(pairs, 1):
            capture = record_skin(synthesis, board, skin=skin, seed=asked.seed)
            write_capture(folder / skin, *to_files(capture, synthesis))
            say(f"{scene}: simulated {skin} on {board} ({i}/{len(pairs)}), {capture.wrapped_n} values past the range")


if __name__ == "__main__":
    run(simulate)
