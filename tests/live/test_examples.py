"""Tests that the example in docs/add-a-skin.md runs, with a substitute for the robot."""

import re
from types import SimpleNamespace

import reskin
from tests.stages.checkout import ROOT

PAGE = (ROOT / "docs/add-a-skin.md").read_text()
EXAMPLES = dict(re.findall(r"```python (\w+)\n(.*?)```", PAGE, re.DOTALL))


def test_example_of_a_robot_in_the_docs_runs(monkeypatch):
    moved, recorded = [], []
    robot = SimpleNamespace(
        places_in_random_order=lambda: [(4.0, 8.0), (0.0, 2.0)], lift_and_go_to=lambda *place: moved.append(place),
        press=lambda: moved.append("press"), force_N=lambda: 0.5,
    )  # fmt: skip
    monkeypatch.setattr(reskin, "record", lambda labels, **options: recorded.extend([*labels, options]))
    exec(EXAMPLES["robot"], {"robot": robot})
    assert moved == [(4.0, 8.0), "press", (0.0, 2.0), "press"]
    assert (recorded[1].x_mm, recorded[1].Fz_N, recorded[0].contact) == (4.0, 0.5, False)
    assert recorded[-1]["scan"] == "random"
