"""Policy for faulty readings: drop them, flag and count them, or refuse the recording."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Bool, Float64, Int

from reskin.config import Strict
from reskin.errors import CaptureError, ParamsError

Decision = Literal["drop", "flag", "refuse"]
Lost = Literal["drop", "refuse"]  # bytes that are no frame cannot be kept
Seen = Literal["flag", "refuse"]  # nothing is there that could be dropped
REMEDY = "Mend the board and record again, or decide otherwise in params.yaml: faults."


class Decisions(Strict):
    """What is decided for each fault, by name."""

    failed_read: Decision  # an I2C read that failed
    zeros: Decision  # in place of a reading
    stuck: Decision  # a chip stays the same while others move
    constant_channel: Seen  # Bx, By or Bz of a chip never changes while other channels do
    chip_reset: Seen  # a chip's step is not that of the others, or changes
    too_hot: Decision  # or too cold: temperature out of range
    saturated: Decision  # field at the end of the chip's range
    int16_wrap: Decision  # field jumps by more than int16 holds
    repeated: Decision  # frames come again, far more often than a fast loop sends them
    dropped: Seen  # the board's clock says that frames are missing
    clock_jump: Seen  # the board's clock falls, or jumps
    unplug: Seen  # nothing comes for a second or more
    torn: Lost  # bytes between frames that are none
    wrong_baud: Lost  # many such bytes in a row


# For who asks whether a recording would be refused, or whether it can be read at all; ingest does as params.yaml says.
REFUSE_ALL = Decisions.model_validate(dict.fromkeys(Decisions.model_fields, "refuse"))
REFUSE_NONE = Decisions.model_validate(
    {name: get_args(field.annotation)[0] for name, field in Decisions.model_fields.items()}
)
DONE = {"drop": "dropped", "flag": "flagged", "refuse": "refused"}
PER_UNIT = {"ms": 1000, "row": 1}  # places are given in s, or rows


def decide(usual: Decisions, words: Iterable[str], where: str) -> Decisions:
    """Change some decisions by `NAME=DECISION`.

    >>> decide(REFUSE_ALL, ["too-hot=drop"], "--on-fault").too_hot
    'drop'
    """
    changes: dict[str, Any] = {}
    for word in words:
        name, _, decision = word.replace("-", "_").partition("=")
        kind = Decisions.model_fields[name].annotation if name in Decisions.model_fields else None
        allowed = getattr(kind, "__args__", ())
        if decision not in allowed:
            names = ", ".join(Decisions.model_fields)
            rule = f"{name}={'|'.join(allowed)}" if allowed else f"NAME=drop|flag|refuse with one of {names}"
            raise ParamsError(where, "a decision", rule, repr(word)[:40], f"Try: {where} too_hot=drop")
        changes[name] = decision
    return usual.model_copy(update=changes)


@dataclass
class Found:
    """How often a fault was seen, first and last where (s of the stream, or rows from 1), and what was decided.

    Where is NaN as long as no time is known: bytes that came last before a recorder was killed may have none.
    """

    count_n: int
    first: float
    last: float
    decision: Decision


class Ledger:
    """Remembers what was found of each fault; `unit` is that of its places in accounts: ms, or row."""

    def __init__(self, decisions: Decisions, where: str, unit: Literal["ms", "row"]) -> None:
        self.found: dict[str, Found] = {}
        self._decisions, self._where, self._unit = decisions, where, unit

    def note(
        self,
        fault: str,
        marks: Bool[np.ndarray, " f"],
        at: Float64[np.ndarray, " f"] | Int[np.ndarray, " f"],
        count_n: int | None = None,
    ) -> Bool[np.ndarray, " f"]:
        """Count a fault where it is marked, or as many as is said; give the marks of what is dropped for it."""
        decision: Decision = getattr(self._decisions, fault)
        if marks.any():
            known = at[marks & np.isfinite(at)]
            first, last = (float(known[0]), float(known[-1])) if len(known) else (math.nan, math.nan)
            count_n = int(marks.sum()) if count_n is None else count_n
            if decision == "refuse":
                place = f"{self._unit} {first * PER_UNIT[self._unit]:.0f}" if len(known) else "an unknown time"
                got = f"{count_n}, the first at {place}"
                raise CaptureError(self._where, fault.replace("_", " "), "nowhere, as was decided", got, REMEDY)
            before = self.found.setdefault(fault, Found(0, first, last, decision))
            before.count_n += count_n
            before.first, before.last = float(np.fmin(before.first, first)), float(np.fmax(before.last, last))
        return marks if decision == "drop" else np.zeros_like(marks)

    def account(self) -> dict[str, int]:
        """Say of each fault its count, decision and, if known, span, as accounts do; of a sound recording, nothing."""
        told: dict[str, int] = {}
        for name, one in self.found.items():
            told[f"fault_{name}_{DONE[one.decision]}_n"] = one.count_n
            if not math.isnan(one.last):
                told[f"fault_{name}_first_{self._unit}"] = round(one.first * PER_UNIT[self._unit])
                told[f"fault_{name}_last_{self._unit}"] = round(one.last * PER_UNIT[self._unit])
        return told
