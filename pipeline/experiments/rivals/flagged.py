"""Are flagged readings truly worse? How unsure a method is, or what it leaves over -> errors of flagged and others.

A board's limit is what so many readings of the other boards exceed. Refuses to know how methods answer.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.experiments.rivals.points import board_of
from pipeline.report.statistics import statistic
from pipeline.training.universal import ASSUMED_TEMPER, METHODS, WAYS, Bench, pool_of, read_both, ready, tell
from reskin.data.splits import Fold
from reskin.metrics import ACCURACY_LIMIT_MM

EVERY_N = 10  # of the tested readings, one is asked
ByBoard = Mapping[str, Float[np.ndarray, "_"]]
Off = Mapping[str, Float[np.ndarray, "_ 2"]]


def first_folds(folds: Sequence[Fold]) -> dict[str, Fold]:
    """Give the first fold of each board."""
    return dict(sorted({board_of(fold): fold for fold in reversed(folds)}.items()))


def limits_of(value: ByBoard, fraction: float) -> dict[str, float]:
    """Give for each board the limit that this part of the other boards' readings exceeds."""
    others = {board: [own for other, own in value.items() if other != board] for board in value}
    return {board: float(np.quantile(np.concatenate(own), 1 - fraction)) for board, own in others.items()}


def worse(value: ByBoard, off_mm: Off, fraction: float) -> dict[str, Any]:
    """Summarise over boards how far flagged readings and all others are off; a board that flags none has no error."""
    found: dict[str, list[float]] = {}
    for board, limit in limits_of(value, fraction).items():
        flagged = value[board] > limit
        found.setdefault("flagged_pct", []).append(100 * float(flagged.mean()))
        for name, rows in (("flagged", flagged), ("others", ~flagged)):
            if rows.any():
                off = np.abs(off_mm[board][rows])
                within = (off <= ACCURACY_LIMIT_MM).all(axis=1)
                found.setdefault(f"accuracy_pct_{name}", []).append(100 * float(within.mean()))
                found.setdefault(f"mse_xy_mm2_{name}", []).append(float((off**2).mean()))
    return {name: statistic(values, boards=True) for name, values in found.items()}


def experts(bench: Bench, folds: Sequence[Fold], fraction: float) -> list[dict[str, Any]]:
    """Flag readings of the experts that know no board: by how unsure they are of a place, and by the misfit."""
    sd_mm, misfit, off_mm = {}, {}, {}
    for board, fold in first_folds(folds).items():
        rows, test = bench.data.rows, fold.test[::EVERY_N]
        told = ready(tell(bench.nominal, bench.seen[board].rest_uT.ravel(), pool_of(bench, fold)), 0)
        ((_, both),) = read_both(told, bench.frame.field(rows.db_uT[test]), [(ASSUMED_TEMPER, ASSUMED_TEMPER)])
        off_mm[board] = both.place_mm - bench.frame.place(rows.target[test, :2].astype(float))
        sd_mm[board], misfit[board] = both.sd_mm.max(axis=1), both.misfit
    method = METHODS[1] + WAYS["nominal"]
    by = {"standard deviation of the place": sd_mm, "misfit of the map": misfit}
    return [{"method": method, "by": name} | worse(value, off_mm, fraction) for name, value in by.items()]
