"""Training for one scene: read rows and folds, make and run training jobs, and write the trained models.

A training job describes the training of one network. Each model is written with a model card, which is a JSON file that
describes its training, inputs, outputs and scores.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Float32, Int64

from pipeline.catalogue import module_name
from pipeline.executors import make_executor, prepare_workers
from pipeline.provenance import code_version_of, home
from pipeline.settings import Settings, Training
from pipeline.stage import say
from reskin import io
from reskin.code import imported
from reskin.data.lines import Lines, grid_lines, take_pokes
from reskin.data.rows import TARGETS, Rows, Selection, load_rows
from reskin.data.splits import Fold, parse_folds
from reskin.errors import SchemaError
from reskin.metrics import score_groups
from reskin.models.inputs import Scaler
from reskin.models.job import Adaptation, FineTuning, Pretrained, TrainingData, TrainingJob, TrainingResult, curve_steps
from reskin.models.recipe import AdaptationWithBase
from reskin.models.runner import run_jobs
from reskin.models.trained import FORMAT
from reskin.seeds import rng_for

TRAINING_MODULE = "reskin.models.train"
CACHE = ".reskin/cells"  # folder of the cache of completed training runs, which is not an output of a stage

PretrainedNetworks = dict[tuple[str, str, int], Pretrained]  # by recipe name, fold name and index of the seed


@dataclass(frozen=True)
class SceneData:
    """Inputs of a stage that trains: the scene's settings, its rows and its folds."""

    scene: str
    settings: Settings
    rows: Rows
    folds: list[Fold]

    def folds_of(self, experiment: str) -> list[Fold]:
        """Return the folds of one experiment."""
        return [fold for fold in self.folds if fold.experiment == experiment]


@dataclass(frozen=True)
class AdaptationPokes:
    """Unlabelled pokes to which a network is adapted.

    - experiment, what: used in the name of the training job.
    - skin: skin on which the pokes were made.
    - seed_i: index of the seed of the network.
    - lines: the pokes, ordered along lines of places.
    """

    experiment: str
    skin: str
    seed_i: int
    what: str
    lines: Lines


def preload_training() -> None:
    """Start the server process from which workers are forked, so that it imports the training module early.

    The import takes seconds. It runs while the stage reads its data.
    """
    prepare_workers(TRAINING_MODULE)


def read_data(settings: Settings, indentations: Path, folds: Path) -> SceneData:
    """Read the rows and folds of a scene."""
    content = io.read_json(folds)
    files = [indentations / f"{name}.parquet" for name in content["captures"]]
    rows = load_rows(files, settings.section(Selection, "selection"))
    return SceneData(settings.scene, settings, rows, parse_folds(content, rows, str(folds)))


def training_data(data: SceneData) -> TrainingData:
    return TrainingData(data.rows.db_uT, data.rows.target, data.rows.skin)


# --- Jobs ---


def make_jobs(
    data: SceneData, training: Training, folds: Iterable[Fold], *, experiment: str | None = None
) -> list[TrainingJob]:
    """Make a training job for every fold, recipe and seed.

    `experiment` is the experiment to which the jobs belong; if it is None, each job belongs to the experiment of its
    fold.
    """
    return [
        TrainingJob(
            experiment or fold.experiment, name, recipe, fold.name, data.settings.seed, seed_i, fold.train, fold.test
        )
        for fold in folds
        for name, recipe in training.recipes.items()
        for seed_i in range(training.seeds_n)
    ]


def adaptation_jobs(
    data: SceneData,
    fold: Fold,
    named_recipe: tuple[str, AdaptationWithBase],
    pretrained: PretrainedNetworks,
    *,
    experiment: str,
    pokes_n: int,
) -> Iterator[TrainingJob]:
    """Make the jobs that adapt a fold's networks to each held-out skin, with `pokes_n` unlabelled indentations."""
    for skin in np.unique(data.rows.skin[fold.test]):
        for seed_i in select_pretrained(pretrained, named_recipe[1].base, fold):
            lines = pool_lines(data, fold, str(skin), pokes_n=pokes_n, seed_i=seed_i)
            pokes = AdaptationPokes(experiment, str(skin), seed_i, f"{pokes_n}pokes", lines)
            yield adaptation_job(data, fold, named_recipe, pretrained, pokes)


def adaptation_job(
    data: SceneData,
    fold: Fold,
    named_recipe: tuple[str, AdaptationWithBase],
    pretrained: PretrainedNetworks,
    pokes: AdaptationPokes,
) -> TrainingJob:
    """Make the job that adapts the fold's network of one seed to one skin and tests it on that skin's test rows."""
    name, settings = named_recipe
    test = fold.test[data.rows.skin[fold.test] == pokes.skin]
    start = select_pretrained(pretrained, settings.base, fold)[pokes.seed_i]
    recipe = data.settings.section(Training, "train_triplet").recipes[settings.base]
    return TrainingJob(
        pokes.experiment, name, recipe, fold.name, data.settings.seed, pokes.seed_i, fold.train, test,
        Adaptation(start, settings, pokes.lines), pokes.skin, pokes.what,
    )  # fmt: skip


def pool_lines(data: SceneData, fold: Fold, skin: str, *, pokes_n: int, seed_i: int) -> Lines:
    """Draw `pokes_n` of the skin's indentations in the fold's adaptation pool; order them along the robot's grid."""
    pool = fold.pool[data.rows.skin[fold.pool] == skin]
    rng = rng_for(data.settings.seed, "pokes", skin, seed_i)
    return grid_lines(data.rows, take_pokes(data.rows, pool, pokes_n, rng))


def read_pretrained(models: Path) -> PretrainedNetworks:
    """Read the networks that stage train_triplet wrote to folder `models`."""
    pretrained = {}
    for file in sorted(models.glob("*.json")):
        card = io.read_json(file)
        tensors, _ = io.read_tensors(file.with_suffix(".safetensors"))
        weights = {name: values for name, values in tensors.items() if name.startswith("layer")}
        network = Pretrained(card["key"], weights, Scaler.of_arrays(tensors))
        pretrained[card["recipe_name"], card["fold"], card["seed_i"]] = network
    return pretrained


def select_pretrained(pretrained: PretrainedNetworks, base: str, fold: Fold) -> dict[int, Pretrained]:
    """Return the networks of recipe `base` and one fold, by the index of their seed."""
    selected = {
        seed_i: network for (recipe, name, seed_i), network in pretrained.items() if (recipe, name) == (base, fold.name)
    }
    if not selected:
        raise SchemaError(f"fold {fold.name}: no networks of recipe {base} to adapt. Run: dvc repro train_triplet")
    return selected


# --- Runs ---


def train_jobs(data: SceneData, jobs: Sequence[TrainingJob], stage: str) -> list[TrainingResult]:
    """Run all training jobs whose results are not cached, and return the results of all jobs.

    A warning is printed for training runs that diverged.
    """
    prefix = f"{data.scene} {stage}"
    with make_executor(imports=TRAINING_MODULE) as executor:
        results = run_jobs(
            jobs,
            training_data(data),
            executor=executor,
            cache=home() / CACHE,
            log=lambda line: say(f"{prefix}: {line}"),
        )
    for job, result in zip(jobs, results, strict=True):
        if result.stopped_step is not None:
            what = f"training of {job.name} diverged by step {result.stopped_step}"
            say(f"warning: {prefix}: {what}, so its weights from before the divergence are kept")
    return results


# --- Results ---


def write_models(
    models: Path, data: SceneData, jobs: Sequence[TrainingJob], results: Sequence[TrainingResult], stage: str
) -> list[dict[str, Any]]:
    """Write models, cards and predictions to folder `models`; return the cards."""
    code = code_of(stage)
    cards = [scored_card(data, job, result) for job, result in zip(jobs, results, strict=True)]
    with io.replacing(models) as folder:
        folder.mkdir()
        for job, result, card in zip(jobs, results, cards, strict=True):
            tensors = dict(result.weights) | result.scaler.arrays()
            io.write_model(folder / f"{job.name}.safetensors", tensors, card | {"git": code})
        io.write_table(folder / "predictions.parquet", _predictions(jobs, results, data.rows))
    return cards


def code_of(stage: str) -> str:
    """Return the last commit that changed the code of a stage."""
    return code_version_of(imported(module_name(stage)))


def model_card(job: TrainingJob, result: TrainingResult, rows: Rows, scene: str) -> dict[str, Any]:
    """Describe a trained network, without its scores."""
    card: dict[str, Any] = {
        "format": FORMAT,
        "scene": scene,
        "question": job.experiment,
        "recipe_name": job.recipe_name,
        "recipe": job.recipe.model_dump(mode="json"),
        "fold": job.fold,
        "seed": job.seed,
        "seed_i": job.seed_i,
        "key": result.key,
        "architecture": {name: list(value.shape) for name, value in result.weights.items()},
        "input": {
            "quantity": "change of field",
            "unit": "uT",
            "channels_n": rows.db_uT.shape[1],
            "view": job.recipe.inputs,
        },
        "output": {name: name.rsplit("_", 1)[1] for name in TARGETS},
        "scaler": {name: value.tolist() for name, value in result.scaler.arrays().items()},
        "stopped_step": result.stopped_step,
        "explained_min": None if result.explained_min is None else round(result.explained_min, 6),
        "collapsed": result.collapsed,
        "collapsed_before_n": result.collapsed_before_n,
        "train_boards": np.unique(rows.board[job.train]).tolist(),
        "train_skins": np.unique(rows.skin[job.train]).tolist(),
        "train_rows_n": len(job.train),
        "test_boards": np.unique(rows.board[job.test]).tolist(),
        "test_skins": np.unique(rows.skin[job.test]).tolist(),
        "curve": [round(value, 9) for value in result.curve],
        "curve_steps": curve_steps(job.schedule.steps_n)[: len(result.curve)],
    }
    if job.tuning is not None:
        card["tuning"] = _tuning_record(job.tuning, rows)
    return card


def _tuning_record(tuning: Adaptation | FineTuning, rows: Rows) -> dict[str, Any]:
    row = tuning.lines.row if isinstance(tuning, Adaptation) else tuning.row
    indentations = np.unique(rows.indentation[row])
    return {
        "from": tuning.start.key,
        "settings": tuning.settings.model_dump(mode="json"),
        "kind": "unlabelled" if isinstance(tuning, Adaptation) else "labelled",
        "skins": np.unique(rows.skin[row]).tolist(),
        "indentations": indentations.tolist(),
        "pokes_n": len(indentations),
    }


def scored_card(data: SceneData, job: TrainingJob, result: TrainingResult) -> dict[str, Any]:
    """Describe a trained network with its scores on the test rows."""
    card = model_card(job, result, data.rows, data.scene)
    card["scores"] = score_test(data, job.test, result.predicted)
    return card


def score_test(data: SceneData, test: Int64[np.ndarray, " b"], predicted: Float32[np.ndarray, "b 3"]) -> dict[str, Any]:
    """Score predictions over all test rows, and separately for each skin.

    The scores over all test rows are computed twice: for the predictions as they are, and for predictions from which
    the mean position error of their board has been subtracted.
    """
    return score_groups(data.rows.target[test], predicted, data.rows.board[test], data.rows.skin[test])


def network_keys(data: SceneData, job: TrainingJob, method: str) -> dict[str, Any]:
    """Return the keys of a network of a sweep in the table of scores."""
    keys = {"experiment": job.experiment, "method": method, "fold": job.fold, "seed": job.seed_i}
    return keys | {"trained_on_skins_n": len(np.unique(data.rows.skin[job.train]))}


def collapse_record(result: TrainingResult) -> dict[str, Any]:
    """Return whether the training run collapsed, and how many earlier attempts with other random draws collapsed."""
    return {"collapsed": result.collapsed, "collapsed_before_n": result.collapsed_before_n}


def _predictions(jobs: Sequence[TrainingJob], results: Sequence[TrainingResult], rows: Rows) -> pa.Table:
    """Tabulate true and predicted values, with one row per job and test row."""
    tables = []
    for job, result in zip(jobs, results, strict=True):
        names = {"question": job.experiment, "recipe": job.recipe_name, "fold": job.fold, "seed_i": job.seed_i}
        columns = {name: pa.repeat(value, len(job.test)) for name, value in names.items()}
        columns["skin"] = pa.array(rows.skin[job.test].tolist())
        for i, name in enumerate(TARGETS):
            columns[f"true_{name}"] = pa.array(rows.target[job.test, i])
            columns[f"predicted_{name}"] = pa.array(result.predicted[:, i])
        tables.append(pa.table(columns))
    return pa.concat_tables(tables)
