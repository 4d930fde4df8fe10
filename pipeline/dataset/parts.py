"""Windows of captures under several no-load policies, as one stack of rows. In: `Readings`. Out: parts, `Rows`.

A part is one window of one skin under one policy. Refuses to know what is trained on a part.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Int64

from pipeline.core.schema import Readings
from pipeline.dataset.rows import Rows, Selection, gather
from pipeline.dataset.windows import Windows, take

Policy = Callable[[np.ndarray, np.ndarray], np.ndarray]  # no-load fields and indentations of the rows -> no-load fields
TRAIN = -1


@dataclass(frozen=True)
class Part:
    """A window's rows in the stack of all; window `TRAIN` is the one trained on."""

    policy: str
    window_i: int
    readings: Readings
    rows: Rows
    noload_off_uT: float  # rms over rows and channels: the policy's no-load field less that read before the contact
    first_row_i: int

    @property
    def row_i(self) -> Int64[np.ndarray, " f"]:
        """The numbers of its rows in the stack."""
        return np.arange(self.first_row_i, self.first_row_i + len(self.rows))


def lay_parts(
    captures: Sequence[tuple[Readings, Int64[np.ndarray, " _"]]],
    policies: Mapping[str, Policy],
    *,
    windows: Windows,
    selection: Selection,
) -> list[Part]:
    """Lay the rows of every capture, policy and window below each other; beside a capture stands the unit of each row.

    A policy sees the whole capture, whatever the windows and the selection leave out.
    """
    parts: list[Part] = []
    next_i = 0
    for one, unit_i in captures:
        for policy, choose in policies.items():
            changed = replace(one, noload_uT=choose(one.noload_uT, one.indentation))
            off_uT = (changed.noload_uT - one.noload_uT).astype(float)
            for window_i, (start, end) in enumerate((windows.train, *windows.tests), TRAIN):
                inside = (unit_i >= start) & (unit_i < end)
                own, apart_uT = take(changed, inside), float(np.sqrt((off_uT[inside] ** 2).mean()))
                parts.append(Part(policy, window_i, own, gather([own], selection), apart_uT, next_i))
                next_i += len(parts[-1].rows)
    return parts


def stack(parts: Sequence[Part]) -> Rows:
    """Make one set of rows of all parts; what the selection left out is counted once, as it is so for every policy."""
    arrays = [field.name for field in fields(Rows) if field.name != "dropped"]
    stacked = {name: np.concatenate([getattr(part.rows, name) for part in parts]) for name in arrays}
    own = [part.rows.dropped for part in parts if part.policy == parts[0].policy]
    return Rows(**stacked, dropped={name: sum(one[name] for one in own) for name in own[0]})
