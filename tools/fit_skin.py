"""Fit the settings of the simulated skin to recorded boards with known places and forces (not in the paper).

The slide and the magnetisation of the nominal skin are from these fits. Run in a checkout with the recordings of scene
lab (`reskin fetch lab`, `reskin scenes use lab`, `dvc repro describe@lab`):

    python -m tools.fit_skin lab

docs/synthetic-skin.md has the output. Each board is fitted three times, always with the gap of its layout:

- linear: without stiffening, presses up to 4.5 N. The released network scales forces by 3 N, so the paper's skins were
  pressed about as hard.
- stiffening: presses up to 4.5 N, and the exponent of the stiffening is fitted, too.
- hard: all presses, and the exponent of the stiffening is fitted, too.

The mean of a setting is the mean over boards of the linear fits. The spread between skins is their standard deviation,
sqrt(sum((x - mean)^2) / (boards - 1)); for the displacement `give`, it is the root of the mean of the variances along x
and y. The uncertainty of a fit is the standard deviation over fits to places that are drawn with replacement.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pandas as pd

from pipeline.experiments.compare import agreement
from pipeline.experiments.results import read_captures
from pipeline.fitting.axes import BoardAxes
from pipeline.fitting.law_fit import AlignedPresses, fit
from pipeline.fitting.presses import pool_skins
from pipeline.settings import read_settings
from pipeline.training.recorded import Compare
from reskin.seeds import rng_for
from reskin.universal.law import beyond_n, simulate_uT

FORCE_MAX_N = 4.5
DRAWS_N = 10
LINEAR = (
    "seat_x_mm", "seat_y_mm", "rotation_deg", "label_x_mm", "label_y_mm", "amplitude", "modulus_MPa", "away_um_mm",
    "give_x_um", "give_y_um", "lets_go_N",
)  # fmt: skip
ABOUT = """\
- fits: `linear` without stiffening, `stiffening` with a fitted exponent, both up to 4.5 N; `hard`: the same, all forces
- ±: standard deviation over fits to places that are drawn with replacement
- cosine: mean cosine between recorded and simulated field changes; growth: exponent n in |dB| ~ F^n
- beyond_n: number of presses whose force is too large for the law
"""
SHOWN = ("modulus_MPa", "stiffening", "amplitude", "away_um_mm", "give_x_um", "give_y_um", "lets_go_N")
ALL = (*LINEAR, "stiffening")
FITS = {"linear": (LINEAR, FORCE_MAX_N), "stiffening": (ALL, FORCE_MAX_N), "hard": (ALL, np.inf)}
# Parameters at which a fit starts, and means of their priors. A layer that stiffens needs a softer material.
STIFFENING_START = {"modulus_MPa": 0.2, "stiffening": 1.0, "lets_go_N": 6.0}
STARTS = {
    "linear": {"modulus_MPa": 0.4, "stiffening": 0.0, "lets_go_N": 6.0},
    "stiffening": STIFFENING_START,
    "hard": STIFFENING_START,
}


def select(presses: AlignedPresses, kept: np.ndarray) -> AlignedPresses:
    """Return some of the presses on a board; `kept` is a mask, or indices that may repeat."""
    recorded = presses.recorded
    names = ("place_mm", "force_N", "db_uT", "noload_uT")
    groups, group_i = np.unique(recorded.group_i[kept], return_inverse=True)
    thinned = replace(
        recorded, groups=tuple(recorded.groups[i] for i in groups), group_i=group_i.ravel(),
        **{name: getattr(recorded, name)[kept] for name in names},
    )  # fmt: skip
    return replace(presses, recorded=thinned, place_mm=presses.place_mm[kept], db_uT=presses.db_uT[kept])


def resamples(presses: AlignedPresses, draws_n: int, seed: int) -> Iterator[AlignedPresses]:
    """Yield the presses at places that are drawn with replacement; all presses at a place are kept together."""
    _, place_i = np.unique(presses.place_mm.round(2), axis=0, return_inverse=True)
    rows = [np.flatnonzero(place_i.ravel() == i) for i in range(place_i.max() + 1)]
    rng = rng_for(seed, "fit_skin", presses.recorded.board)
    for _ in range(draws_n):
        yield select(presses, np.concatenate([rows[i] for i in rng.integers(len(rows), size=len(rows))]))


def fit_board(presses: AlignedPresses, axes: BoardAxes, draws_n: int) -> Iterator[dict[str, object]]:
    """Yield one row per fit of `FITS`: fitted values, their uncertainties (`sd_...`), agreement with the board."""
    setup = axes.setup
    for name, (names, force_max_N) in FITS.items():
        chosen = select(presses, presses.recorded.force_N <= force_max_N)
        mean = replace(axes.start, **STARTS[name])
        law = fit(chosen, setup, names, mean)
        drawn = pd.DataFrame([asdict(fit(each, setup, names, mean, law)) for each in resamples(chosen, draws_n, 0)])
        found = agreement(chosen, simulate_uT(law, setup, chosen.place_mm, chosen.recorded.force_N))
        growth = found.get("growth", {"recorded": np.nan, "simulated": np.nan})
        yield {
            "fit": name, "board": presses.recorded.board, "presses_n": len(chosen.recorded),
            **{key: getattr(law, key) for key in SHOWN},
            **{f"sd_{key}": float(drawn[key].std()) if draws_n > 1 else np.nan for key in SHOWN},
            "cosine": found["cosine_mean"], "growth_recorded": growth["recorded"],
            "growth_simulated": growth["simulated"],
            "beyond_n": beyond_n(law, setup, chosen.recorded.force_N),
        }  # fmt: skip


def show(fits: pd.DataFrame) -> str:
    """Return a table with a column per fit and board."""
    shown = fits.drop(columns=[f"sd_{key}" for key in SHOWN]).map(lambda x: f"{x:.3g}" if isinstance(x, float) else x)
    for key in SHOWN:
        shown[key] += fits[f"sd_{key}"].map(" ± {:.2g}".format)
    shown.index = pd.Index(fits["fit"] + ", " + fits["board"])
    return shown.drop(columns=["fit", "board"]).T.to_markdown()


def over_boards(fits: pd.DataFrame) -> pd.DataFrame:
    """Return the mean over boards of the linear fits, and the standard deviation between boards."""
    linear = fits[fits["fit"] == "linear"].set_index("board")[list(SHOWN)]
    table = pd.DataFrame({"mean": linear.mean(), "spread": linear.std()})
    give = ["give_x_um", "give_y_um"]
    table.loc[give, "spread"] = float(np.sqrt((linear[give].var()).mean()))
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="recorded scene whose stage ingest has run")
    parser.add_argument("--draws-n", type=int, default=DRAWS_N, help="number of fits to drawn places")
    arguments = parser.parse_args()
    settings = read_settings(arguments.scene, Path())
    indentations = Path("data/indentations") / arguments.scene
    axes = settings.section(Compare, "compare").axes
    boards = pool_skins(read_captures(indentations, tuple(settings.captures_in(indentations))), with_force=False)
    known = {board: presses for board, presses in boards.items() if presses.forces_known}
    if len(known) < 2:
        sys.exit(f"scene {arguments.scene} has {len(known)} boards with known forces; a spread needs at least two")
    rows = [row for presses in known.values() for row in fit_board(axes.align(presses), axes, arguments.draws_n)]
    fits = pd.DataFrame(rows)
    print(f"Fits to the recorded boards of scene {arguments.scene} (`python -m tools.fit_skin {arguments.scene}`)\n")
    print(ABOUT)
    print(show(fits))
    print("\nOver boards, linear fits\n")
    print(over_boards(fits).to_markdown(floatfmt=".3g"))


if __name__ == "__main__":
    main()
