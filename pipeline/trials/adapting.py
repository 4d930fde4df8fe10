"""What the stages that adapt share: a held-out skin's pool of pokes and a trained network -> a trial. Knows no argv."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.core import io
from pipeline.core.errors import SchemaError
from pipeline.core.seeds import rng_for
from pipeline.dataset.lines import Lines, grid_lines, take_pokes
from pipeline.dataset.splits import Fold
from pipeline.learning.inputs import Scaler
from pipeline.learning.recipe import Adaptation, training
from pipeline.learning.trial import Adapting, Start, Trial
from pipeline.trials.training import SceneData

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
    data: SceneData, fold: Fold, named: tuple[str, Adaptation], starts: Starts, *, question: str, pokes_n: int
) -> Iterator[Trial]:
    """Adapt to each skin of a fold by itself: so many indentations of its pool, of which only lines are passed on."""
    for skin in np.unique(data.rows.skin[fold.test]):
        for seed_i in own_starts(starts, named[1].base, fold):
            lines = pool_lines(data, fold, str(skin), pokes_n=pokes_n, seed_i=seed_i)
            yield adaptation(data, fold, named, starts, Pokes(question, str(skin), seed_i, f"{pokes_n}pokes", lines))


@dataclass(frozen=True)
class Pokes:
    """What one network is adapted by: lines on one skin; `question` and `what` name the training."""

    question: str
    skin: str
    seed_i: int
    what: str
    lines: Lines


def adaptation(data: SceneData, fold: Fold, named: tuple[str, Adaptation], starts: Starts, pokes: Pokes) -> Trial:
    """Adapt the fold's network of one seed to one skin, whose rows of the fold's test side are tested."""
    name, settings = named
    test = fold.test[data.rows.skin[fold.test] == pokes.skin]
    start = own_starts(starts, settings.base, fold)[pokes.seed_i]
    recipe = training(data.settings, "train_triplet").recipes[settings.base]
    return Trial(
        pokes.question, name, recipe, fold.name, data.settings.seed, pokes.seed_i, fold.train, test,
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
