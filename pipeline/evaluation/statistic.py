"""Mean, spread and number of plain values, and of values by unit and seed. In: floats. Out: {mean, sd, n}.

Refuses to know what the values are of.
"""

from collections.abc import Hashable, Mapping, Sequence

import numpy as np


def statistic(values: Sequence[float]) -> dict[str, float]:
    """Mean, standard deviation (n - 1; absent for one value) and number, as `metrics.summarise` gives them."""
    spread = {"sd": float(np.std(values, ddof=1))} if len(values) > 1 else {}
    return {"mean": float(np.mean(values)), "n": len(values)} | spread


def over_units(values: Sequence[tuple[Hashable, Mapping[str, float]]]) -> dict[str, dict[str, float]]:
    """Summarise named values over units (a fold, a skin), each unit the mean of its seeds."""
    units: dict[Hashable, list[Mapping[str, float]]] = {}
    for unit, one in values:
        units.setdefault(unit, []).append(one)
    names = values[0][1]
    return {name: statistic([float(np.mean([one[name] for one in own])) for own in units.values()]) for name in names}
