"""A row of the table of faults, and how it is judged. In: what was said and kept. Out: Markdown."""

import re
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from tests.faults.place import TRACES, Checkout, Said, sentence_of
from tests.stages.checkout import ROOT

ROOTS = (tempfile.gettempdir(), str(ROOT.parent), "/var")  # paths of this machine, which no reader has
TITLES = ("fault", "how injected", "what the user sees", "exit status", "lost", "the next run", "s", "verdict")


@dataclass
class Row:
    """What became of a fault. `known` explains what is not as it should be."""

    said: str
    status: int | None
    lost: str
    next_run: str
    faults: list[str] = field(default_factory=list)
    known: str = ""


Case = Callable[[Checkout], Row]
NOT_RUN = Said(0, "", 0.0)
CASES: dict[str, tuple[str, Case]] = {}  # by name: how it is injected, and what does it


def fault(name: str, how: str) -> Callable[[Case], Case]:
    """Enter a fault into the table."""

    def enter(case: Case) -> Case:
        CASES[name] = (how, case)
        return case

    return enter


def judge(
    at: Checkout, first: Said, again: Said, *, may_run: Iterable[str] | None = None,
    finished: dict[str, int] | None = None, fails: bool = True,
) -> Row:  # fmt: skip
    """Hold what a fault left, and what the next run made of it, against the undisturbed run.

    `may_run` are the stages that the next run may run; `finished` the trainings that were there before it; `fails`
    tells whether the first run had to fail.
    """
    after, undisturbed, reused = at.lock(), at.template.lock(), _whole(finished or {}, at.cells())
    torn_n = len(finished or {}) - len(reused)
    trained = sum(written != reused.get(name) for name, written in at.cells().items())
    again_trained = [name for name, written in at.cells().items() if name in reused and written != reused[name]]
    unlike = [stage for stage in undisturbed if after.get(stage) != undisturbed[stage]]
    more = sorted(set(again.ran) - set(may_run)) if may_run is not None else []
    checks = {
        "a traceback": TRACES in first.text + again.text,
        "a hang": first.status is None or again.status is None,
        "no failure": fails and first.status == 0,
        "nothing is told": (first.status or 0) > 0 and not sentence_of(first.text),  # one that was killed tells nothing
        f"the next run fails: {sentence_of(again.text)}": again.status not in (0, None),
        f"other results: {', '.join(unlike)}": bool(unlike),
        f"finished stages ran again: {', '.join(more)}": bool(more),
        f"{len(again_trained)} finished trainings again": bool(again_trained),
    }
    told = f"ran {', '.join(stage.partition('@')[0] for stage in again.ran) or 'no stage'}"
    if finished is not None:
        told += f"; {len(reused)} trainings reused, {trained} trained"
    told += "" if unlike else "; results equal byte for byte"
    faults = [words for words, is_true in checks.items() if is_true]
    lost = f"{torn_n} trainings of a stack whose files were being written" if torn_n else "nothing finished"
    return Row(sentence_of(first.text), first.status, lost, told, faults)


def _whole(cells: dict[str, int], later: dict[str, int]) -> dict[str, int]:
    """Keep trainings of stacks that are whole: those of a stack are trained side by side and finished as one."""
    members = [Counter(name.rpartition("-")[0] for name in each) for each in (cells, later)]
    whole = {stack for stack, files_n in members[0].items() if members[1][stack] == files_n}
    return {name: written for name, written in cells.items() if name.rpartition("-")[0] in whole}


def line(name: str, how: str, row: Row, seconds: float) -> str:
    """Write a row."""
    status = "hang" if row.status is None else str(row.status)
    verdict = "green" if not row.faults else f"red: {'; '.join(row.faults)}"
    if row.known:
        verdict += f". {row.known}"
    said = f"“{_plain(row.said)}”" if row.said else "–"
    cells = (name, how, said, status, row.lost, row.next_run, f"{seconds:.0f}", verdict)
    return "| " + " | ".join(_plain(cell) for cell in cells) + " |"


def not_run(name: str, how: str) -> str:
    """Write the row of a fault that was not injected yet."""
    return f"| {_plain(name)} | {_plain(how)} |{' – |' * 5} not run yet |"


def _plain(text: str) -> str:
    return (
        re.sub(rf"(?<!\w)({'|'.join(map(re.escape, ROOTS))})\S*/", "…/", " ".join(text.split()))
        .replace("|", "\\|")
        .replace("<", "&lt;")
    )


def table(lines: Sequence[str]) -> str:
    """Put rows together."""
    return "\n".join(["| " + " | ".join(TITLES) + " |", "|" + "---|" * len(TITLES), *lines]) + "\n"
