"""The paper's table 1 as printed: its cells stay its own, ours stand beside them, and a broken file is refused."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.report.table1 import LOCALISATION, NOT_GIVEN, OURS, measured, read_table1, table1
from reskin.errors import ParamsError
from tests.report.synthetic import all_experiments, stat

DATA = read_table1()
ROWS = (*DATA.rows, LOCALISATION)


def test_the_columns_are_the_papers_and_each_has_a_source_with_its_year():
    assert list(DATA.columns) == ["ReSkin", "DIGIT", "GelSlim", "BioTac", "RSkin"]
    for name, year in zip(DATA.columns, (2021, 2020, 2018, 2019, 2013), strict=True):
        assert f"{year}" in DATA.columns[name]


def test_as_the_caption_says_only_reskin_meets_every_requirement():
    asked = [name for name in DATA.rows if name not in ("Type", "Frequency")]
    met = {column: all(DATA.rows[name][i] == "yes" for name in asked) for i, column in enumerate(DATA.columns)}
    assert [column for column, all_met in met.items() if all_met] == ["ReSkin"]
    assert {cell for name in asked for cell in DATA.rows[name]} == {"yes", "no", "?"}


@given(st.dictionaries(st.sampled_from(ROWS), st.text(max_size=9)))
def test_the_papers_cells_are_never_overwritten(measured):
    table = table1(DATA, measured)
    for (name, cells), (_, row) in zip(DATA.rows.items(), table.iterrows(), strict=False):
        assert [row["property"], *(row[column] for column in DATA.columns)] == [name, *cells]
        assert row[OURS] == measured.get(name, NOT_GIVEN)
    assert set(table.iloc[-1][list(DATA.columns)]) == {NOT_GIVEN}
    assert table.iloc[-1]["property"] == LOCALISATION


def test_what_was_set_in_a_simulated_rig_is_not_called_measured():
    for source, rate, area in (
        ("simulated", "400 Hz, a setting read back from the captures, simulated", "mm, a setting, simulated"),
        ("recorded", "400 Hz, recorded", "mm, recorded"),
    ):
        numbers = all_experiments(source)
        numbers["described"]["grid"]["over_skins"]["rate_hz"] = stat(400.0)
        numbers["sleeve"]["area_mm"] = [50.8, 101.6]
        words = measured(numbers)
        assert words["Frequency"] == rate
        assert words["Area coverage"] == f"40 chips under 50.8 x 101.6 {area}"


def test_every_source_is_told_beside_the_table():
    meaning = table1(DATA, {}).attrs["meaning"]
    assert all(source in meaning for source in DATA.columns.values())


def test_a_measured_row_that_the_table_lacks_is_refused():
    with pytest.raises(ParamsError, match="Weight"):
        table1(DATA, {"Weight": "5 g"})


@pytest.mark.parametrize(("rows", "fault"), [("{Type: [Magnetic]}", "2 cells, not 1"), ("{Type: [1, 2]}", "string")])
def test_a_broken_file_is_refused(tmp_path, rows, fault):
    file = tmp_path / "table1.yaml"
    file.write_text(f"columns: {{a: x, b: y}}\nrows: {rows}\n")
    with pytest.raises(ParamsError, match=fault):
        read_table1(file)
