"""A strict fake of rclpy, with message classes that are made from recorded message definitions.

`ros_messages.txt` has the definitions of ROS 2 Humble and Jazzy, without comments. If RESKIN_ROSBAGS is set,
test_ros2.py compares them with the package rosbags. As in rclpy, the classes refuse unknown
fields, and values of a wrong type, size or range.
"""

import re
from collections import defaultdict
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

DEFINITIONS = Path(__file__).with_name("ros_messages.txt")
RANGES = {"int32": (-(2**31), 2**31 - 1), "uint32": (0, 2**32 - 1)}
DEFAULTS = {"bool": False, "string": "", "float64": 0.0, "byte": b"\x00", "int32": 0, "uint32": 0}
TYPES = {"bool": bool, "string": str, "float64": float, "byte": bytes, "int32": int, "uint32": int}
FIELD = re.compile(r"([\w/]+)(\[(\d*)\])? (\w+)(?:=(\d+))?")


class Message:
    """Base class of messages."""

    fields: dict[str, tuple[str, int | None]]  # name -> type, and length (None: no array, 0: any length)
    classes: dict[str, type["Message"]]

    def __init__(self, **values: object) -> None:
        for name, (kind, length) in self.fields.items():
            make = self.classes.get(kind, lambda kind=kind: DEFAULTS[kind])
            setattr(self, name, make() if length is None else [make() for _ in range(length)])
        for name, value in values.items():
            setattr(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        kind, length = self.fields[name]  # KeyError for an unknown field
        values = [value] if length is None else value
        assert isinstance(values, list), f"{name}: {type(values)}"
        assert not length or len(values) == length, f"{name}: {len(values)} values"
        for each in values:
            assert type(each) is self.classes.get(kind, TYPES.get(kind)), f"{name}: {each!r} is not {kind}"
            if kind in RANGES:
                assert RANGES[kind][0] <= each <= RANGES[kind][1], f"{name}: {each}"
            assert kind != "byte" or len(each) == 1
        object.__setattr__(self, name, value)


def to_plain(value: Any) -> Any:
    """Convert a message to dicts, lists, numbers and texts."""
    if isinstance(value, Message):
        return {name: to_plain(getattr(value, name)) for name in value.fields}
    if isinstance(value, list):
        return [to_plain(each) for each in value]
    return value[0] if isinstance(value, bytes) else value


def read_classes() -> dict[str, type[Message]]:
    """Return the message classes by name, such as `std_msgs/Bool`."""
    classes: dict[str, type[Message]] = {}
    for part in DEFINITIONS.read_text().split("# ")[1:]:
        title, *lines = part.strip().splitlines()
        package, _, name = title.split("/")
        fields: dict[str, tuple[str, int | None]] = {}
        constants: dict[str, object] = {}
        for line in lines:
            kind, is_array, length, field, constant = FIELD.fullmatch(line).groups()
            if constant is not None:
                constants[field] = bytes([int(constant)])
            else:
                fields[field] = kind, int(length or 0) if is_array else None
        classes[f"{package}/{name}"] = type(name, (Message,), {"fields": fields, "classes": classes, **constants})
    return classes


class ExternalShutdownException(Exception):
    """Raised when the context of rclpy is shut down."""


class Node:
    """A node that stores what is published, by topic; `parameters` replace the defaults."""

    def __init__(self, parameters: dict[str, object]) -> None:
        self.published: dict[str, list[Message]] = defaultdict(list)
        self.services: dict[str, Any] = {}
        self.is_destroyed = False
        self._parameters = dict(parameters)

    def declare_parameter(self, name: str, default: object) -> SimpleNamespace:
        value = self._parameters.pop(name, default)
        assert type(value) is type(default)
        return SimpleNamespace(value=value)

    def create_publisher(self, kind: type[Message], topic: str, queue_n: int) -> SimpleNamespace:
        assert queue_n > 0

        def publish(message: Message) -> None:
            assert type(message) is kind
            self.published[topic].append(message)

        return SimpleNamespace(publish=publish)

    def create_service(self, kind: type, name: str, callback: Any) -> None:
        self.services[name] = kind, callback

    def get_logger(self) -> SimpleNamespace:
        return SimpleNamespace(info=print, fatal=print)

    def destroy_node(self) -> None:
        self.is_destroyed = True


def fake_modules(node: Node, spin: Any) -> dict[str, ModuleType]:
    """Return fakes of rclpy and of the packages of messages, by name; `spin` is called instead of `spin_once`."""
    contents: dict[str, dict[str, Any]] = defaultdict(dict)
    for name, kind in read_classes().items():
        package, _, short = name.partition("/")
        contents[f"{package}.msg"][short] = kind
    trigger = type("Trigger", (), {"Response": SimpleNamespace})
    contents["std_srvs.srv"]["Trigger"] = trigger
    contents["rclpy.executors"]["ExternalShutdownException"] = ExternalShutdownException
    contents["rclpy"] = {
        "init": lambda args: None, "create_node": lambda _: node, "try_shutdown": lambda: None,
        "spin_once": lambda spun, timeout_sec: spin(),
    }  # fmt: skip
    for name in list(contents):
        contents[name.partition(".")[0]]  # creates the content of the package itself, e.g. of std_msgs for std_msgs.msg
    modules = {name: ModuleType(name) for name in contents}
    for name, module in modules.items():
        vars(module).update(contents[name])
    return modules
