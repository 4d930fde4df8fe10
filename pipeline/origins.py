"""Where recordings are fetched from: a git repository at a commit, or a folder -> the paths there, and bytes by path.

Git takes the commit's tree and then only the files that are read: a partial clone without a working tree, so no filter
and no line end changes a byte. Refuses to know which files are wanted and which bytes are right (`fetching`).
"""

import re
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from pipeline.core import io
from pipeline.core.errors import CaptureError

OTHERS = "--from takes a git mirror, or a folder of the files."
# No question for a password, which nobody would see, and no wait for a line that is dead.
OPTIONS = ("core.askPass=true", "http.lowSpeedLimit=1000", "http.lowSpeedTime=60")


@dataclass(frozen=True)
class Origin:
    """A place with files."""

    name: str
    paths: Sequence[str]
    read: Callable[[str], bytes]

    def find(self, wanted: str) -> str | None:
        """Give the path that ends most like the one wanted, file name included; None if there is none."""
        parts = PurePosixPath(wanted).parts
        common = {path: _common_tail(PurePosixPath(path).parts, parts) for path in self.paths}
        found = sorted((path for path in self.paths if common[path]), key=lambda path: (-common[path], len(path), path))
        return found[0] if found else None


def open_origin(where: str, commit: str | None, scratch: Path) -> Origin:
    """Open a folder, or a git repository at a commit (None: its newest); `scratch` is an empty folder for git."""
    folder = Path(where)
    if not folder.exists() and not re.search(r"^[^/]{2,}:", where):  # neither a path nor URL nor host:path
        raise CaptureError(where, "the mirror or folder", "there", "nothing", f"Check the path; {OTHERS}")
    if folder.is_dir() and not _is_repository(folder):
        paths = [path.relative_to(folder).as_posix() for path in sorted(folder.rglob("*")) if path.is_file()]
        return Origin(where, paths, lambda path: io.read_bytes(folder / path))
    return _open_repository(str(folder.resolve()) if folder.exists() else where, commit, scratch)


def _common_tail(path: Sequence[str], wanted: Sequence[str]) -> int:
    same = [mine == theirs for mine, theirs in zip(reversed(path), reversed(wanted), strict=False)]
    return same.index(False) if False in same else len(same)


def _is_repository(folder: Path) -> bool:
    return (folder / ".git").exists() or ((folder / "HEAD").is_file() and (folder / "objects").is_dir())


def _open_repository(url: str, commit: str | None, scratch: Path) -> Origin:
    lean, whole = scratch / "lean", scratch / "whole"
    try:
        newest = _git(_empty(lean, url), "ls-remote", "origin", "HEAD").split()
    except subprocess.CalledProcessError as error:
        remedy = f"Check the network and the address; {OTHERS}"
        raise CaptureError(url, "the repository", "there and readable", _reason(error), remedy) from None
    commit = commit or (newest[0].decode() if newest else "HEAD")
    try:
        _git(lean, "fetch", "--quiet", "--filter=blob:none", "--depth=1", "origin", commit)
        taken = lean
    except subprocess.CalledProcessError:
        taken = _fetch_whole(_empty(whole, url), url, commit)
    listed = _git(taken, "ls-tree", "-r", "-z", "--name-only", commit).decode(errors="replace")
    return Origin(f"{url} @{commit[:12]}", listed.split("\0")[:-1], lambda path: _read(taken, url, commit, path))


def _empty(repository: Path, url: str) -> Path:
    _git(repository, "init", "--quiet", "--bare")
    _git(repository, "config", "remote.origin.url", url)
    return repository


def _fetch_whole(repository: Path, url: str, commit: str) -> Path:
    """Take all branches and tags, from a server that gives no commit by its hash.

    With all files: a partial clone of a history that is cut off would look for the missing commits without end.
    """
    try:
        _git(repository, "fetch", "--quiet", "origin", "+refs/heads/*:refs/heads/*", "+refs/tags/*:refs/tags/*")
        _git(repository, "cat-file", "-e", f"{commit}^{{commit}}")
    except subprocess.CalledProcessError as error:
        remedy = f"Was its history rewritten, or is it a clone made with --depth? {OTHERS}"
        rule, got = f"{commit}, at which the files are pinned", f"a repository without it ({_reason(error)})"
        raise CaptureError(url, "the commit", rule, got, remedy) from None
    return repository


def _read(scratch: Path, url: str, commit: str, path: str) -> bytes:
    try:
        return _git(scratch, "cat-file", "blob", f"{commit}:{path}")
    except subprocess.CalledProcessError as error:
        remedy = f"Run it again; {OTHERS}"
        raise CaptureError(f"{url} {path}", "the file", "readable", _reason(error), remedy) from None


def _git(repository: Path, *words: str) -> bytes:
    options = [word for option in OPTIONS for word in ("-c", option)]
    command = ["git", "--git-dir", str(repository), *options, *words]
    try:
        return subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=True).stdout
    except FileNotFoundError:
        remedy = "Install git, or give a folder of the files with --from."
        raise CaptureError("git", "the program", "installed", "none", remedy) from None


def _reason(error: subprocess.CalledProcessError) -> str:
    lines = [line for line in error.stderr.decode(errors="replace").splitlines() if line.strip()]
    lines = [line for line in lines if line.startswith("fatal:")] or lines[-1:]
    return lines[0].rstrip(". ")[:300] if lines else f"exit status {error.returncode} of git"
