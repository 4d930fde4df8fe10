"""Fetch public recordings from a git repository or a folder, check them, and add them to a scene.

`pipeline/fetch.yaml` lists the public recordings. If the server of a git repository supports it, only the needed commit
and files are transferred.
"""

import os
import re
import shutil
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Annotated

from pydantic import AfterValidator, Field

from pipeline import PLAN
from pipeline.manage import add
from pipeline.manage.registry import read_registry
from pipeline.plan import read_plan
from reskin import io
from reskin.config import Strict, parse, read_yaml
from reskin.errors import CaptureError, ParamsError
from reskin.recordings import ReaderLayout, preparing
from reskin.recordings.header import HEADER_FILE
from reskin.recordings.ingest import read_header
from reskin.recordings.pickled import to_lab_csv
from reskin.recordings.preparing import CaptureNames, Prepared

SOURCES = "pipeline/fetch.yaml"
FETCHED = "data/fetched"
# The free disk space must suffice for this many copies of each file. Three copies are written: the fetched file, and
# copies in data/raw and in DVC's cache. The fourth is a reserve.
COPIES_N = 4
USE_FROM = "to take the files from another place, name a git mirror or a folder with option --from."
PART = "pad"  # option of layout leaphand, whose files contain several captures; it selects one of them
Say = Callable[[str], None]


def _check_relative(path: str) -> str:
    if Path(path).is_absolute() or ".." in Path(path).parts:
        raise ValueError("a path below the folder of its source")
    return path


RelativePath = Annotated[str, AfterValidator(_check_relative)]
Commit = Annotated[str, Field(pattern=r"^[0-9a-f]{40}$")]


class File(Strict):
    """A file to fetch.

    - path: path to which the file is written, below the folder of its source.
    - at: path of the file in the repository.
    - commit: the commit from which the file is taken, if this is not the commit of the source.
    - bytes_n, sha256: size and hash of the written file.
    """

    path: RelativePath
    at: str
    commit: Commit | None = None
    bytes_n: Annotated[int, Field(gt=0)]
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Recording(Strict):
    """A recording in the fetched files, with the options of `reskin add` for it."""

    path: RelativePath
    layout: ReaderLayout
    board: str
    skin: str
    options: dict[str, str]


class Source(Strict):
    """A public set of recordings.

    - home: public address of the files.
    - commit: commit of the git repository from which the files are taken; None for the newest commit.
    - licence: licence of the files; None if they have no licence.
    - scene: scene to which the recordings are added; None if they are only fetched.
    - note: the reason why the recordings are not added, if `scene` is None.
    """

    home: str
    commit: Commit | None
    licence: str | None
    scene: str | None
    note: str | None
    files: Annotated[tuple[File, ...], Field(min_length=1)]
    recordings: tuple[Recording, ...]

    def commit_of(self, file: File) -> str | None:
        """Return the commit at which a file is pinned; None if no commit is pinned."""
        return file.commit or self.commit

    @property
    def commits(self) -> str:
        """The commits from which the files are taken, as words for a message."""
        pinned = sorted({commit for file in self.files if (commit := self.commit_of(file))})
        unpinned = "newest commit (pipeline/fetch.yaml names no commit; checksums of the files are checked)"
        return f"commit{'s' * (len(pinned) > 1)} {', '.join(pinned)}" if pinned else unpinned

    @property
    def size(self) -> str:
        return f"{len(self.files)} files, {sum(file.bytes_n for file in self.files) / 1e6:.1f} MB"

    @property
    def terms(self) -> str:
        return self.licence or "none (you may not pass the files on)"


def read_sources(root: Path) -> Mapping[str, Source]:
    """Read `pipeline/fetch.yaml`."""
    where = root / SOURCES
    return {name: parse(Source, section, f"{where}: {name}") for name, section in read_yaml(where).items()}


def fetch(
    root: Path, name: str | None, where: str | None, scene: str | None = None, *, agree: Callable[[str], bool], say: Say
) -> None:
    """Fetch a source and add its recordings to a scene; without a name, list the sources.

    Parameters
    ----------
    where : git repository or folder from which to take the files, instead of the source's home.
    scene : scene to which the recordings are added; None: the scene of the source.
    agree : function that asks the user a yes-or-no question, here whether to use files without a licence.
    """
    sources = read_sources(root)
    if name is None:
        return say("\n".join(
            f"{name}: {source.size}; licence {source.terms}; {source.home}; scene {source.scene or 'none'}"
            for name, source in sources.items()
        ))  # fmt: skip
    if name not in sources:
        raise ParamsError("reskin fetch", "a source", f"one of {', '.join(sources)}", name, f"{SOURCES} lists them.")
    source, folder, running = sources[name], root / FETCHED / name, read_plan(root / PLAN).scenes
    if all(_is_unchanged(folder / file.path, file) for file in source.files):
        say(f"{folder}: {source.size}, already present and unchanged")
    else:
        say(f"{name}: {source.size}; licence: {source.terms}\nhome: {source.home}, {source.commits}")
        if where is not None:
            say(f"taken from: {where}")
        if source.licence is None and not agree("These files have no licence. Fetch them for your own use only?"):
            remedy = "Nothing was fetched. Answer y on a terminal, or add --yes."
            raise ParamsError(f"reskin fetch {name}: the use of files without a licence was not confirmed. {remedy}")
        download(source, where or source.home, folder)
        say(f"{folder}: {source.size}, all checksums match")
    scene = scene or source.scene
    if scene is None or not source.recordings:
        return say(
            source.note or "`reskin add` cannot read the format of these files, so they were not added to a scene"
        )
    _add_all(root, scene, source, folder, say)
    _say_what_runs(root, scene, running, say)


def _is_unchanged(path: Path, file: File) -> bool:
    return path.is_file() and path.stat().st_size == file.bytes_n and io.sha256(path) == file.sha256


def download(source: Source, where: str, folder: Path) -> None:
    """Read and check the files of a source, then replace the content of `folder` with them.

    If a file cannot be read or fails its check, the folder is not changed.
    """
    try:
        with io.replacing(folder) as temporary:
            needed_B = COPIES_N * sum(file.bytes_n for file in source.files)
            free_B = shutil.disk_usage(folder.parent).free
            if free_B < needed_B:
                what = f"needs {needed_B / 1e6:.0f} MB of free disk space; {free_B / 1e6:.0f} MB are free"
                raise CaptureError(
                    f"{folder.parent.absolute()}: {what}. Free some disk space, and run the command again."
                )
            with TemporaryDirectory(prefix=".git-", dir=folder.parent) as scratch:
                origins: dict[str | None, Origin] = {}
                for file in source.files:
                    commit = source.commit_of(file)
                    if commit not in origins:
                        origins[commit] = open_origin(where, commit, Path(scratch) / str(len(origins)))
                    target = temporary / file.path
                    target.parent.mkdir(parents=True, exist_ok=True)
                    target.write_bytes(_read_checked(origins[commit], file))
    except OSError as error:
        reason = f"{error.strerror or error} at {error.filename or folder}"
        raise CaptureError(
            f"{folder}: cannot write the files: {reason}. Free some disk space, or check the permissions of the folder."
        ) from None


def _read_checked(origin: "Origin", file: File) -> bytes:
    """Read a file, convert an archive of pickled samples to CSV, and check the hash of the result."""
    path = file.at if file.at in origin.paths else origin.find(file.path) or origin.find(file.at)
    if path is None:
        remedy = f"Check whether this is the right source; {USE_FROM}"
        raise CaptureError(f"{origin.name}: no file {file.at} or {file.path}. {remedy}")
    content, name = origin.read(path), f"{origin.name} {path}"
    if path.endswith(".npz"):
        content, name = to_lab_csv(content, name), f"{name} as CSV"
    digest = sha256(content).hexdigest()
    if digest != file.sha256:
        rule, got = f"{file.sha256} ({file.bytes_n} bytes)", f"{digest} ({len(content)} bytes)"
        problem = "The file was changed or truncated, or it is another file with the same name. Nothing was kept."
        remedy = f"{problem} Run the command again; {USE_FROM}"
        raise CaptureError(name, "sha256", rule, got, remedy)
    return content


def _add_all(root: Path, scene: str, source: Source, folder: Path, say: Say) -> None:
    """Add the recordings of a source that the scene does not have yet.

    If a recording cannot be added, the recordings that were added before it stay in the scene.
    """
    added_n = 0
    try:
        for recording in source.recordings:
            labels = CaptureNames(recording.board, recording.skin, None)
            prepared = preparing.foreign(folder / recording.path, recording.layout, labels, recording.options)
            if capture := _find_added(root, scene, prepared):
                say(f"{scene}/{capture}: added already")
            else:
                header = add.add(root, scene, prepared, allow_copy=False)
                say(f"added {scene}/{header.capture} (board {header.board}, skin {header.skin})")
            added_n += 1
    except BaseException:
        all_n = len(source.recordings)
        say(f"{added_n} of {all_n} recordings are in scene {scene}; to add the others, run the same command again")
        raise


def _find_added(root: Path, scene: str, prepared: Prepared) -> str | None:
    """Return the name of the capture that a prepared recording would duplicate; None if the scene has no such capture.

    Captures are compared by the hashes of their files and, if the files contain several captures, by the part of the
    files that they use. A capture whose files are not on disk is compared by its name.
    """
    header, files = prepared
    hashes = {
        name: sha256(io.read_bytes(file) if isinstance(file, Path) else file).hexdigest()
        for name, file in files.items()
    }
    for capture in read_registry(root).captures.get(scene, {}):
        raw = root / add.RAW / scene / capture
        if not (raw / HEADER_FILE).is_file():
            if capture == header.capture:
                return capture
        elif (present := read_header(raw)).files == hashes and present.options.get(PART) == header.options.get(PART):
            return capture
    return None


def _say_what_runs(root: Path, scene: str, before: Mapping[str, object], say: Say) -> None:
    """Tell the user whether the scene is in the plan, and which command to run next.

    `before` contains the scenes that were in the plan before the recordings were added.
    """
    running = list(read_plan(root / PLAN).scenes)
    if scene not in running:
        return say(
            f"scene {scene} is not in the plan; to run it: reskin scenes use {' '.join([*running, scene])}; dvc repro"
        )
    if scene not in before:
        say(f"added scene {scene} to {PLAN} (already there: {', '.join(before) or 'none'})")
    say(f"next: dvc repro (runs {', '.join(running)}; to run this scene alone first: reskin scenes use {scene})")
    say(f"report: reports/{scene}/index.html; all scenes: reports/index.html")


@dataclass(frozen=True)
class Origin:
    """A place from which files are taken: a folder, or one commit of a git repository.

    - name: name of the origin in error messages.
    - paths: paths of its files.
    - read: function that returns the content of the file with a given path.
    """

    name: str
    paths: Sequence[str]
    read: Callable[[str], bytes]

    def find(self, wanted: str) -> str | None:
        """Return the path of the file that best matches the path `wanted`.

        The file must have the same name. Among several such files, the one with the most parent folders in common is
        chosen. Returns None if no file has this name.
        """

        def common_n(path: str) -> int:
            parts = zip(reversed(PurePosixPath(path).parts), reversed(PurePosixPath(wanted).parts), strict=False)
            same = [mine == theirs for mine, theirs in parts]
            return same.index(False) if False in same else len(same)

        candidates = [path for path in self.paths if common_n(path)]
        return min(candidates, key=lambda path: (-common_n(path), len(path), path), default=None)


def open_origin(where: str, commit: str | None, scratch: Path) -> Origin:
    """Open a folder, or one commit of a git repository.

    If `commit` is None, the newest commit is used. A repository is fetched to the folder `scratch`, which git creates.
    """
    folder = Path(where)
    if not folder.exists() and not re.search(r"^[^/]{2,}:", where):  # neither an existing path nor a URL or host:path
        raise CaptureError(f"{where}: no such mirror or folder. Check the path; {USE_FROM}")
    is_bare = (folder / "HEAD").is_file() and (folder / "objects").is_dir()
    if folder.is_dir() and not is_bare and not (folder / ".git").exists():
        paths = [path.relative_to(folder).as_posix() for path in sorted(folder.rglob("*")) if path.is_file()]
        return Origin(where, paths, lambda path: io.read_bytes(folder / path))
    return _open_repository(str(folder.resolve()) if folder.exists() else where, commit, scratch)


def _open_repository(url: str, commit: str | None, scratch: Path) -> Origin:
    """Fetch one commit without its files; each file is fetched when it is read.

    If the server does not support this, the whole repository is fetched.
    """
    repository, whole = scratch / "partial", scratch / "whole"
    try:
        _git("init", "--quiet", "--bare", str(repository))
        _git("remote", "add", "origin", url, repository=repository)
        newest = _git("ls-remote", "origin", "HEAD", repository=repository).split()
    except subprocess.CalledProcessError as error:
        remedy = f"Check the network and the address; {USE_FROM}"
        raise CaptureError(f"{url}: cannot read the repository: {_reason(error)}. {remedy}") from None
    commit = commit or (newest[0].decode() if newest else "HEAD")
    try:
        _git("fetch", "--quiet", "--filter=blob:none", "--depth=1", "origin", commit, repository=repository)
    except subprocess.CalledProcessError:
        try:  # clone the repository again and completely, because a partial clone would search for the commit endlessly
            repository = whole
            _git("clone", "--quiet", "--mirror", url, str(whole))
            _git("cat-file", "-e", f"{commit}^{{commit}}", repository=whole)
        except subprocess.CalledProcessError as error:
            remedy = (
                "Perhaps the history of the repository was rewritten, or the repository is an incomplete clone that "
                f"was made with --depth. Use a complete clone; {USE_FROM}"
            )
            what = f"the repository does not have commit {commit}, from which the files are taken ({_reason(error)})"
            raise CaptureError(f"{url}: {what}. {remedy}") from None

    def read(path: str) -> bytes:
        try:
            return _git("cat-file", "blob", f"{commit}:{path}", repository=repository)
        except subprocess.CalledProcessError as error:
            remedy = f"Run the command again; {USE_FROM}"
            raise CaptureError(f"{url} {path}: cannot read the file: {_reason(error)}. {remedy}") from None

    listed = _git("ls-tree", "-r", "-z", "--name-only", commit, repository=repository).decode(errors="replace")
    return Origin(f"{url} @{commit[:12]}", listed.split("\0")[:-1], read)


def _git(*arguments: str, repository: Path | None = None) -> bytes:
    """Run git and return its output.

    A dead connection causes an error after a minute, and git never asks for a password.
    """
    command = ["git", "-c", "http.lowSpeedLimit=1000", "-c", "http.lowSpeedTime=60"]
    command += [] if repository is None else ["--git-dir", str(repository)]
    silent = {"GIT_TERMINAL_PROMPT": "0", "GIT_ASKPASS": "true", "GIT_SSH_COMMAND": "ssh -oBatchMode=yes"}
    try:
        return subprocess.run(
            [*command, *arguments], stdin=subprocess.DEVNULL, capture_output=True, check=True,
            env={**os.environ, **silent},
        ).stdout  # fmt: skip
    except FileNotFoundError:
        raise CaptureError(
            "git is not installed. Install git, or name a folder that contains the files with option --from."
        ) from None


def _reason(error: subprocess.CalledProcessError) -> str:
    lines = [line for line in error.stderr.decode(errors="replace").splitlines() if line.strip()]
    lines = [line for line in lines if line.startswith("fatal:")] or lines[-1:]
    return lines[0].rstrip(". ")[:300] if lines else f"exit status {error.returncode} of git"
