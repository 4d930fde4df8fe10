"""Faults of disks and files: full, read-only, truncated, changed."""

import os
import shutil
import subprocess
from pathlib import Path

from reskin import io
from tests.faults.harness import NOT_RUN, SCENE, Checkout, Row, fault, judge
from tests.faults.kills import address

TRIPLET = address("train_triplet")
IN_NAMESPACE = ("unshare", "--mount", "--propagation", "private", "sh", "-c")  # mounts end with the process


@fault(
    "full disk under trainings",
    "a tmpfs of 300 kB is mounted over `.reskin` while `train_triplet` runs",
)
def full_cells(at: Checkout) -> Row:
    at.reset(TRIPLET)
    script = f"mount -t tmpfs -o size=300k none .reskin && exec dvc repro {TRIPLET}"
    return judge(at, at.run(*IN_NAMESPACE, script), at.run("dvc", "repro"), may_run=[TRIPLET])


@fault(
    "full disk under everything",
    "the checkout is on a tmpfs with 150 kB of free space; the next run has space again",
)
def full_disk(at: Checkout) -> Row:
    at.reset(TRIPLET)
    disk = at.folder.with_name("disk")
    disk.mkdir(exist_ok=True)
    size = subprocess.run(["du", "-sm", str(at.folder)], capture_output=True, text=True, check=True).stdout
    size_MB = int(size.split()[0])
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size_MB + 40}m", "none", str(disk)], check=True)
    try:
        subprocess.run(["cp", "-r", "--preserve=all", str(at.folder), str(disk / "case")], check=True)
        small = Checkout(disk / "case", template=at.template)
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
def read_only_reports(at: Checkout) -> Row:
    return _read_only(at, keep=True)


@fault("read-only `reports/`, nothing in it", "the same, without former outputs")
def read_only_new_reports(at: Checkout) -> Row:
    return _read_only(at, keep=False)


def _read_only(at: Checkout, *, keep: bool) -> Row:
    kept = at.folder / "kept"
    shutil.copytree(at.folder / "reports", kept)
    at.reset(address("report"))
    if keep:
        shutil.rmtree(at.folder / "reports")
        shutil.copytree(kept, at.folder / "reports")
    shutil.rmtree(kept)
    script = f"mount --bind reports reports && mount -o remount,ro,bind reports && exec dvc repro {address('report')}"
    return judge(at, at.run(*IN_NAMESPACE, script), at.run("dvc", "repro"), may_run=[address("report")])


def _truncate(file: Path) -> None:
    content = file.read_bytes()
    file.chmod(0o644)
    file.unlink()  # the cache's copy may be a hard link to this file
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
def cut_all(at: Checkout) -> Row:
    for folder, pattern, _ in CUT.values():
        _truncate(_first(at.folder / folder, pattern))
    first = at.run("dvc", "repro")
    row = judge(at, first, at.run("dvc", "repro"), may_run=[], fails=False)
    row.message = row.message or f"ran {', '.join(first.ran) or 'no stage: the files are restored from DVC’s cache'}"
    row.faults += ["finished stages ran again"] if first.ran else []
    row.faults += [] if first.status == 0 else ["it fails"]
    return row


def add_truncation(what: str, folder: str, pattern: str, reader: str) -> None:
    """Add the fault of a truncated file that is read without DVC."""

    @fault(
        f"truncated {what}, read",
        f"the last third is cut off a `{pattern}` of `{folder}`; `{reader}` runs without DVC",
    )
    def read(at: Checkout) -> Row:
        _truncate(_first(at.folder / folder, pattern))
        row = judge(at, at.run(*at.command(reader)), NOT_RUN)
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


CHECK = ("python", "-m", "pipeline", "check-cache")
CACHED = {  # changed output, its file, the stage that wrote it, a stage that reads it
    "weights": (f"data/models/{SCENE}/train_triplet", "*.safetensors", TRIPLET, address("adapt")),
    "dataset (Parquet)": (f"data/indentations/{SCENE}", "*.parquet", address("ingest_simulated"), address("split")),
}


def _damage_cached(at: Checkout, out: str, pattern: str = "") -> tuple[Path, bytes]:
    """Change a bit in DVC's cached copy of a file, and delete the output, so that DVC restores the changed copy."""
    file = _first(at.folder / out, pattern) if pattern else at.folder / out
    content = file.read_bytes()
    entry = next(
        each for each in (at.folder / ".dvc/cache/files").rglob("*") if each.is_file() and each.read_bytes() == content
    )
    entry.unlink()
    entry.write_bytes(content)
    entry.chmod(0o444)
    _damage(entry)
    io.remove(at.folder / out)
    return file, content


def add_cache_damage(what: str, folder: str, pattern: str, writer: str, reader: str) -> None:
    """Add the fault of a damaged object of DVC's cache that is restored for a stage."""

    @fault(
        f"corrupted DVC cache entry, {what}",
        f"a bit is changed in the cached copy of a `{pattern}` of `{folder}`, the folder is deleted, and "
        f"`{reader.partition('@')[0]}` has to run; then `dvc repro`, `reskin check-cache` and the next run",
    )
    def case(at: Checkout) -> Row:
        file, content = _damage_cached(at, folder, pattern)
        at.reset(reader, trainings=False)
        first, cells = at.run("dvc", "repro"), at.trainings()
        checked = at.run(*CHECK)
        row = judge(at, first, at.run("dvc", "repro"), may_run=[writer, reader], finished=cells)
        row.faults += [] if "check-cache" in row.message else ["the remedy is missing"]
        row.faults += (
            [] if (checked.status, str(file.relative_to(at.folder)) in checked.output) == (1, True) else ["not found"]
        )
        row.faults += [] if file.read_bytes() == content else ["the changed file is in use"]
        return row


for what, paths in CACHED.items():
    add_cache_damage(what, *paths)


@fault(
    "corrupted DVC cache entry, read by no stage",
    "a bit is changed in the cached copy of the folds (JSON), and the folds in the checkout are deleted; `dvc repro` "
    "restores them and runs no stage; then `reskin check-cache`, whose message is shown, and the next run",
)
def cached_folds(at: Checkout) -> Row:
    file, content = _damage_cached(at, f"data/models/{SCENE}/folds.json")
    restored = at.run("dvc", "repro")
    row = judge(at, at.run(*CHECK), at.run("dvc", "repro"), may_run=[address("split")])
    row.faults += [] if (restored.status, restored.ran) == (0, []) else ["the folds were not restored"]
    row.faults += [] if file.read_bytes() == content else ["the changed folds are in use"]
    row.known = "JSON and CSV files have no checksum: only `reskin check-cache` finds what a disk changed in them"
    return row


@fault(
    "cut DVC cache entry of a folder",
    "the list of files of `train_triplet` is truncated in DVC's cache, and the folder is deleted; then `dvc repro`, "
    "`reskin check-cache`, whose message is shown, `dvc repro` and the next run",
)
def cache_folder(at: Checkout) -> Row:
    digest = at.lock()[TRIPLET][f"data/models/{SCENE}/train_triplet"]
    entry = at.folder / ".dvc/cache/files/md5" / digest[:2] / digest[2:]
    _truncate(entry)
    entry.chmod(0o444)
    shutil.rmtree(at.folder / f"data/models/{SCENE}/train_triplet")
    before, checked, after = (at.run(*command) for command in (("dvc", "repro"), CHECK, ("dvc", "repro")))
    row = judge(at, checked, at.run("dvc", "repro"), may_run=[], finished=at.trainings())
    row.faults += [] if before.ran == after.ran == [TRIPLET] else [f"ran {before.ran}, {after.ran}"]
    row.known = (
        "DVC prints nothing, and runs the stage at every `dvc repro` until the cache is checked; no training run is "
        "repeated"
    )
    return row


def add_training_damage(name: str, how: str, damage) -> None:
    """Add the fault of a damaged file of a finished training run."""

    @fault(f"corrupted finished training, {name}", f"{how} a file in `.reskin/cells`; `train_triplet` runs again")
    def case(at: Checkout) -> Row:
        cells = at.trainings()
        at.reset(TRIPLET, trainings=False)
        card = io.read_json(_first(at.template.folder / f"data/models/{SCENE}/train_triplet", "*.json"))
        damage(at.folder / f".reskin/cells/{card['key']}.safetensors")
        whole = {cell: written for cell, written in at.trainings().items() if written == cells[cell]}
        first = at.run("dvc", "repro")
        fresh_n = sum(at.trainings()[cell] != written for cell, written in cells.items())
        row = judge(at, first, at.run("dvc", "repro"), may_run=[], finished=at.trainings(), fails=False)
        row.lost = f"{len(cells) - len(whole)} training run and the others of its stack; {fresh_n} repeated"
        row.faults += [] if 1 <= fresh_n <= 3 else ["training runs of other stacks are repeated too"]
        row.faults += [] if "is damaged" in row.message else ["no message"]
        return row


add_training_damage("cut", "the last third is cut off", _truncate)
add_training_damage("changed", "a bit is changed in", _damage)
