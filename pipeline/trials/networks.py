"""Trained networks at work on new changes of field: cards and weights of train_multi -> answers. Knows no argv."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32

from pipeline.core import io
from pipeline.core.errors import SchemaError
from pipeline.core.executors import device
from pipeline.learning.inputs import VIEW, Scaler
from pipeline.learning.recipe import HEADLINE

if TYPE_CHECKING:
    from pipeline.learning.model import Predictor


@dataclass(frozen=True)
class Network:
    """A finished network: call it with changes of field in uT, and it answers x and y in mm and F in N."""

    card: Mapping[str, Any]
    tensors: Mapping[str, np.ndarray]

    def __call__(self, db_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f 3"]:
        """Answer for changes of field, row by row."""
        scaler, view = Scaler.of_arrays(self.tensors), VIEW[self.card["recipe"]["inputs"]](db_uT)
        return scaler.decode(self._predictor(scaler.encode(view)))

    @cached_property
    def _predictor(self) -> "Predictor":
        """Put the network together once: a controller asks it for every frame."""
        from pipeline.learning.model import Predictor  # torch, late: only a stage that answers pays for it

        weights = {name: values for name, values in self.tensors.items() if name.startswith("layer")}
        return Predictor(weights, self.card["recipe"]["architecture"], device())


def networks_without(models: Path, board: str, *, recipe: str = HEADLINE) -> list[Network]:
    """Read the networks of train_multi that never saw this board, one a seed."""
    found = []
    for file in sorted(models.glob("*.json")):
        card = io.read_json(file)
        if (card["question"], card["fold"], card["recipe_name"]) == ("lobo", board, recipe):
            found.append(Network(card, io.read_tensors(file.with_suffix(".safetensors"))[0]))
    if not found:
        rule = f"some of recipe {recipe} with board {board} held out"
        raise SchemaError(str(models), "networks", rule, "none", "Train them: ask lobo of this scene.")
    return found


def networks_by_fold(models: Path, question: str, *, recipe: str = HEADLINE) -> dict[str, list[Network]]:
    """Read the networks of a question by fold, one a seed; none where it was not asked."""
    found: dict[str, list[Network]] = {}
    for file in sorted(models.glob("*.json")):
        card = io.read_json(file)
        if (card["question"], card["recipe_name"]) == (question, recipe):
            network = Network(card, io.read_tensors(file.with_suffix(".safetensors"))[0])
            found.setdefault(card["fold"], []).append(network)
    return found
