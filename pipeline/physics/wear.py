"""What contacts do to a skin. In: the number of contacts so far. Out: factors and drifts.

All sizes are design values (PHYSICS 5: assumed, within the ranges given there).
Refuses to know which contact was where and how deep.
"""

from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from pydantic import Field

from pipeline.core.config import Strict
from pipeline.core.errors import ParamsError

SETTLING_CONTACTS = 300  # the first softening is over after a few times as many
AGEING_CONTACTS = 1e3


class Ageing(Strict):
    """How fast a skin softens and its field at rest drifts."""

    settling: Annotated[float, Field(ge=0, le=0.5)]  # force lost in the first contacts
    ageing: Annotated[float, Field(ge=0, le=0.1)]  # force lost with each decade of contacts
    fading_per_decade: Annotated[float, Field(ge=0, le=0.1)]  # of the field at rest
    wandering_uT: Annotated[float, Field(ge=0, le=10)]  # sd a contact and channel


def softening(contacts_n: Int[np.ndarray, " n"], *, settling: float, ageing: float) -> Float[np.ndarray, " n"]:
    """Give force over the force of the fresh skin: 1 - settling (1 - exp(-N/300)) - ageing log10(1 + N/1000)."""
    _refuse_counts(contacts_n)
    settled = -np.expm1(-contacts_n / SETTLING_CONTACTS)
    left = 1 - settling * settled - ageing * np.log10(1 + contacts_n / AGEING_CONTACTS)
    if not (left > 0).all():
        got = f"{left.min():.3g} after {contacts_n.max()} contacts"
        raise ParamsError("wear", "stiffness left", "above 0", got, "Lower settling or ageing.")
    return left


def fading(contacts_n: Int[np.ndarray, " n"], *, per_decade: float) -> Float[np.ndarray, " n"]:
    """Give what a skin's field at rest loses, as a share of it: per_decade log10(1 + N)."""
    _refuse_counts(contacts_n)
    return per_decade * np.log10(1 + contacts_n)


def wandering(
    contacts_n: Int[np.ndarray, " n"], channels_n: int, *, step_T: float, rng: np.random.Generator
) -> Float[np.ndarray, "n ch"]:
    """Draw the random walk of each channel's baseline, one normal step of sd `step_T` for every contact, in tesla.

    `contacts_n` must not fall; contacts that nobody looks at are walked all the same.
    """
    _refuse_counts(contacts_n)
    new_n = np.diff(contacts_n, prepend=0)
    if (new_n < 0).any():
        raise ParamsError("wear", "contact count", "never falling", f"{new_n.min()}", "Sort the contacts.")
    steps_T = step_T * np.sqrt(new_n)[:, None] * rng.standard_normal((len(contacts_n), channels_n))
    return np.cumsum(steps_T, axis=0)


def _refuse_counts(contacts_n: Int[np.ndarray, " n"]) -> None:
    if contacts_n.size and contacts_n.min() < 0:
        raise ParamsError("wear", "contact count", "0 or more", f"{contacts_n.min()}", "Count from 0.")
