"""Tests of reading archives of samples from the lab's rig, and that no code in a pickle is run."""

import hashlib
import os
import pickle
import zipfile
from contextlib import suppress
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.manage.fetch import read_sources
from reskin.errors import CaptureError
from reskin.recordings.pickled import COLUMNS, to_lab_csv
from reskin.recordings.readers import lab
from tests.recordings.headers import DEFAULT_POLICY, make_header

ROOT = Path(__file__).resolve().parents[1]
FIELDS = [float(i) for i in range(20)]


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


def archive_of_pickles(content: bytes, shape: str = "(1,)") -> bytes:
    """Return an archive whose two arrays of objects have this pickle."""
    text = f"{{'descr': '|O', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    stream = BytesIO()
    with zipfile.ZipFile(stream, "w") as file:
        for name in ("bl_arr", "cont_arr"):
            file.writestr(f"{name}.npy", b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + content)
    return stream.getvalue()


class Calling:
    """An object whose pickle makes Python call a function."""

    def __init__(self, function, *arguments) -> None:
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", range(6))
def test_command_in_a_pickle_is_refused_and_not_run(tmp_path, protocol):
    command = Calling(os.system, f"touch {tmp_path / 'ran'}")
    nested = Calling(np.dtype, command)
    for content in ([command], [nested], {"Indent": nested}):
        with pytest.raises(CaptureError, match=r"a.npz: .*system"):
            to_lab_csv(archive_of_pickles(pickle.dumps(content, protocol)), "a.npz")
    assert not (tmp_path / "ran").exists()
    pickle.loads(pickle.dumps([nested.call[1]], protocol))
    assert (tmp_path / "ran").exists()  # Python's own pickle module does run the command.


@pytest.mark.parametrize(
    "content",
    [
        # an array of 10^13 numbers, with the content of 8
        pickle.dumps(np.zeros(8), 3).replace(b"K\x08\x85", b"\x8a\x08" + (10**13).to_bytes(8, "little") + b"\x85"),
        pickle.dumps(Calling(np.zeros, 10**13), 4),
        pickle.dumps(
            pickle.PickleBuffer(bytearray(8)), 5, buffer_callback=lambda _: False
        ),  # out-of-band: buffer missing
        pickle.dumps(bytearray(8), 5).replace((8).to_bytes(8, "little"), (2**60).to_bytes(8, "little"), 1),
        b"\x80\x04Nr\xff\xff\xff\x7f.",  # the memo of Python's unpickler in C would take 34 GB
        b"\x80\x04cbuiltins\neval\n.",
        b"\x80\x04cnumpy._core.multiarray\nscalar\nN}X\x01\0\0\0aK\x01s\x86b.",  # sets an attribute of the class
    ],
    ids=["array", "call", "buffers", "bytearray", "memo", "global", "state"],
)
def test_pickle_that_asks_for_memory_or_names_a_function_is_refused(content):
    for shape in ("(1,)", "(10000000000000,)"):
        with pytest.raises(CaptureError, match="^a.npz: not an .npz archive") as caught:
            to_lab_csv(archive_of_pickles(content, shape), "a.npz")
        assert "\n" not in str(caught.value)


@given(st.binary(max_size=200) | st.binary(max_size=50).map(lambda tail: pickle.dumps([1, {"a": 2.5}], 4)[:-1] + tail))
def test_arbitrary_bytes_are_read_or_refused(content):
    with suppress(CaptureError):
        to_lab_csv(archive_of_pickles(content), "a.npz")


@pytest.mark.parametrize("protocol", [3, 4])
@pytest.mark.parametrize("kind", ["<f4", ">f8", "<i8", "u1"])
def test_numpy_numbers_and_arrays_are_read_like_plain_numbers(kind, protocol):
    plain = sample(3, [4, 2], FIELDS, [1, 2, 3])
    arrays = sample(
        np.int64(3), np.array([[4, 0], [2, 0]], kind).T[0], np.array(FIELDS, kind), [*np.array([1, 2, 3], kind)]
    )
    found = [to_lab_csv(archive_of_pickles(pickle.dumps([one], protocol)), "a") for one in (plain, arrays)]
    assert found[0] == found[1]


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
        (b"", "BadZipFile"),
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
