"""Faults of disks and files: a full disk, a read-only folder, truncated files, changed bits."""

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

from reskin import io
from tools.faults.harness import NOT_RUN, SCENE, Checkout, Row, fault, judge
from tools.faults.kills import address

TRIPLET = address("train_triplet")
# The command runs in a mount namespace of its own, so its mounts are removed when it ends.
IN_NAMESPACE = ("unshare", "--mount", "--propagation", "private", "sh", "-c")


@fault(
    "full disk under trainings",
    "a tmpfs of 300 kB is mounted over `.reskin` while `train_triplet` runs",
)
def full_cells(checkout: Checkout) -> Row:
    checkout.reset(TRIPLET)
    script = f"mount -t tmpfs -o size=300k none .reskin && exec dvc repro {TRIPLET}"
    return judge(checkout, checkout.run(*IN_NAMESPACE, script), checkout.run("dvc", "repro"), may_run=[TRIPLET])


@fault(
    "full disk under everything",
    "the checkout is on a tmpfs with 150 kB of free space; before the next run, space is freed",
)
def full_disk(checkout: Checkout) -> Row:
    checkout.reset(TRIPLET)
    disk = checkout.folder.with_name("disk")
    disk.mkdir(exist_ok=True)
    size = subprocess.run(["du", "-sm", str(checkout.folder)], capture_output=True, text=True, check=True).stdout
    size_MB = int(size.split()[0])
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size_MB + 40}m", "none", str(disk)], check=True)
    try:
        subprocess.run(["cp", "-r", "--preserve=all", str(checkout.folder), str(disk / "case")], check=True)
        small = Checkout(disk / "case", template=checkout.template)
        _fill(disk, but_kB=150)
        result = small.run("dvc", "repro")
        (disk / "ballast").unlink()
        return judge(small, result, small.run("dvc", "repro"), may_run=[TRIPLET])
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def _fill(disk: Path, *, but_kB: int) -> None:
    free = os.statvfs(disk)
    with (disk / "ballast").open("wb") as ballast:
        os.posix_fallocate(ballast.fileno(), 0, free.f_bavail * free.f_frsize - but_kB * 1024)


@fault(
    "read-only `reports/`",
    "`reports/` is mounted read-only; `report` has to run, and DVC has to remove the former outputs",
)
def read_only_reports(checkout: Checkout) -> Row:
    return _read_only(checkout, keep=True)


@fault(
    "read-only `reports/`, nothing in it",
    "`reports/` is mounted read-only and contains no former outputs; `report` has to run",
)
def read_only_new_reports(checkout: Checkout) -> Row:
    return _read_only(checkout, keep=False)


def _read_only(checkout: Checkout, *, keep: bool) -> Row:
    kept = checkout.folder / "kept"
    shutil.copytree(checkout.folder / "reports", kept)
    checkout.reset(address("report"))
    if keep:
        shutil.rmtree(checkout.folder / "reports")
        shutil.copytree(kept, checkout.folder / "reports")
    shutil.rmtree(kept)
    script = f"mount --bind reports reports && mount -o remount,ro,bind reports && exec dvc repro {address('report')}"
    return judge(
        checkout, checkout.run(*IN_NAMESPACE, script), checkout.run("dvc", "repro"), may_run=[address("report")]
    )


def _truncate(file: Path) -> None:
    content = file.read_bytes()
    file.chmod(0o644)
    file.unlink()  # unlinked first, because DVC's cached copy may be a hard link to this file
    file.write_bytes(content[: len(content) * 2 // 3])


def _first(folder: Path, pattern: str) -> Path:
    return min(folder.rglob(pattern))


CUT = {
    "simulated capture": (f"data/raw/{SCENE}", "*.bin", "ingest_simulated"),
    "dataset (Parquet)": (f"data/indentations/{SCENE}", "*.parquet", "split"),
    "predictions (Parquet)": (f"data/models/{SCENE}/train_multi", "predictions.parquet", "report"),
    "model (safetensors)": (f"data/models/{SCENE}/train_triplet", "*.safetensors", "adapt"),
}


@fault(
    "truncated files, `dvc repro`",
    "the last third is cut off a capture, a dataset, a table of predictions and a model of finished stages",
)
def cut_all(checkout: Checkout) -> Row:
    for folder, pattern, _ in CUT.values():
        _truncate(_first(checkout.folder / folder, pattern))
    first = checkout.run("dvc", "repro")
    row = judge(checkout, first, checkout.run("dvc", "repro"), may_run=[], fails=False)
    row.message = row.message or f"ran {', '.join(first.ran) or 'no stage: the files are restored from DVC’s cache'}"
    row.faults += ["finished stages ran again"] if first.ran else []
    row.faults += [] if first.status == 0 else ["`dvc repro` fails"]
    return row


def add_truncation(what: str, folder: str, pattern: str, reader: str) -> None:
    """Add a fault: the file `what` is truncated, and the stage `reader` reads it without DVC."""

    @fault(
        f"truncated {what}, read",
        f"the last third is cut off a `{pattern}` of `{folder}`; `{reader}` runs without DVC",
    )
    def read(checkout: Checkout) -> Row:
        _truncate(_first(checkout.folder / folder, pattern))
        row = judge(checkout, checkout.run(*checkout.command(reader)), NOT_RUN)
        row.next_run = "`dvc repro` restores the file, as above"
        return row


for what, (folder, pattern, reader) in CUT.items():
    add_truncation(what, folder, pattern, reader)


def _damage(file: Path) -> None:
    mode, content = file.stat().st_mode, bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.chmod(0o644)
    file.write_bytes(content)
    file.chmod(mode)


CACHED = {  # name: (output folder, damaged file, stage that reads it)
    "weights": (f"data/models/{SCENE}/train_triplet", "*.safetensors", address("adapt")),
    "dataset (Parquet)": (f"data/indentations/{SCENE}", "*.parquet", address("split")),
}


def _damage_cached(checkout: Checkout, out: str, pattern: str) -> tuple[Path, bytes]:
    """Change a bit of a file in DVC's cache and delete the output, so that DVC restores the changed file."""
    file = _first(checkout.folder / out, pattern)
    content = file.read_bytes()
    entry = next(
        candidate
        for candidate in (checkout.folder / ".dvc/cache/files").rglob("*")
        if candidate.is_file() and candidate.read_bytes() == content
    )
    entry.unlink()
    entry.write_bytes(content)
    entry.chmod(0o444)
    _damage(entry)
    io.remove(checkout.folder / out)
    return file, content


def add_cache_damage(what: str, folder: str, pattern: str, reader: str) -> None:
    """Add a fault: DVC restores a damaged file from its cache, and the stage `reader` reads this file."""

    @fault(
        f"corrupted DVC cache entry, {what}",
        f"a bit is changed in the cached copy of a `{pattern}` of `{folder}`, the folder is deleted, and "
        f"`{reader.partition('@')[0]}` has to run; then `dvc repro`, deletion of folder and cache, and the next run",
    )
    def case(checkout: Checkout) -> Row:
        file, content = _damage_cached(checkout, folder, pattern)
        checkout.reset(reader, trainings=False)
        first, cells = checkout.run("dvc", "repro"), checkout.trainings()
        io.remove(checkout.folder / folder)
        io.remove(checkout.folder / ".dvc/cache/files")
        # All stages run again, because their outputs are no longer in the cache. No training run is repeated.
        row = judge(checkout, first, checkout.run("dvc", "repro"), may_run=[*checkout.lock()], finished=cells)
        row.faults += [] if ".dvc/cache/files" in row.message else ["the message does not say what to delete"]
        row.faults += [] if file.read_bytes() == content else ["the changed file is in use"]
        return row


for what, paths in CACHED.items():
    add_cache_damage(what, *paths)


def add_training_damage(name: str, how: str, damage: Callable[[Path], None]) -> None:
    """Add a fault: `damage` is applied to the result file of a finished training run."""

    @fault(f"corrupted finished training, {name}", f"{how} a file in `.reskin/cells`; `train_triplet` runs again")
    def case(checkout: Checkout) -> Row:
        cells = checkout.trainings()
        checkout.reset(TRIPLET, trainings=False)
        card = io.read_json(_first(checkout.template.folder / f"data/models/{SCENE}/train_triplet", "*.json"))
        damage(checkout.folder / f".reskin/cells/{card['key']}.safetensors")
        whole = {cell: written for cell, written in checkout.trainings().items() if written == cells[cell]}
        first = checkout.run("dvc", "repro")
        fresh_n = sum(checkout.trainings()[cell] != written for cell, written in cells.items())
        row = judge(
            checkout, first, checkout.run("dvc", "repro"), may_run=[], finished=checkout.trainings(), fails=False
        )
        row.lost = f"{len(cells) - len(whole)} training run and the others of its stack; {fresh_n} repeated"
        row.faults += [] if 1 <= fresh_n <= 3 else ["training runs of other stacks are repeated too"]
        row.faults += [] if "is damaged" in row.message else ["no message says that a file is damaged"]
        return row


add_training_damage("cut", "the last third is cut off", _truncate)
add_training_damage("changed", "a bit is changed in", _damage)
