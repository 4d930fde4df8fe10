"""Tests of figures as SVG text: equal for equal data, unique ids, and nothing outside the figure at a phone's width."""

import re
import xml.etree.ElementTree as ET

from pipeline.plot import drawing, svg


def draw(y=(1.0, 2.0), **scales) -> str:
    with drawing(3.0, "bias 0.00899") as figure:
        axes = figure.subplots()
        axes.plot([0.123456, 200], y, label="a & b")
        axes.set(**scales)
        axes.legend()
        return svg(figure)


def ids(text: str) -> list[str]:
    return [element.get("id") for element in ET.fromstring(text).iter() if element.get("id")]


def test_equal_data_give_equal_text():
    assert draw() == draw() != draw((1.0, 3.0))


def test_figures_of_one_page_share_no_id_and_refer_only_to_their_own():
    one, other = draw(), draw((1.0, 3.0))
    assert len(ids(one)) == len(set(ids(one)))
    assert not set(ids(one)) & set(ids(other))
    references = re.findall(r'(?:href="#|url\(#)([^")]+)', one)
    assert references
    assert set(references) <= set(ids(one))
