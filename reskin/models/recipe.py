"""A recipe: a row of settings for the training loop. In: a section of a scene. Out: whole recipes by name.

A section names a shared row, its number of steps, and the differences of its variants. Knows no data and no network.
"""

from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field, model_validator

from reskin.config import Settings, Strict, Words, parse, parse_parts
from reskin.errors import ParamsError

HEADLINE = "paper"  # the recipe whose numbers stand beside the paper's; others are variants

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,40}$")]  # a name is part of file names
Weight = Annotated[float, Field(ge=0)]


class Schedule(Strict):
    """How the loop descends: AdamW under a one-cycle rate whose peak is `rate_max`; a batch is drawn at every step.

    A gradient longer than `gradient_norm_max` (all weights of a network as one vector, scaled units) is cut to it.
    """

    steps_n: Annotated[int, Field(ge=1)]
    batch_n: Annotated[int, Field(ge=1)]
    rate_max: Annotated[float, Field(gt=0)]
    gradient_norm_max: Annotated[float, Field(gt=0)]
    weight_decay: Weight


class Recipe(Schedule):
    """What the paper leaves open is written here: inputs, scaling, schedule, weight of the triplet term.

    `architecture` is the paper's text or the network that its authors released (FACTS: ReLU after layer 2 and on the
    output). `inputs` is the change of field as it is, or its direction and the logarithm of its length. `scaling` is
    per-channel standardisation or the released one (5 sd without mean; x/16, y/16, F/3). With a `triplet_weight` of 0
    no triplet is drawn.
    """

    architecture: Literal["paper", "released"]
    inputs: Literal["raw", "shape"]
    scaling: Literal["standard", "released"]
    triplet_weight: Weight


class Augmentation(Strict):
    """Copies of every training skin as other boards would read it; standard deviations of what differs."""

    copies_n: Annotated[int, Field(ge=1, le=100)]
    gain_sd: Weight  # of each channel
    lean_sd_deg: Annotated[float, Field(ge=0, le=45)]  # of each chip, about each axis
    noise_uT: Weight  # of each channel of a reading


class AugmentedRecipe(Recipe):
    """Ours: a recipe that is also trained on boards that might have been."""

    augmentation: Augmentation


class FineTuning(Schedule):
    """How a trained network is adapted to a new skin: its recipe's loss goes on, beside a term on the skin's pokes.

    `unlabelled_weight` weighs the triplet loss of unlabelled pokes along lines (paper section 5).
    """

    unlabelled_weight: Weight


class Labelling(Schedule):
    """How a trained network is fine-tuned on a few labelled pokes of a new skin, weighed by `own_weight`."""

    own_weight: Weight


class Adaptation(FineTuning):
    """Fine-tuning from one recipe of train_triplet; with an `unlabelled_weight` of 0 it is the control."""

    base: Name


class _Recipes(Strict):
    @model_validator(mode="after")
    def _has_a_headline(self) -> "_Recipes":
        if HEADLINE not in self.recipes:  # type: ignore[attr-defined]
            raise ValueError(f"recipes hold a recipe named {HEADLINE}, which stands beside the paper's numbers")
        return self


class Adaptations(_Recipes):
    """What stage adapt runs on every held-out skin: adaptations by `pokes_n` of its indentations, unlabelled."""

    pokes_n: Annotated[int, Field(ge=1)]
    recipes: dict[Name, Adaptation]


class PokesSweep(Strict):
    """Numbers of unlabelled indentations to adapt with, on the last `boards_n` boards held out; 0 is no adaptation."""

    pokes_n: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
    boards_n: Annotated[int, Field(ge=1)]


class Training(_Recipes):
    """What a training stage runs: every recipe on every fold with every seed."""

    recipes: dict[Name, Recipe | AugmentedRecipe]
    seeds_n: Annotated[int, Field(ge=1)]


class AuditSettings(Strict):
    """Whether the scene's settings were chosen, so that a study must vouch for them, or are for speed alone."""

    settings: Literal["chosen", "for speed"]


Steps = Annotated[int, Field(ge=1)]
Variants = dict[Name, dict[str, Any]]  # what each does differently from the row that its section names


class TrainingRow(Strict):
    """Training as a scene writes it: the shared recipe that is the headline, and what variants do differently."""

    recipe: Name
    steps_n: Steps
    seeds_n: Annotated[int, Field(ge=1)]
    variants: Variants


class AdaptationsRow(Strict):
    """Section adapt as a scene writes it: the shared adaptation that is the headline, its base, its variants."""

    adaptation: Name
    base: Name
    steps_n: Steps
    pokes_n: Annotated[int, Field(ge=1)]
    variants: Variants


Model = TypeVar("Model", bound=Strict)


def training(settings: Settings, section: str) -> Training:
    """Read a section that trains, every recipe in full; of what the stage does not declare, nothing is there."""
    row, where = settings.words(section), f"{settings.where}: {section}"
    parse_parts(TrainingRow, row, where)
    return parse_parts(Training, _recipes(settings, row, where), where)


def with_training(settings: Settings, model: type[Model], section: str) -> Model:
    """Read a section that holds a `training`, every recipe in full."""
    whole, where = dict(settings.words(section)), f"{settings.where}: {section}"
    row = whole.get("training", {})
    parse(TrainingRow, row, f"{where}.training")
    return parse(model, whole | {"training": _recipes(settings, row, f"{where}.training")}, where)


def adaptations(settings: Settings) -> Adaptations:
    """Read section adapt, every adaptation in full: the control follows what it controls.

    Every base is a recipe of train_triplet.
    """
    row, where = settings.words("adapt"), f"{settings.where}: adapt"
    parse_parts(AdaptationsRow, row, where)
    shared = {**settings.row("adaptations", row["adaptation"]), "base": row["base"]}
    full = {"recipes": _in_full(row, shared, where)} | {name: row[name] for name in ("pokes_n",) if name in row}
    section = parse_parts(Adaptations, full, where)
    known = sorted(training(settings, "train_triplet").recipes)
    for name, recipe in section.recipes.items():
        if recipe.base not in known:
            raise ParamsError(where, f"base of {name}", f"one of {known}", repr(recipe.base), "Mend it there.")
    return section


def _recipes(settings: Settings, row: Words, where: str) -> dict[str, Any]:
    recipes = _in_full(row, settings.row("recipes", row["recipe"]), where)
    return {"recipes": recipes} | {name: row[name] for name in ("seeds_n",) if name in row}


def _in_full(row: Words, shared: Words, where: str) -> dict[str, dict[str, Any]]:
    """Write every recipe of a section in full: the headline as it is shared, variants with their differences."""
    headline = dict(shared) | {"steps_n": row["steps_n"]}
    variants = row.get("variants", {})
    if HEADLINE in variants:
        rule = f"other than {HEADLINE}, by which tables call the section's own recipe"
        raise ParamsError(f"{where}.variants", "a variant's name", rule, HEADLINE, "Choose another name.")
    return {HEADLINE: headline} | {name: headline | changes for name, changes in variants.items()}
