from hypothesis import given
from hypothesis import strategies as st

from reskin.seeds import rng_for, seed_for

names = st.lists(st.text(max_size=5), max_size=3)


@given(st.integers(0, 2**40), names)
def test_equal_seeds_and_names_give_equal_random_numbers(seed, path):
    assert rng_for(seed, *path).integers(2**60) == rng_for(seed, *path).integers(2**60)


@given(st.integers(0, 2**40), names, names)
def test_different_names_or_seeds_give_different_generators(seed, one, other):
    if one != other:
        assert seed_for(seed, *one) != seed_for(seed, *other)
    assert seed_for(seed, *one) != seed_for(seed + 1, *one)


def test_generator_depends_on_where_one_name_ends_and_the_next_begins():
    assert seed_for(0, "a", "bc") != seed_for(0, "ab", "c")
