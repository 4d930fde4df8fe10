import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.seeds import rng_for
from pipeline.dataset.baseline import each, initial, rank, regular, subtract

B_uT, NOLOAD_uT = (rng_for(0, name).normal(0, 500, (5, 15)).astype(np.float32) for name in ("b", "noload"))


def test_the_change_is_what_two_loops_find():
    expected = [[float(B_uT[f, ch] - NOLOAD_uT[f, ch]) for ch in range(15)] for f in range(5)]
    assert subtract(B_uT, NOLOAD_uT).tolist() == expected


@given(st.floats(-3000, 3000, width=32))
def test_a_field_that_is_always_there_drops_out(ambient_uT):
    # float32 numbers of thousands carry some 1e-4 of rounding each
    shifted = subtract(B_uT + np.float32(ambient_uT), NOLOAD_uT + np.float32(ambient_uT))
    np.testing.assert_allclose(shifted, subtract(B_uT, NOLOAD_uT), atol=2e-3)


runs_n = st.lists(st.integers(1, 4), min_size=1, max_size=12)  # readings of each indentation


def capture(runs_n: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Indentations, numbered with gaps, and the no-load field of each: its number."""
    indentation = np.repeat(7 + 3 * np.arange(len(runs_n), dtype=np.int32), runs_n)
    return np.repeat(indentation[:, None], 3, axis=1).astype(np.float32), indentation


@given(runs_n, st.integers(1, 5))
def test_policies_are_what_a_loop_over_readings_finds(runs_n, regular_n):
    noload_uT, indentation = capture(runs_n)
    seen, first, last = [], None, None
    for i, own in enumerate(indentation.tolist()):
        if own not in seen:
            if len(seen) % regular_n == 0:
                last = noload_uT[i, 0]
            seen.append(own)
        first = noload_uT[0, 0] if first is None else first
        assert initial(noload_uT, indentation)[i].tolist() == [first] * 3
        assert regular(noload_uT, indentation, regular_n=regular_n)[i].tolist() == [last] * 3
        assert each(noload_uT, indentation)[i].tolist() == [own] * 3


@given(runs_n, st.integers(1, 5))
def test_policies_agree_at_the_first_indentation_and_a_reading_every_time_is_each(runs_n, regular_n):
    noload_uT, indentation = capture(runs_n)
    first = slice(0, runs_n[0])
    for policy in (initial(noload_uT, indentation), regular(noload_uT, indentation, regular_n=regular_n)):
        assert (policy[first] == each(noload_uT, indentation)[first]).all()
    assert (regular(noload_uT, indentation, regular_n=1) == each(noload_uT, indentation)).all()
    assert (regular(noload_uT, indentation, regular_n=len(runs_n)) == initial(noload_uT, indentation)).all()


def test_ranks_count_indentations_in_order_of_time():
    assert rank(np.array([5, 5, 2, 9, 9])).tolist() == [0, 0, 1, 2, 2]
    assert rank(np.zeros(0, np.int32)).tolist() == []
