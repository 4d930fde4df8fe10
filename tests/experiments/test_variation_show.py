import xml.etree.ElementTree as ET

from pipeline.experiments.variation import figures, tables
from pipeline.report.formatting import to_markdown


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
    when = {"contact_every_s": 0.0575, "lasts_s": 1166.2, "shown_s": 575.0, "warmer_K": 1.85}
    return {"depth_mm": 1.2, "worn_skin": "s0", "places": places} | when


def drawn(last_uT: float = 40.0) -> dict:
    time = {"contacts_n": [0, 9750], "b_uT": [[0.0] * 15, [last_uT] * 15]}
    place = {"time": time, "skins": {"s0": [1.0] * 15, "s1": [-300.0] * 15}}
    return {"places": [place | {"x_mm": x_mm, "y_mm": 8.0} for x_mm in (8.0, 4.0)]}


def test_each_place_has_what_changes_as_read_what_a_model_sees_and_the_spread_of_skins():
    table = tables(numbers(), "simulated")["variation"]
    assert table["place, mm"].tolist() == ["8, 8"] * 3 + ["4, 8"] * 3
    assert table["difference, µT"].tolist() == ["23.7", "5.21", "241"] * 2
    assert table["difference, % of the change"].tolist() == ["8.98", "1.97", "96.1"] * 2
    assert set(table["source"]) == {"simulated"}
    assert "obvious variation across the samples" in to_markdown(table)


def test_the_pace_and_the_warmth_of_the_contacts_shown_stand_below():
    said = to_markdown(tables(numbers(), "simulated")["variation"])
    assert "after 0.0575 s (median); the whole capture lasts 1,166 s." in said
    assert "A real rig takes seconds a contact" in said
    assert "take 575 s, in which the chips' temperature changes by +1.9 K" in said
    cold = {name: value for name, value in numbers().items() if name != "warmer_K"}
    assert "temperature changes" not in to_markdown(tables(cold, "recorded")["variation"])


def test_one_skin_has_no_spread_between_skins():
    assert tables(numbers(("s0",)), "simulated")["variation"]["difference, µT"].tolist() == ["23.7", "5.21"] * 2


def test_figures_name_fifteen_channels_places_and_skins():
    texts = figures(numbers(), drawn(), "simulated")
    assert sorted(texts) == ["variation_skins.svg", "variation_time.svg"]
    for text in texts.values():
        ET.fromstring(text)
        for word in (
            "(simulated)",
            "µT",
            "at x = 8 mm, y = 8 mm",
            "at x = 4 mm",
            *(f"B{a}{c}" for c in range(5) for a in "xyz"),
        ):
            assert word in text
    assert "contacts before" in texts["variation_time.svg"]
    assert ">s1<" in texts["variation_skins.svg"]


def test_same_lines_same_bytes_other_lines_other_bytes():
    first, again, other = (figures(numbers(), lines, "simulated") for lines in (drawn(), drawn(), drawn(99.0)))
    assert first == again != other
