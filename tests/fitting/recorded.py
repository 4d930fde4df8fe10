"""Simulated presses on a board like those of scene lab, and the axes of these boards."""

from pathlib import Path

import numpy as np

from pipeline.fitting.presses import RecordedPresses
from pipeline.settings import Settings
from pipeline.training.recorded import Compare
from reskin.config import read_yaml
from reskin.seeds import rng_for
from reskin.universal import law

LAB = Path(__file__).resolve().parents[2] / "pipeline/scenes/lab.yaml"
AXES = Settings("lab", str(LAB), read_yaml(LAB), {}).section(Compare, "compare").axes
SETUP = AXES.setup
TRUE = law.Law(0.4, -0.3, 0.0, 1.6, 1.8, 0.5, -0.6, 0.22, 6.0, 40.0, 10.0)


def simulated_presses(parameters: law.Law = TRUE, noise_uT: float = 3.0) -> RecordedPresses:
    """Return simulated presses at 25 places with two forces each, along the axes of scene lab."""
    rng = rng_for(0, "compare")
    grid_mm = np.stack(np.meshgrid(*[np.linspace(-7, 7, 5)] * 2), axis=-1).reshape(-1, 2)
    place_mm, force_N = np.tile(grid_mm, (2, 1)), np.repeat([1.0, 4.0], 25)
    db_uT = np.einsum("kij,nki->nkj", AXES.rotations, law.simulate_uT(parameters, SETUP, place_mm, force_N))
    rest_uT = np.einsum("kij,ki->kj", AXES.rotations, law.at_rest_uT(parameters, SETUP))
    return RecordedPresses(
        board="b", groups=("soft", "hard"), group_i=np.repeat([0, 1], 25), place_mm=AXES.label(place_mm),
        force_N=force_N, db_uT=db_uT + noise_uT * rng.standard_normal(db_uT.shape),
        noload_uT=np.tile(rest_uT, (50, 1, 1)),
    )  # fmt: skip
