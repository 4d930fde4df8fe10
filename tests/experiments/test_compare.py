"""Tests of experiment compare, on simulated presses of two boards and on recordings of two real boards."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.experiments.compare import agreement, compare_boards
from pipeline.fitting.law_fit import TEN, fit
from pipeline.fitting.presses import RecordedPresses, pool, thin
from reskin.recordings.readers import lab
from reskin.universal.law import simulate_uT
from tests.fitting.recorded import AXES, SETUP, TRUE, simulated_presses
from tests.recordings.test_recordings import LAB, ingest
from tests.sizes import FULL


@pytest.fixture(scope="module")
def compared() -> tuple[dict, dict]:
    other = replace(simulated_presses(replace(TRUE, seat_x_mm=-0.3, amplitude=1.5)), board="b2")
    unknown = replace(simulated_presses(), board="b3", force_N=np.full(50, np.nan), forces_known=False)
    return compare_boards({"b1": simulated_presses(), "b2": other, "b3": unknown}, AXES)


def test_simulated_boards_agree_with_fitted_laws_better_than_with_the_nominal_skin(compared):
    numbers, _ = compared
    for board in ("b1", "b2"):
        found = numbers["by_board"][board]
        assert found["cosine_mean"] > 0.995
        assert found["refitted"]["cosine_mean"] > 0.99
        assert found["nominal"]["cosine_mean"] < 0.95
        for growth in (found["growth"], found["refitted"]["growth"]):
            assert growth["simulated"] == pytest.approx(growth["recorded"], abs=0.03)


def test_orientation_is_checked_on_every_board(compared):
    numbers, _ = compared
    assert set(numbers["by_board"]["b3"]) == {"frames", "pokes_n"}  # its forces are unknown
    for found in numbers["by_board"].values():
        assert found["frames"]["sentence"] == "Labels, chips and skin are oriented as layout reskin states."


@pytest.fixture(scope="module")
def real(shared_data, tmp_path_factory) -> dict[str, RecordedPresses]:
    """Return the presses of the recordings of lab boards 1 and 2."""
    captures: dict[str, list] = {}
    for name in LAB:
        file = shared_data / "lab" / f"{name}.csv"
        board = name.partition("_")[0]
        one, _ = ingest(lab, file, tmp_path_factory.mktemp(name), board=board, capture=name)
        captures.setdefault(board, []).append(one)
    return {board: pool(recordings) for board, recordings in captures.items()}


@pytest.mark.skipif(not FULL, reason="slow: run `make bench`")
def test_law_fitted_to_a_third_of_the_presses_agrees_with_all_presses(real):
    for pokes in real.values():
        fitted = fit(AXES.align(thin(pokes, len(pokes) // 3)), SETUP, TEN, AXES.start)
        presses = AXES.align(pokes)
        agreed = agreement(presses, simulate_uT(fitted, SETUP, presses.place_mm, presses.recorded.force_N))
        assert agreed["cosine_mean"] > 0.89
        assert agreed["explained_median"] > 0.78
        assert agreed["growth"]["simulated"] == pytest.approx(agreed["growth"]["recorded"], abs=0.12)
