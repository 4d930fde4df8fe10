"""Tests of docs/tutorial.md: its commands run, and print what the page shows."""

import os

import pytest

from tests.sizes import FULL
from tests.tutorial import PAGE, Done, Step, checkout_copy, differences, read_steps, run, shown, write

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


PAGE_TEXT = """\
<!-- until ready; stop -->
```sh
serve
```

```text
ready in 2.00 s
```

```python
print(1)
```
"""


def test_read_steps_returns_the_options_and_outputs_of_steps():
    first, second = read_steps(PAGE_TEXT)
    assert first == Step("sh", "serve\n", "ready in 2.00 s\n", {"until": "ready", "stop": ""})
    assert second == Step("python", "print(1)\n", None)


@pytest.mark.parametrize(("printed", "differs"), [("2.4", False), ("2.6", True), ("about 2", True)])
def test_numbers_are_compared_with_a_tolerance_and_words_exactly(printed, differs):
    first, _ = read_steps(PAGE_TEXT)
    assert bool(differences(Done(first, f"ready in {printed} s\n"))) == differs


def test_write_replaces_only_the_outputs_on_the_page():
    done = [Done(step, "new\n") for step in read_steps(PAGE_TEXT)]
    assert write(PAGE_TEXT, done) == PAGE_TEXT.replace("ready in 2.00 s", "new")


def test_shown_output_replaces_the_folder_and_marks_omitted_lines(tmp_path):
    step = Step("sh", "", "", {"from": "two", "to": "three"})
    output = f"one\ntwo\none\ntwo {tmp_path}/a\nthree\nfour\n"
    assert shown(output, step, tmp_path) == "[...]\ntwo /home/me/reskin/a\nthree\n[...]\n"
