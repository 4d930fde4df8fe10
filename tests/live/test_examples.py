"""Tests that the examples in docs/live.md and docs/add-a-skin.md run, with fakes of third-party packages."""

import re
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import reskin
from reskin.live.tracker import Contact
from tests.stages.checkout import ROOT

PAGES = "".join((ROOT / "docs" / name).read_text() for name in ("live.md", "add-a-skin.md"))
EXAMPLES = dict(re.findall(r"```python (\w+)\n(.*?)```", PAGES, re.DOTALL))


class OneContact:
    """Fake of an opened board that yields one contact."""

    def __init__(self, port: str) -> None:
        self.port = port

    def __enter__(self):
        contact = Contact(12.5, 4.0, 6.0, 0.5, (0.1, 0.2), np.arange(15, dtype=np.float32), ("no data",))
        return iter([contact])

    def __exit__(self, *_: object) -> None: ...


@pytest.fixture
def run(monkeypatch):
    def run(name: str, **modules: object) -> None:
        for path, content in modules.items():
            module = ModuleType(path.replace("__", "."))
            vars(module).update(content)
            monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setattr(reskin, "open", OneContact)
        exec(EXAMPLES[name], {})

    return run


def test_ros_2_example(run):
    published = []
    node = SimpleNamespace(create_publisher=lambda *_: SimpleNamespace(publish=published.append))

    def message(**fields: object) -> SimpleNamespace:
        return SimpleNamespace(**fields, header=SimpleNamespace(stamp=SimpleNamespace()))

    ros = {"init": lambda: None, "create_node": lambda _: node}
    run("ros2", rclpy=ros, skin_msgs={}, skin_msgs__msg={"Contact": message})
    (sent,) = published
    assert (sent.x_mm, sent.y_mm, sent.force_n) == (4.0, 6.0, 0.5)
    assert (sent.sd_mm, sent.alarms) == ([0.1, 0.2], ["no data"])
    assert (sent.header.stamp.sec, sent.header.stamp.nanosec) == (12, 500_000_000)


def test_lerobot_example(run):
    frames, saved = [], []

    class Dataset:
        @staticmethod
        def create(_name: str, *, fps: int, features: dict) -> SimpleNamespace:
            assert features["observation.skin"]["shape"] == (len(features["observation.skin"]["names"]),)
            return SimpleNamespace(add_frame=frames.append, save_episode=lambda: saved.append(fps))

    names = {"lerobot": {}, "lerobot__datasets": {}, "lerobot__datasets__lerobot_dataset": {"LeRobotDataset": Dataset}}
    run("lerobot", **names)
    np.testing.assert_allclose(frames[0]["observation.skin"], [4.0, 6.0, 0.5, *range(15)])
    assert saved == [30]


def test_robot_example(monkeypatch):
    moved, recorded = [], []
    robot = SimpleNamespace(
        places_in_random_order=lambda: [(4.0, 8.0), (0.0, 2.0)], lift_and_go_to=lambda *place: moved.append(place),
        press=lambda: moved.append("press"), force_N=lambda: 0.5,
    )  # fmt: skip
    monkeypatch.setattr(reskin, "record", lambda labels, **options: recorded.extend([*labels, options]))
    exec(EXAMPLES["robot"], {"robot": robot})
    assert moved == [(4.0, 8.0), "press", (0.0, 2.0), "press"]
    assert (recorded[1].x_mm, recorded[1].Fz_N, recorded[0].contact) == (4.0, 0.5, False)
    assert recorded[-1]["scan"] == "random"
