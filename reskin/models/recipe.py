"""Recipes: the settings of a training, an adaptation or a fine-tuning."""

from typing import Annotated, Literal

from pydantic import Field

from reskin.config import Strict

HEADLINE = "paper"  # the recipe that is compared with the paper; others are variants

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,40}$")]  # a name is part of file names
Weight = Annotated[float, Field(ge=0)]


class Schedule(Strict):
    """Optimisation: AdamW under a one-cycle learning rate with peak `rate_max`.

    Gradients (all weights of a network as one vector, scaled units) are clipped to a norm of `gradient_norm_max`.
    """

    steps_n: Annotated[int, Field(ge=1)]
    batch_n: Annotated[int, Field(ge=1)]
    rate_max: Annotated[float, Field(gt=0)]
    gradient_norm_max: Annotated[float, Field(gt=0)]
    weight_decay: Weight


class Recipe(Schedule):
    """How a network is trained, including what the paper leaves open.

    architecture: that of the paper's text, or of the released network (ReLU after layer 2 and on the output). inputs:
    the change of field as it is, or its direction and the logarithm of its length. scaling: per-channel
    standardisation, or that of the released network (5 sd without mean; x/16, y/16, F/3). triplet_weight: weight of the
    triplet loss; with 0 no triplet is drawn.
    """

    architecture: Literal["paper", "released"]
    inputs: Literal["raw", "shape"]
    scaling: Literal["standard", "released"]
    triplet_weight: Weight


class Augmentation(Strict):
    """Copies of every training skin as other boards would read it; standard deviations of the boards' differences."""

    copies_n: Annotated[int, Field(ge=1, le=100)]
    gain_sd: Weight  # of each channel
    lean_sd_deg: Annotated[float, Field(ge=0, le=45)]  # of each chip, about each axis
    noise_uT: Weight  # of each channel of a reading


class AugmentedRecipe(Recipe):
    """A recipe that also trains on virtual boards (ours, not the paper's)."""

    augmentation: Augmentation


class AdaptationRecipe(Schedule):
    """Adaptation to a new skin: the recipe's loss, and the triplet loss of unlabelled pokes along lines (section 5).

    unlabelled_weight: weight of that triplet loss; with 0 it is the control.
    """

    unlabelled_weight: Weight


class FineTuningRecipe(Schedule):
    """Fine-tuning on a few labelled pokes of a new skin, whose squared error has weight `own_weight`."""

    own_weight: Weight


class AdaptationWithBase(AdaptationRecipe):
    """Adaptation of the networks that train_triplet trained by recipe `base`."""

    base: Name
