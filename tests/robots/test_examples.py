"""Tests that the commands and examples in docs/python.md run, with fakes of LeRobot and of the board."""

import json
import re
import runpy
import shlex
import shutil
import sys
from copy import copy
from types import ModuleType, SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

import reskin
from reskin import cli
from reskin.live.tracker import Contact
from reskin.robots import sensor
from tests.stages.checkout import ROOT
from tests.test_predicting import write_stream
from tests.universal.skins import draw

PAGE = (ROOT / "docs/python.md").read_text(encoding="utf-8")
EXAMPLES = dict(re.findall(r"```python (\w+)\n(.*?)```", PAGE, re.DOTALL))
COMMANDS = [line for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL) for line in block.splitlines()]


def command(beginning: str) -> list[str]:
    (line,) = (line for line in COMMANDS if line.startswith(beginning))
    return shlex.split(line)


def test_export_command_of_the_page_writes_a_dataset(tmp_path, monkeypatch, capsys):
    captures = tmp_path / "captures"
    captures.mkdir()
    write_stream(captures, "binary")
    shutil.copytree(captures / "run1", captures / "run2")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", command("reskin export"))
    with pytest.raises(SystemExit) as done:
        cli.main()
    assert not done.value.code
    assert "wrote datasets/poking: episodes_n 2, frames_n 120, fps 30" in capsys.readouterr().out
    assert "press the button" in str((tmp_path / "datasets/poking/meta/tasks.parquet").read_bytes())
    features = json.loads((tmp_path / "datasets/poking/meta/info.json").read_text())["features"]
    assert all(f"`{name}`" in PAGE for name in features if "." in name)


def test_lerobot_example_of_the_page_records_an_episode(monkeypatch):
    frames, calls = [], []

    class FakeSensor(sensor.SkinSensor):
        observation_features = dict.fromkeys(["Bx0_uT", *sensor.ESTIMATE], float)

        def connect(self) -> None:
            calls.append(self.config.port)

        def disconnect(self) -> None: ...

        def async_read(self) -> dict[str, float]:
            return {name: float(i) for i, name in enumerate(self.observation_features)}

    class Dataset:
        @staticmethod
        def create(_name: str, *, fps: int, features: dict) -> SimpleNamespace:
            assert features["observation.skin"]["shape"] == (len(features["observation.skin"]["names"]),)
            steps = {name: lambda name=name: calls.append(name) for name in ("save_episode", "finalize")}
            return SimpleNamespace(add_frame=frames.append, **steps)

    contents = {"lerobot": {}, "lerobot.datasets": {}, "lerobot.datasets.lerobot_dataset": {"LeRobotDataset": Dataset}}
    for name, content in contents.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(sensor, "SkinSensor", FakeSensor)
    monkeypatch.setattr("time.sleep", lambda _: None)
    exec(EXAMPLES["lerobot"], {})
    assert calls == ["/dev/ttyACM0", "save_episode", "finalize"]
    assert len(frames) == 300
    np.testing.assert_array_equal(frames[0]["observation.skin"], np.arange(8))


def test_ros_2_example_publishes_usable_contacts(monkeypatch):
    nan_uT, node = np.full(15, np.nan), MagicMock()
    contacts = [
        Contact(12.5, 4.0, 6.0, 0.5, (0.1, 0.2), nan_uT, ()),
        Contact(12.6, np.nan, np.nan, 0.0, (np.nan, np.nan), nan_uT, ()),
        Contact(12.7, np.nan, np.nan, np.nan, (np.nan, np.nan), nan_uT, ("no data",), usable=False),
    ]
    packages = ("geometry_msgs", "geometry_msgs.msg", "rclpy", "rclpy.executors", "std_srvs", "std_srvs.srv")
    modules = {name: MagicMock() for name in packages}
    modules["rclpy"].create_node.return_value = node
    modules["rclpy.executors"].ExternalShutdownException = InterruptedError
    skin = MagicMock()
    skin.__enter__.return_value = contacts
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(reskin, "open", lambda port: skin)
    runpy.run_path(str(ROOT / "examples/ros2_node.py"), run_name="__main__")
    assert node.create_publisher.return_value.publish.call_count == 3  # two forces and one place
    assert modules["geometry_msgs.msg"].PointStamped.return_value.point.x == pytest.approx(0.004)
    node.get_logger.return_value.warning.assert_called_once()
    node.destroy_node.assert_called_once()


def test_onnx_examples_of_the_page_export_and_run_a_model(tmp_path, monkeypatch):
    pytest.importorskip("onnx", reason="extra `onnx` is not installed")
    pytest.importorskip("onnxruntime", reason="extra `onnx` is not installed")
    monkeypatch.chdir(tmp_path)
    skin = draw(12)[0]
    calibrated = reskin.load_universal().zero(skin.rest_uT).see(skin.b_uT[:10])
    monkeypatch.setattr(reskin, "load_universal", lambda file: copy(calibrated))
    quiet_uT = skin.rest_uT + np.random.default_rng(0).normal(0, 3, (50, 15))
    variables = {"noload_uT": quiet_uT, "b_uT": quiet_uT[:3]}
    exec(EXAMPLES["export"], variables)
    exec(EXAMPLES["onnx"], variables)
    assert variables["place_mm"].shape == (3, 2)
    assert not variables["contact"].any()
