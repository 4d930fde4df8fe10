"""What contacts and warmth do to a skin. In: number of contacts so far, change of temperature. Out: factors and drifts.

All sizes are design values (PHYSICS 5: assumed, within the ranges given there).
Refuses to know which contact was where and how deep.
"""

import numpy as np
from jaxtyping import Float, Int

from pipeline.errors import ParamsError, complain

SETTLING_CONTACTS = 300  # the first softening is over after a few times as many
AGEING_CONTACTS = 1e3
REMANENCE_PER_K = -0.12e-2  # NdFeB powder: Br falls by 0.12 % for each kelvin


def softening(contacts_n: Int[np.ndarray, " n"], *, settling: float, ageing: float) -> Float[np.ndarray, " n"]:
    """Give force over the force of the fresh skin: 1 - settling (1 - exp(-N/300)) - ageing log10(1 + N/1000)."""
    _refuse_counts(contacts_n)
    settled = -np.expm1(-contacts_n / SETTLING_CONTACTS)
    left = 1 - settling * settled - ageing * np.log10(1 + contacts_n / AGEING_CONTACTS)
    if not (left > 0).all():
        got = f"{left.min():.3g} after {contacts_n.max()} contacts"
        raise ParamsError(complain("wear", "stiffness left", "above 0", got, "Lower settling or ageing."))
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
        raise ParamsError(complain("wear", "contact count", "never falling", f"{new_n.min()}", "Sort the contacts."))
    steps_T = step_T * np.sqrt(new_n)[:, None] * rng.standard_normal((len(contacts_n), channels_n))
    return np.cumsum(steps_T, axis=0)


def remanence(warmer_K: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Give magnetisation over that at the reference temperature; fields at rest and their changes scale alike."""
    return 1 + REMANENCE_PER_K * warmer_K


def _refuse_counts(contacts_n: Int[np.ndarray, " n"]) -> None:
    if contacts_n.size and contacts_n.min() < 0:
        raise ParamsError(complain("wear", "contact count", "0 or more", f"{contacts_n.min()}", "Count from 0."))
