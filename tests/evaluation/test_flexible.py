"""How much nearer flexible boards are to their skins: closed form, and what no gap can change."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.experiments.flexible.boards import gap_less_pct


def test_a_gap_of_a_fifth_is_80_percent_less():
    assert gap_less_pct({"rigid": 2.0, "flexible": 0.4}) == pytest.approx(80.0)


@given(rigid=st.floats(0.1, 10), share=st.floats(0, 3), unit=st.floats(0.01, 100))
def test_it_is_a_share_whatever_the_unit(rigid, share, unit):
    found = gap_less_pct({"rigid": unit * rigid, "flexible": unit * share * rigid})
    assert found == pytest.approx(100 * (1 - share), abs=1e-9)  # rounding
