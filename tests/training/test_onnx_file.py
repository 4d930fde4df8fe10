"""Tests of the exported ONNX model against PyTorch."""

import numpy as np
import pytest

import reskin
from reskin.errors import ParamsError
from reskin.models import trained as onnx_file
from reskin.models.batches import LabelledRows, PreparedJob
from reskin.models.inputs import FIT, VIEW
from reskin.models.job import LossWeights
from reskin.models.network import LAYERS, draw_weights
from reskin.models.train import train
from reskin.models.trained import Network
from reskin.seeds import rng_for
from tests.models.example_jobs import recipe

STEPS_N = 300
SCALING = {"paper": "standard", "released": "released"}
# These are the minimum and maximum of x (mm), y (mm) and F (N).
TARGET_RANGE = np.array([[4.0, 4.0, 0.3], [12.0, 12.0, 1.5]])


def train_network(architecture: str, inputs: str) -> tuple[Network, np.ndarray]:
    """Return a network after a few hundred training steps, and field changes that were not used in the training."""
    rng = rng_for(0, "onnx", architecture, inputs)
    target = rng.uniform(*TARGET_RANGE, (600, 3)).astype(np.float32)  # The columns are x_mm, y_mm and F_N.
    # The linear coefficients in uT per mm or N come first, then the quadratic ones.
    field = 60 * rng.standard_normal((6, 15))
    centred = target - TARGET_RANGE.mean(axis=0)
    db_uT = (np.hstack([centred, centred**2]) @ field + 3 * rng.standard_normal((600, 15))).astype(np.float32)
    settings, view = recipe(architecture=architecture, inputs=inputs, steps_n=STEPS_N, batch_n=64), VIEW[inputs]
    scaler = FIT[SCALING[architecture]](view(db_uT[:500]), target[:500])
    labelled = LabelledRows(scaler.encode(view(db_uT[:500])), scaler.encode_target(target[:500]), None)
    start = draw_weights(LAYERS[architecture](labelled.inputs.shape[1]), rng)
    (outcome,) = train([PreparedJob(start, rng, labelled)], architecture, settings, LossWeights(0.0), "cpu")
    assert outcome.stopped_step is None
    assert outcome.curve[-1] < 0.7 * outcome.curve[0]  # The training has reduced the loss.
    card = {"recipe": {"architecture": architecture, "inputs": inputs}, "input": {"channels_n": 15}}
    return Network(card, dict(outcome.weights) | scaler.arrays()), db_uT[500:]


@pytest.mark.parametrize("architecture", ["paper", "released"])
@pytest.mark.parametrize("inputs", ["raw", "shape"])
def test_onnx_model_equals_torch_within_1e_5(tmp_path, architecture, inputs):
    pytest.importorskip("onnx", reason="extra `onnx` is not installed")
    runtime = pytest.importorskip("onnxruntime", reason="extra `onnx` is not installed")
    network, db_uT = train_network(architecture, inputs)
    reskin.Model(network).export_onnx(tmp_path / "model.onnx")
    session = runtime.InferenceSession(tmp_path / "model.onnx", providers=["CPUExecutionProvider"])
    # These fields are far outside the range of the training rows.
    far_uT = (1000 * rng_for(1, "onnx").standard_normal((100, 15))).astype(np.float32)
    db_uT = np.concatenate([np.zeros((1, 15), np.float32), db_uT, far_uT])
    (found,) = session.run(None, {"db_uT": db_uT})
    expected = network(db_uT)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def test_error_explains_that_package_onnx_is_missing(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "onnx", None)
    with pytest.raises(ParamsError, match=r"pip install.*\[onnx\]"):
        onnx_file.build_onnx(Network({}, {}))
