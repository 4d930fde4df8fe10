"""Recipes: the settings of one training, fine-tuning or labelling."""

from typing import Annotated, Literal

from pydantic import Field

from reskin.config import Strict

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


class AdaptationRecipe(Schedule):
    """How a trained network is adapted to a new skin: its recipe's loss goes on, beside a term on the skin's pokes.

    `unlabelled_weight` weighs the triplet loss of unlabelled pokes along lines (paper section 5).
    """

    unlabelled_weight: Weight


class FineTuningRecipe(Schedule):
    """How a trained network is fine-tuned on a few labelled pokes of a new skin, weighed by `own_weight`."""

    own_weight: Weight


class AdaptationWithBase(AdaptationRecipe):
    """Fine-tuning from one recipe of train_triplet; with an `unlabelled_weight` of 0 it is the control."""

    base: Name
