"""Export a calibrated universal model for programs without Python, as an ONNX file or as C code.

After calibration to a skin, the model computes its estimates (places, forces and their uncertainty) from field changes
by a fixed function. `SkinFunction` contains all numbers of this function. `build_onnx` expresses the function with ONNX
operators, and `estimate.h` implements it in C99. Both follow `Evaluation.combined` and `reskin.universal.kernels`, and
use the same numbers as the Python code. However, they compute in double precision where the Python code uses single
precision. The C code can also be compiled for single precision.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Float32

from reskin import io
from reskin.data.contact import contact_threshold_uT, noise_uT
from reskin.errors import SchemaError, missing_package
from reskin.universal import force, model, network
from reskin.universal.calibration import check_readings
from reskin.universal.kernels import CELL_SD_MM, FARTHEST, TINY, Gaussians
from reskin.universal.map import LENGTH_LOG_N, LENGTH_MM
from reskin.universal.network import Layers

if TYPE_CHECKING:
    from onnx import ModelProto

    from reskin.universal.model import Universal

OPSET, IR = 17, 8  # versions of the ONNX operators and of the file format, from 2022; current runtimes support them
C_CODE = Path(__file__).with_name("estimate.h")
NUMBERS_PER_LINE = 8
REAL, SINGLE = "%.16e", "%.8ef"  # number formats that preserve all digits of double precision and of single precision
OUTPUTS = {  # name of each output: its shape for a single reading
    "place_mm": [2], "sd_mm": [2], "force_N": [], "sd_log_N": [], "misfit": [], "change_uT": [], "contact": [],
}  # fmt: skip


@dataclass(frozen=True)
class SkinFunction:
    """All numbers of the function that computes estimates from the field changes of one skin.

    Field changes are along the chips' axes.

    Parameters
    ----------
    about : texts about the skin, which are written to the exported file
    turn : matrix that converts field changes to the board's axes. If the skin is turned by a quarter, this matrix also
        reverses their sign.
    noload_uT : no-load field that is subtracted from readings
    centre_mm : the board's centre in the frame of the labels
    place_mm, log_N : places and log forces of the hypotheses of the map
    hypotheses : Gaussians of the map (`reskin.universal.kernels`)
    unlabelled : if only few forces are known, Gaussians of the map that is not conditioned on these forces (see
        `Evaluation`)
    few_mm, few_log_N : places and log forces of the presses with these few known forces
    networks : the networks, conditioned on the skin
    external_cov : covariance of external fields, or None if none are expected
    power : likelihood power
    line : the line that calibrates forces
    suppressor : matrix by which field changes are multiplied before a contact is detected, or None for no such matrix
    contact_uT : magnitude above which a field change counts as contact, or None if contacts are not detected
    """

    about: Mapping[str, str]
    turn: Float[np.ndarray, "ch ch"]
    noload_uT: Float[np.ndarray, " ch"]
    centre_mm: Float[np.ndarray, "2"]
    place_mm: Float[np.ndarray, "p 2"]
    log_N: Float[np.ndarray, " q"]
    hypotheses: Gaussians
    unlabelled: Gaussians | None
    few_mm: Float[np.ndarray, "m 2"]
    few_log_N: Float[np.ndarray, " m"]
    networks: Sequence[Layers]
    external_cov: Float[np.ndarray, "ch ch"] | None
    power: float
    line: force.ForceLine
    suppressor: Float[np.ndarray, "ch ch"] | None
    contact_uT: float | None

    @property
    def channels_n(self) -> int:
        return len(self.turn)


def skin_function(skin: "Universal", quiet_uT: Float[np.ndarray, "*f ch"] | None) -> SkinFunction:
    """Collect all numbers of the function that a calibrated model computes.

    If `quiet_uT` is given, it contains readings without contact, from which the threshold for contacts is computed.
    """
    noload_uT = skin.noload_uT
    calibrated, few = skin.calibrated, skin.calibrated.few
    turned = -1 if skin.mounting.turned else 1
    suppressor = contact_uT = None
    if quiet_uT is not None:
        db_uT = check_readings(quiet_uT, skin.channels_n) - noload_uT
        if len(db_uT) < 2:
            raise SchemaError(
                f"quiet_uT: {len(db_uT)} readings are too few to estimate the noise. Pass the readings of about one "
                "second without contact."
            )
        suppressor = skin.suppressor(noise_uT(db_uT))
        contact_uT = contact_threshold_uT(db_uT, suppressor)
    lattice = calibrated.skin.evaluator.lattice
    return SkinFunction(
        about={
            "board": skin.layout.name, "presses_n": str(skin.presses_n), "external_uT": f"{skin.external_uT:g}",
            "noload_uT": " ".join(f"{value:.9g}" for value in noload_uT),
        },
        turn=turned * skin.layout.to_board(np.eye(skin.channels_n)),
        noload_uT=noload_uT,
        centre_mm=np.array(skin.layout.centre_mm),
        place_mm=lattice.place_mm,
        log_N=lattice.log_N,
        hypotheses=calibrated.skin.evaluator.gaussians,
        unlabelled=None if few is None else few.skin.evaluator.gaussians,
        few_mm=np.zeros((0, 2)) if few is None else few.place_mm,
        few_log_N=np.zeros(0) if few is None else few.log_N,
        networks=calibrated.networks,
        external_cov=skin.external_cov,
        power=skin.power,
        line=calibrated.line,
        suppressor=suppressor,
        contact_uT=contact_uT,
    )  # fmt: skip


# --- ONNX ---


class Graph:
    """An ONNX graph under construction.

    Each method adds nodes or constants to the graph, and returns the name of the resulting value. In the functions
    below, values of the graph are represented by such names.
    """

    def __init__(self) -> None:
        from onnx import TensorProto, helper, numpy_helper

        self._make_node, self._from_array = helper.make_node, numpy_helper.from_array
        self._single, self._double = TensorProto.FLOAT, TensorProto.DOUBLE
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self._number = count()

    def constant(self, value: Any, dtype: type[np.generic] = np.float64) -> str:
        name = f"c{next(self._number)}"
        self.constants.append(self._from_array(np.asarray(value, dtype), name))
        return name

    def single(self, value: Float32[np.ndarray, "..."]) -> str:
        """Add a constant that is stored in single precision and is converted to double precision for computations."""
        return self.double(self.constant(value, np.float32))

    def add(self, operator: str, *inputs: str, name: str | None = None, **attributes: Any) -> str:
        output = f"v{next(self._number)}" if name is None else name
        self.nodes.append(self._make_node(operator, list(inputs), [output], **attributes))
        return output

    def double(self, value: str) -> str:
        return self.add("Cast", value, to=self._double)

    def rounded(self, value: str) -> str:
        """Round a value to single precision, and convert it back to double precision."""
        return self.double(self.add("Cast", value, to=self._single))

    def reshape(self, value: str, *shape: int) -> str:
        """Reshape a value. The first axis is kept, and all others are replaced by axes of the lengths `shape`."""
        return self.add("Reshape", value, self.constant((0, *shape), np.int64))

    def squeeze(self, value: str) -> str:
        """Remove axis 1 of a value, which must have the length 1."""
        return self.add("Squeeze", value, self.constant([1], np.int64))

    def sum(self, value: str, axis: int, *, keep: bool = False) -> str:
        return self.add("ReduceSum", value, self.constant([axis], np.int64), keepdims=int(keep))

    def mean(self, values: Sequence[str]) -> str:
        """Average values of the same shape.

        The ONNX operator `Mean` is not used, because ONNX Runtime does not implement it in double precision.
        """
        return self.add("Mul", self.add("Sum", *values), self.constant(1 / len(values)))

    def affine(self, value: str, scale: Any, shift: Any) -> str:
        return self.add("Add", self.add("Mul", value, self.constant(scale)), self.constant(shift))

    def columns(self, value: str, first: int, end: int) -> str:
        at = [self.constant([number], np.int64) for number in (first, end, 1)]
        return self.add("Slice", value, *at)

    def square(self, value: str) -> str:
        return self.add("Mul", value, value)


def write_onnx(of: SkinFunction, file: Path) -> None:
    """Write the function of a skin to a file as an ONNX model. An existing file is replaced."""
    content = build_onnx(of).SerializeToString()
    with io.replacing(file) as temporary:
        temporary.write_bytes(content)


def build_onnx(of: SkinFunction) -> "ModelProto":
    """Convert the function of a skin to an ONNX model.

    The input `db_uT` of the model has the shape [f, ch]. It contains field changes along the chips' axes.
    """
    try:
        from onnx import TensorProto, checker, helper
    except ImportError:
        raise missing_package("onnx", "export_onnx") from None
    g = Graph()
    db_uT = g.add("MatMul", "db_uT", g.constant(of.turn))
    deviance, best, chi2 = _likelihoods(g, of.hypotheses, db_uT)
    normals = _network_estimate(g, of, _without_external(g, of, db_uT, best))
    place_mm, sd_mm, log_forces = _products(g, of, deviance, normals, of.power)
    selected = force.ESTIMATORS.index(of.line.estimator)
    log_N = log_forces[selected]
    if of.unlabelled is not None:
        deviance, _, _ = _likelihoods(g, of.unlabelled, db_uT)
        log_N = _products(g, of, deviance, normals, 1.0)[2][selected]
    log_N, sd_log_N = _line(g, of.line, log_N)
    if of.unlabelled is not None:
        near = _nearness(g, of, place_mm, log_N)
        far = g.affine(near, -1.0, 1.0)
        log_N = g.add("Add", g.add("Mul", near, log_forces[selected]), g.add("Mul", far, log_N))
    g.add("Add", place_mm, g.constant(of.centre_mm), name="place_mm")
    g.add("Identity", sd_mm, name="sd_mm")
    g.add("Exp", log_N, name="force_N")
    g.add("Identity", sd_log_N, name="sd_log_N")
    g.add("Mul", chi2, g.constant(1 / of.channels_n), name="misfit")
    shrunk_uT = "db_uT" if of.suppressor is None else g.add("MatMul", "db_uT", g.constant(of.suppressor))
    change_uT = g.add("Sqrt", g.sum(g.square(shrunk_uT), 1), name="change_uT")
    outputs = dict(OUTPUTS)
    if of.contact_uT is None:
        del outputs["contact"]
    else:
        g.add("Greater", change_uT, g.constant(of.contact_uT), name="contact")
    types = {name: TensorProto.BOOL if name == "contact" else TensorProto.DOUBLE for name in outputs}
    graph = helper.make_graph(
        g.nodes, "reskin",
        [helper.make_tensor_value_info("db_uT", TensorProto.DOUBLE, ["f", of.channels_n])],
        [helper.make_tensor_value_info(name, types[name], ["f", *shape]) for name, shape in outputs.items()],
        g.constants,
    )  # fmt: skip
    built = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR)
    helper.set_model_props(built, dict(of.about))
    checker.check_model(built)
    return built


def _likelihoods(g: Graph, of: Gaussians, db_uT: str) -> tuple[str, str, str]:
    """Add the evaluation of all hypotheses of a map to the graph.

    Returns the deviance under each hypothesis [f, h], the index of the most likely hypothesis [f, 1], and chi^2 of the
    most likely hypothesis [f].
    """
    white, white_mean = _whitening(of)
    hypotheses_n, channels_n = white_mean.shape
    all_white = g.single(white.transpose(2, 0, 1).reshape(channels_n, -1))
    off = g.add("Sub", g.add("MatMul", g.rounded(db_uT), all_white), g.single(white_mean.ravel()))
    chi2 = g.sum(g.square(g.reshape(off, hypotheses_n, channels_n)), 2)
    deviance = g.add("Add", chi2, g.single(of.log_det))
    best = g.add("ArgMin", deviance, axis=1, keepdims=1)
    return deviance, best, g.squeeze(g.add("GatherElements", chi2, best, axis=1))


def _whitening(of: Gaussians) -> tuple[Float32[np.ndarray, "h ch ch"], Float32[np.ndarray, "h ch"]]:
    """Return the whitening matrix W of each Gaussian, and W m, where m is the mean of the Gaussian.

    Both are stored in `Gaussians.row`.
    """
    hypotheses_n = of.row.shape[1]
    channels_n = int((np.sqrt(9 + 8 * len(of.row)) - 3) / 2)  # rows: channels_n (channels_n + 3) / 2
    white = np.zeros((hypotheses_n, channels_n, channels_n), np.float32)
    white_mean = np.zeros((hypotheses_n, channels_n), np.float32)
    f = 0
    for i in range(channels_n):
        white_mean[:, i] = of.row[f]
        white[:, i, : i + 1] = of.row[f + 1 : f + 2 + i].T
        f += i + 2
    return white, white_mean


def _without_external(g: Graph, of: SkinFunction, db_uT: str, best: str) -> str:
    """Add the subtraction of the external field to the graph, as in `MapEvaluator.without_external`.

    `best` is the index of the most likely hypothesis of each reading.
    """
    if of.external_cov is None:
        return db_uT
    white, white_mean = _whitening(of.hypotheses)
    best = g.squeeze(best)
    of_best = g.add("Gather", g.single(white), best, axis=0)
    off = g.add("MatMul", of_best, g.add("Unsqueeze", g.rounded(db_uT), g.constant([2], np.int64)))
    off = g.add("Sub", off, g.add("Gather", g.single(white_mean[:, :, None]), best, axis=0))
    solved = g.add("MatMul", g.add("Transpose", of_best, perm=[0, 2, 1]), off)
    external_uT = g.add("MatMul", g.reshape(solved, of.channels_n), g.constant(of.external_cov))
    return g.add("Sub", db_uT, external_uT)


def _network_estimate(g: Graph, of: SkinFunction, db_uT: str) -> dict[str, str]:
    """Add the estimate of the networks to the graph.

    Returns the means [f, 3] and the standard deviations [f, 3] of x, y and log F.
    """
    length = g.add("Sqrt", g.sum(g.square(db_uT), 1, keep=True))
    length = g.add("Max", length, g.constant(network.LENGTH_MIN_uT))
    direction = g.add("Div", g.add("Mul", db_uT, g.constant(network.DIRECTION_GAIN)), length)
    log_length = g.add("Sub", g.add("Log", length), g.constant(network.LOG_uT))
    inputs = g.rounded(g.add("Concat", direction, log_length, axis=1))
    scale = g.constant([network.PLACE_MM, network.PLACE_MM, network.LOG_N])
    limits = [g.constant(limit) for limit in network.LOG_SD]
    means, variances = [], []
    for layers in of.networks:
        values = inputs
        for i, (weight, bias) in enumerate(zip(layers.weight, layers.bias, strict=True)):
            values = g.add("Relu", values) if i else values
            values = g.add("Add", g.add("MatMul", values, g.single(weight)), g.single(bias))
        means.append(g.add("Mul", g.columns(values, 0, 3), scale))
        log_sd = g.add("Min", g.add("Max", g.columns(values, 3, 6), limits[0]), limits[1])
        variances.append(g.square(g.add("Mul", g.add("Exp", log_sd), scale)))
    mean = g.mean(means)
    # The variance over networks is added to the mean of the networks' own variances, as in `network.evaluate`.
    deviations = [g.square(g.add("Sub", one, mean)) for one in means]
    sd = g.add("Sqrt", g.add("Add", g.mean(variances), g.mean(deviations)))
    sd_min = g.constant([model.SD_MIN_MM, model.SD_MIN_MM, model.SD_MIN_LOG_N])
    return {"mean": mean, "sd": g.add("Max", sd, sd_min)}


def _products(
    g: Graph, of: SkinFunction, deviance: str, normals: Mapping[str, str], power: float
) -> tuple[str, str, tuple[str, str]]:
    """Add the combination of map and networks to the graph, as in `kernels.products`.

    Returns the places, their standard deviations, and the log forces of each estimator.
    """
    places_n, forces_n = len(of.place_mm), len(of.log_N)
    least = g.add("ReduceMin", deviance, axes=[1], keepdims=1)
    likely = _exp(g, g.add("Mul", g.add("Sub", least, deviance), g.constant(0.5 * model.MAP_POWER)))
    likely = g.reshape(likely, places_n, forces_n)
    of_place, of_force = _log_share(g, g.sum(likely, 2)), _log_share(g, g.sum(likely, 1))
    mean_x, mean_y, mean_log_N = (g.columns(normals["mean"], i, i + 1) for i in range(3))
    sd_x, sd_y, sd_log_N = (g.columns(normals["sd"], i, i + 1) for i in range(3))
    for axis_mm, mean, sd in ((of.place_mm[:, 0], mean_x, sd_x), (of.place_mm[:, 1], mean_y, sd_y)):
        of_place = g.add("Sub", of_place, _half_square(g, axis_mm, mean, sd))
    combined = g.add("Sub", of_force, _half_square(g, of.log_N, mean_log_N, sd_log_N))
    off = g.add("Sub", of_place, g.add("ReduceMax", of_place, axes=[1], keepdims=1))
    x_mm, y_mm = (_mean(g, _exp(g, off), g.constant(of.place_mm[:, i])) for i in range(2))
    sharper = _exp(g, g.add("Mul", off, g.constant(power)))
    sds = []
    for i, mean in enumerate((x_mm, y_mm)):
        var_mm2 = _mean(g, sharper, g.square(g.add("Sub", g.constant(of.place_mm[:, i]), mean)))
        sds.append(g.add("Sqrt", g.add("Max", var_mm2, g.constant(CELL_SD_MM**2))))
    place_mm, sd_mm = g.add("Concat", x_mm, y_mm, axis=1), g.add("Concat", *sds, axis=1)
    by_map = g.add("Mul", of_force, g.constant(model.FORCE_POWER))
    log_N = g.constant(of.log_N)
    by_estimator = [g.squeeze(_mean(g, g.add("Softmax", log, axis=1), log_N)) for log in (combined, by_map)]
    return place_mm, sd_mm, (by_estimator[0], by_estimator[1])


def _exp(g: Graph, log: str) -> str:
    return g.add("Exp", g.add("Max", log, g.constant(-FARTHEST)))


def _log_share(g: Graph, likely: str) -> str:
    share = g.add("Div", likely, g.sum(likely, 1, keep=True))
    return g.add("Log", g.add("Max", share, g.constant(TINY)))


def _half_square(g: Graph, values: Float[np.ndarray, " p"], mean: str, sd: str) -> str:
    """Add half of the square of (values - mean) / sd, where `values` are constants."""
    off = g.add("Div", g.add("Sub", g.constant(values), mean), sd)
    return g.add("Mul", g.square(off), g.constant(0.5))


def _mean(g: Graph, weight: str, values: str) -> str:
    """Add the weighted mean of values over axis 1. The values have the shape [p] or [f, p]."""
    return g.add("Div", g.sum(g.add("Mul", weight, values), 1, keep=True), g.sum(weight, 1, keep=True))


def _line(g: Graph, line: force.ForceLine, log_N: str) -> tuple[str, str]:
    """Add the calibration of log forces by a line, as in `ForceLine.apply`.

    Returns the calibrated log forces and their standard deviations.
    """
    off = g.affine(log_N, 1.0, -force.LOG_CENTRE_N)
    (intercept, slope), ((a, b), (_, c)) = line.mean, line.cov
    var = g.affine(g.add("Mul", off, g.affine(off, c, 2 * b)), 1.0, a + line.scatter_var)
    return g.affine(off, slope, force.LOG_CENTRE_N + intercept), g.add("Sqrt", var)


def _nearness(g: Graph, of: SkinFunction, place_mm: str, log_N: str) -> str:
    """Add a measure of how near each press is to the presses with known forces.

    The measure is the largest correlation, according to `map.kernel`, with one of these presses.
    """
    column = [g.columns(place_mm, 0, 1), g.columns(place_mm, 1, 2), g.reshape(log_N, 1)]
    at = [of.few_mm[:, 0], of.few_mm[:, 1], of.few_log_N]
    lengths = [LENGTH_MM, LENGTH_MM, LENGTH_LOG_N]
    terms = [_half_square(g, *part) for part in zip(at, column, map(g.constant, lengths), strict=True)]
    nearest = g.add("ReduceMin", g.add("Sum", *terms), axes=[1], keepdims=0)
    return g.add("Exp", g.add("Neg", nearest))


# --- C ---


def write_c(of: SkinFunction, file: Path) -> None:
    """Write the function of a skin to a C99 header, as the C function `reskin_estimate`. An existing file is replaced.

    The header consists of the file `estimate.h` and the numbers of the skin.
    """
    about = "; ".join(f"{name} {value}" for name, value in of.about.items() if name != "noload_uT")
    code = C_CODE.read_text(encoding="utf-8").replace('"skin.h"', f'"{file.name}"')
    code = code.replace("@ABOUT@", f"The estimate of one calibrated skin ({about}), written by `export_c`.")
    io.write_text(file, code.replace("/* @NUMBERS@ */", "\n".join(_c_numbers(of))))


def _c_numbers(of: SkinFunction) -> Iterator[str]:
    """Yield the lines of C code that define the numbers that the functions in `estimate.h` use."""
    line, contact_uT = of.line, of.contact_uT
    widths = [len(of.networks[0].weight[0]), *(len(bias) for bias in of.networks[0].bias)]
    sizes = {
        "CHANNELS_N": of.channels_n, "PLACES_N": len(of.place_mm), "FORCES_N": len(of.log_N),
        "NETWORKS_N": len(of.networks), "LAYERS_N": len(widths) - 1, "WIDTH_MAX": max(widths),
        "FEW_N": len(of.few_log_N), "FORCE_BY_MAP": int(line.estimator == "map"),
        "EXTERNAL": int(of.external_cov is not None), "SUPPRESSED": int(of.suppressor is not None),
    }  # fmt: skip
    yield from (f"#define RESKIN_{name} {value}" for name, value in sizes.items())
    numbers = {
        "half_map_power": 0.5 * model.MAP_POWER, "force_power": model.FORCE_POWER, "power": of.power,
        "tiny": TINY, "farthest": FARTHEST, "var_min_mm2": CELL_SD_MM**2, "length_min_uT": network.LENGTH_MIN_uT,
        "direction_gain": network.DIRECTION_GAIN, "log_uT": network.LOG_uT, "log_centre_N": force.LOG_CENTRE_N,
        "contact_uT": -1.0 if contact_uT is None else contact_uT,
    }  # fmt: skip
    arrays = {
        "noload_uT": of.noload_uT, "turn": of.turn, "centre_mm": of.centre_mm, "place_mm": of.place_mm,
        "log_N": of.log_N, "log_sd_limits": network.LOG_SD,
        "output_scale": (network.PLACE_MM, network.PLACE_MM, network.LOG_N),
        "sd_min": (model.SD_MIN_MM, model.SD_MIN_MM, model.SD_MIN_LOG_N),
        "line": (*line.mean, line.cov[0, 0] + line.scatter_var, line.cov[0, 1], line.cov[1, 1]),
    }  # fmt: skip
    if len(of.few_log_N):
        numbers |= {"length_mm": LENGTH_MM, "length_log_N": LENGTH_LOG_N}
        arrays["few"] = np.column_stack([of.few_mm, of.few_log_N])
    if of.external_cov is not None:
        arrays["external_cov"] = of.external_cov
    if of.suppressor is not None:
        arrays["suppressor"] = of.suppressor
    yield from (
        f"static const reskin_real reskin_{name} = (reskin_real){float(value)!r};" for name, value in numbers.items()
    )
    for name, values in arrays.items():
        yield from _c_array("reskin_real", name, np.asarray(values, float), REAL)
    yield from _c_array("int", "width", np.array(widths), "%d")
    layers = [
        np.column_stack([bias, weight.T])
        for each in of.networks
        for weight, bias in zip(each.weight, each.bias, strict=True)
    ]
    yield from _c_array("float", "weight", np.concatenate([part.ravel() for part in layers]), SINGLE)
    for suffix, gaussians in (("", of.hypotheses), ("_unlabelled", of.unlabelled)):
        if gaussians is not None:
            yield from _c_array("float", f"row{suffix}", gaussians.row.T, SINGLE)
            yield from _c_array("float", f"log_det{suffix}", gaussians.log_det, SINGLE)


def _c_array(kind: str, name: str, values: np.ndarray, form: str) -> Iterator[str]:
    """Yield the lines of C code that define an array. `form` is the format of its numbers."""
    texts = [form % value for value in values.ravel().tolist()]
    yield f"static const {kind} reskin_{name}[{len(texts)}] = {{"
    for i in range(0, len(texts), NUMBERS_PER_LINE):
        yield "    " + ", ".join(texts[i : i + NUMBERS_PER_LINE]) + ","
    yield "};"
