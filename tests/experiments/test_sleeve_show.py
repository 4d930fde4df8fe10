"""The sleeve's table and map: every method and part is said once, every poke and chip is drawn, sources are told."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from pipeline.experiments.sleeve import NEAR_MM, errors_mm, figures, score_places, tables, to_draw
from tests.experiments.test_sleeve import AREA, answered

SVG = "{http://www.w3.org/2000/svg}"


def answer(n=40):
    true, predicted, indentation = answered(n=n)
    others = {"shape": [predicted, true], "knn-raw": [predicted]}
    numbers = {
        "chips_n": 16, "rate_hz": 132.98, "area_mm": list(AREA.sides_mm), "pokes_n": 5 * n, "trained_n": 4 * n,
        "tested_n": n, "near_mm": NEAR_MM, **score_places(true, [predicted], indentation, AREA),
        "variants": {name: score_places(true, own, indentation, AREA) for name, own in others.items()},
    }  # fmt: skip
    return numbers, to_draw(AREA, true, errors_mm(true, predicted), indentation)


def test_every_method_is_a_row_that_says_its_source_and_that_the_paper_has_no_number():
    numbers, _ = answer()
    table = tables(numbers, "simulated")["sleeve"]
    assert table["method"].tolist() == ["the paper's network", "network, recipe shape", "k nearest neighbours (dB)"]
    assert set(table["source"]) == {"simulated"}
    assert set(table["paper"]) == {"none: a demonstration"}
    assert table["seeds"].tolist() == ["1", "2", "1"]
    assert "±" in table["accuracy, %"][1]
    assert "network seeds that column `seeds` counts" in table.attrs["spread"]
    assert float(table["median error, mm"][0]) == pytest.approx(
        numbers["median_error_mm"]["mean"], rel=5e-3
    )  # 3 digits
    near = numbers["near_seam"]["median_error_mm"]["mean"]
    assert float(table["median near a border of boards, mm"][0]) == pytest.approx(near, rel=5e-3)
    assert f"first {4 * 40} pokes" in table.attrs["meaning"]


def test_a_part_without_pokes_is_a_dash_and_no_zero():
    numbers, _ = answer()
    del numbers["near_seam"]
    table = tables(numbers, "simulated")["sleeve"]
    assert table["median near a border of boards, mm"][0] == "–"
    assert "0 of them less than" in table.attrs["meaning"]


def test_the_set_up_stands_beside_the_papers():
    table = tables(answer()[0], "simulated")["sleeve_set_up"].set_index("what")
    assert table.loc["chips", ["ours", "paper"]].tolist() == ["16", "40"]
    assert table.loc["rate, Hz", ["ours", "paper"]].tolist() == ["133.0", "133"]


def test_the_map_shows_every_tested_poke_and_every_chip_and_says_its_source():
    numbers, drawn = answer()
    texts = figures(numbers, drawn, "simulated")
    assert list(texts) == ["sleeve.svg"]
    marks = [
        len(group.findall(f".//{SVG}use")) for group in ElementTree.fromstring(texts["sleeve.svg"]).iter(f"{SVG}g")
    ]
    assert len(drawn["x_mm"]) == 40
    assert len(drawn["chips_x_mm"]) in marks
    assert 40 in marks
    said = " ".join(re.findall(r">([^<>]+)</text>", texts["sleeve.svg"]))
    for words in ("(simulated)", "x / mm", "y / mm", "place error", "border of two boards"):
        assert words in said


def test_the_same_answer_gives_the_same_bytes_and_another_source_another_title():
    numbers, drawn = answer()
    once, again, other = (figures(numbers, drawn, source)["sleeve.svg"] for source in ("simulated", "simulated", "x"))
    assert once == again
    assert once != other
    assert np.isfinite(drawn["error_mm"]).all()
