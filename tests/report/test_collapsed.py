from hypothesis import given
from hypothesis import strategies as st

from pipeline.experiments.audit import audit_collapse
from pipeline.statistics import tally

OF_ONE = st.fixed_dictionaries({"collapsed": st.booleans(), "collapsed_before_n": st.integers(0, 2)})


@given(st.lists(OF_ONE))
def test_every_training_is_counted_once(done):
    """Counted one by one: each trial as often as it was trained, each collapse of it."""
    attempts = [[True] * one["collapsed_before_n"] + [one["collapsed"]] for one in done]
    assert tally(done) == {
        "trainings_n": sum(map(len, attempts)),
        "collapsed_n": sum(map(sum, attempts)),
        "kept_collapsed_n": sum(own[-1] for own in attempts),
    }


def card(seed_i, **words):
    return {"question": "lobo", "recipe_name": "paper", "fold": "b0", "seed_i": seed_i, "collapsed": False,
            "collapsed_before_n": 0} | words  # fmt: skip


def test_a_dead_network_is_named_in_the_audit_and_is_no_leak():
    check = audit_collapse(
        "train_multi", [card(0, collapsed_before_n=2), card(1, collapsed=True, collapsed_before_n=2)]
    )
    assert check.found == "1 of 2 collapsed: lobo.paper.b0.seed1; 4 trained again"
    assert (check.holds, check.known) == (False, True)
    assert audit_collapse("train_multi", [card(0)]).holds
