"""Every door survives what fuzzing found worth keeping."""

import pytest

from tests.fuzz.fuzz import CORPUS
from tests.fuzz.targets import TARGETS, feed


@pytest.mark.parametrize("name", TARGETS)
def test_what_arrives_is_answered_or_refused_in_one_sentence(name):
    for file in sorted((CORPUS / name).iterdir()):
        feed(name, file.read_bytes())
