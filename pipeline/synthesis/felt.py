"""What a skin makes of a capture's contacts: plan -> field and force at every stop. In: board, skin, tips, terms.

A term of physics that a protocol does not name is not computed (PHYSICS 8 says what that costs).
Refuses to know frames, chips' electronics and clocks.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.constants import micro

from pipeline.core.config import Strict
from pipeline.physics.board import Board
from pipeline.physics.friction import Friction
from pipeline.physics.skin import Skin, beyond_verified_n, changes_of_field, forces
from pipeline.physics.viscoelastic import Relaxation, force_left
from pipeline.physics.warmth import Temperature
from pipeline.physics.wear import Ageing, fading, softening, wandering
from pipeline.synthesis.sideways import push


class Terms(Strict):
    """Physics that only some protocols need, each with its sizes."""

    ageing: Ageing | None = None
    friction: Friction | None = None
    relaxation: Relaxation | None = None
    temperature: Temperature | None = None

    def named(self) -> set[str]:
        """Name the terms that are there."""
        return {name for name in type(self).model_fields if getattr(self, name) is not None}

    def only(self, names: Collection[str]) -> "Terms":
        """Keep the terms of these names."""
        return Terms(**{name: getattr(self, name) for name in names})


@dataclass(frozen=True)
class Felt:
    """Fields at the chips in tesla and forces on the skin in newtons; axes n indentations, p stops, k chips."""

    rest_T: Float[np.ndarray, "n k 3"]  # before each indentation
    change_T: Float[np.ndarray, "n p k 3"]
    force_N: Float[np.ndarray, "n p 3"]
    beyond_verified_n: int  # stops deeper than any published solution vouches for


def feel(
    board: Board,
    skin: Skin,
    tip_m: Float[np.ndarray, "n p 3"],
    *,
    tilt: Float[np.ndarray, "n 2"],
    terms: Terms,
    rng: np.random.Generator,
) -> Felt:
    """Press the skin at every stop (x, y, depth in the board's frame), fresh at the first indentation.

    Without friction nothing pushes sideways: a tip that is dragged or leans (`tilt`, x and y over z) only presses.
    """
    n, stops_n, _ = tip_m.shape
    flat_m = tip_m.reshape(-1, 3)
    force_N = np.zeros((n, stops_n, 3))
    if terms.friction is None:
        rest_T, change_T = changes_of_field(board, skin, flat_m)
    else:
        rest_T, _ = changes_of_field(board, skin, flat_m[:0])
        pushed = push(board, skin, tip_m, tilt=tilt, how=terms.friction)
        force_N[:, :, :2], change_T = pushed.force_N, pushed.change_T
    force_N[:, :, 2] = forces(skin, flat_m[:, 2]).reshape(n, stops_n)
    every_rest_T = np.broadcast_to(rest_T, (n, *rest_T.shape))
    if terms.ageing is not None:
        contacts_n = np.arange(n)
        force_N *= softening(contacts_n, settling=terms.ageing.settling, ageing=terms.ageing.ageing)[:, None, None]
        every_rest_T = _drifted(rest_T, contacts_n, terms.ageing, rng)
    if terms.relaxation is not None:
        force_N *= force_left(terms.relaxation)
    deep_n = beyond_verified_n(skin, flat_m[:, 2])
    return Felt(every_rest_T, change_T.reshape(n, stops_n, *rest_T.shape), force_N, deep_n)


def _drifted(
    rest_T: Float[np.ndarray, "k 3"], contacts_n: Int[np.ndarray, " n"], how: Ageing, rng: np.random.Generator
) -> Float[np.ndarray, "n k 3"]:
    left = 1 - fading(contacts_n, per_decade=how.fading_per_decade)
    walk_T = wandering(contacts_n, rest_T.size, step_T=how.wandering_uT * micro, rng=rng)
    return left[:, None, None] * rest_T + walk_T.reshape(-1, *rest_T.shape)
