"""Did training see the test side of a fold? In: row numbers, labels and dB of a scene. Out: `Check`s.

What must be apart follows from the question; the paper's random readings share indentations, which is a known leak.
Refuses to know how folds are drawn and what is trained on them.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.experiments.audit.copies import COPIED_SHARE_MAX, liken, strong_indentations
from reskin.errors import ParamsError


@dataclass(frozen=True)
class Check:
    """A rule that keeps training apart from testing, and what was found of it."""

    what: str
    where: str
    rule: str
    found: str
    holds: bool
    known: bool


def holds(checks: Iterable[Check]) -> bool:
    """Tell whether every rule holds, but for the leaks that are known."""
    return all(check.holds or check.known for check in checks)


def to_words(checks: Iterable[Check]) -> list[dict[str, str | bool]]:
    """Write checks as JSON words."""
    return [asdict(check) for check in checks]


SKINS_UNSEEN = ("lobo", "sensors", "labels", "transfer")
SKIN_SHARED = ("single_temporal", "single_indentation", "single_pass")
PAPERS_WAY = "single_random"  # readings of one indentation on both sides, as in the paper's section 4


@dataclass(frozen=True)
class Sides:
    """Row numbers of a fold: trained on, poked without labels to adapt to, tested on."""

    question: str
    name: str
    train: Int[np.ndarray, " a"]
    pool: Int[np.ndarray, " c"]
    test: Int[np.ndarray, " b"]

    @property
    def where(self) -> str:
        """A name for people."""
        return f"{self.question}/{self.name}"


@dataclass(frozen=True)
class Labels:
    """What each row of the scene belongs to; `indentation` is unique over the scene."""

    board: np.ndarray
    skin: np.ndarray
    indentation: Int[np.ndarray, " f"]
    capture: np.ndarray


def audit_fold(
    sides: Sides, labels: Labels, *, db_uT: Float[np.ndarray, "f ch"], rng: np.random.Generator
) -> list[Check]:
    """Check that nothing of the test side was trained on, by row, label and likeness, nor adapted to.

    >>> skin = np.array(["s1", "s1", "s2"])
    >>> labels = Labels(np.array(["b1", "b1", "b2"]), skin, np.array([0, 0, 1]), capture=skin)
    >>> db_uT = np.array([[200.0, 0, 0], [200, 0, 0], [0, 200, 0]], np.float32)
    >>> fold = Sides("lobo", "b2", np.array([0, 1]), np.array([], int), np.array([2]))
    >>> for check in audit_fold(fold, labels, db_uT=db_uT, rng=rng):
    ...     print(f"{check.what}: {check.found}: {check.holds}")
    readings: 0 of 1 test readings trained on or adapted to: True
    boards: 0 of 1 on both sides: True
    skins: 0 of 1 on both sides: True
    indentations: 0 of 1 on both sides: True
    copies: 1 of 1 captures compared; s2 like s1: 0.0 % of 1 indentations: True
    """
    _check_question(sides)
    checks = [_readings(sides)]
    if sides.question in SKINS_UNSEEN:
        checks += [_apart("boards", labels.board, sides), _apart("skins", labels.skin, sides)]
        checks += [_apart("indentations", labels.indentation, sides), _copies(sides, labels, db_uT, rng)]
    elif sides.question in SKIN_SHARED:
        rule = "apart; the skin is shared by design"
        checks.append(_apart("indentations", labels.indentation, sides, rule=rule))
    else:
        rule = "apart, but for the paper's own protocol; the skin is shared by design"
        checks.append(_apart("indentations", labels.indentation, sides, rule=rule, known=True))
    return checks + (_pool(sides, labels) if len(sides.pool) else [])


def _check_question(sides: Sides) -> None:
    known = (*SKINS_UNSEEN, *SKIN_SHARED, PAPERS_WAY)
    if sides.question not in known:
        raise ParamsError(
                f"fold {sides.where}", "the question", f"one of {', '.join(known)}", sides.question,
                "Say in the audit what its two sides may share.",
            )  # fmt: skip
    if not (len(sides.train) and len(sides.test)):
        got = f"{len(sides.train)} to train on, {len(sides.test)} to test on"
        raise ParamsError(f"fold {sides.where}", "rows", "on both sides", got, "Split again.")


def _readings(sides: Sides) -> Check:
    seen = np.isin(sides.test, np.concatenate([sides.train, sides.pool]))
    found = f"{int(seen.sum())} of {len(sides.test)} test readings trained on or adapted to"
    return Check("readings", sides.where, "on one side only", found, holds=not seen.any(), known=False)


def _apart(what: str, label: np.ndarray, sides: Sides, *, rule: str = "apart", known: bool = False) -> Check:
    """Look for labels on both sides; `known` excuses them."""
    own = np.unique(label[sides.test])
    shared = own[np.isin(own, np.unique(label[sides.train]))]
    found = f"{len(shared)} of {len(own)} on both sides{_some(shared)}"
    return Check(what, sides.where, rule, found, holds=len(shared) == 0, known=known and len(shared) > 0)


def _copies(sides: Sides, labels: Labels, db_uT: np.ndarray, rng: np.random.Generator) -> Check:
    """Look for recordings of a training skin under a test skin's name."""
    test, train = (
        strong_indentations(name[side], labels.indentation[side], db_uT[side])
        for name, side in ((labels.capture, sides.test), (labels.skin, sides.train))
    )
    rule = f"in no capture {100 * COPIED_SHARE_MAX:g} % like one training skin"
    captures, skins = labels.capture[sides.test], labels.skin[sides.test]
    untold = np.setdiff1d(skins, skins[np.isin(captures, test.name)])
    if len(untold) or not len(train.name):
        found = f"cannot be told: fields within the noise{_some(untold)}"
        return Check("copies", sides.where, rule, found, holds=False, known=False)
    likest = liken(test, train, rng=rng)
    most = max(likest, key=lambda one: one.share)
    found = (
        f"{len(likest)} of {len(np.unique(captures))} captures compared; "
        f"{most.capture} like {most.train_skin}: {100 * most.share:.1f} % of {most.compared_n} indentations"
    )
    return Check("copies", sides.where, rule, found, holds=most.share < COPIED_SHARE_MAX, known=False)


def _pool(sides: Sides, labels: Labels) -> list[Check]:
    """Check the unlabelled pokes: of the skins held out, and none of those tested on."""
    pokes, tested = (np.unique(labels.indentation[side]) for side in (sides.pool, sides.test))
    shared = pokes[np.isin(pokes, tested)]
    skins = np.unique(labels.skin[sides.pool])
    foreign = np.setdiff1d(skins, labels.skin[sides.test])
    apart = f"{len(shared)} of {len(pokes)} unlabelled also tested{_some(shared)}"
    strangers = f"{len(foreign)} of {len(skins)} are not held out{_some(foreign)}"
    return [
        Check("pool indentations", sides.where, "apart from the test", apart, holds=len(shared) == 0, known=False),
        Check("pool skins", sides.where, "skins of the test", strangers, holds=len(foreign) == 0, known=False),
    ]


def _some(names: np.ndarray) -> str:
    """Name the first few, for a sentence."""
    if len(names) == 0:
        return ""
    return f": {', '.join(map(str, names[:3]))}{', ...' if len(names) > 3 else ''}"
