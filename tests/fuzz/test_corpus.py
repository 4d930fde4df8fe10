"""Test that each fuzz target accepts each input of its corpus or raises a `ReskinError`."""

import pytest

from tests.fuzz.fuzz import CORPUS
from tests.fuzz.targets import TARGETS, feed


@pytest.mark.parametrize("name", TARGETS)
def test_corpus_raises_only_reskin_errors(name):
    for file in sorted((CORPUS / name).iterdir()):
        feed(name, file.read_bytes())
