"""Stage ingest: one recorded capture -> indentations/<scene>/<capture>.parquet, one row a reading.

Refuses to know how a layout is read and which faults are dropped.
"""

from pathlib import Path

from pipeline.stage import run, say
from reskin import io
from reskin.config import Files, parse, read_yaml
from reskin.recordings.fault_policy import Decisions
from reskin.recordings.ingest import check_losses, open_capture


def ingest(scene: str, files: Files, raw: Path, lost_fraction_max: float, indentations: Path) -> None:
    """Read a capture, check what it lost, and write its readings."""
    decisions = parse(Decisions, read_yaml(files.params)["faults"], f"{files.params}: faults")
    header, blocks, account = open_capture(raw, decisions)
    io.write_readings(indentations, blocks, account)
    try:
        check_losses(account, lost_fraction_max, str(raw))
    except ValueError:
        io.remove(indentations)
        raise
    kept = ", ".join(f"{key} {count}" for key, count in account.items() if count)
    say(f"{scene}/{header.capture} ({header.source}): {kept}")


if __name__ == "__main__":
    run(ingest)
