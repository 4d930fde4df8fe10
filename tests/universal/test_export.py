"""Tests that exported ONNX files give the same estimates as Python."""

import numpy as np
import pytest

from reskin.data.contact import contact_threshold_uT, magnitudes_uT, noise_uT
from reskin.errors import ParamsError, ReskinError, SchemaError
from reskin.universal import export
from reskin.universal.model import load_universal
from tests.universal.skins import draw

# Python computes in single precision, so its estimates are no more exact than this, relative to a few mm and N.
EXACT = {"rtol": 1e-4, "atol": 1e-4}


@pytest.mark.parametrize(("labels_n", "external_uT"), [(0, 0.0), (3, 30.0), (20, 0.0)])
def test_onnx_gives_the_estimates_of_python(labels_n, external_uT, tmp_path):
    pytest.importorskip("onnx")
    runtime = pytest.importorskip("onnxruntime")
    skin = draw(12)[0]
    model = load_universal(external_uT=external_uT).zero(skin.rest_uT).see(skin.b_uT[:30])
    if labels_n:
        model.label(skin.place_mm[30:][:labels_n], skin.force_N[30:][:labels_n], skin.b_uT[30:][:labels_n])
    if labels_n >= 20:
        model.use_refined({name: value * np.float32(1.01) for name, value in model.weights.items()})
    quiet_uT = skin.rest_uT + np.random.default_rng(0).normal(0, 3, (50, 15))
    model.export_onnx(tmp_path / "skin.onnx", quiet_uT)
    session = runtime.InferenceSession(tmp_path / "skin.onnx")
    tested_uT = np.concatenate([skin.b_uT[60:], quiet_uT[:5]])
    db_uT = tested_uT - skin.rest_uT
    names = [output.name for output in session.get_outputs()]
    found = dict(zip(names, session.run(None, {"db_uT": db_uT}), strict=True))
    assert tuple(found) == tuple(export.OUTPUTS)
    for name in ("place_mm", "sd_mm", "force_N", "sd_N"):
        expected = getattr(model.estimate(tested_uT), name)
        np.testing.assert_allclose(found[name], expected, **EXACT)
    quiet = quiet_uT - skin.rest_uT
    suppressor = model.suppressor(noise_uT(quiet))
    changes_uT = magnitudes_uT(db_uT, suppressor)
    np.testing.assert_allclose(found["change_uT"], changes_uT)
    np.testing.assert_array_equal(found["contact"], changes_uT > contact_threshold_uT(quiet, suppressor))
    assert found["contact"][:-5].all()
    about = session.get_modelmeta().custom_metadata_map
    assert about["board"] == "reskin"
    np.testing.assert_allclose([float(value) for value in about["noload_uT"].split()], skin.rest_uT, rtol=1e-8)


def test_export_needs_a_no_load_reading_and_enough_quiet_readings(tmp_path, monkeypatch):
    pytest.importorskip("onnx")
    model = load_universal()
    with pytest.raises(SchemaError, match="First call zero"):
        model.export_onnx(tmp_path / "skin.onnx")
    model.zero(np.ones(15))
    with pytest.raises(SchemaError, match="1 readings are too few"):
        model.export_onnx(tmp_path / "skin.onnx", np.ones(15))
    assert not (tmp_path / "skin.onnx").exists()
    monkeypatch.setitem(__import__("sys").modules, "onnx", None)
    with pytest.raises((ParamsError, ReskinError, ImportError), match="onnx"):
        model.export_onnx(tmp_path / "skin.onnx")
