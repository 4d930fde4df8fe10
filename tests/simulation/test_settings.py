"""Tests of the check that a scene's protocols have the kind, boards and skins that the experiments need."""

import pytest

from pipeline.simulation import check_protocols
from reskin.errors import ParamsError
from tests.simulation.scene import DRAG, GRID, HAND, LOAD, SECTIONS, synthesis, with_protocol

FLEXIBLE = SECTIONS["boards"] | {"flexible": SECTIONS["boards"]["rigid"] | {"letter": "f"}}
FRICTION = {"boards": FLEXIBLE, "terms": {"friction": {"coefficient": 0.8}}}


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("wear", "grid"), ("flexible", "grid"), ("drag", "drag"), ("hand", "hand"), ("sleeve", "scatter"),
        ("glass", "load"), ("grip", "load"), ("log", "walk"),
    ],
)  # fmt: skip
def test_wrong_kind_of_protocol_is_an_error(name, kind):
    other = HAND if kind == "grid" else GRID | {"skins_n": 1}
    message = f"test: protocol {name}: kind must be {kind}, which its experiment reads, not {other['kind']}. "
    with pytest.raises(ParamsError, match=message) as refused:
        check_protocols(with_protocol(name, other), "test")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("name", "protocol", "changes", "message"),
    [
        ("wear", GRID | {"skins_n": 2}, {}, "protocol wear: skins_n must be 1, .*, not 2"),
        ("glass", LOAD | {"skins_n": 2}, {}, "protocol glass: skins_n must be 1, .*, not 2"),
        (
            "glass",
            LOAD | {"boards": "flexible"},
            {"boards": FLEXIBLE},
            "protocol glass: boards must be rigid, .* flexible",
        ),
        (
            "grip",
            LOAD | {"boards": "flexible"},
            {"boards": FLEXIBLE},
            "protocol grip: boards must be rigid, .* flexible",
        ),
        (
            "hand",
            HAND | {"boards": "flexible"},
            {"boards": FLEXIBLE},
            "protocol hand: boards must be rigid, .* flexible",
        ),
        ("drag", DRAG | {"boards": "flexible"}, FRICTION, "protocol drag: boards must be rigid, .* flexible"),
        ("flexible", GRID, {"boards": FLEXIBLE}, "protocol flexible: boards must not be rigid"),
    ],
)
def test_wrong_boards_or_skins_are_an_error(name, protocol, changes, message):
    with pytest.raises(ParamsError, match=message):
        check_protocols(with_protocol(name, protocol, **changes), "test")


@pytest.mark.parametrize(
    ("name", "protocol", "changes"),
    [
        ("drag", DRAG, FRICTION), ("glass", LOAD, {}),
        ("flexible", GRID | {"boards": "flexible"}, {"boards": FLEXIBLE}),
    ],
)  # fmt: skip
def test_suitable_protocols_are_accepted(name, protocol, changes):
    check_protocols(with_protocol(name, protocol, **changes), "test")


def test_boards_of_protocol_grid_must_have_a_skin_of_the_size_in_the_paper():
    changed = synthesis("boards", rigid=SECTIONS["boards"]["rigid"] | {"skin_mm": (50.8, 101.6)})
    with pytest.raises(ParamsError, match="skin_mm of the boards of protocol grid must be .20.0, 20.0."):
        check_protocols(changed, "test")
