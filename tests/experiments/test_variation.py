"""Tests of experiment variation, which shows how readings at one place change over time and between skins."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.experiments.variation import (
    Variation,
    Visits,
    figures,
    find_visits,
    over_skins,
    over_time,
    variation,
)
from reskin import io
from reskin.errors import ParamsError
from reskin.seeds import rng_for
from tests.data.tables import readings
from tests.experiments.test_drift import CI, DRIFT_uT
from tests.experiments.test_drift import capture as drifting


def capture(passes_n: int = 4):
    """Return readings with random fields.

    Each pass visits three places at two depths, with two readings per contact.
    """
    stops = [(x_mm, depth_mm) for _ in range(passes_n) for depth_mm in (0.6, 1.2) for x_mm in (0, 2, 4)]
    x_mm, depth_mm = np.repeat(np.array(stops, np.float32), 2, axis=0).T
    f = len(x_mm)
    rng = rng_for(0, "visits")
    return readings(
        f=f, x_mm=x_mm, depth_mm=depth_mm, indentation=np.arange(f, dtype=np.int32) // 2,
        n_contacts=np.arange(f, dtype=np.int32) // 2, b_uT=rng.normal(0, 100, (f, 3)).astype(np.float32),
        noload_uT=rng.normal(0, 100, (f, 3)).astype(np.float32),
    )  # fmt: skip


def visits(b_uT: list, db_uT: list, contacts_n: list | None = None) -> Visits:
    counted = np.array(contacts_n or range(len(b_uT)), np.int32)
    return Visits(counted, np.array(b_uT, float), np.array(db_uT, float))


def test_visits_to_a_place_equal_a_loop_over_readings():
    one = capture()
    found = find_visits(one, (2.0, 2.0), 1.2)
    naive: dict[int, list[np.ndarray]] = {}
    for i in range(len(one)):
        if one.x_mm[i] == 2 and abs(one.depth_mm[i] - 1.2) < 1e-6:
            naive.setdefault(int(one.n_contacts[i]), []).append(np.stack([one.b_uT[i], one.b_uT[i] - one.noload_uT[i]]))
    assert found.contacts_n.tolist() == list(naive) == [4, 10, 16, 22]
    expected = np.array([np.mean(pair, axis=0) for pair in naive.values()])
    # Tolerance: fields of 100 uT are rounded by 1e-5 uT in single precision.
    np.testing.assert_allclose(found.b_uT, expected[:, 0], atol=1e-4)
    np.testing.assert_allclose(found.db_uT, expected[:, 1], atol=1e-4)


@pytest.mark.parametrize(
    ("place_mm", "depth_mm", "listed"),
    [
        ((2.0, 2.0), 0.9, "Choose one of the depths at this place: 0.6, 1.2 mm"),
        ((3.0, 2.0), 1.2, "3 places, among them 0, 2; 2, 2; 4, 2"),
    ],
)
def test_place_or_depth_that_was_not_visited_is_refused(place_mm, depth_mm, listed):
    with pytest.raises(ParamsError, match=listed) as caught:
        find_visits(capture(), place_mm, depth_mm)
    assert "\n" not in str(caught.value)


def test_change_over_time_is_between_the_first_and_the_last_visit_within_the_limit():
    visited = visits([[0, 0], [9, 9], [3, -1], [50, 50]], [[2, 2], [8, 8], [2, 4], [99, 99]], [7, 8, 9, 17])
    numbers, plotted = over_time(visited, 10)
    assert numbers == {
        "visits_n": 3, "contacts_n": 2, "first_db_uT": 2.0,
        "raw_change_uT": pytest.approx(5**0.5), "raw_change_pct": pytest.approx(50 * 5**0.5),
        "db_change_uT": pytest.approx(2**0.5), "db_change_pct": pytest.approx(50 * 2**0.5),
    }  # fmt: skip
    assert plotted == {"contacts_n": [7, 8, 9], "b_uT": [[0, 0], [9, 9], [3, -1]]}


def test_spread_between_skins_is_the_rms_difference_over_all_pairs_of_skins():
    lines = {"s0": [1.0, 2.0], "s1": [4.0, 2.0], "s2": [1.0, 8.0]}
    numbers, plotted = over_skins({skin: visits([line] * 2, [line] * 2) for skin, line in lines.items()})
    pairs = [(one, other) for one in lines for other in lines if one < other]
    squares = [(a - b) ** 2 for one, other in pairs for a, b in zip(lines[one], lines[other], strict=True)]
    size_uT = np.sqrt(np.mean([value**2 for line in lines.values() for value in line]))
    assert numbers["spread_uT"] == pytest.approx(np.sqrt(np.mean(squares)))
    assert numbers["spread_pct"] == pytest.approx(100 * np.sqrt(np.mean(squares)) / size_uT)
    assert plotted == lines


def numbers(skins: tuple[str, ...] = ("s0", "s1")) -> dict:
    time = {
        "visits_n": 26, "contacts_n": 9750, "first_db_uT": 264.0, "raw_change_uT": 23.7, "raw_change_pct": 8.98,
        "db_change_uT": 5.21, "db_change_pct": 1.97,
    }  # fmt: skip
    spread = {"spread_uT": 241.0, "spread_pct": 96.1} if len(skins) > 1 else {}
    places = [
        {"x_mm": x_mm, "y_mm": 8.0, "time": time, "skins": {"skins": list(skins), "mean_db_uT": 250.0, **spread}}
        for x_mm in (8.0, 4.0)
    ]
    return {"depth_mm": 1.2, "places": places}


def test_stage_recovers_the_known_drift_and_gain_of_skins(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    worn, gains = drifting("s0-wear"), {"s0": 1.0, "s1": 1.5, "s2": 9.0}
    io.write_readings(tmp_path / "wear/s0-wear.parquet", [worn], {})
    for skin, board in (("s0", "b0"), ("s1", "b1"), ("s2", "b0")):
        plain = drifting(skin, skin, board)
        louder_uT = plain.noload_uT + np.float32(gains[skin]) * (plain.b_uT - plain.noload_uT)
        io.write_readings(tmp_path / f"main/{skin}.parquet", [replace(plain, b_uT=louder_uT)], {})
    section = CI.section(Variation, "variation").model_copy(update={"skins_n": 2})
    variation(CI, section, tmp_path / "main", tmp_path / "wear", tmp_path / "results.json")
    results = io.read_json(tmp_path / "results.json")
    for place in results["numbers"]["places"]:
        assert place["time"]["visits_n"] == 2
        assert place["time"]["raw_change_uT"] == pytest.approx(DRIFT_uT * 130, rel=1e-3)
        assert place["time"]["db_change_uT"] < 1e-3  # rounding of fields of 1000 uT to single precision
        assert place["skins"]["skins"] == ["s0", "s1"]  # only the first skin of each board
        # The second skin has 1.5 times the field of the first. The spread is relative to the rms of both fields.
        assert place["skins"]["spread_pct"] == pytest.approx(100 * 0.5 / np.sqrt((1 + 1.5**2) / 2), rel=1e-4)
    assert len(figures(results["numbers"], results["drawn"], "simulated")) == 2
