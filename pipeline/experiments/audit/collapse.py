"""Does a headline average dead networks? In: the cards of one arm. Out: a `Check`.

A network that collapsed in every attempt is told by name and fails nothing: it is a result. Refuses to know how it is
found out.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.experiments.audit.checks import Check

COLLAPSE = "collapse"


def audit_collapse(arm: str, cards: Sequence[Mapping[str, Any]]) -> Check:
    """Count the networks of an arm that answer nearly the same to any input, and trainings that were done again."""
    kept = [
        f"{one['question']}.{one['recipe_name']}.{one['fold']}.seed{one['seed_i']}" for one in cards if one["collapsed"]
    ]
    again_n = sum(one["collapsed_before_n"] for one in cards)
    found = f"{len(kept)} of {len(cards)} collapsed{': ' if kept else ''}{', '.join(kept)}; {again_n} trained again"
    rule = "no network answers nearly the same to any input"
    return Check(COLLAPSE, arm, rule, found, holds=not kept, known=bool(kept))
