"""What the stages that adapt share: a held-out skin's pool of pokes and a trained network -> a cell. Knows no argv."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pipeline import io
from pipeline.dataset.lines import grid_lines, take_pokes
from pipeline.dataset.splits import Fold
from pipeline.errors import SchemaError, complain
from pipeline.learning.cell import Adapting, Cell, Start
from pipeline.learning.recipe import Adaptation
from pipeline.learning.standardise import Scaler
from pipeline.seeds import rng_for
from pipeline.stages._train import Scenery

Starts = dict[tuple[str, str, int], Start]  # by recipe, fold and seed


def read_starts(models: Path) -> Starts:
    """Read the networks of train_triplet."""
    starts = {}
    for file in sorted(models.glob("*.json")):
        card = io.read_json(file)
        tensors, _ = io.read_tensors(file.with_suffix(".safetensors"))
        weights = {name: values for name, values in tensors.items() if name.startswith("layer")}
        starts[card["recipe_name"], card["fold"], card["seed_i"]] = Start(
            card["key"], weights, Scaler.of_arrays(tensors)
        )
    return starts


def adaptations(
    at: Scenery, fold: Fold, named: tuple[str, Adaptation], starts: Starts, *, question: str, pokes_n: int
) -> Iterator[Cell]:
    """Adapt to each skin of a fold by itself: so many indentations of its pool, of which only lines are passed on."""
    assert at.asked.train_triplet is not None
    name, settings = named
    recipe = at.asked.train_triplet.recipes[settings.base]
    own = {seed_i: start for (base, of, seed_i), start in starts.items() if (base, of) == (settings.base, fold.name)}
    if not own:
        raise SchemaError(
            complain(
                f"fold {fold.name}", "networks to adapt", f"those of recipe {settings.base}", "none", "Train them."
            )
        )
    for skin in np.unique(at.rows.skin[fold.test]):
        pool, test = (side[at.rows.skin[side] == skin] for side in (fold.pool, fold.test))
        for seed_i, start in own.items():
            rng = rng_for(at.asked.seed, "pokes", str(skin), seed_i)
            lines = grid_lines(at.rows, take_pokes(at.rows, pool, pokes_n, rng))
            yield Cell(
                question, name, recipe, fold.name, at.asked.seed, seed_i, fold.train, test,
                Adapting(start, settings, lines), str(skin), f"{pokes_n}pokes",
            )  # fmt: skip
