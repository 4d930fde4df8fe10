"""Was a network adapted to a new skin without a look at its tests? In: what its card says, its fold. Out: `Check`s.

It must go on from the network of its own fold and seed, and its pokes must be of the fold's pool and of no tested
indentation. Refuses to know how it was adapted.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Int

from pipeline.experiments.audit.checks import Check
from pipeline.experiments.audit.sides import Sides


def audit_tuning(
    where: str, tuning: Mapping[str, Any], *, bases: set[str], sides: Sides, indentation: Int[np.ndarray, " f"]
) -> list[Check]:
    """Check a card's `tuning`; `bases` are the keys of the networks of its fold and seed."""
    own = np.array(tuning["indentations"], np.int64)
    tested = np.intersect1d(own, indentation[sides.test])
    strange = np.setdiff1d(own, indentation[sides.pool])
    base = "one of this fold and seed" if tuning["from"] in bases else "another"
    pokes = f"{len(tested)} of {len(own)} are tested, {len(strange)} are not of the pool"
    return [
        Check("base", where, "a network of its fold and seed", base, holds=tuning["from"] in bases, known=False),
        Check(
            "pokes",
            where,
            "of the pool, and none tested",
            pokes,
            holds=not len(tested) and not len(strange),
            known=False,
        ),
    ]
