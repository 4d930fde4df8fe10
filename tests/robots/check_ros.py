"""Compare recorded message definitions with the package rosbags, and serialise published messages as ROS 2 does.

Run by tests/robots/test_ros2.py with the Python of RESKIN_ROSBAGS: PYTHON check_ros.py DEFINITIONS MESSAGES, where the
file MESSAGES has a list of pairs of a type, such as `std_msgs/msg/Bool`, and a message as JSON.
"""

import json
import sys
from pathlib import Path

import numpy as np
from rosbags.typesys import Stores, get_typestore


def build(store, name: str, value: dict):
    """Return a message of rosbags from plain values."""
    arguments = {}
    for field, (kind, detail) in store.fielddefs[name][1]:
        given = value[field]
        if kind.name == "NAME":
            given = build(store, detail, given)
        elif kind.name == "ARRAY":
            given = np.array(given)
        elif kind.name == "SEQUENCE":
            given = [build(store, detail[0][1], each) for each in given]
        arguments[field] = given
    return store.types[name](**arguments)


def main(definitions: Path, messages: Path) -> None:
    for number in (Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY):
        store = get_typestore(number)
        for part in definitions.read_text().split("# ")[1:]:
            title, _, body = part.partition("\n")
            expected = store.generate_msgdef(title, ros_version=2)[0].split("=====")[0]
            assert body.strip() == expected.strip(), title
        for name, value in json.loads(messages.read_text()):
            message = build(store, name, value)
            again = store.deserialize_cdr(store.serialize_cdr(message, name), name)
            assert str(again) == str(message), name
    print("all definitions and messages equal those of ROS 2")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
