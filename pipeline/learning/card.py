"""The card of a model: all that its use needs, and what it was trained on. In: a training. Out: values for JSON."""

from typing import Any

import numpy as np

from pipeline.dataset.rows import TARGETS, Rows
from pipeline.learning.trial import Adapting, FewLabels, Trained, Trial

FORMAT = "reskin-model/3"


def describe(trial: Trial, trained: Trained, rows: Rows, scene: str, code: str) -> dict[str, Any]:
    """Describe a trained trial; `scores` are added where the truth is known."""
    card = {
        "format": FORMAT,
        "scene": scene,
        "question": trial.question,
        "recipe_name": trial.recipe_name,
        "recipe": trial.recipe.model_dump(mode="json"),
        "fold": trial.fold,
        "seed": trial.seed,
        "seed_i": trial.seed_i,
        "key": trained.key,
        "git": code,
        "architecture": {name: list(value.shape) for name, value in trained.weights.items()},
        "input": {
            "quantity": "change of field",
            "unit": "uT",
            "channels_n": rows.db_uT.shape[1],
            "view": trial.recipe.inputs,
        },
        "output": {name: name.rsplit("_", 1)[1] for name in TARGETS},
        "scaler": {name: value.tolist() for name, value in trained.scaler.arrays().items()},
        "stopped_step": trained.stopped_step,
        "explained_min": None if trained.explained_min is None else round(trained.explained_min, 6),
        **collapse_record(trained),
        "train_boards": np.unique(rows.board[trial.train]).tolist(),
        "train_skins": np.unique(rows.skin[trial.train]).tolist(),
        "train_rows_n": len(trial.train),
        "test_boards": np.unique(rows.board[trial.test]).tolist(),
        "test_skins": np.unique(rows.skin[trial.test]).tolist(),
        "curve": [round(value, 9) for value in trained.curve],
    }
    return card if trial.tuning is None else card | {"tuning": _tuning(trial.tuning, rows)}


def collapse_record(trained: Trained) -> dict[str, Any]:
    """Record whether a training collapsed, and how often the same trial did before, with other draws."""
    return {"collapsed": trained.collapsed, "collapsed_before_n": trained.collapsed_before_n}


def _tuning(tuning: Adapting | FewLabels, rows: Rows) -> dict[str, Any]:
    row = tuning.lines.row if isinstance(tuning, Adapting) else tuning.row
    indentations = np.unique(rows.indentation[row])
    return {
        "from": tuning.start.key,
        "settings": tuning.settings.model_dump(mode="json"),
        "kind": "unlabelled" if isinstance(tuning, Adapting) else "labelled",
        "skins": np.unique(rows.skin[row]).tolist(),
        "indentations": indentations.tolist(),
        "pokes_n": len(indentations),
    }
