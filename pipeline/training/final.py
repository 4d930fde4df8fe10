"""Train the final model of a scene: one network that is trained on all boards of the scene, for use on other boards.

Because all readings are used for training, none are left to test this network. Its card (the JSON file that describes
the model) and the report therefore state the scores of other networks. These were trained in the same way on all boards
except one, and tested on the board that was left out.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.scores import rows_of_cards, select, whole
from pipeline.settings import Training
from pipeline.statistics import records
from pipeline.training.jobs import SceneData, model_card, train_jobs
from reskin import io
from reskin.metrics import METRICS
from reskin.models.job import TrainingJob
from reskin.models.recipe import HEADLINE
from reskin.models.trained import SUFFIX

EXPERIMENT = "final"
FILE = f"{EXPERIMENT}{SUFFIX}"  # in folder data/models/SCENE/final
NOT_TESTED = (
    "no, because all boards were used for training. Entry held_out contains the scores of other networks of the same "
    "recipe. Each of them was trained without one board, and tested on this board"
)
NO_ROWS = np.zeros(0, np.int64)
F = 2  # index of the force in the array of targets


def train_final(folder: Path, data: SceneData, training: Training, held_out: Sequence[Any], code: str) -> None:
    """Train a network on all rows of the scene with the headline recipe, and write it with its card to `folder`.

    `held_out` contains the cards of the networks that were trained with the same recipe and tested on held-out boards.
    If the force is unknown in all rows, the network predicts NaN as the force.
    """
    rows = np.arange(len(data.rows))
    job = TrainingJob(
        EXPERIMENT, HEADLINE, training.recipes[HEADLINE], "all boards", data.settings.seed, 0, rows, NO_ROWS
    )
    (result,) = train_jobs(data, [job], "train_multi")
    tensors = dict(result.weights) | result.scaler.arrays()
    forces_known = bool(np.isfinite(data.rows.target[:, F]).any())
    if not forces_known:
        tensors["target_shift"] = np.where(
            np.arange(tensors["target_shift"].size) == F, np.nan, tensors["target_shift"]
        )
    card = model_card(job, result, data.rows, data.scene)
    scores = whole(select(rows_of_cards(held_out), recipe=HEADLINE)).groupby("board")[list(METRICS)].mean()
    more = {"git": code, "tested": NOT_TESTED, "held_out": records(scores), "forces_known": forces_known}
    with io.replacing(folder) as temporary:
        temporary.mkdir()
        io.write_model(temporary / FILE, tensors, card | more)


def final_numbers(models: Path, scene: str) -> dict[str, Any]:
    """Return a dictionary with the entry `final_model` of numbers.json; it is empty if the scene has no final model."""
    card_file = (models / EXPERIMENT / FILE).with_suffix(".json")
    if not card_file.is_file():
        return {}
    card = io.read_json(card_file)
    numbers = {f"{what}_n": len(card[f"train_{what}"]) for what in ("boards", "skins")}
    names = {"file": f"data/models/{scene}/{EXPERIMENT}/{FILE}", "forces_known": card["forces_known"]}
    return {"final_model": names | numbers | {"rows_n": card["train_rows_n"], "steps_n": card["recipe"]["steps_n"]}}
