"""What stage logs knows of a simulated log: its board as it was drawn, and a chip beside it. Knows no argv."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.constants import micro

from pipeline.core.config import Settings
from pipeline.core.seeds import rng_for
from pipeline.experiments.ambient.fields import take_board
from pipeline.experiments.logs.estimates import Answers
from pipeline.experiments.logs.turning import Log, step_period_s, turn_log
from pipeline.physics.ambient import EARTH_SIZE_T
from pipeline.synthesis.settings import synthesis_of


def turned(log: Log, board: str, settings: Settings, networks: Sequence[Answers]) -> dict[str, Any]:
    """Tell what the networks find in the log if its board turns in the earth's field."""
    of, seed = synthesis_of(settings), settings.seed
    noise_uT = np.array([of.chip.noise_xy_uT, of.chip.noise_xy_uT, of.chip.noise_z_uT])  # a log's readings are single
    own = replace(take_board(of, board, seed=seed), noise_uT=noise_uT)
    return {
        "turning": turn_log(log, own, networks, rng_for(seed, "logs", board, "aside")),
        "turning_period_s": step_period_s(log.t_s, np.isfinite(log.true[:, 2])),
        "earth_uT": EARTH_SIZE_T / micro,
    }
