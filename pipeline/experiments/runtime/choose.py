"""Which quadrature the product should take. In: rows of the study, the rule it takes now. Out: the choice.

Refuses to know how errors were found.
"""

from collections.abc import Sequence

from pipeline.experiments.runtime.lattices import written
from pipeline.experiments.runtime.rows import CANDIDATES, ERROR_MAX, Choice, Precision
from pipeline.physics.nodes import Quadrature


def choose(rows: Sequence[Precision], *, used: Quadrature, error_max: float = ERROR_MAX) -> Choice:
    """Take the rule with the fewest nodes among those whose error, of the worst depth, is below `error_max`.

    Nodes stand for time, to which they are proportional, so that the choice is the same in every run.
    """
    tried = {row.setting: row for row in rows if row.method == CANDIDATES}
    passing = [row for row in tried.values() if row.error is not None and row.error < error_max]
    best = min(passing, key=lambda row: (row.work_n, row.error), default=None)
    now = tried.get(written(used))
    return Choice(
        setting=best.setting if best else None,
        nodes_n=best.work_n if best else None,
        error=best.error if best else None,
        used_setting=written(used),
        used_nodes_n=now.work_n if now else None,
        used_error=now.error if now else None,
        differs=best is None or best.setting != written(used),
    )
