"""A checkout with finished stages, copies of it for faults, and what was said and kept there.

In: the last commit. Out: folders, commands run under a limit of time, outputs by stage. Refuses to know faults.
"""

import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil
from ruamel.yaml import YAML

from tests.repositories import git
from tests.stages.checkout import ROOT, variables

SCENE = "faults"
EXPERIMENTS = ("single_random", "transfer", "lobo", "triplet", "adapt", "baselines", "sensitivity", "audit")
PROTOCOLS = ("grid", "glass")  # those that these experiments need
SECTIONS = (
    "source",
    "seed",
    "selection",
    "train_single",
    "train_multi",
    "train_triplet",
    "adapt",
    "train_classical",
    "audit",
)
SPLIT = ("random_test_fraction", "random_repeats_n", "transfer_skins_n", "pool_passes_n")
LIMIT_S = 600.0  # what takes longer is a hang
TRACES = "Traceback (most recent call last)"


@dataclass(frozen=True)
class Said:
    """What a command said, how it ended (None: not within the limit), and how long it took."""

    status: int | None
    text: str
    seconds: float

    @property
    def ran(self) -> list[str]:
        """Name the stages that DVC ran."""
        return re.findall(r"^Running stage '([^']+)'", self.text, re.MULTILINE)


class Checkout:
    """A folder in which commands run, with its own code."""

    def __init__(self, folder: Path, said: Path | None = None, template: "Checkout | None" = None) -> None:
        self.folder = folder
        self.template = template or self  # the finished one that this is a copy of
        self._said = said or folder.with_suffix(".said")

    def start(self, *words: str, **environment: str) -> subprocess.Popen[bytes]:
        """Start a command in a group of its own; what it says goes into a file."""
        env = variables(self.folder, **environment)
        env["PATH"] = f"{self.folder / '.venv/bin'}{os.pathsep}{env['PATH']}"
        with self._said.open("wb") as said:
            return subprocess.Popen(
                words, cwd=self.folder, env=env, stdout=said, stderr=subprocess.STDOUT, start_new_session=True
            )

    def end(self, process: subprocess.Popen[bytes], start_s: float, limit_s: float = LIMIT_S) -> Said:
        """Wait for a command; end all of its group if it takes too long."""
        try:
            status: int | None = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            status = None
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        return Said(status, self.said(), time.monotonic() - start_s)

    def run(self, *words: str, limit_s: float = LIMIT_S, **environment: str) -> Said:
        """Run a command to its end."""
        start_s = time.monotonic()
        return self.end(self.start(*words, **environment), start_s, limit_s)

    def said(self) -> str:
        """Give what the last command has said so far, without the folder's name."""
        return self._said.read_text(errors="replace").replace(f"{self.folder}/", "")

    def stage(self, name: str, find_s: float = LIMIT_S) -> psutil.Process:
        """Wait until DVC has started a stage, and give its process."""
        command = ["-m", "pipeline", name]
        until_s = time.monotonic() + find_s
        while time.monotonic() < until_s:
            for process in psutil.process_iter(["cmdline"]):
                if (process.info["cmdline"] or [])[1:4] == command and _cwd(process) == self.folder:
                    return process
            time.sleep(0.05)
        raise AssertionError(f"stage {name} must start within {find_s:.0f} s:\n{self.said()[-2000:]}")

    def until(self, happened: Callable[[], bool], process: psutil.Process, limit_s: float = LIMIT_S) -> bool:
        """Wait until something has happened; False if the process ended before."""
        until_s = time.monotonic() + limit_s
        while not happened():
            if not alive(process) or time.monotonic() > until_s:
                return False
            time.sleep(0.01)
        return alive(process)

    def cells(self) -> dict[str, int]:
        """List finished trainings with the time at which each was written."""
        return {file.name: file.stat().st_mtime_ns for file in (self.folder / ".reskin/cells").glob("*.safetensors")}

    def lock(self) -> dict[str, dict[str, str]]:
        """Give from dvc.lock the hash of every output, by stage."""
        words = YAML(typ="safe").load((self.folder / "dvc.lock").read_text())
        return {
            stage: {out["path"]: out["md5"] for out in entry.get("outs", [])}
            for stage, entry in words["stages"].items()
        }

    def command(self, stage: str) -> list[str]:
        """Give the words of a stage's command, from dvc.lock."""
        entries = YAML(typ="safe").load((self.folder / "dvc.lock").read_text())["stages"].values()
        return next(entry["cmd"].split() for entry in entries if f" {stage} " in entry["cmd"])

    def forget(self, *names: str, cells: bool = True) -> None:
        """Let stages be yet to run: without entry, outputs and trainings."""
        file = self.folder / "dvc.lock"
        words = YAML().load(file.read_text())
        for name in names:
            for out in words["stages"].pop(name).get("outs", []):
                path = self.folder / out["path"]
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        with file.open("w") as stream:
            YAML().dump(words, stream)
        shutil.rmtree(self.folder / ".dvc/cache/runs", ignore_errors=True)  # of what ran since the template was made
        for cell in self.cells() if cells else ():
            (self.folder / ".reskin/cells" / cell).unlink()


def alive(process: psutil.Process) -> bool:
    """Tell whether a process runs; one that ended and nobody has asked about does not."""
    try:
        return process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def _cwd(process: psutil.Process) -> Path | None:
    try:
        return Path(process.cwd())
    except psutil.Error:
        return None


def make_template(folder: Path) -> tuple[Checkout, Said]:
    """Clone the last commit, and run the small scene there to its end."""
    subprocess.run(["git", "clone", "--quiet", "--shared", str(ROOT), str(folder)], check=True)
    (folder / ".venv").symlink_to(ROOT / ".venv")
    scenes = folder / "pipeline/scenes"
    with (scenes / f"{SCENE}.yaml").open("w") as stream:
        YAML().dump(small(YAML(typ="safe").load((scenes / "ci.yaml").read_text())), stream)
    (folder / "dvc.lock").unlink()
    at = Checkout(folder)
    for words in (["python", "-m", "pipeline", "scenes", "use", SCENE], ["dvc", "repro"]):
        done = at.run(*words, limit_s=6 * LIMIT_S)
        if done.status:
            raise AssertionError(f"{' '.join(words)} failed:\n{done.text[-3000:]}")
    git(folder, "add", "--all")
    git(folder, "commit", "--quiet", "--message", "finished")
    shutil.rmtree(folder / ".dvc/cache/runs")  # else DVC restores what a fault is to hit
    return at, done


def small(ci: dict) -> dict:
    """Take from scene ci what a few experiments need."""
    scene = {name: ci[name] for name in SECTIONS} | {"experiments": list(EXPERIMENTS)}
    scene["split"] = {name: ci["split"][name] for name in SPLIT}
    scene["simulate"] = {
        "boards": {"rigid": ci["simulate"]["boards"]["rigid"]},
        "protocols": {name: ci["simulate"]["protocols"][name] for name in PROTOCOLS},
    }
    return scene


def copy(template: Checkout, folder: Path) -> Checkout:
    """Copy a finished checkout; blocks are shared where the file system can."""
    subprocess.run(["cp", "-r", "--preserve=all", "--reflink=auto", str(template.folder), str(folder)], check=True)
    return Checkout(folder, template=template)


def sentence_of(said: Sequence[str] | str) -> str:
    """Pick the sentence that tells a user what went wrong: the stage's own, else DVC's."""
    lines = said.splitlines() if isinstance(said, str) else list(said)
    for start in ("error:", "warning:", "ERROR:", "WARNING:", "is invalid"):  # the last: DVC, of its own files
        found = [line for line in lines if line.startswith(start) or f" {start} " in f" {line}"]
        if found:
            return re.sub(r"(sh pipeline/run\.sh \w+).*?(, exited|$)", r"\1 …\2", found[0])
    return ""
