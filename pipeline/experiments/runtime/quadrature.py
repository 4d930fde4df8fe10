"""Error of dB over rules of quadrature. In: trials, and rules for each method. Out: rows, and calls for the stopwatch.

All methods move their nodes by the same flow; the reference is a finer rule of higher order, and how wrong that is at
most is a row too. Refuses to know clocks, pictures and which rule the product takes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field
from scipy.constants import milli

from pipeline.experiments.runtime.methods import METHODS, Prepared, whole
from pipeline.experiments.runtime.rows import REFERENCE, Contestant, Precision, written
from pipeline.experiments.runtime.trials import Pokes, Trial, gauss_everywhere
from reskin.errors import ParamsError
from reskin.physics.magnet import Quadrature

STUDY = "dB of an indentation"
ALL = "all depths"
Cell_mm = Annotated[float, Field(gt=0, le=20)]
Layers = Annotated[int, Field(ge=1, le=100)]


class Quadratures(Pokes):
    """Pokes seen from the skin's middle, on so many skins, and (cell, layers) of every rule of every method."""

    skins_n: Annotated[int, Field(ge=1, le=100)]
    rules: Annotated[dict[str, tuple[tuple[Cell_mm, Layers], ...]], Field(min_length=1)]

    def rules_of(self) -> dict[str, list[Quadrature]]:
        """Give the rules of every method."""
        return {name: [Quadrature(milli * cell, n) for cell, n in rules] for name, rules in self.rules.items()}


@dataclass(frozen=True)
class Reference:
    """Gauss rules along x, y and z: the truth is the finer one, and the coarser one bounds its error.

    Moved boxes would be the obvious truth, but rigid boxes overlap where the skin is squeezed: they approach this one
    with the square of the cell, 5-9 % off at 0.4 mm x 20 layers, and extrapolated to no cell within 1 %.
    """

    coarser: Quadrature
    finer: Quadrature
    per_cell_n: int


FINE = Reference(coarser=Quadrature(0.7e-3, 8), finer=Quadrature(0.5e-3, 10), per_cell_n=3)


def study_quadratures(
    trials: Sequence[Trial], rules: Mapping[str, Sequence[Quadrature]], reference: Reference = FINE
) -> tuple[list[Precision], list[Contestant]]:
    """Compare every rule of every method with the reference, over all trials; the first trial is what is timed.

    `parts` of a row holds the error of each depth, of the skin that is worst there; `error` is the worst of these.
    """
    if not trials or (unknown := set(rules) - set(METHODS)):
        got = unknown if trials else "no trial"
        raise ParamsError(STUDY, "methods", f"among {list(METHODS)}", got, "Mend the rules.")
    truths_T = [_reference(trial, reference.finer, reference.per_cell_n).call() for trial in trials]
    coarser = [_reference(trial, reference.coarser, reference.per_cell_n) for trial in trials]
    found_T = [prepared.call() for prepared in coarser]
    rows = [_row(REFERENCE, reference.coarser, coarser[0].nodes_n, errors(trials, found_T, truths_T))]
    contestants = []
    for method, rule in ((method, rule) for method, of_method in rules.items() for rule in of_method):
        skins = [METHODS[method](trial, rule) for trial in trials]
        found_T = [prepared.call() for prepared in skins]
        rows.append(_row(method, rule, skins[0].nodes_n, errors(trials, found_T, truths_T)))
        contestants.append(Contestant(rows[-1].key, skins[0].call, len(trials[0].pokes_m)))
    return rows, contestants


def errors(
    trials: Sequence[Trial],
    found_T: Sequence[Float[np.ndarray, "n k 3"]],
    truth_T: Sequence[Float[np.ndarray, "n k 3"]],
) -> dict[str, float]:
    """Give rms error over rms of dB at each depth, of the skin that is worst there, and over all pokes of all skins."""
    depths_mm = trials[0].depths_mm
    shape = (len(trials), len(depths_mm), -1)
    true_T = np.stack(truth_T).reshape(shape)
    wrong_T = np.stack(found_T).reshape(shape) - true_T
    each = np.linalg.norm(wrong_T, axis=2) / np.linalg.norm(true_T, axis=2)
    named = {f"{depth:.3g} mm": float(worst) for depth, worst in zip(depths_mm, each.max(axis=0), strict=True)}
    return named | {ALL: float(np.linalg.norm(wrong_T) / np.linalg.norm(true_T))}


def _row(method: str, rule: Quadrature, nodes_n: int, parts: dict[str, float]) -> Precision:
    return Precision(STUDY, method, written(rule), work_n=nodes_n, error=max(parts.values()), parts=parts)


def _reference(trial: Trial, rule: Quadrature, per_cell_n: int) -> Prepared:
    return whole(trial, gauss_everywhere(trial.skin.thickness_m, rule, per_cell_n=per_cell_n))
