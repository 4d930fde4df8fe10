"""A question that reads one capture refuses to choose among several."""

from pathlib import Path

import pytest

from pipeline.core.errors import SchemaError
from pipeline.experiments.only import only


def test_the_one_capture_of_a_folder_is_given():
    assert only(["b0_s0-glass"], Path("ci-glass")) == "b0_s0-glass"


@pytest.mark.parametrize("captures", [[], ["b0_s0-glass", "b1_s0-glass"]])
def test_none_or_several_captures_are_refused_and_counted(captures):
    with pytest.raises(SchemaError, match=f"ci-glass: captures must be one, as .*; got {len(captures)}. Ask its") as no:
        only(captures, Path("ci-glass"))
    assert "\n" not in str(no.value)
