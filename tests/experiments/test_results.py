"""Tests of the result files of experiments: numbers, data of figures, and how many rows each capture lost."""

from pathlib import Path

import pytest

from pipeline.experiments.results import only, read_losses
from reskin import io
from reskin.errors import SchemaError
from tests.data import tables


def test_results_list_the_lost_rows_of_each_capture(tmp_path):
    for i in range(2):
        account = {"bytes_n": 82 * (i + 1), "skipped_resync_bytes_n": i}
        io.write_readings(tmp_path / f"b{i}_s0-wear.parquet", [tables.readings()], account)
    losses = read_losses(tmp_path, {"low_force_rows_n": 3})
    assert [account["bytes_n"] for account in losses["accounts"]] == [82, 164]
    assert [account["skipped_resync_bytes_n"] for account in losses["accounts"]] == [0, 1]
    assert losses["left_out"] == {"low_force_rows_n": 3}


@pytest.mark.parametrize("captures", [[], ["b0_s0-glass", "b1_s0-glass"]])
def test_error_is_raised_if_there_is_no_capture_or_more_than_one(captures):
    with pytest.raises(
        SchemaError, match=f"ci-glass: {len(captures)} captures, but .* reads exactly one. Set skins_n: 1"
    ) as no:
        only(captures, Path("ci-glass"))
    assert "\n" not in str(no.value)
