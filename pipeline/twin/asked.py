"""What a user hands to the shipped model: readings, places and forces, checked before anything is learnt from them.

Refuses to know what is learnt.
"""

import numpy as np
from jaxtyping import Bool, Float

from pipeline.core.errors import SchemaError

CHANNELS_N = 15  # of five chips, three axes each
FIELD_MAX_uT = 1e6  # 20 times what a chip can measure: no poke, and single precision holds its square
LABELS_MAX_N = 2000  # pokes at once: memory grows with their square, time faster


def rows_of(b_uT: Float[np.ndarray, "..."]) -> Float[np.ndarray, "f ch"]:
    """Take one reading or several; raise SchemaError on those of another board."""
    rows_uT = np.atleast_2d(np.asarray(b_uT, float))
    if rows_uT.ndim != 2 or rows_uT.shape[1] != CHANNELS_N:
        rule, remedy = f"the {CHANNELS_N} of five chips", "Load a model of such boards."
        raise SchemaError("fields", "channels", rule, f"shape {np.shape(b_uT)}", remedy)
    return rows_uT


def learnt_rows_of(b_uT: Float[np.ndarray, "..."]) -> Float[np.ndarray, "f ch"]:
    """Take readings to learn from; raise SchemaError on one that is no number, or that no chip measures."""
    rows_uT = rows_of(b_uT)
    _need("fields", "readings to learn from", "finite numbers of uT", rows_uT, np.isfinite(rows_uT))
    rule = f"at most {FIELD_MAX_uT:,.0f} uT in size"
    _need("fields", "readings to learn from", rule, rows_uT, np.abs(rows_uT) <= FIELD_MAX_uT)
    return rows_uT


def labels_of(
    place_mm: Float[np.ndarray, "..."],
    force_N: Float[np.ndarray, "..."],
    rows_n: int,
    reach_mm: Float[np.ndarray, "2 2"],
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, " m"]]:
    """Take one label or several, as many as readings: places within `reach_mm` (least, most), forces above 0 N."""
    places_mm, forces_N = np.atleast_2d(place_mm), np.atleast_1d(force_N)
    got = f"places {places_mm.shape}, forces {forces_N.shape}, readings ({rows_n}, {CHANNELS_N})"
    if places_mm.shape != (rows_n, 2) or forces_N.shape != (rows_n,):
        rule, remedy = "x and y, a force and a reading of each poke", "Give arrays [m, 2], [m] and [m, 15]."
        raise SchemaError("labels", "shapes", rule, got, remedy)
    if rows_n > LABELS_MAX_N:
        raise SchemaError("labels", "their number", f"at most {LABELS_MAX_N}", rows_n, "Take some of them.")
    least_mm, most_mm = reach_mm
    on_skin = (places_mm >= least_mm) & (places_mm <= most_mm)
    _need("labels", "places", f"on the skin, {least_mm.tolist()} to {most_mm.tolist()} mm", places_mm, on_skin)
    _need("labels", "forces", "above 0 N", forces_N, forces_N > 0)
    _need("labels", "forces", "finite", forces_N, np.isfinite(forces_N))
    return places_mm, forces_N


def _need(where: str, what: str, rule: str, got: np.ndarray, holds: Bool[np.ndarray, "..."]) -> None:
    if not holds.all():
        wrong = np.argwhere(~holds)[0]
        raise SchemaError(where, what, rule, str(got[tuple(wrong)]), "Leave it out.")
