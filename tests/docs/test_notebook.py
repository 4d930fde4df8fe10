"""Tests of docs/notebook.ipynb: its code runs and prints the committed outputs."""

import io
import json
import tempfile
from contextlib import redirect_stdout
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

FILE = Path(__file__).resolve().parents[2] / "docs/notebook.ipynb"


@pytest.fixture
def cells() -> list[dict]:
    content = json.loads(FILE.read_text(encoding="utf-8"))
    return [cell for cell in content["cells"] if cell["cell_type"] == "code"]


def test_cells_print_the_committed_outputs(cells, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    plt.switch_backend("Agg")
    variables: dict[str, object] = {}
    try:
        for i, cell in enumerate(cells, 1):
            printed, figures_n = io.StringIO(), len(plt.get_fignums())
            with redirect_stdout(printed):
                exec(compile("".join(cell["source"]), f"{FILE.name}, code cell {i}", "exec"), variables)
            assert printed.getvalue() == "".join("".join(output.get("text", "")) for output in cell["outputs"])
            shown = [output for output in cell["outputs"] if "image/png" in output.get("data", {})]
            assert len(plt.get_fignums()) - figures_n == len(shown)
    finally:
        plt.close("all")
