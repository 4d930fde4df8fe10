"""Run the three commands of docs/add-your-data.md on simulated recordings of three boards with six chips; time them."""

import json
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd

import reskin
from reskin.recordings.readers.table import columns_of
from tests.stages.checkout import copy_checkout, run

CHIPS = [(-5, -4, 0), (5, -4, 90), (-5, 4, 180), (5, 4, 270), (0, 0, 0), (0, 6.5, 90)]  # x, y in mm; turn in degrees
CENTRE_MM = np.array([20.0, 15.0])  # the board's centre in the coordinates of the robot
PASSES_N, DEPTHS_MM, READINGS_N, NOISE_uT = 2, (0.6, 1.1), 3, 3.0
FIELDS = columns_of(len(CHIPS))[3 : 3 + 3 * len(CHIPS)]


def simulate(board: str) -> pd.DataFrame:
    """Simulate passes over 6 x 5 places and two depths in random order, as rows of layout `table`."""
    chips_mm, turns_deg = [chip[:2] for chip in CHIPS], [chip[2] for chip in CHIPS]
    drawn = reskin.draw_board(board, seed=5, chips_xy_mm=chips_mm, chips_turn_deg=turns_deg, gap_mm=1.3)
    skin, rng = reskin.draw_skin(f"{board}_s1", seed=5), np.random.default_rng(int(board[1:]))
    axes_mm = np.meshgrid(np.linspace(-6, 6, 6), np.linspace(-5, 5, 5), DEPTHS_MM, indexing="ij")
    presses = np.stack(axes_mm, axis=-1).reshape(-1, 3)
    parts = []
    for pass_i in range(PASSES_N):
        ordered = rng.permutation(presses)
        pokes = reskin.simulate_pokes(skin, ordered + np.array([8, 8, 0]), board=drawn, seed=pass_i)
        number = np.arange(len(ordered)) + pass_i * len(ordered)
        press_i = np.arange(len(ordered)).repeat(READINGS_N)
        readings_uT = pokes.b_uT[press_i] + NOISE_uT * rng.standard_normal((len(press_i), len(FIELDS)))
        touched = pd.DataFrame(readings_uT, columns=FIELDS).assign(phase="contact", indentation=number[press_i])
        touched[["x_mm", "y_mm"]] = ordered[press_i, :2] + CENTRE_MM
        touched = touched.assign(depth_mm=ordered[press_i, 2], Fz_N=pokes.Fz_N[press_i])
        lifted = pd.DataFrame(pokes.noload_uT, columns=FIELDS).assign(phase="noload", indentation=number)
        both = pd.concat([lifted, touched]).sort_values("indentation", kind="stable")
        parts.append(both.assign(**{"pass": pass_i}))
    return pd.concat(parts)


def describe_boards(scene: Path) -> None:
    """Edit key `layout` of the scene's file, as a user does."""
    text = scene.read_text()
    start, end = text.index("    chips:\n"), text.index("    centre_mm:")
    chips = "".join(f"      - {{x_mm: {x}, y_mm: {y}, turn_deg: {turn}}}\n" for x, y, turn in CHIPS)
    text = f"{text[:start]}    chips:\n{chips}{text[end:]}"
    for before, after in (
        ("centre_mm: [8.0, 8.0]", f"centre_mm: {CENTRE_MM.tolist()}"),
        ("gap_mm: 1.6", "gap_mm: 1.3"),
        ("half_x_mm: 8.0, half_y_mm: 8.0, octagon: true", "half_x_mm: 6.0, half_y_mm: 5.0, octagon: false"),
    ):
        if before not in text:
            raise ValueError(f"{scene}: no {before!r}")
        text = text.replace(before, after)
    scene.write_text(text)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        root = copy_checkout(Path(folder) / "checkout")
        files = [f"{board}_s1.csv" for board in ("b1", "b2", "b3")]
        for file in files:
            run(root, "reskin", "template", file, "--chips", str(len(CHIPS)))
            simulate(file[:2]).reindex(columns=pd.read_csv(root / file).columns).to_csv(root / file, index=False)
        start_s = time.monotonic()
        counts = ("--presses", str(30 * len(DEPTHS_MM)), "--passes", str(PASSES_N))
        run(root, "reskin", "new", "mine", "--boards", "b1,b2,b3", *counts)
        describe_boards(root / "pipeline/scenes/mine.yaml")
        run(root, "reskin", "add", *files, "--layout", "table", "--scene", "mine")
        run(root, "reskin", "scenes", "use", "mine")
        run(root, "dvc", "repro", "report@mine")
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        print(f"{time.monotonic() - start_s:.0f} s; processor time {used.ru_utime + used.ru_stime:.0f} s")
        numbers = json.loads((root / "reports/mine/numbers.json").read_text())
        print({row: scores["accuracy_pct"]["mean"] for row, scores in numbers["table2"].items()})


if __name__ == "__main__":
    main()
