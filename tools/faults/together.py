"""Faults of concurrent commands, wrong clocks, interrupted `reskin add`, and unfinished git operations."""

import shutil
import signal
import subprocess
import time
from pathlib import Path

from ruamel.yaml import YAML

from tests.recordings.readers.test_lab import PRESSES, write
from tests.repositories import git
from tests.scenes import recorded_scene
from tools.faults.files import _truncate
from tools.faults.harness import SCENE, Checkout, Result, Row, fault, judge
from tools.faults.kills import address

TRIPLET = address("train_triplet")
FINISHED = (address("report"),)
CAPTURE = "board1_skin1_readings"
INGEST = f"ingest@rig-{CAPTURE}"
RAW = f"data/raw/rig/{CAPTURE}"


@fault("two `dvc repro` at once", "the second starts while the first runs `train_triplet`")
def two(checkout: Checkout) -> Row:
    checkout.reset(TRIPLET)
    start_s = time.monotonic()
    first, other = checkout.start("dvc", "repro"), Checkout(checkout.folder, checkout.folder.with_suffix(".other"))
    checkout.until(lambda: bool(checkout.trainings()), checkout.stage("train_triplet"))
    second = other.run("dvc", "repro")
    one, finished = checkout.end(first, start_s), checkout.trainings()
    row = judge(checkout, second, checkout.run("dvc", "repro"), may_run=[], finished=finished)
    row.faults += [] if one.status == 0 else ["the first fails"]
    return row


@fault(
    "two `dvc repro` at once, of different stages",
    "the second runs `sensitivity` while the first runs `train_triplet`",
)
def two_stages(checkout: Checkout) -> Row:
    checkout.reset(TRIPLET, address("sensitivity"))
    start_s = time.monotonic()
    first, other = (
        checkout.start("dvc", "repro", TRIPLET),
        Checkout(checkout.folder, checkout.folder.with_suffix(".other")),
    )
    checkout.until(lambda: bool(checkout.trainings()), checkout.stage("train_triplet"))
    second = other.run("dvc", "repro", address("sensitivity"))
    one, finished = checkout.end(first, start_s), checkout.trainings()
    # If the second command was refused, the next run has to run its stage.
    yet_to_run = [address("sensitivity")] if second.status else []
    row = judge(checkout, second, checkout.run("dvc", "repro"), may_run=yet_to_run, finished=finished, fails=False)
    row.faults += [] if one.status == 0 else ["the first fails"]
    row.faults += ["the second command was refused, but ran a stage"] if second.status and second.ran else []
    row.message = row.message or "no message: both commands succeed"
    return row


def _add(checkout: Checkout) -> list[str]:
    """Write a recorded scene and a recording; return the command that adds the recording to the scene."""
    with (checkout.folder / "pipeline/scenes/rig.yaml").open("w") as stream:
        YAML().dump(recorded_scene(), stream)
    recording = checkout.folder.with_name("recording")
    recording.mkdir(exist_ok=True)
    write(recording, *PRESSES)
    labels = ["--layout", "lab", "--board", "board1", "--skin", "skin1", "--scene", "rig"]
    return ["python", "-m", "pipeline", "add", str(recording / "readings.csv"), *labels]


def _ingest(checkout: Checkout, *others: str) -> Result:
    """Put the scene of the added recording into the plan; then run its stage, and other stages."""
    checkout.run("python", "-m", "pipeline", "scenes", "use", SCENE, "rig")
    return checkout.run("dvc", "repro", INGEST, *others)


@fault(
    "`reskin add` beside a running `dvc repro`",
    "a recording is added while `train_triplet` runs, and again after its end",
)
def add_beside(checkout: Checkout) -> Row:
    checkout.reset(TRIPLET)
    command, start_s = _add(checkout), time.monotonic()
    first, other = checkout.start("dvc", "repro"), Checkout(checkout.folder, checkout.folder.with_suffix(".other"))
    checkout.until(lambda: bool(checkout.trainings()), checkout.stage("train_triplet"))
    added = other.run(*command)
    one = checkout.end(first, start_s)
    later = checkout.run(*command)
    row = judge(checkout, added, _ingest(checkout, *FINISHED), may_run=[INGEST])
    row.faults += [] if (one.status, later.status) == (0, 0) else ["`dvc repro` or the later `reskin add` fails"]
    row.next_run = f"the recording is added after the end of `dvc repro`; {row.next_run}"
    return row


@fault(
    "kill -9 of `reskin add`",
    "SIGKILL as soon as the folder of the capture exists; then `dvc repro`, `reskin add`, the deletion of the folder "
    "that its message asks for, and `reskin add` again",
)
def kill_add(checkout: Checkout) -> Row:
    command, start_s = _add(checkout), time.monotonic()
    adding = checkout.start(*command)
    while adding.poll() is None and not (checkout.folder / RAW).exists():
        time.sleep(0.002)
    adding.send_signal(signal.SIGKILL)
    checkout.end(adding, start_s)
    after_kill = checkout.run("dvc", "repro")
    again = checkout.run(*command)
    shutil.rmtree(checkout.folder / RAW)
    later = checkout.run(*command)
    row = judge(checkout, again, _ingest(checkout, *FINISHED), may_run=[INGEST])
    row.faults += (
        []
        if (after_kill.status, after_kill.ran, later.status) == (0, [], 0)
        else [f"{after_kill.ran}, {later.output[-200:]}"]
    )
    return row


@fault(
    "kill -9 in `ingest`",
    "SIGKILL to the stage's process as soon as it exists; the recording has layout `lab`",
)
def kill_ingest(checkout: Checkout) -> Row:
    checkout.run(*_add(checkout))
    undisturbed = _ingest(checkout)
    expected = checkout.lock()[INGEST]
    checkout.reset(INGEST, trainings=False)
    start_s = time.monotonic()
    repro = checkout.start("dvc", "repro", INGEST)
    checkout.stage("ingest").kill()
    result = checkout.end(repro, start_s)
    row = judge(checkout, result, _ingest(checkout, *FINISHED), may_run=[INGEST])
    row.faults += (
        []
        if (undisturbed.status, checkout.lock()[INGEST]) == (0, expected)
        else ["the readings differ from those of an undisturbed run"]
    )
    return row


@fault(
    "truncated recorded capture",
    "the last third is cut off `readings.csv` of an added recording, which is ingested and committed; "
    "then `dvc repro`; for the next run, `git restore` of its `.dvc` file and `dvc checkout --force`",
)
def cut_recording(checkout: Checkout) -> Row:
    checkout.run(*_add(checkout))
    _ingest(checkout)
    expected = checkout.lock()[INGEST]
    git(checkout.folder, "add", "--all")
    git(checkout.folder, "commit", "--quiet", "--message", "added")
    _truncate(checkout.folder / RAW / "readings.csv")
    result = _ingest(checkout)
    git(checkout.folder, "restore", f"{RAW}.dvc")
    restored = checkout.run("dvc", "checkout", "--force", f"{RAW}.dvc")
    row = judge(checkout, result, _ingest(checkout, *FINISHED), may_run=[INGEST])
    row.faults += (
        []
        if restored.status == 0 and checkout.lock()[INGEST] == expected
        else [f"not restored: {restored.output[-300:]}"]
    )
    return row


CLOCK_SET_BACK = """\
import time
_before = {name: getattr(time, name) for name in ("time", "time_ns")}
_until = time.monotonic() + 2.0
def _set_back(name, by):
    setattr(time, name, lambda: _before[name]() - (by if time.monotonic() > _until else 0))
_set_back("time", 86400.0)
_set_back("time_ns", 86400 * 10**9)
"""


@fault(
    "clock set back",
    "by a day, 2 s after each process of `dvc repro` starts (`time.time` is replaced by a sitecustomize), so that "
    "files of finished stages are from the future; the next run has the right clock",
)
def clock(checkout: Checkout) -> Row:
    stages = [TRIPLET, address("adapt"), address("report")]
    checkout.reset(*stages)
    shim = checkout.folder.with_name("shim")
    shim.mkdir(exist_ok=True)
    (shim / "sitecustomize.py").write_text(CLOCK_SET_BACK)
    for file in (checkout.folder / "data/indentations").rglob("*.parquet"):
        subprocess.run(["touch", "--date", "tomorrow", str(file)], check=True)
    first = checkout.run("dvc", "repro", PYTHONPATH=f"{shim}:{checkout.folder}")
    row = judge(checkout, first, checkout.run("dvc", "repro"), may_run=[], finished=checkout.trainings(), fails=False)
    row.faults += [] if set(first.ran) == set(stages) else [f"ran {first.ran}"]
    row.message = row.message or "no message"
    return row


def _damage_and_restore(
    checkout: Checkout, file: str, content: str, command: tuple[str, ...], *, fails: bool = True
) -> Row:
    (checkout.folder / file).write_text(content)
    result = checkout.run(*command)
    git(checkout.folder, "restore", file)
    return judge(checkout, result, checkout.run("dvc", "repro"), may_run=[], fails=fails)


CONFLICT = "<<<<<<< HEAD\n{}=======\n{}>>>>>>> other\n"


@fault(
    "git: conflict left in dvc.lock",
    "conflict markers in `dvc.lock`; `dvc repro`; `git restore dvc.lock` for the next run",
)
def conflict_lock(checkout: Checkout) -> Row:
    text = (checkout.folder / "dvc.lock").read_text()
    return _damage_and_restore(checkout, "dvc.lock", CONFLICT.format(text, text), ("dvc", "repro"))


@fault(
    "git: conflict left in data/captures.yaml",
    "conflict markers in `data/captures.yaml`; `reskin scenes check`; `git restore` of this file for the next run",
)
def conflict_captures(checkout: Checkout) -> Row:
    command = ("python", "-m", "pipeline", "scenes", "check")
    text = CONFLICT.format("captures: {a: {}}\n", "captures: {b: {}}\n")
    return _damage_and_restore(checkout, "data/captures.yaml", text, command)


@fault(
    "dvc.lock cut", "the last twentieth of `dvc.lock` is cut off; `dvc repro`; `git restore dvc.lock` for the next run"
)
def cut_lock(checkout: Checkout) -> Row:
    text = (checkout.folder / "dvc.lock").read_text()
    row = _damage_and_restore(checkout, "dvc.lock", text[: len(text) * 19 // 20], ("dvc", "repro"), fails=False)
    row.message = row.message or "no message: stages that are missing in `dvc.lock` run again"
    return row


@fault(
    "git: index.lock left by a killed git",
    "`.git/index.lock` exists while `split` and later stages run; it is removed for the next run",
)
def index_lock(checkout: Checkout) -> Row:
    checkout.reset(address("split"), trainings=False)
    (checkout.folder / ".git/index.lock").touch()
    first = checkout.run("dvc", "repro")
    Path(checkout.folder / ".git/index.lock").unlink()
    row = judge(checkout, first, checkout.run("dvc", "repro"), may_run=[], finished=checkout.trainings(), fails=False)
    row.faults += [] if first.ran == [address("split")] else [f"ran {first.ran}"]
    row.message = row.message or "no message: no stage needs git's index"
    return row
