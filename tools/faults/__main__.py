"""Inject every fault and print a table: python -m tools.faults [--only WORD] [--work FOLDER].

A row is green if four conditions are met: a command that fails prints a message and no traceback; no command takes more
than ten minutes; no finished stage or training run is computed again; and all outputs equal those of the undisturbed
run. The program clones the last commit, runs a small scene with a few experiments in the clone, and injects each fault
into a new copy of the clone. It needs Linux; faults that mount file systems need root.
"""

import argparse
import shutil
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from reskin import io
from tests.repositories import git
from tools.faults import files, kills, together  # noqa: F401 (importing a module adds its faults)
from tools.faults.harness import CASES, Checkout, Row, copy, line, make_template, not_run, table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--only", nargs="*", default=[], help="inject only the faults whose name contains one of these words"
    )
    parser.add_argument("--work", type=Path, help="a folder in which the finished checkout and the table rows are kept")
    arguments = parser.parse_args()
    work = (arguments.work or Path(tempfile.mkdtemp())).resolve()
    work.mkdir(parents=True, exist_ok=True)
    start_s, template = time.monotonic(), Checkout(work / "template")
    if not template.folder.exists():
        template, _ = make_template(work / "template")
    print(f"finished checkout: {time.monotonic() - start_s:.0f} s", flush=True)
    rows_file, code = work / "rows.json", git(template.folder, "rev-parse", "--short=12", "HEAD~1:pipeline")
    rows = io.read_json(rows_file) if rows_file.exists() else {}
    for name, (how, case) in CASES.items():
        if any(part in name for part in arguments.only) if arguments.only else rows.get(name, {}).get("code") != code:
            row, seconds = inject(case, template, work / "case")
            rows[name] = {"line": line(name, how, row, seconds), "red": bool(row.faults), "code": code, "s": seconds}
            print(rows[name]["line"], flush=True)
            io.write_json(rows_file, rows)
    if not arguments.work:
        shutil.rmtree(work)
    print(summary(rows))


def inject(case: Callable[[Checkout], Row], template: Checkout, folder: Path) -> tuple[Row, float]:
    """Inject a fault into a new copy of the finished checkout; return the fault's table row and the seconds taken."""
    shutil.rmtree(folder, ignore_errors=True)
    checkout, start_s = copy(template, folder), time.monotonic()
    try:
        row = case(checkout)
    except Exception as error:  # the table shows this error as the outcome
        traceback.print_exc()
        row = Row(
            "", None, "not known", "–", [f"the fault could not be injected ({type(error).__name__} {error})"[:300]]
        )
    return row, time.monotonic() - start_s


def summary(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the table of all faults; those that have not been injected yet are marked."""
    ran = [rows[name] for name in CASES if name in rows]
    lines = [rows[name]["line"] if name in rows else not_run(name, how) for name, (how, _) in CASES.items()]
    return f"{table(lines)}\n{sum(not row['red'] for row in ran)} of {len(ran)} rows are green; {len(CASES)} faults"


if __name__ == "__main__":
    main()
