"""Tests of docs/tutorial.md: its commands run, and print what the page shows."""

import os

import pytest

from tests.sizes import FULL
from tools.tutorial import PAGE, checkout_copy, differences, read_steps, run

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo-terminals"),
    pytest.mark.timeout(3600),
]


@pytest.mark.skipif(not FULL, reason="takes minutes: RESKIN_SLOW_TESTS=1")
def test_commands_of_the_page_print_its_outputs():
    steps = read_steps(PAGE.read_text(encoding="utf-8"))
    with checkout_copy() as folder:
        wrong = [sentence for done in run(steps, folder) for sentence in differences(done)]
    assert not wrong, "\n".join(wrong)
