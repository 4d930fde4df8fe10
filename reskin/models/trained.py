"""Read trained networks from disk, predict with them, and export them as ONNX."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from jaxtyping import Float32
from pydantic import Field

from reskin import io
from reskin.config import Strict, parse
from reskin.data.rows import TARGETS
from reskin.display import one_line
from reskin.errors import ParamsError, SchemaError, require
from reskin.models.inputs import VIEW, DB_FLOOR_uT, Scaler
from reskin.models.onnx_graph import Graph
from reskin.models.recipe import HEADLINE
from reskin.numerics import device

# A model is stored with a JSON card, a file that describes the model. The card's entry `format` is FORMAT for networks.
# For the universal model, it begins with UNIVERSAL.
FORMAT = "reskin-model/3"
UNIVERSAL = "reskin-universal"
SUFFIX = ".safetensors"
OUTPUT = "x_mm y_mm F_N"  # name of the output of the ONNX model

if TYPE_CHECKING:
    from onnx import ModelProto

    from reskin.models.network import Predictor


class CardRecipe(Strict, extra="ignore"):
    """Section `recipe` of a model's card: those settings of the training on which predictions depend."""

    architecture: Literal["paper", "released"]
    inputs: Literal["raw", "shape"]


class CardInput(Strict, extra="ignore"):
    """Section `input` of a model's card: the quantity, the unit and the number of the inputs."""

    quantity: Literal["change of field"]
    unit: Literal["uT"]
    channels_n: Annotated[int, Field(ge=3, le=192, multiple_of=3)]  # at most 64 chips


class Card(Strict, extra="ignore"):
    """The entries of a model's JSON card on which predictions depend. Other entries are ignored."""

    format: str
    recipe: CardRecipe
    input: CardInput
    output: dict[str, str]
    collapsed: bool


@dataclass(frozen=True)
class Network:
    """A trained network. It can be called like a function, to predict targets from field changes.

    card: the content of the network's JSON card.
    tensors: the weights of the network, and the shifts and scales of its inputs and outputs.
    """

    card: Mapping[str, Any]
    tensors: Mapping[str, np.ndarray]

    __repr__ = one_line

    def __call__(self, db_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f t"]:
        """Predict the targets for each of f field changes in uT.

        The targets are those with which the network was trained, usually x_mm, y_mm and F_N.
        """
        scaler, view = Scaler.of_arrays(self.tensors), VIEW[self.card["recipe"]["inputs"]](db_uT)
        return scaler.decode(self._predictor(scaler.encode(view)))

    @cached_property
    def _predictor(self) -> "Predictor":
        """The network as a PyTorch model. It is built only once, because a robot's controller predicts every frame."""
        from reskin.models.network import Predictor  # imported here, because it imports torch

        weights = {name: values for name, values in self.tensors.items() if name.startswith("layer")}
        return Predictor(weights, self.card["recipe"]["architecture"], device())


def read_network(model: Path) -> Network:
    """Read a trained network from its .safetensors file, and its JSON card, which is in the same folder.

    Raises
    ------
    ParamsError
        If the network or its card is missing.
    SchemaError
        If the card is invalid or not the one that was written with the weights, if the weights are not finite or of
        another shape, or if the network has collapsed, which means that it predicts nearly the same for all inputs.
    """
    card_file = model.with_suffix(".json")
    if model.is_dir():
        raise ParamsError(f"{model}: this is a folder, not a model file. {_find_models(model / 'any')}")
    if not model.is_file():
        raise ParamsError(f"{model}: model file not found. {_find_models(model)}")
    if model.suffix != SUFFIX:
        weights = model.with_suffix(SUFFIX)
        remedy = f"Use {weights}." if weights.is_file() else f"Pass a {SUFFIX} file, or copy a damaged file again."
        raise ParamsError(f"{model}: not a trained model ({SUFFIX}) or a saved calibration. {remedy}")
    if not card_file.is_file():
        raise ParamsError(
            f"{card_file}: card of the model not found. Copy the card to the folder of {model.name}. If {model.name} "
            "is a calibration of the universal model, load it with reskin.load_universal."
        )
    content = io.read_json(card_file)
    form = content.get("format") if isinstance(content, dict) else None
    if str(form).startswith(UNIVERSAL):
        raise ParamsError(f"{model}: this is a universal model. Load it with reskin.load_universal(file=...).")
    if form != FORMAT:
        raise SchemaError(f"{card_file}: format {form} is not supported, only {FORMAT}. Train the model again.")
    card = parse(Card, content, str(card_file))
    if tuple(card.output) != TARGETS:
        outputs = ", ".join(card.output) or "nothing"
        raise SchemaError(f"{card_file}: the model predicts {outputs}, not {', '.join(TARGETS)}. Use another model.")
    if card.collapsed:
        raise SchemaError(
            f"{card_file}: the model has collapsed: it predicts nearly the same for any input. Use a model that was "
            "trained with another seed."
        )
    require("torch", model)
    return _read(model, content)


def _read(model: Path, card: Mapping[str, Any]) -> Network:
    """Read the arrays of a network; raise SchemaError if they are not finite or do not fit the card."""
    from reskin.models.network import LAYERS  # imported here, because it imports torch

    channels, tensors = np.zeros((1, card["input"]["channels_n"]), np.float32), io.read_model(model, card)
    inputs, outputs = (VIEW[card["recipe"]["inputs"]](channels).shape[1],), (len(card["output"]),)
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("input_shift", "input_scale"), inputs)
    shapes |= dict.fromkeys(("target_shift", "target_scale"), outputs)
    for i, layer in enumerate(LAYERS[card["recipe"]["architecture"]](*inputs, *outputs), 1):
        shapes |= {f"layer{i}.weight": (layer.out_n, layer.in_n), f"layer{i}.bias": (layer.out_n,)}
    finite = dict(tensors)
    if card.get("forces_known") is False and "target_shift" in tensors:  # NaN, so that the network predicts no force
        finite["target_shift"] = np.nan_to_num(tensors["target_shift"], nan=0, posinf=np.inf, neginf=-np.inf)
    io.check_arrays(model, finite, shapes)
    return Network(card, tensors)


def _find_models(missing: Path) -> str:
    """Return advice for the user on a model file that is missing.

    If other models are in the folder, the advice lists them. Otherwise, the scene that trains the model is taken from
    the path, because pipeline stages write models to data/models/SCENE/STAGE.
    """
    if names := sorted(file.name for file in missing.parent.glob(f"*{SUFFIX}")):
        return f"Models in this folder: {', '.join(names[:3])}{', ...' if names[3:] else ''}"
    if missing.parts[-5:-3] != ("data", "models"):
        return "Use the path of a trained .safetensors file."
    scene = missing.parts[-3]
    return f"Scene {scene} trains it: in the checkout, run `reskin scenes use {scene}` and then `make repro`."


def networks_held_out(models: Path, board: str) -> list[Network]:
    """Read the networks of the headline recipe that were trained without this board. There is one for each seed."""
    networks = []
    for file in sorted(models.glob("*.json")):
        card = io.read_json(file)
        if (card["question"], card["fold"], card["recipe_name"]) == ("lobo", board, HEADLINE):
            networks.append(_read(file.with_suffix(SUFFIX), card))
    if not networks:
        what = f"there are no networks of recipe {HEADLINE} that were trained without board {board}"
        raise SchemaError(f"{models}: {what}. To train them, add lobo to the experiments of the scene.")
    return networks


def networks_by_fold(models: Path, experiment: str) -> dict[str, list[Network]]:
    """Read the networks of the headline recipe by the name of the fold, one network for each fold and seed.

    The result is empty if the scene does not run the experiment.
    """
    by_fold: dict[str, list[Network]] = {}
    for file in sorted(models.glob("*.json")):
        card = io.read_json(file)
        if (card["question"], card["recipe_name"]) == (experiment, HEADLINE):
            by_fold.setdefault(card["fold"], []).append(_read(file.with_suffix(SUFFIX), card))
    return by_fold


# --- ONNX ---


def write_onnx(network: Network, file: Path) -> None:
    """Write a network as an ONNX file. An existing file is replaced."""
    file.write_bytes(build_onnx(network).SerializeToString())


def build_onnx(network: Network) -> "ModelProto":
    """Build the ONNX model of a network, with the same steps as `Network.__call__`."""
    g = Graph(np.float32)  # first, so that a missing package onnx is reported at once

    from reskin.models.network import LAYERS  # imported here, because it imports torch

    card, tensors, value = network.card, network.tensors, "db_uT"
    if card["recipe"]["inputs"] == "shape":  # as `reskin.models.inputs.shape`
        length = g.add("Max", g.length(value), DB_FLOOR_uT)
        value = g.add("Concat", g.add("Div", value, length), g.add("Log", length), axis=1)
    value = g.add("Sub", value, g.constant(tensors["input_shift"]))
    value = g.add("Div", value, g.constant(tensors["input_scale"]))
    for i, layer in enumerate(LAYERS[card["recipe"]["architecture"]](tensors["input_shift"].size), 1):
        value = g.affine(value, tensors[f"layer{i}.weight"].T, tensors[f"layer{i}.bias"])
        value = g.add("Relu", value) if layer.relu else value
    value = g.add("Mul", value, g.constant(tensors["target_scale"]))
    g.add("Add", value, g.constant(tensors["target_shift"]), name=OUTPUT)
    return g.build(card["input"]["channels_n"], {OUTPUT: [tensors["target_shift"].size]})
