"""Fetch public recordings with pooch, and add them to a scene. `pipeline/fetch.yaml` lists them with their hashes."""

from collections.abc import Callable, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Annotated

import pooch
from pydantic import Field

from pipeline.manage import add
from pipeline.manage.registry import read_registry
from reskin import io
from reskin.config import Strict, parse, read_yaml
from reskin.errors import CaptureError, ParamsError
from reskin.recordings import ReaderLayout, preparing
from reskin.recordings.pickled import to_lab_csv
from reskin.recordings.preparing import CaptureNames

SOURCES = "pipeline/fetch.yaml"
FETCHED = "data/fetched"
Say = Callable[[str], None]


class Recording(Strict):
    """A recording in the fetched files, with the options of `reskin add` for it."""

    path: str
    layout: ReaderLayout
    board: str
    skin: str
    options: dict[str, str] = Field(default_factory=dict)


class Source(Strict):
    """A public set of recordings; the comment at the top of `pipeline/fetch.yaml` describes the fields."""

    home: str
    base: str | None
    how: str | None = None
    licence: str | None
    scene: str | None
    files: dict[str, Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]]
    archives: dict[str, str] = Field(default_factory=dict)
    urls: dict[str, str] = Field(default_factory=dict)
    recordings: tuple[Recording, ...] = ()

    def __str__(self) -> str:
        licence = self.licence or "none (you may not pass the files on)"
        return f"{len(self.files)} files; licence {licence}; {self.home}; scene {self.scene or 'none'}"


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
    where : folder, or address of a mirror, from which to take the files instead of their public address.
    scene : scene to which the recordings are added; None: the scene of the source.
    agree : function that asks the user a yes-or-no question, here whether to use files without a licence.
    """
    sources = read_sources(root)
    if name is None:
        return say("\n".join(f"{name}: {source}" for name, source in sources.items()))
    if name not in sources:
        raise ParamsError("reskin fetch", "a source", f"one of {', '.join(sources)}", name, f"{SOURCES} lists them.")
    source, folder = sources[name], root / FETCHED / name
    missing = [
        path for path, digest in source.files.items()
        if not (folder / path).is_file() or io.sha256(folder / path) != digest
    ]  # fmt: skip
    if missing:
        say(f"{name}: {source}")
        if source.licence is None and not agree("These files have no licence. Fetch them for your own use only?"):
            remedy = "Nothing was fetched. Answer y on a terminal, or add --yes."
            raise ParamsError(f"reskin fetch {name}: the use of files without a licence was not confirmed. {remedy}")
        if where is None or "://" in where:
            _download(source, where, folder)
        else:
            for path in missing:
                _copy(source, path, Path(where), folder / path)
    say(f"{folder}: {len(source.files)} files, all hashes match")
    scene = scene or source.scene
    if scene is None or not source.recordings:
        return say("No scene uses these files; data/README.md describes how to add them to a scene.")
    _add_all(root, scene, source, folder, say)
    say(f"next: reskin scenes use {scene}; dvc repro")


def _download(source: Source, mirror: str | None, folder: Path) -> None:
    """Download the files that are missing in `folder` or have another hash."""
    base = mirror or source.base
    if base is None:
        raise CaptureError(f"{source.home}: {source.how}")
    registry = {path: f"sha256:{digest}" for path, digest in source.files.items()}
    files = pooch.create(folder, base.rstrip("/") + "/", registry=registry, urls={} if mirror else source.urls)
    for path in registry:
        try:
            files.fetch(path, progressbar=True)
        except (OSError, ValueError) as error:  # errors of the network are OSErrors, a wrong hash is a ValueError
            remedy = "Check the network, or name a folder or a mirror with option --from."
            raise CaptureError(f"{files.get_url(path)}: cannot fetch the file: {error}. {remedy}") from None


def _copy(source: Source, path: str, where: Path, target: Path) -> None:
    """Find a file by its name and hash in a folder, and copy it; a file from an .npz archive is converted."""
    names = [Path(path).name, *filter(None, [source.archives.get(path)])]
    for found in sorted(found for name in names for found in where.rglob(name)):
        content = io.read_bytes(found)
        if found.suffix == ".npz":
            content = to_lab_csv(content, str(found))
        if sha256(content).hexdigest() == source.files[path]:
            with io.replacing(target) as temporary:
                temporary.write_bytes(content)
            return
    remedy = f"Check the folder: perhaps the file was changed or truncated. The original is at {source.home}."
    raise CaptureError(f"{where}: no file {' or '.join(names)} with SHA-256 {source.files[path]}. {remedy}")


def _add_all(root: Path, scene: str, source: Source, folder: Path, say: Say) -> None:
    """Add the recordings of a source that the scene does not have yet."""
    for recording in source.recordings:
        names = CaptureNames(recording.board, recording.skin, None)
        prepared = preparing.foreign(folder / recording.path, recording.layout, names, recording.options)
        capture = prepared[0].capture
        if capture in read_registry(root).captures.get(scene, {}):
            say(f"{scene}/{capture}: added already")
            continue
        try:
            add.add(root, scene, prepared, allow_copy=False)
            say(f"added {scene}/{capture} (board {recording.board}, skin {recording.skin})")
        except CaptureError as error:  # perhaps the user has added the recording under another name
            say(f"{scene}/{capture}: not added. {error}")
