"""Shared by the training stages: rows and folds of a scene, trials, finished trainings, models with cards."""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Float32, Int64

from pipeline.executors import make_executor, prepare_workers
from pipeline.provenance import COSTS, SECONDS, home, note_trainings, version_of
from pipeline.settings import Settings, Training
from pipeline.stage import say
from pipeline.stages import module_name
from reskin import io
from reskin.code import imported
from reskin.data.folds import load_rows, parse_folds
from reskin.data.lines import Lines, grid_lines, take_pokes
from reskin.data.rows import TARGETS, Rows, Selection
from reskin.data.splits import Fold
from reskin.errors import SchemaError
from reskin.metrics import score_groups
from reskin.models.grid import run_trials
from reskin.models.inputs import Scaler
from reskin.models.recipe import Adaptation
from reskin.models.trained import FORMAT
from reskin.models.trial import Adapting, FewLabels, Measured, Start, Trained, Trial
from reskin.seeds import rng_for

TRAINS = "reskin.models.train"
CACHE = ".reskin/cells"  # finished trainings: a cache, and no output


@dataclass(frozen=True)
class SceneData:
    """What a stage that trains reads: the scene's settings, its rows and its folds."""

    scene: str
    settings: Settings
    rows: Rows
    folds: list[Fold]

    def folds_of(self, experiment: str) -> list[Fold]:
        """Take the folds of one experiment."""
        return [fold for fold in self.folds if fold.experiment == experiment]


def prepare_training() -> None:
    """Let what trains be imported while the stage reads what it trains on."""
    prepare_workers(TRAINS)


def read_data(settings: Settings, indentations: Path, folds: Path) -> SceneData:
    """Read the rows and folds that a stage trains on."""
    words = io.read_json(folds)
    rows = load_rows(
        [indentations / f"{name}.parquet" for name in words["captures"]], settings.section(Selection, "selection")
    )
    return SceneData(settings.scene, settings, rows, parse_folds(words, rows, str(folds)))


def trials_of(
    data: SceneData, training: Training, folds: Iterable[Fold], *, experiment: str | None = None
) -> list[Trial]:
    """Make a trial of every recipe, fold and seed; they answer the folds' own experiment, or the one that is named."""
    return [
        Trial(experiment or fold.experiment, name, recipe, fold.name, data.settings.seed, seed_i, fold.train, fold.test)
        for fold in folds
        for name, recipe in training.recipes.items()
        for seed_i in range(training.seeds_n)
    ]


def measured(data: SceneData) -> Measured:
    """Give of the rows what trainings read."""
    return Measured(data.rows.db_uT, data.rows.target, data.rows.skin)


def train_all(data: SceneData, trials: Sequence[Trial], stage: str) -> list[Trained]:
    """Train what is not finished yet; say what stopped early, for it is used as it last was."""
    start_s, stage_words = time.monotonic(), f"{data.scene} {stage}"

    def tell(line: str) -> None:
        say(f"{stage_words}: {line}")

    with make_executor(imports=TRAINS) as executor:
        trained = run_trials(trials, measured(data), executor=executor, cache=home() / CACHE, tell=tell)
    took = {result.key: (result.seconds, result.reused) for result in trained}
    note_trainings(COSTS / data.scene, stage, took, time.monotonic() - start_s)
    for trial, result in zip(trials, trained, strict=True):
        if result.stopped_step is not None:
            diverged = f"{trial.name} diverged by step {result.stopped_step}: kept as it was before"
            say(f"warning: {stage_words}: {diverged}")
    return trained


def write_models(
    models: Path, data: SceneData, trials: Sequence[Trial], trained: Sequence[Trained], stage: str
) -> None:
    """Write models, their cards and predictions; what they took here stands beside, as it is no result."""
    code = version_of(imported(module_name(stage)))
    cards = [card_of(data, trial, result) | {"git": code} for trial, result in zip(trials, trained, strict=True)]
    with io.replacing(models) as folder:
        folder.mkdir()
        for trial, result, card in zip(trials, trained, cards, strict=True):
            tensors = dict(result.weights) | result.scaler.arrays()
            io.write_tensors(folder / f"{trial.name}.safetensors", tensors, {"format": card["format"]})
            io.write_json(folder / f"{trial.name}.json", card)
        io.write_table(folder / "predictions.parquet", _predictions(trials, trained, data.rows))
    note_seconds(data.scene, stage, trials, trained)


def card_of(data: SceneData, trial: Trial, trained: Trained) -> dict[str, Any]:
    """Describe a training, with its scores on the rows that it was not trained on."""
    card = describe(trial, trained, data.rows, data.scene)
    return card | {"scores": score_test(data, trial.test, trained.predicted)}


def score_test(data: SceneData, test: Int64[np.ndarray, " b"], predicted: Float32[np.ndarray, "b 3"]) -> dict[str, Any]:
    """Score predictions for tested rows."""
    return score_groups(data.rows.target[test], predicted, data.rows.board[test], data.rows.skin[test])


def point_of(data: SceneData, trial: Trial, trained: Trained, method: str) -> dict[str, Any]:
    """Keep of a training in a sweep what its curve needs: no weights, no predictions."""
    card = card_of(data, trial, trained)
    kept = ("key", "question", "fold", "seed_i", "stopped_step", "scores", "collapsed", "collapsed_before_n")
    return {name: card[name] for name in kept} | {"method": method, "trained_on_skins_n": len(card["train_skins"])}


def note_seconds(scene: str, stage: str, trials: Sequence[Any], trained: Sequence[Any]) -> None:
    """Keep what trainings, of networks or of classical methods, took here."""
    took = [
        {"name": trial.name, "train_s": result.seconds, "one_reading_s": result.one_reading_s}
        for trial, result in zip(trials, trained, strict=True)
    ]
    io.write_json(SECONDS / scene / f"{stage}.json", took)


def _predictions(trials: Sequence[Trial], trained: Sequence[Trained], rows: Rows) -> pa.Table:
    """One row a test row and training: the truth and the prediction, side by side."""
    tables = []
    for trial, result in zip(trials, trained, strict=True):
        words = {"question": trial.experiment, "recipe": trial.recipe_name, "fold": trial.fold, "seed_i": trial.seed_i}
        columns = {name: pa.repeat(word, len(trial.test)) for name, word in words.items()}
        columns["skin"] = pa.array(rows.skin[trial.test].tolist())
        for i, name in enumerate(TARGETS):
            columns[f"true_{name}"] = pa.array(rows.target[trial.test, i])
            columns[f"predicted_{name}"] = pa.array(result.predicted[:, i])
        tables.append(pa.table(columns))
    return pa.concat_tables(tables)


def describe(trial: Trial, trained: Trained, rows: Rows, scene: str) -> dict[str, Any]:
    """Describe a trained trial; `scores` are added where the truth is known."""
    card = {
        "format": FORMAT,
        "scene": scene,
        "question": trial.experiment,
        "recipe_name": trial.recipe_name,
        "recipe": trial.recipe.model_dump(mode="json"),
        "fold": trial.fold,
        "seed": trial.seed,
        "seed_i": trial.seed_i,
        "key": trained.key,
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


Starts = dict[tuple[str, str, int], Start]  # by recipe, fold and seed


def read_starts(models: Path) -> Starts:
    """Read the networks of train_triplet."""
    starts = {}
    for file in sorted(models.glob("*.json")):
        card = io.read_json(file)
        tensors, _ = io.read_tensors(file.with_suffix(".safetensors"))
        weights = {name: values for name, values in tensors.items() if name.startswith("layer")}
        start = Start(card["key"], weights, Scaler.of_arrays(tensors))
        starts[card["recipe_name"], card["fold"], card["seed_i"]] = start
    return starts


def adaptations(
    data: SceneData, fold: Fold, named: tuple[str, Adaptation], starts: Starts, *, experiment: str, pokes_n: int
) -> Iterator[Trial]:
    """Adapt to each skin of a fold by itself: so many indentations of its pool, of which only lines are passed on."""
    for skin in np.unique(data.rows.skin[fold.test]):
        for seed_i in own_starts(starts, named[1].base, fold):
            lines = pool_lines(data, fold, str(skin), pokes_n=pokes_n, seed_i=seed_i)
            yield adaptation(data, fold, named, starts, Pokes(experiment, str(skin), seed_i, f"{pokes_n}pokes", lines))


@dataclass(frozen=True)
class Pokes:
    """What one network is adapted by: lines on one skin; `experiment` and `what` name the training."""

    experiment: str
    skin: str
    seed_i: int
    what: str
    lines: Lines


def adaptation(data: SceneData, fold: Fold, named: tuple[str, Adaptation], starts: Starts, pokes: Pokes) -> Trial:
    """Adapt the fold's network of one seed to one skin, whose rows of the fold's test side are tested."""
    name, settings = named
    test = fold.test[data.rows.skin[fold.test] == pokes.skin]
    start = own_starts(starts, settings.base, fold)[pokes.seed_i]
    recipe = data.settings.training("train_triplet").recipes[settings.base]
    return Trial(
        pokes.experiment, name, recipe, fold.name, data.settings.seed, pokes.seed_i, fold.train, test,
        Adapting(start, settings, pokes.lines), pokes.skin, pokes.what,
    )  # fmt: skip


def pool_lines(data: SceneData, fold: Fold, skin: str, *, pokes_n: int, seed_i: int) -> Lines:
    """Draw so many indentations of a skin's pool, and index them along the robot's grid."""
    pool = fold.pool[data.rows.skin[fold.pool] == skin]
    return grid_lines(
        data.rows, take_pokes(data.rows, pool, pokes_n, rng_for(data.settings.seed, "pokes", skin, seed_i))
    )


def own_starts(starts: Starts, base: str, fold: Fold) -> dict[int, Start]:
    """Choose the networks of one recipe and fold, by seed."""
    own = {seed_i: start for (recipe, of, seed_i), start in starts.items() if (recipe, of) == (base, fold.name)}
    if not own:
        where, rule = f"fold {fold.name}", f"those of recipe {base}"
        raise SchemaError(where, "networks to adapt", rule, "none", "Train them.")
    return own
