"""Load an exported dataset with LeRobot, and compare it with one that LeRobot writes from the same frames.

Run by tests/robots/test_dataset.py with the Python of RESKIN_LEROBOT, which has the package lerobot but not reskin:
PYTHON load_lerobot.py DATASET FOLDER writes all frames to FOLDER/frames.json. With a third argument, `compare`, it also
writes the frames with LeRobot to FOLDER/own, and compares all files.
"""

import json
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from lerobot.datasets.lerobot_dataset import LeRobotDataset

INDICES = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
MOMENTS = {"min", "max", "mean", "std", "count"}  # computed in single precision; quantiles are only approximate


def compare(exported: Path, own: Path) -> None:
    """Compare information, schemas, episodes and statistics of two datasets."""
    ours, theirs = (json.loads((folder / "meta/info.json").read_text()) for folder in (exported, own))
    assert ours.keys() == theirs.keys(), ours.keys() ^ theirs.keys()
    for key in ours.keys() - {"robot_type", "features"}:
        assert ours[key] == theirs[key], key
    features, their_features = ours["features"], theirs["features"]
    assert features.keys() == their_features.keys()
    for name, feature in features.items():
        assert {key: feature[key] for key in ("dtype", "shape", "names")} == {
            key: their_features[name][key] for key in ("dtype", "shape", "names")
        }, name
    for folder in ("data", "meta/episodes"):
        tables = [pq.read_table(path / folder) for path in (exported, own)]
        schemas = [{field.name: field.type for field in table.schema} for table in tables]
        assert schemas[0].keys() == schemas[1].keys(), schemas[0].keys() ^ schemas[1].keys()
        for name in schemas[0]:
            if not name.startswith("stats/"):  # their types differ between versions of LeRobot
                ours, theirs = (str(schema[name]).replace("element", "item") for schema in schemas)
                assert ours == theirs, name
                assert str(tables[0][name].to_pylist()) == str(tables[1][name].to_pylist()), name  # NaN equals NaN
    statistics, their_statistics = (json.loads((path / "meta/stats.json").read_text()) for path in (exported, own))
    for name, values in statistics.items():
        assert values.keys() == their_statistics[name].keys(), name
        if np.isnan(their_statistics[name]["mean"]).any():
            continue  # if some values are unknown, LeRobot's statistics are NaN
        largest = np.abs([values["min"], values["max"]]).max()
        for key in MOMENTS:
            np.testing.assert_allclose(
                values[key], their_statistics[name][key], rtol=1e-4, atol=1e-3 * largest, err_msg=name
            )


def write(frames: list[dict], dataset: LeRobotDataset, folder: Path) -> None:
    """Write the frames of a dataset with LeRobot."""
    features = {name: feature for name, feature in dataset.features.items() if name not in INDICES}
    own = LeRobotDataset.create("local/own", fps=dataset.fps, features=features, root=folder, use_videos=False)
    for i, frame in enumerate(frames):
        values = {name: frame[name].numpy().reshape(feature["shape"]) for name, feature in features.items()}
        own.add_frame(values | {"task": frame["task"]})
        if i + 1 == len(frames) or frames[i + 1]["episode_index"] != frame["episode_index"]:
            own.save_episode()
    own.finalize()


def main(exported: Path, folder: Path, *, own: bool) -> None:
    dataset = LeRobotDataset("local/exported", root=exported)
    frames = [dataset[i] for i in range(len(dataset))]
    if own:
        write(frames, dataset, folder / "own")
        compare(exported, folder / "own")
    field = "observation.field_uT"
    two = LeRobotDataset("local/exported", root=exported, delta_timestamps={field: [-1 / dataset.fps, 0]})
    assert two[1][field].tolist() == [frames[0][field].tolist(), frames[1][field].tolist()]
    last_i = dataset.num_episodes - 1
    part = LeRobotDataset("local/exported", root=exported, episodes=[last_i])
    assert len(part) == sum(frame["episode_index"] == last_i for frame in frames)
    text = json.dumps([{key: value if key == "task" else value.tolist() for key, value in f.items()} for f in frames])
    (folder / "frames.json").write_text(text)
    print(f"lerobot {version('lerobot')}: {len(frames)} frames, {dataset.num_episodes} episodes")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), own=sys.argv[3:] == ["compare"])
