"""Labels of points find places of their own."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.report.figures import place_labels

LABEL = np.array([0.06, 0.05])
MARK = np.array([0.03, 0.04])
PARTS = st.tuples(st.floats(0.1, 0.9), st.floats(0.1, 0.9))


@given(st.lists(PARTS, min_size=1, max_size=16))
def test_no_label_hides_a_label_or_a_mark_or_leaves_the_axes(points):
    places = np.array(points)
    labels = place_labels(places, places, label=LABEL, mark=MARK)
    exact = 1e-9  # rounding of a sum of parts
    for i, own in enumerate(labels):
        for other in labels[:i]:
            assert (np.abs(own - other) >= LABEL - exact).any()
        for point in places:
            assert (np.abs(own - point) >= (LABEL + MARK) / 2 - exact).any()
        assert (own >= LABEL / 2 - exact).all()
        assert (own <= 1 - LABEL / 2 + exact).all()


def test_a_label_that_hides_nothing_stands_where_it_is_wished():
    wished = np.array([[0.4, 0.5], [0.6, 0.3]])
    labels = place_labels(np.array([[0.5, 0.5]]), wished, label=LABEL, mark=MARK)
    # Nearest of places that are 0.01 apart.
    np.testing.assert_allclose(labels, wished, atol=0.0051)
