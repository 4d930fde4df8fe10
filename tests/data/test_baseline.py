import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.data.baseline import alike_within_uT, each, follow_free, free, initial, rank, regular, subtract
from reskin.seeds import rng_for

B_uT, NOLOAD_uT = (rng_for(0, name).normal(0, 500, (5, 15)).astype(np.float32) for name in ("b", "noload"))


def test_field_changes_equal_those_computed_by_nested_loops():
    expected = [[float(B_uT[f, ch] - NOLOAD_uT[f, ch]) for ch in range(15)] for f in range(5)]
    assert subtract(B_uT, NOLOAD_uT).tolist() == expected


@given(st.floats(-3000, 3000, width=32))
def test_field_changes_are_not_affected_by_a_constant_external_field(ambient_uT):
    # The tolerance in uT is rounding: single precision rounds fields of a few thousand uT by about 1e-4 uT.
    shifted = subtract(B_uT + np.float32(ambient_uT), NOLOAD_uT + np.float32(ambient_uT))
    np.testing.assert_allclose(shifted, subtract(B_uT, NOLOAD_uT), atol=2e-3)


runs_n = st.lists(st.integers(1, 4), min_size=1, max_size=12)  # The number of readings of each indentation.


def capture(runs_n: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return no-load fields and indentation numbers.

    Each no-load field equals the number of its indentation. Some numbers are missing.
    """
    indentation = np.repeat(7 + 3 * np.arange(len(runs_n), dtype=np.int32), runs_n)
    return np.repeat(indentation[:, None], 3, axis=1).astype(np.float32), indentation


@given(runs_n, st.integers(1, 5))
def test_no_load_readings_chosen_by_each_policy_equal_those_of_a_loop(runs_n, regular_n):
    noload_uT, indentation = capture(runs_n)
    seen, first, last = [], None, None
    for i, number in enumerate(indentation.tolist()):
        if number not in seen:
            if len(seen) % regular_n == 0:
                last = noload_uT[i, 0]
            seen.append(number)
        first = noload_uT[0, 0] if first is None else first
        assert initial(noload_uT, indentation)[i].tolist() == [first] * 3
        assert regular(noload_uT, indentation, regular_n=regular_n)[i].tolist() == [last] * 3
        assert each(noload_uT, indentation)[i].tolist() == [number] * 3


@given(runs_n, st.integers(1, 5))
def test_all_policies_use_the_same_no_load_reading_at_the_first_indentation(runs_n, regular_n):
    noload_uT, indentation = capture(runs_n)
    first = slice(0, runs_n[0])
    for policy in (initial(noload_uT, indentation), regular(noload_uT, indentation, regular_n=regular_n)):
        assert (policy[first] == each(noload_uT, indentation)[first]).all()
    assert (regular(noload_uT, indentation, regular_n=1) == each(noload_uT, indentation)).all()
    assert (regular(noload_uT, indentation, regular_n=len(runs_n)) == initial(noload_uT, indentation)).all()


def test_rank_numbers_indentations_in_their_order_in_time():
    assert rank(np.array([5, 5, 2, 9, 9])).tolist() == [0, 0, 1, 2, 2]
    assert rank(np.zeros(0, np.int32)).tolist() == []


def make_touches(rows_n: int, touches_n: int = 200, walk_uT: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the field, the randomly drifting no-load field and the touch number of each row.

    A touch has `rows_n` rows.
    """
    rng = rng_for(0, "touched")
    rest_uT = np.cumsum(walk_uT * rng.standard_normal((touches_n, 15)), axis=0)
    touch_uT = 60 * rng.standard_normal((touches_n, 15))
    indentation = np.repeat(np.arange(touches_n, dtype=np.int32), rows_n)
    noload_uT = rest_uT[indentation].astype(np.float32)
    return noload_uT + touch_uT[indentation].astype(np.float32), noload_uT, indentation


@pytest.mark.parametrize("rows_n", [1, 4, 50])
def test_no_load_field_estimated_between_touches_follows_the_drift(rows_n):
    b_uT, noload_uT, indentation = make_touches(rows_n)
    within_uT = alike_within_uT(noload_uT[: 20 * rows_n], indentation[: 20 * rows_n])
    assert within_uT == pytest.approx(2.0, rel=0.2)
    off_uT = free(b_uT, noload_uT, indentation, within_uT=within_uT) - noload_uT
    # The estimate is usually less than one touch old, and occasionally one or two touches.
    assert np.sqrt((off_uT**2).mean()) < 0.7
    assert np.sqrt(((initial(noload_uT, indentation) - noload_uT) ** 2).mean()) > 5


def test_no_load_reading_is_not_replaced_during_a_long_slide():
    b_uT, noload_uT, _ = make_touches(1, walk_uT=0.1)
    sent = [field for pair in zip(noload_uT, b_uT, strict=True) for field in pair]
    slid = [*sent[:100], *(sent[101] + 20 * i for i in range(60)), *sent[100:]]
    zeros = list(follow_free(slid, within_uT=0.5))
    np.testing.assert_array_equal(zeros[159], sent[98])
    np.testing.assert_array_equal(zeros[-1], sent[-2])


def test_no_load_field_estimated_between_touches_does_not_depend_on_later_readings():
    b_uT, noload_uT, indentation = make_touches(2)
    whole, part = (free(b_uT[:n], noload_uT[:n], indentation[:n], within_uT=2.0) for n in (400, 123))
    np.testing.assert_array_equal(whole[:123], part)
