"""Recipes: the settings of training, of adaptation and of fine-tuning."""

from typing import Annotated, Literal

from pydantic import Field

from reskin.config import Strict

HEADLINE = "paper"  # the recipe whose results are compared with the paper; other recipes are variants

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,40}$")]  # limited, because names are parts of file names
Weight = Annotated[float, Field(ge=0)]


class Schedule(Strict):
    """Optimisation: AdamW with a one-cycle learning rate that peaks at `rate_max`.

    The gradient with respect to all weights of a network, as one vector in scaled units, is clipped to a norm of at
    most `gradient_norm_max`.
    """

    steps_n: Annotated[int, Field(ge=1)]
    batch_n: Annotated[int, Field(ge=1)]
    rate_max: Annotated[float, Field(gt=0)]
    gradient_norm_max: Annotated[float, Field(gt=0)]
    weight_decay: Weight


class Recipe(Schedule):
    """How a network is trained, including the choices that the paper does not specify.

    architecture: that of the paper's text, or that of the released network (with ReLU after layer 2 and on the output).
    inputs: the field change itself, or its direction and the logarithm of its magnitude. scaling: standardisation of
    each channel, or the scaling of the released network (each channel / 5 sd, without removing the mean; x / 16,
    y / 16, F / 3). triplet_weight: weight of the triplet loss; with 0, no triplets are drawn.
    """

    architecture: Literal["paper", "released"]
    inputs: Literal["raw", "shape"]
    scaling: Literal["standard", "released"]
    triplet_weight: Weight


class Augmentation(Strict):
    """Virtual copies of each training skin, as if other boards had measured it.

    The settings are standard deviations of the differences between boards.
    """

    copies_n: Annotated[int, Field(ge=1, le=100)]
    gain_sd: Weight  # of each channel
    lean_sd_deg: Annotated[float, Field(ge=0, le=45)]  # of each chip, about each axis
    noise_uT: Weight  # of each channel of a reading


class AugmentedRecipe(Recipe):
    """A recipe that also trains on virtual boards (not in the paper)."""

    augmentation: Augmentation


class AdaptationRecipe(Schedule):
    """Adaptation to a new skin: the recipe's loss plus a triplet loss on unlabelled pokes along lines (section 5).

    unlabelled_weight: weight of this triplet loss; 0 for the control.
    """

    unlabelled_weight: Weight


class FineTuningRecipe(Schedule):
    """Fine-tuning to a new skin; the squared error on its few labelled pokes has weight `own_weight`."""

    own_weight: Weight


class AdaptationWithBase(AdaptationRecipe):
    """Adaptation of the networks that stage `train_triplet` trained with recipe `base`."""

    base: Name
