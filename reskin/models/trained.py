"""Trained networks: read from disk, predict, and export as ONNX."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32

from reskin import io
from reskin.errors import SchemaError, missing_package
from reskin.models.inputs import VIEW, DB_FLOOR_uT, Scaler
from reskin.models.recipe import HEADLINE
from reskin.numerics import device

FORMAT = "reskin-model/3"  # of a model's card

if TYPE_CHECKING:
    from onnx import ModelProto

    from reskin.models.network import Predictor


@dataclass(frozen=True)
class Network:
    """A trained network with its card: changes of field in uT -> x, y in mm and F in N."""

    card: Mapping[str, Any]
    tensors: Mapping[str, np.ndarray]

    def __call__(self, db_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f 3"]:
        """Predict row by row."""
        scaler, view = Scaler.of_arrays(self.tensors), VIEW[self.card["recipe"]["inputs"]](db_uT)
        return scaler.decode(self._predictor(scaler.encode(view)))

    @cached_property
    def _predictor(self) -> "Predictor":
        """Built once: a controller predicts for every frame."""
        from reskin.models.network import Predictor  # imports torch: only a process that predicts needs it

        weights = {name: values for name, values in self.tensors.items() if name.startswith("layer")}
        return Predictor(weights, self.card["recipe"]["architecture"], device())


def networks_held_out(models: Path, board: str, *, recipe: str = HEADLINE) -> list[Network]:
    """Read the networks of train_multi with this board held out, one a seed."""
    found = []
    for file in sorted(models.glob("*.json")):
        card = io.read_json(file)
        if (card["question"], card["fold"], card["recipe_name"]) == ("lobo", board, recipe):
            found.append(Network(card, io.read_tensors(file.with_suffix(".safetensors"))[0]))
    if not found:
        rule = f"some of recipe {recipe} with board {board} held out"
        raise SchemaError(str(models), "networks", rule, "none", "Train them: ask lobo of this scene.")
    return found


def networks_by_fold(models: Path, experiment: str, *, recipe: str = HEADLINE) -> dict[str, list[Network]]:
    """Read the networks of an experiment by fold, one a seed; empty if the scene does not run it."""
    found: dict[str, list[Network]] = {}
    for file in sorted(models.glob("*.json")):
        card = io.read_json(file)
        if (card["question"], card["recipe_name"]) == (experiment, recipe):
            network = Network(card, io.read_tensors(file.with_suffix(".safetensors"))[0])
            found.setdefault(card["fold"], []).append(network)
    return found


# --- ONNX ---

OPSET, IR = 17, 8  # of 2022, which current runtimes read
INPUT, OUTPUT = "db_uT", "x_mm y_mm F_N"
Node = tuple[str, tuple[str, ...], str]  # operator, inputs, output


def write_onnx(network: Network, file: Path) -> None:
    """Write a network as ONNX; an existing file is replaced."""
    file.write_bytes(build_onnx(network).SerializeToString())


def build_onnx(network: Network) -> "ModelProto":
    """Build the ONNX graph of a network: view, scaling, layers, units."""
    try:
        from onnx import TensorProto, checker, helper, numpy_helper
    except ImportError:
        raise missing_package("onnx", "export_onnx") from None
    from reskin.models.network import LAYERS  # imported late: imports torch

    card, scaler = network.card, dict(network.tensors)
    channels_n = card["input"]["channels_n"]
    layers = LAYERS[card["recipe"]["architecture"]](scaler["input_shift"].size)
    nodes = [
        *VIEW_NODES[card["recipe"]["inputs"]](),
        *_scale_inputs(),
        *_layers([layer.relu for layer in layers]),
        *_scale_outputs(),
    ]
    made = [
        helper.make_node(operator, list(inputs), [output], **ATTRIBUTES.get(operator, {}))
        for operator, inputs, output in nodes
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
    """The direction and the natural log of the length, as `reskin.models.inputs.shape`."""
    yield "ReduceL2", (INPUT,), "length_uT"
    yield "Max", ("length_uT", "floor_uT"), "floored_uT"
    yield "Div", (INPUT, "floored_uT"), "direction"
    yield "Log", ("floored_uT",), "log_length"
    yield "Concat", ("direction", "log_length"), "view"


VIEW_NODES = {"raw": _raw, "shape": _shape}


def _scale_inputs() -> Iterator[Node]:
    yield "Sub", ("view", "input_shift"), "shifted"
    yield "Div", ("shifted", "input_scale"), "features0"


def _layers(relus: list[bool]) -> Iterator[Node]:
    for i, relu in enumerate(relus, 1):
        yield "Gemm", (f"features{i - 1}", f"layer{i}.weight", f"layer{i}.bias"), f"linear{i}"
        yield ("Relu" if relu else "Identity"), (f"linear{i}",), f"features{i}"
    yield "Identity", (f"features{len(relus)}",), "encoded"


def _scale_outputs() -> Iterator[Node]:
    yield "Mul", ("encoded", "target_scale"), "scaled"
    yield "Add", ("scaled", "target_shift"), OUTPUT
