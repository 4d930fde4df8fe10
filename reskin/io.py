"""Read and write Parquet, safetensors, JSON and text files (every write is atomic), and cache computed arrays."""

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import version
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import safetensors
import safetensors.numpy

from reskin.code import package_digest
from reskin.errors import DISK_REMEDIES, SchemaError
from reskin.numerics import signature
from reskin.schema import Readings, arrow_schema, from_table, to_table

COUNTS_KEY = b"reskin.account"
DIGEST = "digest"  # in the metadata of a safetensors file
HEADER_AT = 8  # a safetensors file begins with the length of its header, in this many bytes
REMEDY = (
    "It was cut or changed. If `dvc repro` wrote it, delete it, then run `reskin check-cache` and `dvc repro`. "
    "Otherwise copy it again."
)
MACHINE_ERRNOS = {
    errno.EACCES,
    errno.EIO,
    errno.EMFILE,
    errno.ENFILE,
    errno.ESTALE,
}  # with these errors, the file may be intact


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` for a file or folder, and rename it to `path` when the block succeeds."""
    make_folder(path.parent)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        remove(temporary)
        yield temporary
        if temporary.is_dir():
            remove(path)
        elif path.is_dir():
            raise SchemaError(f"{path}: a folder of this name exists. Choose another name for the file.")
        temporary.replace(path)
    except BaseException as error:
        if isinstance(error, OSError) and error.errno in DISK_REMEDIES and _is_written(error, temporary):
            error.filename = str(path)  # not the temporary name
        with suppress(OSError):  # the first error is reported
            remove(temporary)
        raise


def _is_written(error: OSError, temporary: Path) -> bool:
    """Return whether an error concerns the file being written, and not a file that is read at the same time."""
    if error.filename is None:  # from an open stream; EIO may come from reading or from writing
        return error.errno != errno.EIO
    names = (error.filename,) if error.errno == errno.EIO else (error.filename, error.filename2)  # copyfile gives both
    return any(str(temporary) in str(name) for name in names)


@contextmanager
def restoring(*files: Path) -> Iterator[None]:
    """Restore the content of files if the block fails or is interrupted."""
    contents = {file: file.read_bytes() for file in files}
    try:
        yield
    except BaseException:
        for file, content in contents.items():
            if file.read_bytes() != content:
                with replacing(file) as temporary:
                    temporary.write_bytes(content)
        raise


def make_folder(folder: Path) -> None:
    """Create a folder and its parents if they are missing; raise `SchemaError` if that is impossible."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileNotFoundError, FileExistsError, NotADirectoryError) as error:  # /proc, a missing drive, a file
        raise SchemaError(
            f"{folder}: cannot create this folder: {error.strerror}. Choose another folder for the output."
        ) from None


def remove(path: Path) -> None:
    """Delete a file or a folder, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_bytes(path: Path) -> bytes:
    """Read a whole file; raise `SchemaError` if it cannot be read."""
    _check_is_file(path)
    try:
        return path.read_bytes()
    except OSError as error:
        raise SchemaError(f"{path}: cannot read the file: {error.strerror}. Check the path.") from None


def write_text(path: Path, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_texts(folder: Path, texts: Mapping[str, str]) -> None:
    """Write texts into a folder, by file name; the folder's earlier content is deleted."""
    with replacing(folder) as temporary:
        temporary.mkdir()
        for name, text in texts.items():
            write_text(temporary / name, text)


def append(file: FileIO, data: bytes) -> None:
    """Append all bytes to an unbuffered file, or no bytes if the disk is full."""
    start = file.tell()
    try:
        while data:
            data = data[file.write(data) :]
    except OSError:
        file.truncate(start)
        raise


def write_json(path: Path, value: Any) -> None:
    """Write JSON with two-space indent; NaN and infinity are errors, because JSON has neither."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """Read JSON; raise `SchemaError` with the place of the first syntax error."""
    _check_is_file(path)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise SchemaError(f"{path}: the file is not JSON: {error}. Run its stage again.") from None


def write_tensors(path: Path, tensors: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> None:
    """Write named arrays and metadata as safetensors, with a digest of both."""
    dense = {name: np.ascontiguousarray(value) for name, value in tensors.items()}
    metadata = {**metadata, DIGEST: _digest(dense, metadata)}
    content = safetensors.numpy.save(dense, metadata)
    with replacing(path) as temporary, temporary.open("wb") as stream:  # save_file hides disk errors
        stream.write(content[:HEADER_AT] + _sorted_header(content, metadata))
        stream.write(memoryview(content)[stream.tell() :])


def read_tensors(
    path: Path, names: Sequence[str] = (), *, digest_needed: bool = False
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Read arrays and metadata that `write_tensors` wrote; no pickle is ever opened.

    If all arrays are read, they are compared with the file's digest. Files from older code have no digest; they are
    accepted unless `digest_needed`. If only some arrays are read, nothing is checked.
    """
    _check_is_file(path)
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            tensors = {name: file.get_tensor(name) for name in names or file.keys()}
            metadata: dict[str, str] = file.metadata() or {}
    except (safetensors.SafetensorError, OSError) as error:
        _raise_machine_error(error)
        raise SchemaError(f"{path}: the file is not safetensors: {error}. Is it a trained model? {REMEDY}") from None
    written = metadata.pop(DIGEST, None)
    is_checked = not names and (digest_needed or written is not None)
    if is_checked and written != _digest(tensors, metadata):
        raise SchemaError(f"{path}: the file's content does not match its digest. {REMEDY}")
    return tensors, metadata


def _digest(tensors: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> str:
    hasher = hashlib.sha256(repr(sorted(metadata.items())).encode())
    for name, values in sorted(tensors.items()):
        hasher.update(f"{name} {values.dtype} {values.shape}".encode())
        hasher.update(values.data)
    return hasher.hexdigest()[:32]


def _sorted_header(content: bytes, metadata: Mapping[str, str]) -> bytes:
    # The order in which the library writes the metadata differs from process to process.
    length = int.from_bytes(content[:HEADER_AT], "little")
    header = json.loads(content[HEADER_AT : HEADER_AT + length]) | {"__metadata__": dict(sorted(metadata.items()))}
    return json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode().ljust(length)


def write_table(path: Path, table: pa.Table) -> None:
    with replacing(path) as temporary:
        pq.write_table(table, temporary, compression="zstd", write_page_checksum=True)


def read_table(path: Path) -> pa.Table:
    with _parquet(path) as file:
        return file.read()


def write_readings(path: Path, blocks: Iterable[Readings], counts: Mapping[str, int]) -> None:
    """Write the readings of one capture block by block; `counts` is written last, so it may change until then."""
    with replacing(path) as temporary:
        writer: pq.ParquetWriter | None = None
        for block in blocks:
            if writer is None:
                schema = arrow_schema(block.chips_n)
                writer = pq.ParquetWriter(temporary, schema, compression="zstd", write_page_checksum=True)
            writer.write_table(to_table(block))
        if writer is None:
            raise SchemaError(f"{path}: the capture has no readings left. See what was dropped, and why.")
        writer.add_key_value_metadata({COUNTS_KEY.decode(): json.dumps(dict(counts), sort_keys=True)})
        writer.close()


def read_readings(path: Path) -> Readings:
    return from_table(read_table(path), str(path))


def read_ingest_counts(path: Path) -> dict[str, int]:
    """Read the ingestion counts of one capture: bytes, frames and rows, and those dropped, by reason."""
    with _parquet(path) as file:
        metadata = file.metadata.metadata or {}
    if COUNTS_KEY not in metadata:
        raise SchemaError(f"{path}: the file's metadata lacks the ingestion counts. Ingest it again.")
    counts: dict[str, int] = json.loads(metadata[COUNTS_KEY])
    return counts


def _check_is_file(path: Path) -> None:
    if not path.exists():
        raise SchemaError(f"{path}: file not found. Check the path, or run the stage that writes it.")


def _raise_machine_error(error: Exception) -> None:
    """Raise the error if it comes from the disk, permissions or limits; the file may be intact then."""
    if isinstance(error, OSError) and error.errno in MACHINE_ERRNOS:
        raise error


@contextmanager
def _parquet(path: Path) -> Iterator[pq.ParquetFile]:
    _check_is_file(path)
    try:
        yield pq.ParquetFile(path, page_checksum_verification=True)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError, UnicodeDecodeError, OSError) as error:
        _raise_machine_error(error)
        reason = " ".join(str(error).split()).rstrip(".")
        raise SchemaError(f"{path}: the file is not readable as Parquet: {reason}. {REMEDY}") from None


# --- Cache of computed arrays, beside the compiled code of a package ---

LIBRARIES = ("numpy", "scipy", "numba")


def load_cached_array(package: Path, name: str) -> np.ndarray | None:
    """Read a cached array; None if it is not cached, or was computed by other code or with other library versions."""
    try:
        return np.load(_cache_file(package, name), allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None


def save_cached_array(package: Path, name: str, array: np.ndarray) -> None:
    """Cache an array, and delete cached arrays that were computed by other code."""
    file = _cache_file(package, name)
    try:
        with replacing(file) as temporary, temporary.open("wb") as stream:
            np.save(stream, array, allow_pickle=False)
        current = set(file.parent.glob(f"kept-{_cache_state(package)}-*"))
        for old in set(file.parent.glob("kept-*.npy")) - current:
            remove(old)
    except (OSError, SchemaError):
        return  # on a read-only or full disk, the array is computed again next time


def _cache_file(package: Path, name: str) -> Path:
    digest = hashlib.sha256(name.encode()).hexdigest()[:16]
    return package / "__pycache__" / f"kept-{_cache_state(package)}-{digest}.npy"


@cache
def _cache_state(package: Path) -> str:
    libraries = [(name, version(name)) for name in LIBRARIES]
    return hashlib.sha256(repr((libraries, signature(), package_digest(package))).encode()).hexdigest()[:16]
