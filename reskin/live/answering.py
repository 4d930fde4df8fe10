"""Who answers while a board is at work: trained networks, or the map of simulated skins that comes with the project.

In: changes of field in contact. Out: places, forces, how sure they are, and whether this is a skin that was ever seen.
Refuses to know ports, frames and pages.
"""

from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from reskin.errors import ParamsError
from reskin.models.inputs import VIEW, Scaler
from reskin.models.trained import Network
from reskin.universal.calibration import CHANNELS_N
from reskin.universal.map import Estimate
from reskin.universal.model import Universal

UNLIKE_SDS = 10.0  # assumed, of an input in training; 6 in scene quick, 7 on lab's boards under its models
MISFIT_MAX = 4.0  # assumed, of chi^2 a channel: about 1 where the skin is one that the map knows
Models = Sequence[Network] | Universal


class Answered(NamedTuple):
    """Of each reading: x_mm, y_mm and F_N, the place's standard deviation, and whether it is like no known skin."""

    answer: Float64[np.ndarray, "f 3"]
    sd_mm: Float64[np.ndarray, "f 2"]
    unlike: Bool[np.ndarray, " f"]


class Networks:
    """Several give the mean, and how far they are apart: not how far they are from the truth."""

    channels_n: int

    def __init__(self, models: Sequence[Network]) -> None:
        self._models = models
        self.channels_n = models[0].card["input"]["channels_n"]
        self.about = f"{len(models)} network{'s' if len(models) > 1 else ''}"
        for model in models:  # imports and puts together what a first contact should not wait for
            model(np.zeros((1, model.card["input"]["channels_n"]), np.float32))
        self._scaled = [(VIEW[model.card["recipe"]["inputs"]], Scaler.of_arrays(model.tensors)) for model in models]

    def zero(self, b_uT: Float[np.ndarray, "f ch"]) -> None:
        """Networks are shown changes of field alone."""

    def __call__(self, db_uT: Float32[np.ndarray, "f ch"]) -> Answered:
        answers = np.stack([model(db_uT) for model in self._models]).astype(np.float64)
        sd_mm = answers[:, :, :2].std(axis=0, ddof=1) if len(answers) > 1 else np.full((len(db_uT), 2), np.nan)
        shown = np.stack([np.abs(scaler.encode(view(db_uT))).max(axis=1) for view, scaler in self._scaled])
        return Answered(answers.mean(axis=0), sd_mm, np.asarray((shown > UNLIKE_SDS).any(axis=0)))


class Map:
    """Is fitted to the no-load field, to pokes at unknown places if it is let see some, and to shown ones.

    The model that it is given stays as it is; what that one learnt of the skin is kept. Later pokes here take the place
    of earlier ones: a dozen that went wrong is mended by another.
    """

    channels_n = CHANNELS_N
    about = "map of simulated skins"

    def __init__(self, universal: Universal) -> None:
        self._given = universal
        self._noload_uT = universal.noload_uT
        self._pokes_uT = np.zeros((0, CHANNELS_N))  # changes of field that it was let see
        self._shown_mm, self._shown_uT = np.zeros((0, 2)), np.zeros((0, CHANNELS_N))  # pokes at known places
        self._learn()

    def zero(self, b_uT: Float[np.ndarray, "f ch"]) -> None:
        """Begin anew from the no-load field, and from the pokes that were seen before."""
        self._noload_uT = b_uT.mean(axis=0, dtype=np.float64)
        self._learn()

    def see(self, db_uT: Float[np.ndarray, "n ch"]) -> str:
        """Learn from pokes anywhere; say what they did to its sureness. Nobody knows where they were."""
        before, self._pokes_uT = self._estimate(db_uT), db_uT.astype(np.float64)
        self._learn()
        after = self._estimate(db_uT)
        sd_mm, misfit = ([np.median(each) for each in pair] for pair in zip(
            (before.sd_mm.max(axis=1), before.misfit), (after.sd_mm.max(axis=1), after.misfit), strict=True
        ))  # fmt: skip
        return (
            f"adapted to {len(db_uT)} pokes: standard deviation of a place {sd_mm[0]:.2f} mm before, {sd_mm[1]:.2f} mm "
            f"after; misfit {misfit[0]:.2f} before, {misfit[1]:.2f} after"
        )

    def label(
        self, place_mm: Float[np.ndarray, "n 2"], db_uT: Float[np.ndarray, "n ch"], kept: Bool[np.ndarray, " n"]
    ) -> str:
        """Learn from pokes at shown places; say how far off it was, and is, at those that were kept from it.

        Nobody measured the force: it is taken as the map estimates it.
        """

        def error_mm() -> float:
            return float(np.median(np.linalg.norm(self._estimate(db_uT[kept]).place_mm - place_mm[kept], axis=1)))

        before_mm = error_mm()
        self._shown_mm, self._shown_uT = place_mm[~kept], db_uT[~kept].astype(np.float64)
        self._learn()
        return (
            f"adapted to {(~kept).sum()} shown places: error at {kept.sum()} others {before_mm:.2f} mm before, "
            f"{error_mm():.2f} mm after (medians)"
        )

    def __call__(self, db_uT: Float32[np.ndarray, "f ch"]) -> Answered:
        found = self._estimate(db_uT)
        answer = np.column_stack([found.place_mm, found.force_N])
        return Answered(answer, found.sd_mm, np.asarray(found.misfit > MISFIT_MAX))

    def _estimate(self, db_uT: Float[np.ndarray, "n ch"]) -> Estimate:
        return self._universal.estimate(db_uT + self._noload_uT)

    def _learn(self) -> None:
        universal = copy(self._given).zero(self._noload_uT, keep=True)
        if len(self._pokes_uT):
            universal.see(self._pokes_uT + self._noload_uT)
        if len(self._shown_uT):
            b_uT = self._shown_uT + self._noload_uT
            universal.label(self._shown_mm, universal.estimate(b_uT).force_N, b_uT, keep=True)
        universal.estimate(self._noload_uT)  # what a first contact should not wait for
        self._universal = universal


def answering(models: Models) -> Networks | Map | None:
    """Let networks answer, or the map; nobody, if there is no model."""
    if isinstance(models, Universal):
        return Map(models)
    return Networks(models) if models else None


def check_boards(models: Models, boards_n: int, where: str) -> None:
    """Raise ParamsError if a model that learnt one skin is to answer for several boards."""
    if boards_n > 1 and isinstance(models, Universal) and models.presses_n:
        rule, remedy = "for one board", "Open that board alone, or give no model."
        raise ParamsError(where, f"a model that was told {models.presses_n} pokes of a skin", rule, boards_n, remedy)
