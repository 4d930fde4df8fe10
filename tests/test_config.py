"""Tests of the loader of YAML files."""

import pytest

from reskin.config import read_yaml
from reskin.errors import ParamsError


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("[" * 100_000, "more than 50 levels"),
        ("- " * 60_000, "more than 50 levels"),
        ("a: &a [1, 1]\nb: &b [*a, *a]\nc: [*b, *b]", "line 2 has an alias"),
        ("a: " + "9" * 5000, "digits"),
        ("a: 2026-99-99", "month"),
        ("# " + "x" * 2**22, "bytes"),
    ],
    ids=["deep flow", "deep lists", "aliases", "long number", "no such date", "large"],
)
def test_yaml_that_would_exhaust_the_loader_is_refused_in_one_sentence(tmp_path, text, fault):
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ParamsError, match=f"a.yaml: .*{fault}"):
        read_yaml(tmp_path / "a.yaml")
