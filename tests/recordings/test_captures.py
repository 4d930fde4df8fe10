import pytest

from reskin.errors import CaptureError
from reskin.recordings.header import write_capture
from reskin.recordings.ingest import check_losses, open_capture, read_header
from reskin.recordings.readers import READERS, lab
from tests.recordings.headers import AS_USUAL, make_header
from tests.recordings.readers.test_lab import NAMES, PRESSES


def capture(folder):
    text = "\n".join([NAMES, *PRESSES]) + "\n"
    write_capture(folder, make_header(capture=folder.name, chips_n=2), {lab.READINGS: text.encode()})
    return folder


def test_capture_opens_with_the_reader_of_its_layout(tmp_path):
    header, blocks, account = open_capture(capture(tmp_path / "c0"), AS_USUAL)
    assert header.layout in READERS
    assert sum(map(len, blocks)) == account["rows_n"] == 4


def test_changed_file_is_refused(tmp_path):
    folder = capture(tmp_path / "c0")
    with (folder / lab.READINGS).open("a") as stream:
        stream.write("\n")
    with pytest.raises(CaptureError, match="has changed since it was added"):
        open_capture(folder, AS_USUAL)
    (folder / lab.READINGS).unlink()
    with pytest.raises(CaptureError, match="file not found, but the header lists it"):
        open_capture(folder, AS_USUAL)


def test_folder_without_header_is_refused(tmp_path):
    with pytest.raises(CaptureError, match="no capture folder"):
        read_header(tmp_path)


@pytest.mark.parametrize(
    ("account", "message"),
    [
        (
            {"bytes_n": 100, "skipped_resync_bytes_n": 6},
            "more than 5% of 100 bytes are lost: 6 skipped_resync_bytes",
        ),
        ({"rows_read_n": 10, "dropped_failed_read_rows_n": 1}, "1 dropped_failed_read_rows"),
        ({"frames_n": 10, "dropped_no_time_frames_n": 9}, "9 dropped_no_time_frames"),
        ({"logged_indentations_n": 10, "dropped_no_frame_indentations_n": 9}, "9 dropped_no_frame_indentations"),
    ],
)
def test_too_much_loss_is_refused(account, message):
    with pytest.raises(CaptureError, match=message):
        check_losses(account, 0.05, "c0")


def test_small_loss_and_frames_between_dwells_are_accepted():
    check_losses(
        {"bytes_n": 100, "skipped_resync_bytes_n": 5, "frames_n": 9, "dropped_between_dwells_frames_n": 8}, 0.05, "c0"
    )
