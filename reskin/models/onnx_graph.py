"""Build ONNX models, with which programs without Python can use networks and the universal model."""

from collections.abc import Mapping, Sequence
from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np

from reskin.errors import missing_package

if TYPE_CHECKING:
    from onnx import ModelProto

OPSET, IR = 17, 8  # versions of the ONNX operators and of the file format, from 2022; current runtimes support them


class Graph:
    """An ONNX graph under construction, which computes in precision `dtype`; values are represented by their names.

    Raises ParamsError if the package onnx is not installed.
    """

    def __init__(self, dtype: type[np.floating]) -> None:
        try:
            from onnx import helper, numpy_helper
        except ImportError:
            raise missing_package("onnx", "export_onnx") from None
        self.dtype = dtype
        self.type = helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
        self._make_node, self._from_array = helper.make_node, numpy_helper.from_array
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self._number = count()

    def constant(self, value: Any, dtype: type[np.generic] | None = None) -> str:
        """Add a constant, by default in the precision of the graph."""
        name = f"c{next(self._number)}"
        self.constants.append(self._from_array(np.asarray(value, dtype or self.dtype), name))
        return name

    def single(self, value: np.ndarray) -> str:
        """Add a constant that is stored in single precision, and is converted to the precision of the graph."""
        return self.add("Cast", self.constant(value, np.float32), to=self.type)

    def add(self, operator: str, *inputs: str | float, name: str | None = None, **attributes: Any) -> str:
        """Add a node; inputs that are numbers become constants."""
        output = f"v{next(self._number)}" if name is None else name
        names = [value if isinstance(value, str) else self.constant(value) for value in inputs]
        self.nodes.append(self._make_node(operator, names, [output], **attributes))
        return output

    def reshape(self, value: str, *shape: int) -> str:
        """Reshape a value; 0 keeps the length of an axis."""
        return self.add("Reshape", value, self.constant(shape, np.int64))

    def columns(self, value: str, first: int, end: int) -> str:
        """Select columns of a value."""
        return self.add("Slice", value, *(self.constant([number], np.int64) for number in (first, end, 1)))

    def mean(self, value: str) -> str:
        """Average over the last axis, which is kept."""
        return self.add("ReduceMean", value, axes=[-1], keepdims=1)

    def length(self, value: str) -> str:
        """Return the norm over the last axis, which is kept."""
        square = self.add("Mul", value, value)
        return self.add("Sqrt", self.add("ReduceSum", square, self.constant([-1], np.int64), keepdims=1))

    def affine(self, value: str, weight: np.ndarray, bias: np.ndarray) -> str:
        """Multiply by a matrix with one row per input, and add a bias."""
        return self.add("Add", self.add("MatMul", value, self.single(weight)), self.single(bias))

    def bend(self, value: str) -> str:
        """Apply hard swish."""
        limited = self.add("Min", self.add("Max", self.add("Add", value, 3.0), 0.0), 6.0)
        return self.add("Div", self.add("Mul", value, limited), 6.0)

    def normalise(self, value: str, norm: np.ndarray, eps: float) -> str:
        """Apply a layer normalisation with these weights and biases."""
        centred = self.add("Sub", value, self.mean(value))
        variance = self.mean(self.add("Mul", centred, centred))
        scaled = self.add("Div", centred, self.add("Sqrt", self.add("Add", variance, eps)))
        return self.add("Add", self.add("Mul", scaled, self.single(norm[0])), self.single(norm[1]))

    def build(self, inputs_n: int, outputs: Mapping[str, Sequence[int]], of_bool: Sequence[str] = ()) -> "ModelProto":
        """Return the ONNX model with input `db_uT` [f inputs_n] and outputs [f ...] of these names and shapes.

        `of_bool` are the names of the outputs that are true or false.
        """
        from onnx import TensorProto, checker, helper

        types = {name: TensorProto.BOOL if name in of_bool else self.type for name in outputs}
        graph = helper.make_graph(
            self.nodes, "reskin",
            [helper.make_tensor_value_info("db_uT", self.type, ["f", inputs_n])],
            [helper.make_tensor_value_info(name, types[name], ["f", *shape]) for name, shape in outputs.items()],
            self.constants,
        )  # fmt: skip
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR)
        checker.check_model(model)
        return model
