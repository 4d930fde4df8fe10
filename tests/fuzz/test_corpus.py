"""Every fuzz target accepts its corpus or raises a `ReskinError`."""

import pytest

from tests.fuzz.fuzz import CORPUS
from tests.fuzz.targets import TARGETS, feed


@pytest.mark.parametrize("name", TARGETS)
def test_corpus(name):
    for file in sorted((CORPUS / name).iterdir()):
        feed(name, file.read_bytes())
