"""The ONNX file answers as the network does under torch."""

import numpy as np
import pytest

import reskin
from pipeline.core.errors import ParamsError
from pipeline.core.seeds import rng_for
from pipeline.learning.model import LAYERS, draw_weights
from pipeline.trials import onnx_file
from pipeline.trials.networks import Network


def network_of(architecture: str, inputs: str) -> Network:
    """A network with weights that were drawn, and scalers of the size that trained ones have."""
    rng, inputs_n = rng_for(0, "onnx"), {"raw": 15, "shape": 16}[inputs]
    scaler = {
        "input_shift": rng.standard_normal(inputs_n), "input_scale": rng.uniform(0.2, 200, inputs_n),
        "target_shift": np.array([8.0, 8.0, 1.0]), "target_scale": np.array([4.6, 4.6, 0.5]),
    }  # fmt: skip
    weights = draw_weights(LAYERS[architecture](inputs_n), rng)
    recipe = {"architecture": architecture, "inputs": inputs}
    card = {"recipe": recipe, "input": {"channels_n": 15}}
    return Network(card, weights | {name: value.astype(np.float32) for name, value in scaler.items()})


@pytest.mark.parametrize("architecture", ["paper", "released"])
@pytest.mark.parametrize("inputs", ["raw", "shape"])
def test_onnxruntime_answers_as_torch_within_1e_5(tmp_path, architecture, inputs):
    pytest.importorskip("onnx", reason="extra `onnx` is not installed")
    runtime = pytest.importorskip("onnxruntime", reason="extra `onnx` is not installed")
    network = network_of(architecture, inputs)
    reskin.Model(network).export_onnx(tmp_path / "model.onnx")
    session = runtime.InferenceSession(tmp_path / "model.onnx", providers=["CPUExecutionProvider"])
    db_uT = (300 * rng_for(1, "onnx").standard_normal((1000, 15))).astype(np.float32)
    db_uT[0] = 0.0
    (found,) = session.run(None, {"db_uT": db_uT})
    expected = network(db_uT)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def test_without_the_package_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "onnx", None)
    with pytest.raises(ParamsError, match=r"pip install.*\[onnx\]"):
        onnx_file.build(network_of("paper", "raw"))
