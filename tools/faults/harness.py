"""Copies of a finished checkout, into which faults are injected, and checks of what each fault causes."""

import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
from ruamel.yaml import YAML

from tests.repositories import git
from tests.stages.checkout import ROOT, variables

SCENE = "faults"
EXPERIMENTS = ("single_random", "transfer", "lobo", "triplet", "adapt", "sensitivity", "audit")
PROTOCOLS = ("grid", "glass")  # protocols that the experiments above need
SECTIONS = (
    "source", "seed", "selection", "train_single", "train_multi", "train_triplet", "adapt", "audit",
)  # fmt: skip
SPLIT = ("random_test_fraction", "random_repeats_n", "transfer_skins_n", "pool_passes_n")
LIMIT_S = 600.0  # a command that takes longer counts as hanging
TRACES = "Traceback (most recent call last)"


@dataclass(frozen=True)
class Result:
    """Exit status of a command (None if it was killed at the time limit), output, and duration in s."""

    status: int | None
    output: str
    seconds: float

    @property
    def ran(self) -> list[str]:
        """Return the names of the stages that DVC ran."""
        return re.findall(r"^Running stage '([^']+)'", self.output, re.MULTILINE)


class Checkout:
    """A copy of the repository, in which commands run with the copy's code."""

    def __init__(self, folder: Path, output: Path | None = None, template: "Checkout | None" = None) -> None:
        self.folder = folder
        self.template = template or self  # the finished checkout from which this one was copied
        self._output = output or folder.with_suffix(".output")

    def start(self, *arguments: str, **environment: str) -> subprocess.Popen[bytes]:
        """Start a command in a new process group; its output is written to a file."""
        env = variables(self.folder, **environment)
        with self._output.open("wb") as output:
            return subprocess.Popen(
                arguments, cwd=self.folder, env=env, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
            )

    def end(self, process: subprocess.Popen[bytes], start_s: float, limit_s: float = LIMIT_S) -> Result:
        """Wait for a command to end; at the time limit, kill the process group."""
        try:
            status: int | None = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            status = None
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        return Result(status, self.output(), time.monotonic() - start_s)

    def run(self, *arguments: str, limit_s: float = LIMIT_S, **environment: str) -> Result:
        """Run a command; return its result."""
        start_s = time.monotonic()
        return self.end(self.start(*arguments, **environment), start_s, limit_s)

    def output(self) -> str:
        """Return the output so far of the last command; the name of the checkout's folder is removed."""
        return self._output.read_text(errors="replace").replace(f"{self.folder}/", "")

    def stage(self, name: str, find_s: float = LIMIT_S) -> psutil.Process:
        """Wait until DVC has started a stage; return the process of the stage."""
        command = ["-m", "pipeline", name]
        until_s = time.monotonic() + find_s
        while time.monotonic() < until_s:
            for process in psutil.process_iter(["cmdline"]):
                if (process.info["cmdline"] or [])[1:4] == command and _cwd(process) == self.folder:
                    return process
            time.sleep(0.05)
        raise AssertionError(f"stage {name} did not start within {find_s:.0f} s:\n{self.output()[-2000:]}")

    def until(self, condition: Callable[[], bool], process: psutil.Process, limit_s: float = LIMIT_S) -> bool:
        """Wait until `condition` returns true; return False if the process ends or the time limit is reached first."""
        until_s = time.monotonic() + limit_s
        while not condition():
            if not alive(process) or time.monotonic() > until_s:
                return False
            time.sleep(0.01)
        return alive(process)

    def trainings(self) -> dict[str, int]:
        """Return the modification time (ns) of the result file of each finished training run, by file name."""
        return {file.name: file.stat().st_mtime_ns for file in (self.folder / ".reskin/cells").glob("*.safetensors")}

    def lock(self) -> dict[str, dict[str, str]]:
        """Return the hashes in dvc.lock: the hash of each output, by stage and path."""
        lock = YAML(typ="safe").load((self.folder / "dvc.lock").read_text())
        return {
            stage: {out["path"]: out["md5"] for out in entry.get("outs", [])} for stage, entry in lock["stages"].items()
        }

    def command(self, stage: str) -> list[str]:
        """Return the command of a stage, from dvc.lock."""
        entries = YAML(typ="safe").load((self.folder / "dvc.lock").read_text())["stages"].values()
        return next(entry["cmd"].split() for entry in entries if f" {stage} " in entry["cmd"])

    def reset(self, *names: str, trainings: bool = True) -> None:
        """Remove entries in dvc.lock, outputs and cached training runs of these stages, so that they run again."""
        file = self.folder / "dvc.lock"
        lock = YAML().load(file.read_text())
        for name in names:
            for out in lock["stages"].pop(name).get("outs", []):
                path = self.folder / out["path"]
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        with file.open("w") as stream:
            YAML().dump(lock, stream)
        shutil.rmtree(self.folder / ".dvc/cache/runs", ignore_errors=True)  # DVC's run cache would restore the outputs
        for name in self.trainings() if trainings else ():
            (self.folder / ".reskin/cells" / name).unlink()


def alive(process: psutil.Process) -> bool:
    """Return whether a process is running (not a zombie)."""
    try:
        return process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def _cwd(process: psutil.Process) -> Path | None:
    try:
        return Path(process.cwd())
    except psutil.Error:
        return None


def make_template(folder: Path) -> tuple[Checkout, Result]:
    """Clone the last commit and run the small scene; return the clone and the result of `dvc repro`."""
    subprocess.run(["git", "clone", "--quiet", "--shared", str(ROOT), str(folder)], check=True)
    scenes = folder / "pipeline/scenes"
    with (scenes / f"{SCENE}.yaml").open("w") as stream:
        YAML().dump(small_scene(YAML(typ="safe").load((scenes / "ci.yaml").read_text())), stream)
    (folder / "dvc.lock").unlink()
    checkout = Checkout(folder)
    for command in (["python", "-m", "pipeline", "scenes", "use", SCENE], ["dvc", "repro"]):
        done = checkout.run(*command, limit_s=6 * LIMIT_S)
        if done.status:
            raise AssertionError(f"{' '.join(command)} failed:\n{done.output[-3000:]}")
    git(folder, "add", "--all")
    git(folder, "commit", "--quiet", "--message", "finished")
    shutil.rmtree(folder / ".dvc/cache/runs")  # otherwise, DVC would restore the files that a fault damages
    return checkout, done


def small_scene(ci: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of scene ci, reduced to a few experiments."""
    scene = {name: ci[name] for name in SECTIONS} | {"experiments": list(EXPERIMENTS)}
    scene["split"] = {name: ci["split"][name] for name in SPLIT}
    scene["simulate"] = {
        "boards": {"rigid": ci["simulate"]["boards"]["rigid"]},
        "protocols": {name: ci["simulate"]["protocols"][name] for name in PROTOCOLS},
    }
    return scene


def copy(template: Checkout, folder: Path) -> Checkout:
    """Copy a checkout to another folder."""
    subprocess.run(["cp", "-r", "--preserve=all", "--reflink=auto", str(template.folder), str(folder)], check=True)
    return Checkout(folder, template=template)


def message_of(output: Sequence[str] | str) -> str:
    """Return the error message in a command's output: the message of the stage if there is one, else that of DVC."""
    # An error follows a progress bar without a new line.
    lines = re.sub(r"\d+%\|.*?\]", "\n", output).splitlines() if isinstance(output, str) else list(output)
    # DVC reports its own damaged files with the words "is invalid".
    for start in ("error:", "warning:", "ERROR:", "WARNING:", "is invalid"):
        found = [line for line in lines if line.startswith(start) or f" {start} " in f" {line}"]
        if found:
            return re.sub(r"(sh pipeline/run\.sh \w+).*?(, exited|$)", r"\1 …\2", found[0])
    return ""


ROOTS = (tempfile.gettempdir(), str(ROOT.parent), "/var")  # the table shortens these paths of this machine
TITLES = (
    "fault",
    "how it is injected",
    "what the user sees",
    "exit status",
    "lost work",
    "the next run",
    "s",
    "verdict",
)


@dataclass
class Row:
    """The outcome of a fault; `known` explains a shortcoming that is accepted."""

    message: str
    status: int | None
    lost: str
    next_run: str
    faults: list[str] = field(default_factory=list)
    known: str = ""


Case = Callable[[Checkout], Row]
NOT_RUN = Result(0, "", 0.0)
CASES: dict[str, tuple[str, Case]] = {}  # name of each fault: its description, and the function that injects it


def fault(name: str, how: str) -> Callable[[Case], Case]:
    """Return a decorator that adds a function as the fault `name`; `how` describes the injection."""

    def add(case: Case) -> Case:
        CASES[name] = (how, case)
        return case

    return add


def judge(
    checkout: Checkout, first: Result, again: Result, *, may_run: Iterable[str] | None = None,
    finished: dict[str, int] | None = None, fails: bool = True,
) -> Row:  # fmt: skip
    """Judge a fault by comparing the run with the fault, and the run after it, with an undisturbed run.

    first, again: results of the two runs. may_run: stages that the second run may run (None: any). finished: training
    runs that finished before the second run. fails: whether the first run must fail.
    """
    after, undisturbed, reused = checkout.lock(), checkout.template.lock(), _whole(finished or {}, checkout.trainings())
    torn_n = len(finished or {}) - len(reused)
    trained = sum(written != reused.get(name) for name, written in checkout.trainings().items())
    again_trained = [
        name for name, written in checkout.trainings().items() if name in reused and written != reused[name]
    ]
    different = [stage for stage in undisturbed if after.get(stage) != undisturbed[stage]]
    unexpected = sorted(set(again.ran) - set(may_run)) if may_run is not None else []
    checks = {
        "a command prints a traceback": TRACES in first.output + again.output,
        "a command reaches the time limit": first.status is None or again.status is None,
        "the run with the fault does not fail": fails and first.status == 0,
        # a negative status means a killed process, which prints nothing
        "the failed run prints no message": (first.status or 0) > 0 and not message_of(first.output),
        f"the next run fails: {message_of(again.output)}": again.status not in (0, None),
        f"the results of these stages differ: {', '.join(different)}": bool(different),
        f"finished stages ran again: {', '.join(unexpected)}": bool(unexpected),
        f"{len(again_trained)} finished training runs repeated": bool(again_trained),
    }
    next_run = f"ran {', '.join(stage.partition('@')[0] for stage in again.ran) or 'no stage'}"
    if finished is not None:
        next_run += f"; {len(reused)} training runs reused, {trained} computed"
    next_run += "" if different else "; results equal byte for byte"
    faults = [fault for fault, is_true in checks.items() if is_true]
    lost = f"{torn_n} training runs of a stack whose files were being written" if torn_n else "no finished work"
    return Row(message_of(first.output), first.status, lost, next_run, faults)


def _whole(trainings: dict[str, int], later: dict[str, int]) -> dict[str, int]:
    """Return only the training runs of stacks that were written completely; the runs of a stack finish together."""
    members = [Counter(name.rpartition("-")[0] for name in runs) for runs in (trainings, later)]
    whole = {stack for stack, files_n in members[0].items() if members[1][stack] == files_n}
    return {name: written for name, written in trainings.items() if name.rpartition("-")[0] in whole}


def line(name: str, how: str, row: Row, seconds: float) -> str:
    """Format the outcome of a fault as a row of the Markdown table."""
    status = "hang" if row.status is None else str(row.status)
    verdict = "green" if not row.faults else f"red: {'; '.join(row.faults)}"
    if row.known:
        verdict += f". {row.known}"
    message = f"“{_plain(row.message)}”" if row.message else "–"
    cells = (name, how, message, status, row.lost, row.next_run, f"{seconds:.0f}", verdict)
    return "| " + " | ".join(_plain(cell) for cell in cells) + " |"


def not_run(name: str, how: str) -> str:
    """Format the Markdown row of a fault that has not been injected yet."""
    return f"| {_plain(name)} | {_plain(how)} |{' – |' * 5} not run yet |"


def _plain(text: str) -> str:
    return (
        re.sub(rf"(?<!\w)({'|'.join(map(re.escape, ROOTS))})\S*/", "…/", " ".join(text.split()))
        .replace("|", "\\|")
        .replace("<", "&lt;")
    )


def table(lines: Sequence[str]) -> str:
    """Return the Markdown table with these rows."""
    return "\n".join(["| " + " | ".join(TITLES) + " |", "|" + "---|" * len(TITLES), *lines]) + "\n"
