"""How far a number of numbers.json may lie from the committed one, and why. In: its name. Out: a `Tolerance`.

The only home of these limits. Refuses to know numbers and files.
"""

import re
from dataclasses import dataclass

# A name: `table2.multi.accuracy_pct.mean`, `sweep_pokes[65].mse_xy_mm2.sd`, `audit[skins, lobo/b0].holds`.
IGNORED = (
    (r"provenance\.(git|trained|device|seconds)$", "the commit, the machine and its seconds"),
    (r"drift\.findings.*\.(verdict|of_trainings|why|holds)$", "words about numbers that are compared themselves"),
    (r"runtime\.stages\b", "seconds and memory of stages"),
    (r"runtime\.(learning|adaptation)\b", "seconds; their scores stand under their own questions"),
    (r"runtime\..*\.(median_s|repeats_n|train_s|inference_us|seconds)$", "seconds"),
)


@dataclass(frozen=True)
class Tolerance:
    """A number whose name matches may differ by `absolute`, or by `relative` of the committed one, if that is more."""

    pattern: str
    absolute: float
    relative: float
    why: str

    def allows(self, committed: float, fresh: float) -> bool:
        """Tell whether two numbers are the same within it."""
        return abs(fresh - committed) <= max(self.absolute, self.relative * abs(committed))

    def __str__(self) -> str:
        """Say it: `2`, `25 %`, `0.02 or 25 %`, `exact`."""
        parts = [f"{self.absolute:g}"] * bool(self.absolute) + [f"{100 * self.relative:g} %"] * bool(self.relative)
        return " or ".join(parts) or "exact"


COMPUTED = r"(capture|described|variation|sensitivity|left_out|verification|stability|runtime|audit)"  # no training
LAST_BITS = "other instruction sets add in another order: weights differ in their last bits, and training magnifies it"
TOLERANCES = (  # the first that matches holds
    Tolerance(r"runtime\..*work_n$", 0.0, 0.01, "an adaptive integrator takes a step more or less"),
    Tolerance(r"^trainings\.", 3.0, 0.0, "other last bits, and another training collapses"),
    Tolerance(r"(_n|\.n|_i|seed)$", 0.0, 0.0, "a count"),
    Tolerance(r"stability\[learning", 0.01, 0.25, LAST_BITS),
    Tolerance(rf"^{COMPUTED}\b.*error$", 1e-7, 1e-3, "below 1e-7 an error is rounding itself"),
    Tolerance(rf"^{COMPUTED}", 1e-9, 1e-3, "computed in double precision, without training"),
    Tolerance(r"_pct\.(sd|sd_seeds)$", 2.0, 0.0, f"{LAST_BITS}; the spread of a few units"),
    Tolerance(r"\.(sd|sd_seeds)$|\.spread\.", 0.02, 0.5, f"{LAST_BITS}; the spread of a few units"),
    Tolerance(r"_pct\.ci95\b", 4.0, 0.5, f"{LAST_BITS}; an end of an interval over few boards"),
    Tolerance(r"\.ci95\b", 0.1, 0.5, f"{LAST_BITS}; an end of an interval over few boards"),
    Tolerance(r"_pct\b", 2.0, 0.0, LAST_BITS),
    Tolerance(r"(^|\.)(paired|contrasts)\b.*mse_", 0.05, 0.25, f"{LAST_BITS}; a small difference of two means"),
    Tolerance(r"mse_\w+", 0.002, 0.25, LAST_BITS),
    Tolerance(r"", 0.02, 0.25, LAST_BITS),
)


def ignored(name: str) -> bool:
    """Tell whether a number is of the machine, and of no result."""
    return any(re.search(pattern, name) for pattern, _ in IGNORED)


def tolerance_of(name: str) -> Tolerance:
    """Find the tolerance of a number."""
    return next(one for one in TOLERANCES if re.search(one.pattern, name))
