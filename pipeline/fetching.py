"""Public recordings: `pipeline/fetch.yaml` -> files in data/fetched/<source>, checked, and added to their scene.

Files count only when every one has its checksum; until then they are in a temporary folder. Refuses to know how files
are read from git or a folder (`origins`) and how a recording is added (`adding`).
"""

import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

from pydantic import AfterValidator, Field

from pipeline import adding, preparing
from pipeline.capture.header import HEADER_FILE
from pipeline.capture.layouts import Foreign
from pipeline.core import config, io
from pipeline.core.config import Strict, parse, read_yaml
from pipeline.core.errors import CaptureError, ParamsError
from pipeline.dataset.captures import read_header
from pipeline.origins import OTHERS, Origin, open_origin
from pipeline.params import read_plan
from pipeline.pickled import to_lab_csv
from pipeline.preparing import Labels, Prepared
from pipeline.registry import read_registry

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
    layout: Foreign
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
    source, folder, running = sources[name], root / FETCHED / name, read_plan(root / config.PLAN).scenes
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
                header = adding.add(root, scene, prepared, allow_copy=False)
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
        raw = root / adding.RAW / scene / capture
        if not (raw / HEADER_FILE).is_file():
            if capture == header.capture:
                return capture
        elif read_header(raw).files == {name: hashed.hexdigest() for name, hashed in hashes.items()}:
            return capture
    return None


def _say_what_runs(root: Path, scene: str, before: Mapping[str, object], say: Say) -> None:
    running = list(read_plan(root / config.PLAN).scenes)
    if scene not in running:
        return say(f"scene {scene} is switched off; now: reskin scenes use {' '.join([*running, scene])}; dvc repro")
    if scene not in before:
        say(f"switched scene {scene} on in {config.PLAN}, beside {', '.join(before) or 'no other'}")
    say(f"now: dvc repro (runs {', '.join(running)}; only this one: reskin scenes use {scene})")
    say(f"then: reports/{scene}/index.html, and beside the other scenes in reports/index.html")
