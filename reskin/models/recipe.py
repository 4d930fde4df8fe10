"""Recipes: the settings of training, adaptation and fine-tuning.

The recipes themselves, with their names and values, are in `params.yaml` and in the files of scenes. This module
defines which settings a recipe has.
"""

from typing import Annotated, Literal

from pydantic import Field

from reskin.config import Strict

# Name of the recipe whose results are compared with the results of the paper. The other recipes are variants of it.
HEADLINE = "paper"

# The name of a recipe. Only some characters are allowed, because the names of files contain it.
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,40}$")]
Weight = Annotated[float, Field(ge=0)]


class Schedule(Strict):
    """The settings of the optimisation, which uses AdamW with a one-cycle schedule of the learning rate.

    steps_n: the number of training steps.
    batch_n: the number of rows in a batch.
    rate_max: the largest learning rate of the schedule.
    gradient_norm_max: the largest norm of the gradient of a network's loss, in scaled units, with respect to all
        weights of the network. A gradient with a larger norm is scaled down to this norm.
    weight_decay: the weight decay of AdamW.
    """

    steps_n: Annotated[int, Field(ge=1)]
    batch_n: Annotated[int, Field(ge=1)]
    rate_max: Annotated[float, Field(gt=0)]
    gradient_norm_max: Annotated[float, Field(gt=0)]
    weight_decay: Weight


class Recipe(Schedule):
    """The settings of a training run, including those that the paper does not specify.

    architecture: `paper` is the network that the paper describes. `released` is the network that the paper's authors
        released, which also has ReLUs after the second layer and on the outputs.
    inputs: with `raw`, the inputs are the field change. With `shape`, they are the direction of the field change and
        the logarithm of its magnitude.
    scaling: with `standard`, inputs and targets are scaled to mean 0 and standard deviation 1. With `released`, they
        are scaled as in the network that the authors released (see `reskin.models.inputs.fit_released`).
    triplet_weight: the weight of the triplet loss. With 0, no triplets are drawn.
    """

    architecture: Literal["paper", "released"]
    inputs: Literal["raw", "shape"]
    scaling: Literal["standard", "released"]
    triplet_weight: Weight


class Augmentation(Strict):
    """Settings for virtual boards: copies of the training data, modified as if other boards had measured the skins.

    `copies_n` is the number of copies of each skin. The other settings are the standard deviations of the random
    differences between a virtual board and the real one.
    """

    copies_n: Annotated[int, Field(ge=1, le=100)]
    gain_sd: Weight  # of the relative gain of each channel of a virtual board
    lean_sd_deg: Annotated[float, Field(ge=0, le=45)]  # of the tilt of each chip of a virtual board, about each axis
    noise_uT: Weight  # of the noise that is added to each channel of a reading


class AugmentedRecipe(Recipe):
    """A recipe that trains on virtual boards in addition to the real data. The paper does not use this method."""

    augmentation: Augmentation


class AdaptationRecipe(Schedule):
    """The settings of the adaptation of a trained network to a new skin (section 5 of the paper).

    The loss is the loss of the recipe with which the network was trained, plus a triplet loss on unlabelled pokes of
    the new skin along lines.

    unlabelled_weight: the weight of the triplet loss on the unlabelled pokes. It is 0 in the control experiment, which
        trains for equally many steps without the pokes.
    """

    unlabelled_weight: Weight


class FineTuningRecipe(Schedule):
    """The settings of the fine-tuning of a trained network to a new skin.

    The loss is the loss of the recipe with which the network was trained, plus the squared error on a few labelled
    pokes of the new skin.

    own_weight: the weight of the squared error on the labelled pokes of the new skin.
    """

    own_weight: Weight


class AdaptationWithBase(AdaptationRecipe):
    """The settings of an adaptation that starts from the networks which stage `train_triplet` trained.

    base: the name of the recipe with which these networks were trained.
    """

    base: Name
