"""Draw the folds of benchmark v1.

The folds are frozen, and this module documents how they were drawn. The module must therefore not change.

    python -m pipeline.benchmark.draw RECORDINGS OUT

RECORDINGS is a folder with the recordings of scenes lab and eflesh, as `reskin fetch` writes them (data/fetched). OUT
is a new folder for the files. If the simulator or NumPy has changed since v1, the simulated presses may differ from
those of v1.
"""

import json
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import reskin
from pipeline.benchmark.folds import (
    FORMAT,
    FoldFile,
    Presses,
    Recording,
    join_presses,
    read_boards,
    write_simulated,
)
from pipeline.experiments.random_presses import CHECKERBOARD, BoardPresses, draw_presses
from pipeline.manage.fetch import SOURCES, read_sources
from reskin import io
from reskin.code import ROOT
from reskin.config import parse
from reskin.data.grid import CENTRE_MM
from reskin.errors import ParamsError
from reskin.seeds import rng_for
from reskin.universal.calibration import LabelledPresses

VERSION = "v1"
SEED = 2021  # the seed of scene lab; the draws of lab equal those of experiment random_presses
LABELS_N = (0, 10, 40)
UNLABELLED_N = 65
LAB_DRAWS_N = 10
EFLESH_TEST_FRACTION = 0.2  # tests are the last of five passes, as in scene eflesh
POPULATION_SEED = 2026
TRAIN_SKINS_N, TEST_SKINS_N, PRESSES_N = 40, 12, 195
DEPTHS_MM = (0.4, 1.2)
HALF_MM, CORNER = 8.0, 1.5  # places are in the octagon |x|, |y| <= HALF_MM, (|x| + |y|) / HALF_MM <= CORNER
ABOUT = {
    "lab": "Boards 1 and 2 of the paper's rig (65 places, 3 depths), one skin each. Train on one board, test on the "
    "other. Unlabelled presses are at random places; labels are on one colour of a checkerboard of places, tests on "
    "the other colour, and the colours alternate from draw to draw. No press at the middle of the skin is tested.",
    "eflesh": "A five-chip board under a printed lattice (eFlesh), places of a 31 x 31 grid without forces. The labels "
    "are passes 1 to 4, the tests pass 5. The no-load field is measured before each press.",
    "simulated": "Skins and boards of the project's simulator (reskin.draw_skin, reskin.draw_board, "
    "reskin.simulate_pokes, with the board's name as name of skin and board, and the stated seed), one skin per board, "
    "pressed at random places of an octagon to depths of 0.4 to 1.2 mm. Boards train0 to train39 are for training.",
}


def draw_all(recordings: Path, out: Path) -> None:
    """Draw all folds and write their files to a new folder."""
    if out.exists():
        raise ParamsError(f"{out}: the folder exists. Choose a new one.")
    with io.replacing(out) as folder:
        folder.mkdir()
        write_simulated(folder / "simulated.parquet", simulate())
        for dataset, content in {
            "lab": draw_lab(*_recorded("lab", recordings)),
            "eflesh": draw_eflesh(*_recorded("eflesh", recordings)),
            "simulated": draw_simulated(folder),
        }.items():
            common = {"format": FORMAT, "version": VERSION, "dataset": dataset, "about": ABOUT[dataset]}
            folds = parse(FoldFile, common | content, dataset)
            text = json.dumps(folds.model_dump(mode="json"), indent=2)
            one_line = re.sub(r"\[[\d,\s]+\]", lambda numbers: " ".join(numbers[0].split()), text)
            io.write_text(folder / f"{dataset}.json", f"{one_line}\n")


def draw_lab(recordings: list[Recording], presses: Mapping[str, Presses]) -> dict[str, Any]:
    """Draw presses of the lab boards as experiment random_presses does."""
    draws = []
    for board, own in presses.items():
        labelled = LabelledPresses(own.place_mm - CENTRE_MM, own.force_N, own.db_uT)
        places = BoardPresses(board, own.noload_uT[0], labelled, labelled, own.press)
        for i in range(LAB_DRAWS_N):
            drawn = draw_presses(places, CHECKERBOARD, UNLABELLED_N, SEED, i)
            draws.append({
                "board": board, "draw": f"draw{i}", "train": [other for other in presses if other != board],
                "unlabelled": drawn.unlabelled.tolist(), "labels": drawn.labels[: max(LABELS_N)].tolist(),
                "tests": _shuffled(drawn.tested, "lab", board, i),
            })  # fmt: skip
    return _content("recorded", {"presses": SEED}, LABELS_N, presses, recordings, draws)


def draw_eflesh(recordings: list[Recording], presses: Mapping[str, Presses]) -> dict[str, Any]:
    """Split the presses of the eFlesh board by time."""
    ((board, own),) = presses.items()
    labels, tests = np.split(own.press, [round(len(own) * (1 - EFLESH_TEST_FRACTION))])
    draws = [{
        "board": board, "draw": "draw0", "train": [], "unlabelled": [],
        "labels": labels.tolist(), "tests": _shuffled(tests, "eflesh", board, 0),
    }]  # fmt: skip
    return _content("recorded", {"order of tests": SEED}, (len(labels),), presses, recordings, draws)


def simulate() -> Presses:
    """Simulate the presses of all training and test skins."""
    names = [f"train{i}" for i in range(TRAIN_SKINS_N)] + [f"test{i}" for i in range(TEST_SKINS_N)]
    return join_presses([simulate_skin(name) for name in names])


def simulate_skin(name: str) -> Presses:
    """Simulate the presses of one skin on its own board; skin and board are both called `name`."""
    rng = rng_for(POPULATION_SEED, "benchmark", VERSION, name)
    place_mm = rng.uniform(-HALF_MM, HALF_MM, (4 * PRESSES_N, 2))
    place_mm = place_mm[np.abs(place_mm).sum(axis=1) <= CORNER * HALF_MM][:PRESSES_N] + CENTRE_MM
    depth_mm = rng.uniform(*DEPTHS_MM, len(place_mm))
    seed = POPULATION_SEED
    skin, board = reskin.draw_skin(name, seed=seed), reskin.draw_board(name, seed=seed)
    pokes = reskin.simulate_pokes(skin, np.column_stack([place_mm, depth_mm]), board=board, seed=seed)
    noload_uT, b_uT = pokes.noload_uT.astype(float), pokes.b_uT.astype(float)
    press = np.arange(len(place_mm))
    board_names = np.full(len(press), name)
    return Presses(board_names, press, np.zeros_like(press), place_mm, pokes.Fz_N, noload_uT, b_uT - noload_uT)


def draw_simulated(folder: Path) -> dict[str, Any]:
    """Draw presses of the simulated test skins; all presses of the training skins are labelled."""
    file = "simulated.parquet"
    content: dict[str, Any] = {"path": file, "layout": "presses", "board": None, "options": {}}
    recording = parse(Recording, content | {"files": {file: io.sha256(folder / file)}}, file)
    presses, _ = read_boards(folder, [recording])
    train = [board for board in presses if board.startswith("train")]
    draws = []
    for board in [board for board in presses if board not in train]:
        order = rng_for(POPULATION_SEED, "benchmark", VERSION, "roles", board).permutation(PRESSES_N)
        unlabelled, labels, tests = np.split(order, [UNLABELLED_N, UNLABELLED_N + max(LABELS_N)])
        roles = {"unlabelled": unlabelled.tolist(), "labels": labels.tolist(), "tests": tests.tolist()}
        draws.append({"board": board, "draw": "draw0", "train": train, **roles})
    return _content("simulated", {"population": POPULATION_SEED}, LABELS_N, presses, [recording], draws)


def _recorded(source: str, folder: Path) -> tuple[list[Recording], dict[str, Presses]]:
    """Return the recordings of a source of `reskin fetch`, in the form of a fold file, and their presses."""
    fetched = read_sources(ROOT)[source]
    recordings = []
    for one in fetched.recordings:
        files = {file.path: file.sha256 for file in fetched.files if file.path.startswith(one.path)}
        content = one.model_dump(include={"path", "layout", "board", "options"}) | {"files": files}
        recordings.append(parse(Recording, content, SOURCES))
    return recordings, read_boards(folder / source, recordings)[0]


def _shuffled(tests: np.ndarray, *names: str | int) -> list[int]:
    """Return tests in random order, because rigs press places in the same order in each pass."""
    shuffled: list[int] = rng_for(SEED, "benchmark", VERSION, "tests", *names).permutation(tests).tolist()
    return shuffled


def _content(
    source: str, seeds: dict[str, int], labels_n: tuple[int, ...], presses: Mapping[str, Presses],
    recordings: list[Recording], draws: list[dict[str, Any]],
) -> dict[str, Any]:  # fmt: skip
    forces = all(np.isfinite(own.force_N).all() for own in presses.values())
    return {
        "source": source, "forces": forces, "seeds": seeds, "labels_n": list(labels_n),
        "presses_n": {board: len(own) for board, own in presses.items()},
        "recordings": [recording.model_dump() for recording in recordings], "draws": draws,
    }  # fmt: skip


if __name__ == "__main__":
    draw_all(Path(sys.argv[1]), Path(sys.argv[2]))
