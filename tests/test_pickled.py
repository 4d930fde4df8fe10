"""Tests of the safe decoder for pickles, which decodes plain values and NumPy arrays and runs no code.

Further tests are about archives of samples from the lab's rig.
"""

import hashlib
import os
import pickle
from contextlib import suppress
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.manage.fetch import read_sources
from reskin.errors import CaptureError
from reskin.recordings.pickled import COLUMNS, decode, to_lab_csv
from reskin.recordings.readers import lab
from tests.recordings.headers import DEFAULT_POLICY, make_header

PROTOCOLS = (3, 4)
ROOT = Path(__file__).resolve().parents[1]

scalars = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | st.binary()
values = st.recursive(
    scalars, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner) | st.lists(inner, max_size=5).map(tuple)
)


@given(values, st.sampled_from(PROTOCOLS))
def test_pickled_plain_values_are_decoded_unchanged(value, protocol):
    assert decode(pickle.dumps(value, protocol), "a") == value


def test_value_that_occurs_several_times_is_decoded_at_each_place():
    row = [1.5, 2.5]
    assert decode(pickle.dumps({"a": row, "b": [row, row]}, 3), "a") == {"a": row, "b": [row, row]}


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("kind", ["<f4", ">f8", "<i8", "u1", "bool"])
def test_numpy_values_become_lists(kind, protocol):
    array = np.arange(6).reshape(2, 3).astype(kind)
    found = decode(pickle.dumps({"array": array, "columns": array.T, "number": array[1, 2]}, protocol), "a")
    assert found == {"array": array.tolist(), "columns": array.T.tolist(), "number": array[1, 2].item()}


class CommandPickle:
    """An object whose pickle would run a command if Python loaded it."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_command_in_a_pickle_is_not_run(tmp_path, protocol):
    command = f"touch {tmp_path / 'ran'}"
    with pytest.raises(CaptureError, match="a call of posix system"):
        decode(pickle.dumps([CommandPickle(command)], protocol), "a")
    assert not (tmp_path / "ran").exists()
    pickle.loads(pickle.dumps([CommandPickle(command)], protocol))
    assert (tmp_path / "ran").exists()  # Python's own pickle module does run the command.


@given(st.binary(max_size=200) | st.binary(max_size=50).map(lambda tail: pickle.dumps([1, {"a": 2.5}], 4)[:-1] + tail))
def test_arbitrary_bytes_are_decoded_or_raise_a_capture_error(content):
    with suppress(CaptureError):
        decode(content, "a")


def sample(indent: int, place, fields, forces) -> dict:
    return {"ReSkin Data": fields, "Force Data": forces, "Location": place, "Indent": indent}


def archive_of(**samples) -> bytes:
    stream = BytesIO()
    np.savez(stream, **samples)  # NumPy pickles a list of dicts as an array of objects.
    return stream.getvalue()


def archive_of_csv(text: str) -> bytes:
    """Return an archive as the lab's rig writes it, with the rows of a lab CSV."""
    parts: dict[str, list] = {"noload": [], "contact": []}
    for line in text.splitlines()[1:]:
        indent, phase, *cells = line.split(",")
        numbers = [float(cell) for cell in cells]
        parts[phase].append(sample(int(indent), [int(cells[0]), int(cells[1])], numbers[2:-3], numbers[-3:]))
    return archive_of(bl_arr=parts["noload"], cont_arr=parts["contact"])


FIELDS = [float(i) for i in range(20)]


def test_samples_of_an_archive_become_rows_in_the_order_of_indentations():
    text = to_lab_csv(
        archive_of(
            bl_arr=[sample(0, [4, 0], FIELDS, [0, 0, 0]), sample(1, [6, 0], FIELDS, [0, 0, 0])],
            cont_arr=[
                sample(0, [4, 0], FIELDS, [0.1, 0, -2]),
                sample(1, [6, 0], np.array(FIELDS, "f4"), [0, 0.25, -3]),
            ],
        ),
        "a",
    ).decode()
    head, *rows = text.split("\r\n")[:-1]
    assert head == f"indent,phase,x_mm,y_mm,{','.join(COLUMNS)},Fx,Fy,Fz"
    assert [row.split(",")[:4] for row in rows] == [
        ["0", "noload", "4", "0"], ["0", "contact", "4", "0"], ["1", "noload", "6", "0"], ["1", "contact", "6", "0"],
    ]  # fmt: skip
    assert rows[-1].split(",")[4:8] == ["0.0000", "1.0000", "2.0000", "3.0000"]
    assert rows[-1].split(",")[-3:] == ["0.000000", "0.250000", "-3.000000"]


def test_converted_archive_is_read_as_a_recording_of_layout_lab(tmp_path):
    presses = [sample(i, [4 * i, 2], FIELDS, [0, 0, 0]) for i in range(3)]
    contacts = [sample(i, [4 * i, 2], [2 * value for value in FIELDS], [0, 0, -1 - i]) for i in range(3)]
    (tmp_path / lab.READINGS).write_bytes(to_lab_csv(archive_of(bl_arr=presses, cont_arr=contacts), "a"))
    readings, account = lab.read(tmp_path, make_header(layout="lab", chips_n=5), DEFAULT_POLICY)
    assert (account["rows_n"], account["noload_rows_n"]) == (3, 3)
    assert readings.x_mm.tolist() == [0, 4, 8]
    assert readings.Fz_N.tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("archive", "message"),
    [
        (b"", "not an .npz archive with samples in the arrays bl_arr and cont_arr: BadZipFile"),
        (archive_of(bl_arr=[sample(0, [0, 0], FIELDS, [0, 0, 0])]), "cont_arr.npy"),
        (archive_of(bl_arr=[1.5], cont_arr=[1.5]), "the array contains values of type float64 instead of objects"),
        (archive_of(bl_arr=[{"a": 1}], cont_arr=[{"a": 1}]), "KeyError 'Indent'"),
        (
            archive_of(bl_arr=[sample(0, [0, 0], [1.0], [0, 0, 0])], cont_arr=[{}]),
            "a sample has 2 coordinates, 1 readings",
        ),
        (
            archive_of(bl_arr=[sample(0, [0, 0], ["x"] * 20, [0, 0, 0])], cont_arr=[{}]),
            "ValueError Unknown format code",
        ),
    ],
)
def test_invalid_archive_is_an_error(archive, message):
    with pytest.raises(CaptureError, match=message) as caught:
        to_lab_csv(archive, "port_1.npz")
    assert str(caught.value).startswith("port_1.npz")
    assert "\n" not in str(caught.value)


def test_converted_archive_of_real_samples_equals_the_recorded_file(shared_data):
    """The original archive is not available. Therefore an archive is built from the recorded values."""
    file = shared_data / "lab/board1_depth1.csv"
    known = read_sources(ROOT)["lab"].files
    again = to_lab_csv(archive_of_csv(file.read_text()), "a")
    assert hashlib.sha256(again).hexdigest() == known[file.name]


def test_each_value_of_deeply_nested_references_is_converted_only_once():
    nested: list = []
    for _ in range(60):
        nested = [nested, nested]  # There are 2^60 paths through these references.
    found = decode(pickle.dumps(nested, 4), "a")
    assert found[0] is found[1]
