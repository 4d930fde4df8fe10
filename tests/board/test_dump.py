import numpy as np
import pytest

from reskin.board.decode import decode_dump
from reskin.board.wire import encode
from reskin.errors import CaptureError
from tests.board.signals import make_frames


def test_a_dump_becomes_a_column_a_channel_with_its_unit():
    frames = make_frames(4, 2, seed=0)
    table, account = decode_dump(encode(frames, "binary"), "binary", 2, "dump.bin")
    assert account["frames_n"] == len(table) == 4
    np.testing.assert_array_equal(table["by1_uT"].to_numpy(), frames.b_uT[:, 4])
    np.testing.assert_array_equal(table["temperature1_degC"].to_numpy(), frames.temperature_degC[:, 1])
    assert table.schema.field("bz0_uT").metadata[b"unit"] == b"uT"
    assert table["end_byte"].to_pylist() == [34, 68, 102, 136]


def test_a_dump_without_a_frame_is_refused():
    with pytest.raises(CaptureError, match="no frame found in 3 bytes"):
        decode_dump(b"abc", "binary", 2, "dump.bin")
