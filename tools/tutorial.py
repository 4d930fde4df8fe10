"""Run docs/tutorial.md: its commands in a copy of the checkout, in order, with their outputs.

`python -m tools.tutorial --write` runs all steps (about ten minutes) and replaces the outputs on the page.
tests.docs.test_tutorial.py runs the quick steps, or all of them with RESKIN_SLOW_TESTS=1, and compares the outputs.

A step is a block of code (sh or python). The block of text that follows is the output of the step. An HTML comment
before a step has options, separated by semicolons:

* `until TEXT`: run the step in the background; its output ends with the first line that contains TEXT
* `stop`: after that line, press Ctrl-C (only together with `until`)
* `from TEXT`: show only the lines from the last line that begins with TEXT
* `to TEXT`: after that line, show only the lines up to the first one that begins with TEXT
* `words`: compare only the words of the output, because trainings amplify the differences between recordings

Consecutive Python steps share their variables.
"""

import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from tests.stages.checkout import ROOT, copy_checkout, variables

PAGE = ROOT / "docs/tutorial.md"
CUT = "[...]"
STEP = re.compile(
    r"(?:<!-- (?P<options>[^>]*) -->\n)?```(?P<language>sh|python)\n(?P<code>.*?)```\n"
    r"(?:\n```text\n(?P<output>.*?)```\n)?",
    re.DOTALL,
)
LONG_S = 1800.0
# The port on the page. The tests use a free port instead, because several tests may run at the same time.
HTTP_PORT = "8765"
# Two numbers are equal if they differ by at most TOLERANCE plus TOLERANCE_PCT % of the number on the page. Outputs
# depend on times of arrival: a recording may begin at another frame, and the number of frames of a press varies by one.
TOLERANCE_PCT, TOLERANCE = 20.0, 0.1
NUMBER = re.compile(r"(?<![A-Za-z_])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
OPTIONAL = (  # patterns of parts of lines that are printed only if the machine is busy
    re.compile(r"; [a-z ]+(?:: [a-z ]+)? \(\d+, [\d.]+ s\)"),  # alarms
    re.compile(r"[,;] (?:skipped_|gap)\w+ \d+"),
    re.compile(r"; \d+ touches left out: [^;\n]*"),
    re.compile(r", \d+ (?:without a no-load dwell before them|out of order)"),
)
MARK = "\x1e"  # printed after each of several Python steps


@dataclass(frozen=True)
class Step:
    """A step of the page."""

    language: str
    code: str
    output: str | None  # None: the page shows no output
    options: dict[str, str] = field(default_factory=dict)


class Done(NamedTuple):
    """A step that was run, and what it printed."""

    step: Step
    output: str


def read_steps(text: str) -> list[Step]:
    return [_step(match) for match in STEP.finditer(text)]


def _step(match: re.Match[str]) -> Step:
    parts = [part.strip() for part in (match["options"] or "").split(";") if part.strip()]
    options = {name: value.strip() for name, _, value in (part.partition(" ") for part in parts)}
    return Step(match["language"], match["code"], match["output"], options)


def run(steps: Sequence[Step], folder: Path, say: Callable[[str], object] = lambda text: None) -> Iterator[Done]:
    """Run steps in a folder, a copy of the checkout; yield each with its output. Raises if a command fails."""
    with Shell(folder) as shell:
        i = 0
        while i < len(steps):
            same = [steps[i]]
            while steps[i].language == "python" and i + len(same) < len(steps):
                if steps[i + len(same)].language != "python":
                    break
                same.append(steps[i + len(same)])
            say(same[0].code.splitlines()[0])
            outputs = shell.run_python(same) if same[0].language == "python" else [shell.run(same[0])]
            for step, output in zip(same, outputs, strict=True):
                yield Done(step, shown(output, step, folder))
            i += len(same)


def shown(output: str, step: Step, folder: Path) -> str:
    """Return an output as the page shows it: with the page's folder and terminal, and shortened if the step says so."""
    output = re.sub(r"/dev/pts/\d+", "/dev/pts/3", output).replace(str(folder), "/home/me/reskin").replace("\r", "\n")
    lines = [line.rstrip() for line in output.splitlines() if line.strip()]
    if "from" in step.options:
        first = max(i for i, line in enumerate(lines) if line.startswith(step.options["from"]))
        lines = [CUT, *lines[first:]]
    if "to" in step.options:
        last = next(i for i, line in enumerate(lines) if i > 0 and line.startswith(step.options["to"]))
        lines = [*lines[: last + 1], CUT]
    return "".join(f"{line}\n" for line in lines)


class Shell:
    """Runs the steps of the page; at the end of the `with` block, ends the programs that run in the background."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._port = folder, str(_free_port())
        self._running: list[subprocess.Popen[str]] = []

    def __enter__(self) -> "Shell":
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._running:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.communicate()

    def run(self, step: Step) -> str:
        code = step.code.replace("reskin live", f"reskin live --http-port {self._port}")
        process = self._start("bash", "-ec", code)
        if "until" in step.options:
            output = _read_until(process, step.options["until"])
            if "stop" in step.options:
                os.killpg(process.pid, signal.SIGINT)
                process.communicate(timeout=LONG_S)
            return output.replace(self._port, HTTP_PORT)
        return _finish(process, step.code)

    def run_python(self, steps: Sequence[Step]) -> list[str]:
        code = f"print({MARK!r}, flush=True)\n".join(step.code for step in steps)
        return _finish(self._start(sys.executable, "-c", code), code).split(f"{MARK}\n")

    def _start(self, *command: str) -> subprocess.Popen[str]:
        environment = variables(self._folder, PYTHONUNBUFFERED="1")
        process = subprocess.Popen(
            command, cwd=self._folder, env=environment, text=True, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, start_new_session=True, preexec_fn=_restore_ctrl_c,
        )  # fmt: skip
        self._running.append(process)
        return process


def _finish(process: "subprocess.Popen[str]", code: str) -> str:
    output, _ = process.communicate(timeout=LONG_S)
    if process.returncode:
        raise AssertionError(f"{code}\nfailed with exit status {process.returncode}:\n{output[-3000:]}")
    return output


def _read_until(process: "subprocess.Popen[str]", text: str) -> str:
    """Read lines up to one that contains `text`; later lines are read and dropped by a thread."""
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        lines.append(line)
        if text in line:
            threading.Thread(target=process.stdout.read, daemon=True).start()
            return "".join(lines)
    raise AssertionError(f"no line with {text!r}:\n{''.join(lines)}")


def _restore_ctrl_c() -> None:
    """Let Ctrl-C end this process, even if a shell started the tests in the background, where Ctrl-C is ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def differences(done: Done) -> list[str]:
    """Compare the output of a step with the page; describe what differs."""
    step = done.step
    if step.output is None:
        return []
    expected, got = (_without_optional(text) for text in (step.output, done.output))
    if NUMBER.sub("#", expected) != NUMBER.sub("#", got):
        return [f"{step.code}printed\n{done.output}instead of\n{step.output}"]
    pairs = () if "words" in step.options else zip(NUMBER.findall(expected), NUMBER.findall(got), strict=True)
    return [
        f"{step.code}printed {b} instead of {a} (tolerance {TOLERANCE} + {TOLERANCE_PCT} %)\n{done.output}"
        for a, b in pairs
        if abs(float(a) - float(b)) > TOLERANCE + TOLERANCE_PCT / 100 * abs(float(a))
    ]


def _without_optional(text: str) -> str:
    for pattern in OPTIONAL:
        text = pattern.sub("", text)
    return re.sub(r" +", " ", re.sub(r"-{2,}", "--", text))  # the widths of tables depend on their numbers


def write(text: str, done: Sequence[Done]) -> str:
    """Return the page with new outputs of its steps; steps without an output on the page do not get one."""
    outputs = iter(done)

    def replace_output(match: re.Match[str]) -> str:
        output = next(outputs).output
        if match["output"] is None:
            return match[0]
        return (
            match[0][: match.start("output") - match.start()] + output + match[0][match.end("output") - match.start() :]
        )

    return STEP.sub(replace_output, text)


@contextmanager
def checkout_copy() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        yield copy_checkout(Path(folder).resolve() / "reskin")


def main() -> None:
    if sys.argv[1:] != ["--write"]:
        sys.exit("usage: python -m tools.tutorial --write")
    text = PAGE.read_text(encoding="utf-8")
    with checkout_copy() as folder:
        done = list(run(read_steps(text), folder, say=print))
    PAGE.write_text(write(text, done), encoding="utf-8")


if __name__ == "__main__":
    main()
