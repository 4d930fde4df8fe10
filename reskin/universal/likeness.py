"""How like the simulated skins a skin is: the likelihood of its no-load field and of its field changes.

A network estimates a place for any numbers. Readings of exchanged chips or of another kind of skin are found because
they are unlikely among simulated skins.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from reskin.universal.network import LENGTH_MIN_uT, REST_uT

COMPONENTS_N, JITTER = 16, 1e-3  # components of the mixture; is added to the variances of the features
REST_SHARE, PRESS_SHARE, SKIN_SHARE = 0.995, 0.998, 0.995  # shares of simulated fields, presses and skins without alarm
PRESSES_MIN_N = 5  # with fewer presses, a skin is judged by its no-load field only
JUDGED_MIN_uT = 100.0  # smaller field changes are not judged: their direction is mostly noise


@dataclass(frozen=True)
class Likeness:
    """A normal distribution of no-load fields, and a mixture of normal distributions of directions of field changes.

    Each normal distribution has a mean and a matrix that whitens deviations from it. All fields have the sign of
    `network.sign_of`. A misfit is a negative log likelihood relative to the simulated skins, so that 1 is the limit
    above which something is said to be unlike them, and 0 is the median of simulated ones.
    """

    rest_mean: Float[np.ndarray, " ch"]
    rest_whiten: Float[np.ndarray, "ch ch"]
    means: Float[np.ndarray, "g ch"]
    whiten: Float[np.ndarray, "g ch ch"]
    log_weights: Float[np.ndarray, " g"]
    # Medians and limits of the negative log likelihoods: of no-load fields, of presses, and of means over presses
    scales: Float[np.ndarray, "3 2"]

    @classmethod
    def fit(cls, rest_uT: Float[np.ndarray, "s ch"], db_uT: Float[np.ndarray, "s m ch"], seed: int = 0) -> "Likeness":
        """Fit to simulated skins; the second half of the skins sets the limits. Requires scikit-learn."""
        from sklearn.mixture import GaussianMixture

        half, channels_n = len(rest_uT) // 2, rest_uT.shape[1]
        rests = rest_uT / REST_uT
        covariance = np.cov(rests[:half].T) + JITTER * np.eye(channels_n)
        directions = [directions_of(strong(changes)) for changes in db_uT]
        mixture = GaussianMixture(COMPONENTS_N, reg_covar=JITTER, random_state=seed, init_params="k-means++")
        mixture.fit(np.concatenate(directions[:half]))
        whiten = mixture.precisions_cholesky_
        of_determinant = np.log(np.diagonal(whiten, axis1=1, axis2=2)).sum(axis=1)
        log_weights = np.log(mixture.weights_) + of_determinant
        rest_whiten = np.linalg.inv(np.linalg.cholesky(covariance)).T
        raw = cls(
            rests[:half].mean(axis=0), rest_whiten, mixture.means_, whiten, log_weights, np.array([[0.0, 1.0]] * 3)
        )
        of_rest = np.array([raw.rest_misfit(rest) for rest in rest_uT[half:]])
        of_press = [raw._surprise(each) for each in directions[half:] if len(each)]
        values = (
            (of_rest, REST_SHARE), (np.concatenate(of_press), PRESS_SHARE),
            (np.array([each.mean() for each in of_press]), SKIN_SHARE),
        )  # fmt: skip
        scales = np.array([np.quantile(value, (0.5, share)) for value, share in values])
        return cls(raw.rest_mean, raw.rest_whiten, raw.means, raw.whiten, raw.log_weights, scales)

    @staticmethod
    def shapes(channels_n: int) -> dict[str, tuple[int, ...]]:
        """Return the shape of each array, for a board with this number of channels."""
        row, matrix, groups = (channels_n,), (channels_n, channels_n), (COMPONENTS_N,)
        return {
            "rest_mean": row, "rest_whiten": matrix, "means": groups + row, "whiten": groups + matrix,
            "log_weights": groups, "scales": (3, 2),
        }  # fmt: skip

    def rest_misfit(self, rest_uT: Float[np.ndarray, " ch"]) -> float:
        """Return the misfit of a no-load field."""
        white = (rest_uT / REST_uT - self.rest_mean) @ self.rest_whiten
        return float(self._scaled(0, np.array(0.5 * white @ white)))

    def misfit(self, db_uT: Float[np.ndarray, "n ch"]) -> Float[np.ndarray, " n"]:
        """Return the misfit of each field change; 0 for field changes that are too small to be judged."""
        judged = np.linalg.norm(db_uT, axis=1) >= JUDGED_MIN_uT
        return np.where(judged, self._scaled(1, self._surprise(directions_of(db_uT))), 0.0)

    def skin_misfit(self, rest_uT: Float[np.ndarray, " ch"], db_uT: Float[np.ndarray, "n ch"]) -> float:
        """Return the misfit of a skin: of its no-load field, or of all of its presses, whichever is larger."""
        own, db_uT = self.rest_misfit(rest_uT), strong(db_uT)
        if len(db_uT) < PRESSES_MIN_N:
            return own
        return max(own, float(self._scaled(2, np.array(self._surprise(directions_of(db_uT)).mean()))))

    def _surprise(self, directions: Float[np.ndarray, "n ch"]) -> Float[np.ndarray, " n"]:
        white = np.einsum("ngf,gfh->ngh", directions[:, None] - self.means, self.whiten)
        log_p = self.log_weights - 0.5 * (white**2).sum(axis=2)
        most = log_p.max(axis=1)
        return -(most + np.log(np.exp(log_p - most[:, None]).sum(axis=1)))

    def _scaled(self, which: int, value: np.ndarray) -> np.ndarray:
        median, limit = self.scales[which]
        return np.asarray((value - median) / (limit - median))


def strong(db_uT: Float[np.ndarray, "n ch"]) -> Float[np.ndarray, "m ch"]:
    """Select the field changes that are large enough to be judged."""
    return db_uT[np.linalg.norm(db_uT, axis=1) >= JUDGED_MIN_uT]


def directions_of(db_uT: Float[np.ndarray, "n ch"]) -> Float[np.ndarray, "n ch"]:
    """Return the directions of field changes, which show how chips and magnets are placed."""
    return db_uT / np.maximum(np.linalg.norm(db_uT, axis=1, keepdims=True), LENGTH_MIN_uT)
