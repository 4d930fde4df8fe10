"""A simulated gripper with a skin on its finger. It closes on a spring and controls the estimated force.

Frames of the skin are encoded, decoded and evaluated like those of a real board.
"""

import warnings
from dataclasses import dataclass, field

import numpy as np
from sklearn.neural_network import MLPRegressor

import reskin
from reskin.board.wire import Frames
from reskin.live.emulator import encode_pieces
from reskin.live.models import Models
from reskin.live.tracker import LiveSkin
from reskin.models.inputs import Scaler, fit_standard
from reskin.models.trained import Network
from reskin.seeds import rng_for
from tests.live.boards import RATE_HZ

AIM_N, GAIN_MM_N = 0.5, 0.1
# PERIOD_S is the period with which the stiffness of the object changes. The force is evaluated only after the time
# SETTLED_S.
PERIOD_S, SETTLED_S = 6.0, 1.0
SOFT_N_MM, HARD_N_MM = 0.3, 3.0
NOISE_uT, STEP_uT = 3.0, np.array([0.15, 0.15, 0.242])
DEPTHS_MM = np.linspace(0.02, 1.5, 60)


@dataclass(frozen=True)
class FittedNetwork(Network):
    """A network that is trained on labelled pokes of a single skin (section 5 of the paper)."""

    regressor: MLPRegressor = field(default_factory=MLPRegressor)

    def __call__(self, db_uT: np.ndarray) -> np.ndarray:
        scaler = Scaler.of_arrays(self.tensors)
        return scaler.decode(self.regressor.predict(scaler.encode(db_uT)).astype(np.float32))


def fit(seed: int, pokes_n: int = 600) -> FittedNetwork:
    """Train a network on simulated pokes of the skin with this seed. Each poke has one reading."""
    rng = rng_for(seed, "gripper")
    pokes = np.column_stack([rng.uniform(2, 14, (pokes_n, 2)), rng.uniform(DEPTHS_MM[0], DEPTHS_MM[-1], pokes_n)])
    noload_uT, b_uT, force_N = reskin.simulate_pokes(reskin.draw_skin(seed=seed), pokes, seed=seed)
    db_uT, target = (b_uT - noload_uT).astype(np.float32), np.column_stack([pokes[:, :2], force_N]).astype(np.float32)
    scaler = fit_standard(db_uT, target)
    net = MLPRegressor(
        hidden_layer_sizes=(64, 64), solver="lbfgs", alpha=1e-3, max_iter=1500, max_fun=10**6, random_state=seed
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # scikit-learn warns that the training has not converged.
        net.fit(scaler.encode(db_uT), scaler.encode_target(target))
    card = {"input": {"channels_n": 15}, "recipe": {"inputs": "raw"}}
    return FittedNetwork(card, scaler.arrays(), net)


class Finger:
    """A skin that is pressed at the place `at_mm`.

    Readings at some forces are simulated. The reading at any other force is interpolated between these readings.
    """

    def __init__(self, seed: int, at_mm: tuple[float, float] = (8.0, 8.0)) -> None:
        pokes = np.column_stack([np.tile(at_mm, (len(DEPTHS_MM), 1)), DEPTHS_MM])
        # These readings are simulated without noise. Noise is added to each frame later.
        quiet = {"noise_xy_uT": 0.0, "noise_z_uT": 0.0}
        noload_uT, b_uT, force_N = reskin.simulate_pokes(reskin.draw_skin(seed=seed), pokes, seed=seed, chip=quiet)
        self.noload_uT = noload_uT.mean(axis=0)
        self._change_uT = np.vstack([np.zeros(15), b_uT - self.noload_uT])
        self._force_N, self._depth_mm = np.append(0, force_N), np.append(0, DEPTHS_MM)

    def force_at(self, closed_mm: float, stiffness_N_mm: float) -> float:
        """Return the force in N at which skin and spring are in equilibrium after closing by this distance."""
        total_mm = self._depth_mm + self._force_N / stiffness_N_mm
        return float(np.interp(max(closed_mm, 0.0), total_mm, self._force_N))

    def read(self, force_N: float) -> np.ndarray:
        return self.noload_uT + np.array([np.interp(force_N, self._force_N, column) for column in self._change_uT.T])


class FingerReader:
    """A reader that returns one frame at a time.

    Each frame has the field for the force that then acts on the finger.
    """

    plugged_in, problem, missed_bytes_n = True, "", 0

    def __init__(self, finger: Finger, rng: np.random.Generator) -> None:
        self._finger, self._rng, self.force_N, self.frames_n = finger, rng, 0.0, 0

    @property
    def taken_s(self) -> float:
        return self.unix_s()

    def unix_s(self) -> float:
        return self.frames_n / RATE_HZ

    def take(self, _wait_s: float) -> list[tuple[bytes, float]]:
        self.frames_n += 1
        b_uT = self._finger.read(self.force_N) + NOISE_uT * self._rng.standard_normal(15)
        b_uT = (np.rint(b_uT.reshape(5, 3) / STEP_uT) * STEP_uT).reshape(1, 15).astype(np.float32)
        warm_degC = 25 + 0.02 * self._rng.standard_normal((1, 5)).astype(np.float32)
        frames = Frames(b_uT, warm_degC.astype(np.float32), np.full(1, np.nan), np.zeros(1, np.int64))
        return [(encode_pieces(frames, "binary")[0], self.unix_s())]


def grip(
    finger: Finger, models: Models, rng: np.random.Generator, *, aim_N: float = AIM_N, seconds: float = PERIOD_S
) -> np.ndarray:
    """Hold an object whose stiffness varies by a factor of ten.

    Returns the true and the estimated force in N at each time step: [f 2].
    """
    skin, wire, closed_mm, forces_N = LiveSkin("gripper", models), FingerReader(finger, rng), 0.0, []
    skin.reader = wire
    while len(forces_N) < seconds * RATE_HZ:
        estimates = skin.poll(0.0, latest=True)
        if estimates is None or not skin.zeroed:
            continue
        estimate_N = float(estimates.target[-1, 2])
        forces_N.append((wire.force_N, estimate_N))
        # This is a proportional controller: the gripper closes in proportion to the missing force.
        closed_mm += GAIN_MM_N * (aim_N - estimate_N)
        share = (1 - np.cos(2 * np.pi * len(forces_N) / RATE_HZ / PERIOD_S)) / 2
        wire.force_N = finger.force_at(closed_mm, SOFT_N_MM * (HARD_N_MM / SOFT_N_MM) ** share)
    return np.array(forces_N)
