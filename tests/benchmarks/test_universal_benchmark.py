"""Error of the universal model against its cost, for different lattices, numbers of training skins and steps.

`RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_universal_benchmark.py` prints the table of docs/learning.md.
The test skins were not used in training, and have 65 presses each. As in training, their fields differ from those of
the simulated law by random errors. All times are processor time of one thread.
"""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.training.shipping import AS_TRAINED, NO_POWERS, calibrate, draw_prior_skins, law_error, split_presses
from reskin.config import parse
from reskin.data.grid import SKIN_MM
from reskin.physics.skin import SkinDesign
from reskin.simulation.defaults import nominal
from reskin.universal import map
from reskin.universal.batches import NOMINAL_NAME, SkinPrior, TrainingSettings
from reskin.universal.law import CHIPS_MM, Setup
from reskin.universal.map import NOMINAL, NOMINAL_SPREADS, Tables, tabulate
from reskin.universal.model import Universal
from reskin.universal.network import FULL_SET_N, Weights
from reskin.universal.training import train_networks
from tests.benchmarks import FULL, size

ROOT = Path(__file__).resolve().parents[2]
SIDE_MM = map.PITCH_MM * len(map.lattice_mm())
PITCHES_MM, FORCES_N = size((1.6, 0.8, 0.6), (3.2,)), size((4, 9, 17), (3,))
SKINS_N, STEPS_N = size((125, 500, 2000), (8,)), size((300, 1200), (5,))
TESTED_N, SEED = size(24, 2), 2021


@dataclass(frozen=True)
class Row:
    """Errors and costs of one setting."""

    setting: str
    accuracy_pct: float
    mse_xy_mm2: float
    force_factor: float
    build_s: float
    reading_us: float

    def __str__(self) -> str:
        return (
            f"| {self.setting} | {self.accuracy_pct:.1f} | {self.mse_xy_mm2:.2f} | {self.force_factor:.2f} | "
            f"{self.build_s:.0f} | {self.reading_us:.0f} |"
        )


def test_print_errors_and_times_of_maps_and_networks(monkeypatch):
    design = parse(SkinDesign, nominal("skin"), "skin")
    setup = Setup(design, np.array(CHIPS_MM), NOMINAL.gap_mm, SKIN_MM, design.flipped, design.tip_radius_mm)
    prior = SkinPrior(NOMINAL_NAME, NOMINAL, NOMINAL_SPREADS, setup)
    networks: dict[tuple[int, int], tuple[Sequence[Weights], float]] = {}
    for skins_n in SKINS_N:
        for steps_n in STEPS_N:
            start_s = time.process_time()
            trained = train_networks(prior, TrainingSettings(skins_n=skins_n, steps_n=steps_n, seeds_n=1), SEED)
            networks[skins_n, steps_n] = trained, time.process_time() - start_s
    used = networks[SKINS_N[len(SKINS_N) // 2], STEPS_N[-1]][0]
    print(f"\nload of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; {TESTED_N} skins")
    print("| setting | within 1 mm, % | MSE_xy, mm² | force wrong by a factor of | build time, s | reading time, µs |")
    print("|---|---|---|---|---|---|")
    rows = []
    for pitch_mm in PITCHES_MM:
        for forces_n in FORCES_N if pitch_mm == 0.8 or not FULL else (9,):
            tables, build_s = make_lattice(monkeypatch, pitch_mm, forces_n, setup)
            rows.append(evaluate(f"pitch {pitch_mm} mm, {forces_n} forces", tables, used, prior, build_s))
            print(rows[-1])
    whole, _ = make_lattice(monkeypatch, 0.8 if FULL else 3.2, 9 if FULL else 3, setup)
    for (skins_n, steps_n), (trained, trained_s) in networks.items():
        rows.append(evaluate(f"network of {skins_n} skins, {steps_n} steps", whole, trained, prior, trained_s))
        print(rows[-1])
    assert all(np.isfinite([row.accuracy_pct, row.mse_xy_mm2, row.force_factor]).all() for row in rows)
    if FULL:
        assert rows[-1].accuracy_pct > 50


def make_lattice(monkeypatch, pitch_mm: float, forces_n: int, setup: Setup) -> tuple[Tables, float]:
    """Tabulate the fields on a lattice of this pitch and number of forces; return the tables and the seconds taken."""
    steps_n = 2 * round(SIDE_MM / pitch_mm / 2)
    monkeypatch.setattr(map, "lattice_mm", lambda _: pitch_mm * (np.arange(steps_n) - (steps_n - 1) / 2))
    forces_N = np.geomspace(map.FORCES_N[0], map.FORCES_N[-1], forces_n)
    start_s = time.process_time()
    return tabulate(NOMINAL, NOMINAL_SPREADS, setup, forces_N), time.process_time() - start_s


def evaluate(setting: str, tables: Tables, networks: Sequence[Weights], prior: SkinPrior, build_s: float) -> Row:
    """Calibrate a model to 65 presses of each test skin and score it there."""
    model = Universal(tables, networks, NO_POWERS)
    skins = draw_prior_skins(prior, TESTED_N, SEED, AS_TRAINED, law_error())
    off_mm, off_log, took_s, read_n = [], [], 0.0, 0
    for i in range(len(skins)):
        b_uT, place_mm = calibrate(model, skins, i, (FULL_SET_N, 0), even=True, seed=SEED)
        model.estimate(b_uT[:1])  # this call prepares the map, so that the timed calls do not have to
        start_s = time.process_time()
        found = model.estimate(b_uT)
        took_s, read_n = took_s + time.process_time() - start_s, read_n + len(b_uT)
        off_mm.append(found.place_mm - place_mm)
        off_log.append(np.log(found.force_N / split_presses(skins, i, SEED)[1].force_N))
    off = np.concatenate(off_mm)
    return Row(
        setting, 100 * float((np.abs(off) <= 1).all(axis=1).mean()), float((off**2).mean()),
        float(np.exp(np.sqrt(np.mean(np.concatenate(off_log) ** 2)))), build_s, 1e6 * took_s / read_n,
    )  # fmt: skip
