"""A trained network as an ONNX file, for programs without Python. In: a network. Out: a file that says what it takes.

The view, the scaler and the layers are in it: changes of field in uT go in, x and y in mm and F in N come out. Needs
extra `onnx`. Refuses to know where the network comes from.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.packages import lacking
from pipeline.learning.inputs import DB_FLOOR_uT
from pipeline.learning.model import LAYERS
from pipeline.trials.networks import Network

if TYPE_CHECKING:
    from onnx import ModelProto

OPSET, IR = 17, 8  # of 2022, which runtimes of today still read
INPUT, OUTPUT = "db_uT", "x_mm y_mm F_N"
Node = tuple[str, tuple[str, ...], str]  # operator, inputs, output


def write(network: Network, file: Path) -> None:
    """Write a network; an existing file is replaced."""
    file.write_bytes(build(network).SerializeToString())


def build(network: Network) -> "ModelProto":
    """Put the graph together."""
    try:
        from onnx import TensorProto, checker, helper, numpy_helper
    except ImportError:
        raise lacking("onnx", "export_onnx") from None
    card, scaler = network.card, dict(network.tensors)
    channels_n = card["input"]["channels_n"]
    layers = LAYERS[card["recipe"]["architecture"]](scaler["input_shift"].size)
    nodes = [*VIEWS[card["recipe"]["inputs"]](), *_scaled(), *_layers([layer.relu for layer in layers]), *_answers()]
    made = [
        helper.make_node(kind, list(inputs), [output], **ATTRIBUTES.get(kind, {})) for kind, inputs, output in nodes
    ]
    constants = {name: np.asarray(value, np.float32) for name, value in scaler.items()}
    constants["floor_uT"] = np.array([DB_FLOOR_uT], np.float32)
    graph = helper.make_graph(
        made, "reskin",
        [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, ["f", channels_n])],
        [helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, ["f", scaler["target_shift"].size])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR)
    checker.check_model(model)
    return model


ATTRIBUTES: dict[str, dict[str, object]] = {
    "Gemm": {"transB": 1}, "ReduceL2": {"axes": [1], "keepdims": 1}, "Concat": {"axis": 1},
}  # fmt: skip


def _raw() -> Iterator[Node]:
    yield "Identity", (INPUT,), "view"


def _shape() -> Iterator[Node]:
    """The direction and the natural log of the length, as `learning.inputs.shape`."""
    yield "ReduceL2", (INPUT,), "length_uT"
    yield "Max", ("length_uT", "floor_uT"), "floored_uT"
    yield "Div", (INPUT, "floored_uT"), "direction"
    yield "Log", ("floored_uT",), "log_length"
    yield "Concat", ("direction", "log_length"), "view"


VIEWS = {"raw": _raw, "shape": _shape}


def _scaled() -> Iterator[Node]:
    yield "Sub", ("view", "input_shift"), "shifted"
    yield "Div", ("shifted", "input_scale"), "features0"


def _layers(relus: list[bool]) -> Iterator[Node]:
    for i, relu in enumerate(relus, 1):
        yield "Gemm", (f"features{i - 1}", f"layer{i}.weight", f"layer{i}.bias"), f"linear{i}"
        yield ("Relu" if relu else "Identity"), (f"linear{i}",), f"features{i}"
    yield "Identity", (f"features{len(relus)}",), "encoded"


def _answers() -> Iterator[Node]:
    yield "Mul", ("encoded", "target_scale"), "scaled"
    yield "Add", ("scaled", "target_shift"), OUTPUT
