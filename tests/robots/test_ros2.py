"""Tests of the ROS 2 node with a strict fake of rclpy (tests/robots/ros.py): pip cannot install rclpy."""

import json
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import reskin
from reskin.board import find
from reskin.live.tracker import Contact
from reskin.robots import ros2
from tests.live.boards import ScriptReader, make_script, write_model
from tests.robots.ros import DEFINITIONS, ExternalShutdownException, Message, Node, fake_modules, to_plain

ROSBAGS = os.environ.get("RESKIN_ROSBAGS")  # a Python with the package rosbags
B_uT = np.arange(15, dtype=np.float32)
TOUCHED = Contact(12.5, 4.0, 6.0, 0.5, (0.1, 0.2), B_uT, (), 0.05)
UNTOUCHED = Contact(12.6, np.nan, np.nan, 0.0, (np.nan, np.nan), B_uT, ())
FAULTY = Contact(12.7, np.nan, np.nan, np.nan, (np.nan, np.nan), B_uT, ("chip 1: failed I2C reads",), usable=False)
SILENT = Contact(
    12.8, np.nan, np.nan, np.nan, (np.nan, np.nan), np.full(15, np.nan, np.float32), ("no data",), usable=False
)
ESTIMATES = {"~/contact", "~/place", "~/force", "~/force_sd"}


class FakeSkin:
    """Fake of a `LiveSkin` that yields given contacts, and then shuts ROS down."""

    def __init__(self, contacts: list[Contact], *, has_model: bool = True) -> None:
        self.contacts, self.estimator = contacts, object() if has_model else None
        self.detected, self.port, self.description = SimpleNamespace(chips_n=5), "/dev/ttyACM0", "a board"
        self.zeroed, self.lost_bytes_n, self.zeros_n = True, 7, 0

    def __enter__(self) -> "FakeSkin":
        return self

    def __exit__(self, *_: object) -> None: ...

    def __iter__(self) -> Iterator[Contact]:
        yield from self.contacts
        raise ExternalShutdownException

    def zero(self) -> None:
        self.zeros_n += 1


@pytest.fixture
def run(monkeypatch):
    """Return a function that runs the node on a skin and returns the published messages of each topic."""

    def run(skin, spin=lambda: None, **parameters) -> dict[str, list[Message]]:
        node = Node({"rate_hz": 1e6, "port": "played"} | parameters)
        for name, module in fake_modules(node, spin).items():
            monkeypatch.setitem(sys.modules, name, module)
        if skin is not None:
            monkeypatch.setattr(reskin, "open", lambda port, **options: skin)
        ros2.main()
        assert node.is_destroyed
        run.node = node
        return node.published

    return run


def test_contact_is_published_in_SI_units_with_its_covariance(run):
    published = run(FakeSkin([TOUCHED]), frame_id="finger")
    (place,), (force,), (sd,) = (published[topic] for topic in ("~/place", "~/force", "~/force_sd"))
    assert published["~/contact"][0].data is True
    position, covariance = place.pose.pose.position, np.reshape(place.pose.covariance, (6, 6))
    np.testing.assert_allclose([position.x, position.y, position.z], [0.004, 0.006, 0])
    np.testing.assert_allclose(covariance, np.diag([1e-8, 4e-8, 0, 0, 0, 0]))
    wrench = [[getattr(part, axis) for axis in "xyz"] for part in (force.wrench.force, force.wrench.torque)]
    np.testing.assert_allclose(wrench, [[0, 0, -0.5], np.cross([0.004, 0.006, 0], [0, 0, -0.5])])
    assert sd.wrench.force.z == 0.05
    assert math.isnan(sd.wrench.force.x)
    for chip in range(5):
        (field,) = published[f"~/chip{chip}/field"]
        assert field.header.frame_id == f"finger_chip{chip}"
        b = field.magnetic_field
        np.testing.assert_allclose([b.x, b.y, b.z], 1e-6 * B_uT[3 * chip :][:3])
    for message in (place, force, sd, field):
        assert (message.header.stamp.sec, message.header.stamp.nanosec) == (12, 500_000_000)
    assert {place.header.frame_id, force.header.frame_id, sd.header.frame_id} == {"finger"}


def test_no_place_is_published_without_contact(run):
    published = run(FakeSkin([UNTOUCHED]))
    assert [message.data for message in published["~/contact"]] == [False]
    assert to_plain(published["~/force"][0].wrench.force) == {"x": 0.0, "y": 0.0, "z": 0.0}
    assert not {"~/place", "~/force_sd"} & set(published)


def test_unusable_readings_are_published_only_as_diagnostics(run):
    published = run(FakeSkin([FAULTY, SILENT]))
    assert set(published) == {"/diagnostics"}
    statuses = [message.status[0] for message in published["/diagnostics"]]
    assert [status.message for status in statuses] == ["chip 1: failed I2C reads", "no data"]
    assert [status.level for status in statuses] == [b"\x02", b"\x02"]
    assert to_plain(statuses[0].values) == [{"key": "lost_bytes_n", "value": "7"}]


def test_node_without_a_model_publishes_fields_but_no_estimates(run):
    contacts = [contact._replace(x_mm=np.nan, y_mm=np.nan, F_N=np.nan) for contact in (TOUCHED, FAULTY, UNTOUCHED)]
    published = run(FakeSkin(contacts, has_model=False))
    assert len(published["~/chip4/field"]) == 2
    assert not ESTIMATES & set(published)


def test_diagnostics_are_published_each_time_the_alarms_change(run, monkeypatch):
    monkeypatch.setattr(ros2, "DIAGNOSTICS_S", math.inf)
    published = run(FakeSkin([TOUCHED, UNTOUCHED, FAULTY, FAULTY, UNTOUCHED]))
    assert [message.status[0].message for message in published["/diagnostics"]] == [
        "no alarm", FAULTY.alarms[0], "no alarm",
    ]  # fmt: skip


def test_service_zero_takes_a_new_noload_reading(run):
    skin = FakeSkin([UNTOUCHED])
    run(skin)
    kind, zero = run.node.services["~/zero"]
    response = zero(None, kind.Response())
    assert (skin.zeros_n, response.success, bool(response.message)) == (1, True, True)


def test_limit_rate_keeps_contacts_at_the_given_rate(monkeypatch):
    now_s = iter(np.arange(4000) / 400)
    monkeypatch.setattr(ros2, "time", SimpleNamespace(monotonic=lambda: next(now_s)))
    kept = [contact is not None for contact in ros2.limit_rate(iter([TOUCHED] * 4000), 30.0)]
    assert sum(kept) == pytest.approx(300, abs=2)


def test_node_publishes_the_contacts_of_a_board(run, monkeypatch, tmp_path):
    reader = ScriptReader(make_script(pokes_n=1))
    monkeypatch.setattr("reskin.live.tracker.Reader", lambda port, baud: reader)

    def spin() -> None:
        if reader.at_end:
            raise KeyboardInterrupt

    published = run(None, spin, port="played", model=str(write_model(tmp_path)))
    assert {message.data for message in published["~/contact"]} == {True, False}
    x_m = [message.pose.pose.position.x for message in published["~/place"]]
    np.testing.assert_allclose(x_m, 0.004, atol=5e-4)
    assert len(published["~/chip0/field"]) == len(published["~/force"]) == len(published["~/contact"])


def test_error_ends_the_node_with_a_message(run, monkeypatch, capsys):
    monkeypatch.setattr(find, "port_names", lambda: [])
    for port, message in (("/dev/nowhere", "/dev/nowhere"), ("", "no board found")):
        with pytest.raises(SystemExit):
            run(None, port=port)
        assert message in capsys.readouterr().out


def test_find_model_selects_models_by_the_parameters_of_the_node():
    assert ros2.find_model("", "", 0.0) == []
    assert ros2.find_model("a.safetensors", "b.safetensors", 0.0) == ["a.safetensors", "b.safetensors"]
    assert ros2.find_model("", "", 30.0).external_uT == 30.0


@pytest.mark.skipif(ROSBAGS is None, reason="RESKIN_ROSBAGS=PYTHON is not set; PYTHON must have the package rosbags")
def test_definitions_and_messages_of_the_fake_equal_those_of_ROS_2(run, tmp_path):
    published = run(FakeSkin([TOUCHED, UNTOUCHED, SILENT]))
    types = {"~/contact": "std_msgs/msg/Bool", "~/place": "geometry_msgs/msg/PoseWithCovarianceStamped"}
    types |= {"~/force": "geometry_msgs/msg/WrenchStamped", "~/force_sd": "geometry_msgs/msg/WrenchStamped"}
    types |= {"/diagnostics": "diagnostic_msgs/msg/DiagnosticArray", "~/chip0/field": "sensor_msgs/msg/MagneticField"}
    messages = [(kind, to_plain(message)) for topic, kind in types.items() for message in published[topic]]
    (tmp_path / "messages.json").write_text(json.dumps(messages))
    command = [ROSBAGS, Path(__file__).with_name("check_ros.py"), DEFINITIONS, tmp_path / "messages.json"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
