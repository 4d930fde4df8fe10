"""What a hold-out is: how a scene asks for it (`Split`), and who is on which side (`Fold`). Refuses to draw."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Int64
from pydantic import Field, field_validator

from pipeline.core.config import Strict

Question = Literal[
    "lobo", "sensors", "labels", "transfer", "single_random", "single_indentation", "single_pass", "single_temporal"
]
ONE_SKIN = {
    "transfer",
    "single_random",
    "single_indentation",
    "single_pass",
    "single_temporal",
}  # of those: trained on one
Count = Annotated[int, Field(ge=1)]


class Split(Strict):
    """How folds are drawn; each part is there if, and only if, its question is asked."""

    random_test_fraction: Annotated[float, Field(gt=0, lt=1)] | None = None
    random_repeats_n: Count | None = None
    temporal_test_fraction: Annotated[float, Field(gt=0, lt=1)] | None = None
    transfer_skins_n: Count | None = None
    sensors_skins_n: Annotated[tuple[Count, ...], Field(min_length=1)] | None = None
    sensors_draws_n: Count | None = None
    pool_passes_n: Count | None = None  # of each held-out skin, its first ones
    labels_pool_n: Count | None = None  # indentations of each held-out skin that may be labelled, of all depths
    labels_draws_n: Count | None = None

    @field_validator("sensors_skins_n")
    @classmethod
    def _sensors_differ(cls, skins_n: tuple[int, ...] | None) -> tuple[int, ...] | None:
        if skins_n is not None and len(set(skins_n)) < len(skins_n):
            raise ValueError(f"sensors_skins_n names each number of skins once, not {list(skins_n)}")
        return skins_n


@dataclass(frozen=True)
class Fold:
    """Row numbers (of `Rows`): the two sides of one hold-out, and the pool of unlabelled pokes on the held-out skins.

    Adaptation may poke in the pool; nothing is scored there, so that every method is scored on the same rows.
    """

    question: str
    name: str
    train: Int64[np.ndarray, " a"]
    test: Int64[np.ndarray, " b"]
    pool: Int64[np.ndarray, " c"]


NO_POOL = np.zeros(0, np.int64)
