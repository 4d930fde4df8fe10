"""Export a calibrated universal model for programs without Python, as an ONNX file.

After calibration to a skin, the model computes its estimates from field changes by a fixed function: a network that
attends to a fixed context, and a correction of forces. `build_onnx` expresses this function with ONNX operators. They
compute in double precision where the Python code uses single precision.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from reskin import io
from reskin.data.contact import contact_threshold_uT, noise_uT
from reskin.errors import SchemaError
from reskin.models.onnx_graph import Graph
from reskin.universal import force, network
from reskin.universal.calibration import check_readings
from reskin.universal.network import HEAD, HEADS_N, LAYERS_N, WIDTH

if TYPE_CHECKING:
    from onnx import ModelProto

    from reskin.universal.model import Calibrated, Universal

OUTPUTS = {  # name of each output: its shape for a single reading
    "place_mm": [2], "sd_mm": [2], "force_N": [], "sd_N": [], "change_uT": [], "contact": [],
}  # fmt: skip


def write_onnx(model: "Universal", file: Path, quiet_uT: Float[np.ndarray, "*f ch"] | None = None) -> None:
    """Write the function of a calibrated model to a file as an ONNX model. An existing file is replaced."""
    content = build_onnx(model, quiet_uT).SerializeToString()
    with io.replacing(file) as temporary:
        temporary.write_bytes(content)


def build_onnx(model: "Universal", quiet_uT: Float[np.ndarray, "*f ch"] | None = None) -> "ModelProto":
    """Convert the function of a calibrated model to an ONNX model; see `Universal.export_onnx`."""
    noload_uT, channels_n = model.noload_uT, model.channels_n
    suppressor = contact_uT = None
    if quiet_uT is not None:
        quiet = check_readings(quiet_uT, channels_n) - noload_uT
        if len(quiet) < 2:
            problem = f"quiet_uT: {len(quiet)} readings are too few to estimate the noise"
            raise SchemaError(f"{problem}. Pass the readings of about one second without contact.")
        suppressor = model.suppressor(noise_uT(quiet))
        contact_uT = contact_threshold_uT(quiet, suppressor)
    g, outputs = Graph(np.float64), dict(OUTPUTS)
    db_uT = g.add("MatMul", "db_uT", g.constant(model.layout.to_board(np.eye(channels_n))))
    scaled, sd = _normals(g, model.skin, db_uT)
    of_place = scaled if model.skin.refined is None else _normals(g, model.skin.refined, db_uT)[0]
    place_mm = g.add("Mul", g.columns(of_place, 0, 2), network.PLACE_MM)
    g.add("Add", place_mm, g.constant(model.layout.centre_mm), name="place_mm")
    judge = model.skin.judge
    g.add("Mul", g.columns(sd, 0, 2), network.PLACE_MM * judge.sd_mm, name="sd_mm")
    log_N = g.add("Mul", g.columns(scaled, 2, 3), network.LOG_N)
    force_N = g.add("Exp", log_N) if judge.head is None else _head(g, judge.head, log_N, db_uT)
    if judge.head is not None and judge.enough:
        floored_N = g.add("Max", force_N, force.FLOOR * judge.head.mean_N)
        sd_N = g.add("Mul", floored_N, judge.head.error / force.NORMAL_90)
    else:
        sd_N = g.add("Mul", force_N, g.add("Mul", g.columns(sd, 2, 3), network.LOG_N * judge.sd_log_N))
    for name, value in (("force_N", force_N), ("sd_N", sd_N)):
        g.add("Squeeze", value, g.constant([1], np.int64), name=name)
    shrunk_uT = "db_uT" if suppressor is None else g.add("MatMul", "db_uT", g.constant(suppressor))
    change_uT = g.add("Squeeze", g.length(shrunk_uT), g.constant([1], np.int64), name="change_uT")
    if contact_uT is None:
        del outputs["contact"]
    else:
        g.add("Greater", change_uT, contact_uT, name="contact")
    built = g.build(channels_n, outputs, of_bool=["contact"])
    from onnx import helper  # imported here, because the package is optional

    about = {"board": model.layout.name, "presses_n": str(model.presses_n), "external_uT": f"{model.external_uT:g}"}
    helper.set_model_props(built, about | {"noload_uT": " ".join(f"{value:.9g}" for value in noload_uT)})
    return built


def _normals(g: Graph, skin: "Calibrated", db_uT: str) -> tuple[str, str]:
    """Add the network, as `network.estimate` computes it; return scaled means and standard deviations [f 3]."""
    compiled, context = skin.compiled, skin.context
    length = g.add("Max", g.length(db_uT), network.LENGTH_MIN_uT)
    direction = g.add("Div", g.add("Mul", db_uT, context.sign * network.DIRECTION_GAIN), length)
    inputs = g.add("Concat", direction, g.add("Sub", g.add("Log", length), network.LOG_uT), axis=1)
    token = g.affine(g.bend(g.affine(inputs, compiled.embed[0], context.shared)), *compiled.embed[1:])
    for i in range(LAYERS_N):
        normed = g.normalise(token, compiled.norms[2 * i], network.NORM_EPS)
        asked = g.affine(normed, compiled.query[0][i], compiled.query[1][i])
        asked = g.reshape(asked, 0, HEADS_N, 1, HEAD)
        keys = context.keys[i].reshape(HEADS_N, HEAD, -1)
        values = context.values[i].reshape(-1, HEADS_N, HEAD).transpose(1, 0, 2)
        share = g.add("Softmax", g.add("MatMul", asked, g.single(keys)), axis=-1)
        read = g.reshape(g.add("MatMul", share, g.single(values)), 0, WIDTH)
        token = g.add("Add", token, g.affine(read, compiled.mix[0][i], compiled.mix[1][i]))
        hidden = g.affine(
            g.normalise(token, compiled.norms[2 * i + 1], network.NORM_EPS), compiled.mlp[0][i], compiled.mlp[1][i]
        )
        token = g.add("Add", token, g.affine(g.bend(hidden), compiled.mlp[2][i], compiled.mlp[3][i]))
    out = g.affine(g.normalise(token, compiled.norms[-1], network.NORM_EPS), *compiled.out[:2])
    out = g.affine(g.bend(out), *compiled.out[2:])
    low, high = network.LOG_SD
    return g.columns(out, 0, 3), g.add("Exp", g.add("Min", g.add("Max", g.columns(out, 3, 6), low), high))


def _head(g: Graph, head: force.ForceHead, log_N: str, db_uT: str) -> str:
    """Add the correction of forces, as in `ForceHead.force_N`; return forces [f 1]."""
    estimated_N = g.add("Exp", g.add("Min", log_N, force.LOG_MAX_N))
    length = g.add("Max", g.length(db_uT), network.LENGTH_MIN_uT)
    direction = g.add("Mul", g.add("Div", db_uT, length), force.DIRECTION_WEIGHT)
    features = g.add("Concat", direction, g.add("Mul", g.add("Log", length), force.LOG_WEIGHT), axis=1)
    apart = g.add("Sub", g.reshape(features, 0, 1, head.features.shape[1]), g.constant(head.features[None]))
    apart2 = g.add("ReduceSum", g.add("Mul", apart, apart), g.constant([-1], np.int64), keepdims=0)
    of_field = g.add("Exp", g.add("Mul", apart2, -0.5 / force.FIELD_LENGTH**2))
    of_scale = g.add("Mul", estimated_N, g.constant(head.estimated_N[None] * (force.SCALE_SD / head.spread_N) ** 2))
    covariance = g.add("Add", of_scale, g.add("Mul", of_field, force.OF_FIELD_SD**2))
    force_N = g.add("Add", estimated_N, g.add("MatMul", covariance, g.constant(head.weights[:, None])))
    return g.add("Min", g.add("Max", force_N, head.limits_N[0]), head.limits_N[1])
