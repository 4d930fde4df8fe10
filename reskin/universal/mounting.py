"""Check how a skin is mounted on its board, and how the axes of the labels are oriented.

The poles of the paper's skin alternate like the fields of a checkerboard. Therefore, if the skin is turned by one or
three quarter turns before it is glued on, every field has the opposite sign. Half a turn changes nothing. If the skin
is glued on upside down, fields have the same sign and are about 1.3 times as large.

The no-load field shows whether a skin is turned. Without this check, the universal model would estimate wrong places on
a turned skin, because two field changes are similar: the field change of a press on a turned skin, and the field change
of a press on the opposite side of a skin that is not turned.

Presses at known places show whether the axes of the labels are oriented as the user has stated.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve

from reskin.universal.map import Estimate, OFFSET_uT, Tables

LOG_ODDS_MIN = 2.0  # an orientation with smaller log odds is reported as uncertain (odds of 7 to 1)
# A no-load field is reported as unusual if chi^2 per channel exceeds this value, which happens on few skins.
NOLOAD_MISFIT_MAX = 12.0
LABELS_MIN_N = 3  # with fewer labels, the orientation of their axes is not checked
FRAME_LOG_ODDS_MIN = 5.0  # another orientation of the labels' axes is reported if its log odds are at least this value
FRAME_SD_MM = 1.0  # standard deviation of that part of the errors in place that the estimated uncertainty omits
# This fraction of the estimated places is assumed to be useless: such a place may be anywhere on an area of this size.
OUTLIER_SHARE, AREA_MM2 = 0.1, 200.0

TURNED = "turned by a quarter"


@dataclass(frozen=True)
class Mounting:
    """Orientation of a skin on its board: turned by a quarter, or not turned.

    `turned` is True if the skin is turned by a quarter, so that all fields have the opposite sign of the fields on the
    recorded boards. `log_odds` is the logarithm of the probability of this orientation divided by the probability of
    the other orientation. It is negative if the other orientation fits better. `misfit` is chi^2 per channel of the
    no-load field.
    """

    turned: bool
    log_odds: float
    misfit: float

    @property
    def probability(self) -> float:
        """Probability of this orientation, if both orientations are equally probable before the no-load reading."""
        return float(1 / (1 + np.exp(-self.log_odds)))

    def warnings(self, *, turnable: bool = True) -> list[str]:
        """Return warnings if the no-load field is unusual, or if the orientation is uncertain or unlikely.

        `turnable` states whether a quarter turn of the skin reverses the sign of its fields. If it does not, there are
        no warnings about the orientation.
        """
        sentences = []
        if self.misfit > NOLOAD_MISFIT_MAX:
            sentences.append(
                "the no-load field is unlike the no-load fields of the skins on which the model was trained (chi^2 per "
                f"channel {self.misfit:.3g}, limit {NOLOAD_MISFIT_MAX:g}). Check the order of the chips in the "
                "readings, and use a model for this kind of skin."
            )
        found = TURNED if self.turned else "not turned"
        if turnable and self.log_odds < -LOG_ODDS_MIN:
            sentences.append(
                f"the skin is assumed to be {found}, but its no-load field fits the other orientation better (log odds "
                f"{self.log_odds:.1f}). Take the no-load reading again without contact, and call zero without the "
                "argument `turned`."
            )
        elif turnable and self.log_odds < LOG_ODDS_MIN:
            sentences.append(
                f"the skin is assumed to be {found}, but its no-load field fits both orientations (log odds "
                f"{self.log_odds:.1f}). If you know the orientation, state it in Python with zero(noload_uT, "
                "turned=True) or turned=False. Otherwise, press some known places, and use the orientation in which "
                "their estimates are more accurate."
            )
        return sentences


def find_mounting(tables: Tables, rest_uT: Float[np.ndarray, " ch"], *, turned: bool | None = None) -> Mounting:
    """Find the orientation of a skin from its no-load field, which must be along the board's axes.

    If `turned` is given, it is used as the orientation, and only its log odds and the misfit are computed. Otherwise, a
    skin is assumed to be turned only if the log odds for this are at least `LOG_ODDS_MIN`. The no-load field has a
    normal distribution under the prior of the map (`reskin.universal.map`). Before the no-load reading, both
    orientations are equally probable.
    """
    covariance = _noload_covariance(tables)
    chi2 = {}
    for sign in (1, -1):
        off_uT = sign * rest_uT - tables.rest_uT
        chi2[sign] = float(off_uT @ cho_solve(covariance, off_uT))
    if turned is None:
        turned = (chi2[1] - chi2[-1]) / 2 >= LOG_ODDS_MIN
    sign = -1 if turned else 1
    return Mounting(turned, (chi2[-sign] - chi2[sign]) / 2, chi2[sign] / len(rest_uT))


def _noload_covariance(tables: Tables) -> tuple[Float[np.ndarray, "ch ch"], bool]:
    """Return the Cholesky factor of the covariance of the no-load field under the prior of the map."""
    slope_uT = tables.rest_slope_uT
    return cho_factor(slope_uT @ slope_uT.T + OFFSET_uT**2 * np.eye(len(slope_uT)))


@cache
def frames() -> Mapping[str, Float[np.ndarray, "2 2"]]:
    """Return the eight possible orientations of the labels' axes, each with its name and a matrix.

    There are four turns, each with and without mirroring. The matrix converts labelled places to true places if the
    labels' axes have this orientation.
    """
    quarter, mirror_x = np.array([[0.0, -1.0], [1.0, 0.0]]), np.diag([-1.0, 1.0])
    turns = [np.linalg.matrix_power(quarter, k) for k in range(4)]
    names = ("as given", "turned by 90°", "turned by 180°", "turned by 270°")
    mirrored = ("mirrored in x", "mirrored at the line x = -y", "mirrored in y", "mirrored at the line x = y")
    matrices = dict(zip(names, turns, strict=True)) | dict(
        zip(mirrored, [turn @ mirror_x for turn in turns], strict=True)
    )
    return MappingProxyType(matrices)


@dataclass(frozen=True)
class LabelFrame:
    """The most probable orientation of the labels' axes among those that the user has not stated.

    `name` is the name of this orientation (see `frames`). `log_odds` is the logarithm of its probability divided by
    that of the stated orientation. It is above 0 if this orientation fits better.
    """

    name: str
    log_odds: float

    def warning(self) -> str | None:
        """Return a warning if the labels' axes are probably not oriented as the user has stated."""
        if self.log_odds < FRAME_LOG_ODDS_MIN:
            return None
        return (
            f"the labelled places fit the estimated places better if the labelled places are {self.name} (log odds "
            f"{self.log_odds:.1f}). Convert the labelled places to the axes of the board, and call label again."
        )


def find_label_frame(estimate: Estimate, place_mm: Float[np.ndarray, "m 2"]) -> LabelFrame:
    """Find the most probable orientation of the labels' axes among those that the user has not stated.

    The errors of the estimated places are assumed to be normally distributed, except for a fraction of outliers.

    Parameters
    ----------
    estimate : estimated places of the labelled presses, from a model that is not calibrated to these labels
    place_mm : labelled places. Both these and the estimated places are relative to the board's centre.
    """
    log_p = {name: _log_likelihood(estimate, place_mm @ matrix.T) for name, matrix in frames().items()}
    as_given = log_p.pop("as given")
    name = max(log_p, key=log_p.__getitem__)
    return LabelFrame(name, log_p[name] - as_given)


def _log_likelihood(estimate: Estimate, place_mm: Float[np.ndarray, "m 2"]) -> float:
    var_mm2 = estimate.sd_mm**2 + FRAME_SD_MM**2
    density = np.exp(-((estimate.place_mm - place_mm) ** 2 / var_mm2).sum(axis=1) / 2)
    density = density / (2 * np.pi * np.sqrt(var_mm2.prod(axis=1)))
    return float(np.log((1 - OUTLIER_SHARE) * density + OUTLIER_SHARE / AREA_MM2).sum())
