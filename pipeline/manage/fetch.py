"""Fetch public recordings from a git repository at a commit or a folder, check them, and add them to their scene."""

import os
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Annotated

from pydantic import AfterValidator, Field

from pipeline import PLAN
from pipeline.manage import add
from pipeline.manage.registry import read_registry
from pipeline.scenes import read_plan
from reskin import io
from reskin.config import Strict, parse, read_yaml
from reskin.errors import CaptureError, ParamsError
from reskin.recordings import ReaderLayout, preparing
from reskin.recordings.header import HEADER_FILE
from reskin.recordings.ingest import read_header
from reskin.recordings.pickled import to_lab_csv
from reskin.recordings.preparing import Labels, Prepared

OTHERS = "--from takes a git mirror, or a folder of the files."
OPTIONS = ("http.lowSpeedLimit=1000", "http.lowSpeedTime=60")  # no wait for a line that is dead
# No question for a password, which nobody would see.
SILENT = {"GIT_TERMINAL_PROMPT": "0", "GIT_ASKPASS": "true", "GIT_SSH_COMMAND": "ssh -oBatchMode=yes"}


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
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, check=True, env={**os.environ, **SILENT}
        )
        return done.stdout
    except FileNotFoundError:
        remedy = "Install git, or give a folder of the files with --from."
        raise CaptureError("git", "the program", "installed", "none", remedy) from None


def _reason(error: subprocess.CalledProcessError) -> str:
    lines = [line for line in error.stderr.decode(errors="replace").splitlines() if line.strip()]
    lines = [line for line in lines if line.startswith("fatal:")] or lines[-1:]
    return lines[0].rstrip(". ")[:300] if lines else f"exit status {error.returncode} of git"


SOURCES = "pipeline/fetch.yaml"
FETCHED = "data/fetched"
COPIES_N = 4  # of each byte on disk: as fetched, in data/raw, in DVC's cache, and one in reserve
Say = Callable[[str], None]


def _below(path: str) -> str:
    if Path(path).is_absolute() or ".." in Path(path).parts:
        raise ValueError("a path below the folder of its source")
    return path


Below = Annotated[str, AfterValidator(_below)]


class File(Strict):
    """One file: where it lies at home, where it lands here, and what it then must be."""

    path: Below
    at: str
    bytes_n: Annotated[int, Field(gt=0)]
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Recording(Strict):
    """How fetched files are added: the words of `reskin add`."""

    path: Below
    layout: ReaderLayout
    board: str
    skin: str
    options: dict[str, str]


class Source(Strict):
    """One public set of recordings; without a scene it is fetched and not added, and the note says why."""

    home: str
    commit: Annotated[str, Field(pattern=r"^[0-9a-f]{40}$")] | None
    licence: str | None
    scene: str | None
    note: str | None
    files: Annotated[tuple[File, ...], Field(min_length=1)]
    recordings: tuple[Recording, ...]

    @property
    def size(self) -> str:
        return f"{len(self.files)} files, {sum(file.bytes_n for file in self.files) / 1e6:.1f} MB"

    @property
    def terms(self) -> str:
        return self.licence or "none (use it here, do not pass it on)"


def read_sources(root: Path) -> Mapping[str, Source]:
    """Read `pipeline/fetch.yaml`."""
    where = root / SOURCES
    return {name: parse(Source, words, f"{where}: {name}") for name, words in read_yaml(where).items()}


def fetch(root: Path, name: str | None, where: str | None, *, agree: Callable[[str], bool], say: Say) -> None:
    """Fetch a source from its home or from elsewhere, add its recordings, say which scene to run; None: list all."""
    sources = read_sources(root)
    if name is None:
        return say("\n".join(_summary(name, source) for name, source in sources.items()))
    if name not in sources:
        raise ParamsError("reskin fetch", "a source", f"one of {', '.join(sources)}", name, f"{SOURCES} lists them.")
    source, folder, running = sources[name], root / FETCHED / name, read_plan(root / PLAN).scenes
    if all(_is_there(folder / file.path, file) for file in source.files):
        say(f"{folder}: {source.size}, there already and unchanged")
    else:
        _show(name, source, where, say)
        if source.licence is None and not agree("It has no licence. Fetch it, for use here only?"):
            remedy = "Nothing was fetched. Answer y on a terminal, or add --yes."
            raise ParamsError(f"reskin fetch {name}", "use without a licence", "agreed to", "no yes", remedy)
        bring(source, where or source.home, folder)
        say(f"{folder}: {source.size}, every checksum as it must be")
    if source.scene is None:
        return say(source.note or "no layout reads it, so nothing is added")
    _add_all(root, source.scene, source, folder, say)
    _say_what_runs(root, source.scene, running, say)


def bring(source: Source, where: str, folder: Path) -> None:
    """Read the files of a source, check each, and put them in a folder in place of what it held; all, or nothing."""
    with _naming_the_disk(folder), io.replacing(folder) as temporary:
        _check_space(source, folder.parent)
        with TemporaryDirectory(prefix=".git-", dir=folder.parent) as scratch:
            origin = open_origin(where, source.commit, Path(scratch))
            for file in source.files:
                target = temporary / file.path
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(_content(origin, file))


def _content(origin: Origin, file: File) -> bytes:
    found = file.at if file.at in origin.paths else origin.find(file.path) or origin.find(file.at)
    if found is None:
        remedy = f"Is it the right place? {OTHERS}"
        raise CaptureError(origin.name, "a file", f"{file.at} or {file.path}", "none of that name", remedy)
    content, name = origin.read(found), f"{origin.name} {found}"
    if found.endswith(".npz"):
        content, name = to_lab_csv(content, name), f"{name} as CSV"
    digest = sha256(content).hexdigest()
    if digest != file.sha256:
        rule, got = f"{file.sha256} ({file.bytes_n} bytes)", f"{digest} ({len(content)} bytes)"
        remedy = f"It was changed or cut, or is another of that name; nothing was kept. Run it again; {OTHERS}"
        raise CaptureError(name, "sha256", rule, got, remedy)
    return content


def _summary(name: str, source: Source) -> str:
    return f"{name}: {source.size}; licence {source.terms}; {source.home}; scene {source.scene or 'none'}"


def _is_there(path: Path, file: File) -> bool:
    return path.is_file() and path.stat().st_size == file.bytes_n and io.sha256(path) == file.sha256


def _show(name: str, source: Source, where: str | None, say: Say) -> None:
    commit = f"commit {source.commit}" if source.commit else "newest commit (none is pinned: checksums alone tell)"
    say(f"{name}: {source.size}; licence: {source.terms}")
    say(f"home: {source.home}, {commit}")
    if where is not None:
        say(f"taken from: {where}")


def _check_space(source: Source, folder: Path) -> None:
    needed, free = COPIES_N * sum(file.bytes_n for file in source.files), shutil.disk_usage(folder).free
    if free < needed:
        rule, got = f"free by {needed / 1e6:.0f} MB or more", f"{free / 1e6:.0f} MB"
        raise CaptureError(folder.absolute(), "its disk", rule, got, "Make room, and run it again.")


@contextmanager
def _naming_the_disk(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        got = f"{error.strerror or error} at {error.filename or folder}"
        raise CaptureError(folder, "the folder", "writable", got, "Make room, or mend its rights.") from None


def _add_all(root: Path, scene: str, source: Source, folder: Path, say: Say) -> None:
    """Add each recording that its scene does not hold; what was added stays, should a later one fail."""
    done_n = 0
    try:
        for recording in source.recordings:
            labels = Labels(recording.board, recording.skin, None)
            prepared = preparing.foreign(folder / recording.path, recording.layout, labels, recording.options)
            if twin := _added_as(root, scene, prepared):
                say(f"{scene}/{twin}: added already")
            else:
                header = add.add(root, scene, prepared, allow_copy=False)
                say(f"added {scene}/{header.capture} (board {header.board}, skin {header.skin})")
            done_n += 1
    except BaseException:
        say(
            f"{done_n} of {len(source.recordings)} recordings are in scene {scene}; the same command goes on from there"
        )
        raise


def _added_as(root: Path, scene: str, prepared: Prepared) -> str | None:
    """Find the capture of a scene that holds the same files, or has the same name while its files are away."""
    header, files = prepared
    hashes = {name: sha256(io.read_bytes(file) if isinstance(file, Path) else file) for name, file in files.items()}
    for capture in read_registry(root).captures.get(scene, {}):
        raw = root / add.RAW / scene / capture
        if not (raw / HEADER_FILE).is_file():
            if capture == header.capture:
                return capture
        elif read_header(raw).files == {name: hashed.hexdigest() for name, hashed in hashes.items()}:
            return capture
    return None


def _say_what_runs(root: Path, scene: str, before: Mapping[str, object], say: Say) -> None:
    running = list(read_plan(root / PLAN).scenes)
    if scene not in running:
        return say(f"scene {scene} is switched off; now: reskin scenes use {' '.join([*running, scene])}; dvc repro")
    if scene not in before:
        say(f"switched scene {scene} on in {PLAN}, beside {', '.join(before) or 'no other'}")
    say(f"now: dvc repro (runs {', '.join(running)}; only this one: reskin scenes use {scene})")
    say(f"then: reports/{scene}/index.html, and beside the other scenes in reports/index.html")
