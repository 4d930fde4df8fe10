"""Run the three commands of docs/add-a-skin.md on simulated recordings of three boards with six chips; time them.

Run `RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_own_boards_benchmark.py`, five minutes of processor time.
"""

import json
import resource
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import reskin
from reskin.config import read_yaml
from reskin.recordings.readers.table import columns_of
from tests.benchmarks import FULL
from tests.stages.checkout import copy_checkout, run

CHIPS = [(-5, -4, 0), (5, -4, 90), (-5, 4, 180), (5, 4, 270), (0, 0, 0), (0, 6.5, 90)]  # x, y in mm; turn in degrees
CENTRE_MM = np.array([20.0, 15.0])  # the board's centre in the coordinates of the robot
PASSES_N, DEPTHS_MM, READINGS_N, NOISE_uT = 2, (0.6, 1.1), 3, 3.0
FIELDS = columns_of(len(CHIPS))[3 : 3 + 3 * len(CHIPS)]
pytestmark = [pytest.mark.skipif(not FULL, reason="takes five minutes: run `make bench`"), pytest.mark.timeout(3600)]


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
        pokes = reskin.simulate_pokes(skin, ordered + [8, 8, 0], board=drawn, seed=pass_i)
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
        assert before in text
        text = text.replace(before, after)
    scene.write_text(text)


def test_three_commands_of_the_page_produce_scores_and_a_model(tmp_path):
    root = copy_checkout(tmp_path / "checkout")
    for board in ("b1", "b2", "b3"):
        file = root / f"{board}_s1.csv"
        run(root, "reskin", "template", file.name, "--chips", str(len(CHIPS)))
        head = pd.read_csv(file).columns
        simulate(board).reindex(columns=head).to_csv(file, index=False)
    files = [f"{board}_s1.csv" for board in ("b1", "b2", "b3")]
    presses_n = 30 * len(DEPTHS_MM)
    start_s = time.monotonic()
    run(root, "reskin", "new", "mine", "--boards", "b1,b2,b3", "--presses", str(presses_n), "--passes", str(PASSES_N))
    wrong = run(root, "reskin", "add", *files, "--layout", "table", "--scene", "mine")
    assert "6 chips were recorded, but compare.layout has 5" in wrong.stderr
    for capture in read_yaml(root / "data/captures.yaml")["captures"]["mine"]:
        run(root, "reskin", "remove", "mine", capture)
    describe_boards(root / "pipeline/scenes/mine.yaml")
    added = run(root, "reskin", "add", *files, "--layout", "table", "--scene", "mine")
    assert "warning" not in added.stderr
    run(root, "reskin", "scenes", "use", "mine")
    run(root, "dvc", "repro", "report@mine")
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f"{time.monotonic() - start_s:.0f} s; processor time {used.ru_utime + used.ru_stime:.0f} s")
    numbers = json.loads((root / "reports/mine/numbers.json").read_text())
    print({row: scores["accuracy_pct"]["mean"] for row, scores in numbers["table2"].items()})
    assert set(numbers["table2"]) == {"single", "multi", "triplet", "adapted"}
    sentences = {board["frames"]["sentence"] for board in numbers["compare"]["by_board"].values()}
    assert sentences == {"Labels, chips and skin are oriented as layout mine states."}
    table = pd.read_csv(root / files[0])
    lifted, touched = table[table.phase == "noload"], table[table.phase == "contact"]
    model = reskin.load_model(root / numbers["final_model"]["file"]).zero(lifted[FIELDS].to_numpy())
    predicted = model.predict(touched[FIELDS].to_numpy())
    # the model was trained on this board, so the error is small
    assert np.abs(predicted[:, :2] - touched[["x_mm", "y_mm"]].to_numpy()).mean() < 0.5
    assert numbers["final_model"]["file"] in (root / "reports/mine/index.html").read_text()
