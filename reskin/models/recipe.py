"""Recipes: the settings of training, adaptation and fine-tuning."""

from typing import Annotated, Literal

from pydantic import Field

from reskin.config import Strict

HEADLINE = "paper"  # the recipe that is compared with the paper; others are variants

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,40}$")]  # a name is part of file names
Weight = Annotated[float, Field(ge=0)]


class Schedule(Strict):
    """Optimisation: AdamW under a one-cycle learning rate with peak `rate_max`.

    The gradient (of all weights of a network as one vector, in scaled units) is clipped to norm `gradient_norm_max`.
    """

    steps_n: Annotated[int, Field(ge=1)]
    batch_n: Annotated[int, Field(ge=1)]
    rate_max: Annotated[float, Field(gt=0)]
    gradient_norm_max: Annotated[float, Field(gt=0)]
    weight_decay: Weight


class Recipe(Schedule):
    """How a network is trained, including what the paper leaves open.

    architecture: that of the paper's text, or that of the released network (with ReLU after layer 2 and on the output).
    inputs: the field change as it is, or its direction and the logarithm of its length. scaling: standardisation of
    each channel, or the scaling of the released network (divide by 5 sd, without mean; x/16, y/16, F/3).
    triplet_weight: weight of the triplet loss; with 0, no triplets are drawn.
    """

    architecture: Literal["paper", "released"]
    inputs: Literal["raw", "shape"]
    scaling: Literal["standard", "released"]
    triplet_weight: Weight


class Augmentation(Strict):
    """Copies of every training skin as other boards would read it; standard deviations between boards."""

    copies_n: Annotated[int, Field(ge=1, le=100)]
    gain_sd: Weight  # of each channel
    lean_sd_deg: Annotated[float, Field(ge=0, le=45)]  # of each chip, about each axis
    noise_uT: Weight  # of each channel of a reading


class AugmentedRecipe(Recipe):
    """A recipe that also trains on virtual boards (ours, not the paper's)."""

    augmentation: Augmentation


class AdaptationRecipe(Schedule):
    """Adaptation to a new skin: the recipe's loss plus the triplet loss on unlabelled pokes along lines (section 5).

    unlabelled_weight: weight of that triplet loss; 0 for the control.
    """

    unlabelled_weight: Weight


class FineTuningRecipe(Schedule):
    """Fine-tuning on a few labelled pokes of a new skin, whose squared error has weight `own_weight`."""

    own_weight: Weight


class AdaptationWithBase(AdaptationRecipe):
    """Adaptation of the networks that stage train_triplet trained with recipe `base`."""

    base: Name
