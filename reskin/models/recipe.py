"""Recipes: the settings of training, adaptation and fine-tuning."""

from typing import Annotated, Literal

from pydantic import Field

from reskin.config import Strict

HEADLINE = "paper"  # the recipe whose results are compared with those of the paper; other recipes are variants

# The characters are restricted, because names are used in file names.
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,40}$")]
Weight = Annotated[float, Field(ge=0)]


class Schedule(Strict):
    """Optimisation: AdamW with a one-cycle learning rate that peaks at `rate_max`.

    The gradient of a network's loss with respect to all its weights, taken as one vector, is clipped to a norm of at
    most `gradient_norm_max`. Targets are in scaled units.
    """

    steps_n: Annotated[int, Field(ge=1)]
    batch_n: Annotated[int, Field(ge=1)]
    rate_max: Annotated[float, Field(gt=0)]
    gradient_norm_max: Annotated[float, Field(gt=0)]
    weight_decay: Weight


class Recipe(Schedule):
    """Settings of a training run, including those that the paper does not specify.

    architecture: `paper` (as in the paper's text) or `released` (as in the network that the authors released, with a
    ReLU after layer 2 and on the output). inputs: `raw` (the field change) or `shape` (the direction of the field
    change and the logarithm of its magnitude). scaling: `standard` (mean 0 and standard deviation 1) or `released`
    (see `reskin.models.inputs.fit_released`).
    triplet_weight: weight of the triplet loss; with 0, no triplets are drawn.
    """

    architecture: Literal["paper", "released"]
    inputs: Literal["raw", "shape"]
    scaling: Literal["standard", "released"]
    triplet_weight: Weight


class Augmentation(Strict):
    """Settings for virtual copies of each training skin, as if other boards had measured the skin.

    `copies_n` is the number of copies. The other settings are standard deviations.
    """

    copies_n: Annotated[int, Field(ge=1, le=100)]
    gain_sd: Weight  # relative gain of each channel of a virtual board
    lean_sd_deg: Annotated[float, Field(ge=0, le=45)]  # tilt of each chip of a virtual board, about each axis
    noise_uT: Weight  # additional noise of each channel of a reading


class AugmentedRecipe(Recipe):
    """A recipe that also trains on virtual boards (not in the paper)."""

    augmentation: Augmentation


class AdaptationRecipe(Schedule):
    """Adaptation to a new skin: the recipe's loss plus a triplet loss on unlabelled pokes along lines.

    This is the method of section 5 of the paper. unlabelled_weight: weight of the triplet loss on unlabelled pokes; 0
    in the control experiment.
    """

    unlabelled_weight: Weight


class FineTuningRecipe(Schedule):
    """Fine-tuning to a new skin: the recipe's loss plus the squared error on a few labelled pokes of the new skin.

    own_weight: weight of the squared error on the labelled pokes of the new skin.
    """

    own_weight: Weight


class AdaptationWithBase(AdaptationRecipe):
    """Adaptation of the networks that stage `train_triplet` trained with recipe `base`."""

    base: Name
