"""Read and write Parquet, safetensors, JSON and text files, and cache computed arrays.

A file is first written under a temporary name, and then renamed. If writing is interrupted, there is no partial file
under the final name.
"""

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
from reskin.schema import INGEST_AGAIN, Readings, arrow_schema, from_table, to_table

PARQUET_MAGIC = b"PAR1"  # first bytes of a Parquet file
TABLE_BYTES_MAX_N = 6 * 10**9  # a Parquet file of a few kB may expand to any size
COUNTS_KEY = b"reskin.account"  # key of the ingestion counts in the metadata of a Parquet file of readings
DIGEST, CARD = "digest", "card"  # keys of the digests of content and card in the metadata of a safetensors file
HEADER_AT = 8  # position of the header in a safetensors file; the bytes before it contain the length of the header
REMEDY = (
    "The file is incomplete, or it was changed after it was written. If `dvc repro` wrote the file, delete the file "
    "and DVC's copies (.dvc/cache/files), then run `dvc repro`. Otherwise, copy the file again from where you got it."
)
MACHINE_ERRNOS = {
    errno.EACCES,
    errno.EIO,
    errno.EMFILE,
    errno.ENFILE,
    errno.ESTALE,
}  # numbers of errors that are due to the machine; after such an error, the file itself may be intact


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Replace a file or folder in one step, at the end of a `with` block.

    The context manager yields a temporary path beside `path`, at which the block creates the new file or folder. If the
    block succeeds, the temporary path is renamed to `path`. If it fails, the temporary file or folder is deleted, and
    `path` is unchanged.
    """
    make_folder(path.parent)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        remove(temporary)
        yield temporary
        if temporary.is_dir():
            remove(path)
        elif path.is_dir():
            raise SchemaError(
                f"{path}: a file cannot be written here, because there is a folder with this name. Choose another name "
                "for the file."
            )
        temporary.replace(path)
    except BaseException as error:
        if isinstance(error, OSError) and error.errno in DISK_REMEDIES and _is_written(error, temporary):
            error.filename = str(path)  # report the final name instead of the temporary name
        with suppress(OSError):  # a second error must not hide the first
            remove(temporary)
        raise


def _is_written(error: OSError, temporary: Path) -> bool:
    """Return whether an error is about the file that is written, and not about another file that the block reads."""
    # The error is about an open stream, whose name is unknown. Most of these errors can only be caused by writing. EIO
    # is an exception: it may be an error of reading or of writing.
    if error.filename is None:
        return error.errno != errno.EIO
    # An error of `shutil.copyfile` contains the names of both files, the one that is read and the one that is written.
    names = (error.filename,) if error.errno == errno.EIO else (error.filename, error.filename2)
    return any(str(temporary) in str(name) for name in names)


@contextmanager
def restoring(*files: Path) -> Iterator[None]:
    """If the `with` block fails or is interrupted, restore the content that the files had before the block."""
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
    except (FileNotFoundError, FileExistsError, NotADirectoryError) as error:
        raise SchemaError(
            f"{folder}: cannot create this folder: {error.strerror}. Choose another folder for the output."
        ) from None


def remove(path: Path) -> None:
    """Delete a file or a folder, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def sync(*paths: Path) -> None:
    """Wait until files, or the names in folders, are on the disk, so that they survive a power cut."""
    for path in paths:
        if os.name == "nt" and path.is_dir():
            continue  # Windows cannot open folders
        handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_blocks(path: Path, bytes_n: int) -> Iterator[bytes]:
    """Read a file in blocks of `bytes_n` bytes; raise `SchemaError` if it cannot be read."""
    _check_is_file(path)
    try:
        with path.open("rb") as stream:
            while block := stream.read(bytes_n):
                yield block
    except OSError as error:
        raise SchemaError(f"{path}: cannot read the file: {error.strerror}. Check the path.") from None


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
    """Replace the content of a folder by text files. `texts` contains the text of each file by the name of the file."""
    with replacing(folder) as temporary:
        temporary.mkdir()
        for name, text in texts.items():
            write_text(temporary / name, text)


def append(file: FileIO, data: bytes) -> None:
    """Append data to an unbuffered file.

    If writing fails, the file is cut to its earlier length, so that no part of the data remains, and the error is
    raised.
    """
    start = file.tell()
    try:
        while data:
            data = data[file.write(data) :]
    except OSError:
        file.truncate(start)
        raise


def write_json(path: Path, value: Any) -> None:
    """Write JSON with two-space indent; raise ValueError for NaN and infinity, which are not valid JSON."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """Read JSON; raise `SchemaError` with the line and column of the first syntax error."""
    _check_is_file(path)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise SchemaError(
            f"{path}: the file is not JSON: {error}. Run the stage again that writes this file."
        ) from None


def write_tensors(path: Path, tensors: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> None:
    """Write named arrays and metadata as a safetensors file.

    A digest of the arrays and of the metadata is added to the metadata, so that `read_tensors` can detect damage.
    """
    dense = {name: np.ascontiguousarray(value) for name, value in tensors.items()}
    metadata = {**metadata, DIGEST: _digest(dense, metadata)}
    content = safetensors.numpy.save(dense, metadata)
    # The file is not written with the function save_file of safetensors, because that function would hide errors of the
    # disk.
    with replacing(path) as temporary, temporary.open("wb") as stream:
        stream.write(content[:HEADER_AT] + _sorted_header(content, metadata))
        stream.write(memoryview(content)[stream.tell() :])


def read_tensors(path: Path, names: Sequence[str] = ()) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Read arrays and metadata from a file that `write_tensors` wrote.

    `names` contains the names of the arrays to read. If it is empty, all arrays are read, and the content of the file
    is compared with its digest. If only some arrays are read, the digest is not checked.
    """
    _check_is_file(path)
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            tensors = {name: file.get_tensor(name) for name in names or file.keys()}
            metadata: dict[str, str] = file.metadata() or {}
    except (safetensors.SafetensorError, OSError) as error:
        _raise_machine_error(error)
        raise SchemaError(
            f"{path}: the file cannot be read as a safetensors file: {error}. Check that the path is that of a trained "
            f"model. {REMEDY}"
        ) from None
    written = metadata.pop(DIGEST, None)
    if not names and written != _digest(tensors, metadata):
        raise SchemaError(f"{path}: the file's content does not match its digest. {REMEDY}")
    return tensors, metadata


def write_model(file: Path, tensors: Mapping[str, np.ndarray], card: Mapping[str, Any]) -> None:
    """Write the arrays of a model as a safetensors file, and its card, which describes it, as JSON of the same name.

    The metadata of the arrays contain a digest of the card, so that `read_model` can detect another or an edited card.
    """
    write_json(card_of(file), card)
    write_tensors(file, tensors, {CARD: _card_digest(read_json(card_of(file)))})


def read_model(file: Path, card: Any) -> dict[str, np.ndarray]:
    """Read the arrays of a model; raise `SchemaError` if `card`, the content of its JSON file, is another one."""
    tensors, metadata = read_tensors(file)
    if metadata.get(CARD) != _card_digest(card):
        remedy = "Copy both files of the model again, or train it again."
        raise SchemaError(card_of(file), "the card", f"the one that was written with {file.name}", "another", remedy)
    return tensors


def card_of(file: Path) -> Path:
    """Return the file of a model's card."""
    return file.with_suffix(".json")


def check_arrays(file: Path, arrays: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise `SchemaError` unless these arrays of a file are finite float32 numbers of the given shapes."""
    for name in dict.fromkeys([*shapes, *arrays]):
        what, values, shape = f"array {name}", arrays.get(name), shapes.get(name)
        if values is None or values.shape != shape:
            raise SchemaError(file, what, f"of shape {shape}", "none" if values is None else values.shape, REMEDY)
        if values.dtype != np.float32:
            raise SchemaError(file, what, "finite float32 numbers", values.dtype, REMEDY)
        if not np.isfinite(values).all():
            raise SchemaError(file, what, "finite float32 numbers", "NaN or infinity", REMEDY)


def _card_digest(card: Any) -> str:
    return hashlib.sha256(json.dumps(card, sort_keys=True).encode()).hexdigest()[:32]


def _digest(tensors: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> str:
    hasher = hashlib.sha256(repr(sorted(metadata.items())).encode())
    for name, values in sorted(tensors.items()):
        hasher.update(f"{name} {values.dtype} {values.shape}".encode())
        hasher.update(values.data)
    return hasher.hexdigest()[:32]


def _sorted_header(content: bytes, metadata: Mapping[str, str]) -> bytes:
    # The safetensors library writes the entries of the metadata in an order that differs from process to process. The
    # entries are sorted here, so that equal contents give equal bytes.
    length = int.from_bytes(content[:HEADER_AT], "little")
    header = json.loads(content[HEADER_AT : HEADER_AT + length]) | {"__metadata__": dict(sorted(metadata.items()))}
    return json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode().ljust(length)


def write_table(path: Path, table: pa.Table) -> None:
    with replacing(path) as temporary:
        pq.write_table(table, temporary, compression="zstd", write_page_checksum=True)


def is_parquet(path: Path) -> bool:
    """Return whether a file begins with the bytes with which every Parquet file begins."""
    with path.open("rb") as stream:
        return stream.read(len(PARQUET_MAGIC)) == PARQUET_MAGIC


def read_table(path: Path) -> pa.Table:
    """Read a whole table; raise `SchemaError` if its values need more than `TABLE_BYTES_MAX_N` of memory."""
    with _parquet(path) as file:
        bytes_n = 8 * file.metadata.num_rows * file.metadata.num_columns
        if bytes_n > TABLE_BYTES_MAX_N:
            raise SchemaError(
                f"{path}: the table has {file.metadata.num_rows} rows and {file.metadata.num_columns} columns, which "
                f"need {bytes_n / 1e9:.1f} GB of memory. Tables of at most {TABLE_BYTES_MAX_N / 1e9:.0f} GB can be "
                "read at once. Divide the table."
            )
        return file.read()


def read_batches(path: Path, rows_n: int) -> Iterator[pa.Table]:
    """Read a table in parts of at most `rows_n` rows, of which only one is in memory at a time."""
    with _parquet(path) as file:
        # A single iterator over the whole file would keep the compressed bytes of all row groups that it has read.
        for group_i in range(file.metadata.num_row_groups):
            for batch in file.iter_batches(rows_n, row_groups=[group_i]):
                yield pa.Table.from_batches([batch])


def write_readings(path: Path, blocks: Iterable[Readings], counts: Mapping[str, int]) -> None:
    """Write the readings of one capture block by block, and then the counts of its ingestion.

    `counts` is written last, because the iterator `blocks` may change it while the readings are written.
    """
    with replacing(path) as temporary:
        writer: pq.ParquetWriter | None = None
        for block in blocks:
            if writer is None:
                schema = arrow_schema(block.chips_n)
                writer = pq.ParquetWriter(temporary, schema, compression="zstd", write_page_checksum=True)
            writer.write_table(to_table(block))
        if writer is None:
            raise SchemaError(
                f"{path}: all readings of the capture were dropped. Check the labels (places and forces) of the "
                "capture, and look for faults of the board, such as failed reads."
            )
        writer.add_key_value_metadata({COUNTS_KEY.decode(): json.dumps(dict(counts), sort_keys=True)})
        writer.close()


def read_readings(path: Path) -> Readings:
    return from_table(read_table(path), str(path))


def read_ingest_counts(path: Path) -> dict[str, int]:
    """Read the counts that were written when a capture was ingested.

    They are the numbers of bytes, frames and rows that were read and, for each reason, the number of those that were
    dropped.
    """
    with _parquet(path) as file:
        metadata = file.metadata.metadata or {}
    if COUNTS_KEY not in metadata:
        raise SchemaError(f"{path}: the metadata of the file lacks the ingestion counts. {INGEST_AGAIN}")
    counts: dict[str, int] = json.loads(metadata[COUNTS_KEY])
    return counts


def _check_is_file(path: Path) -> None:
    if not path.exists():
        raise SchemaError(f"{path}: file not found. Check the path, or run the stage that writes this file.")


def _raise_machine_error(error: Exception) -> None:
    """Raise the error again if it was caused by the machine, and not by the content of the file.

    Errors of the machine concern the disk, permissions, and limits such as the number of open files.
    """
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
        raise SchemaError(f"{path}: the file cannot be read as a Parquet file: {reason}. {REMEDY}") from None


# --- Cache of computed arrays. It is in the folder __pycache__ of the package that computes them. ---

LIBRARIES = ("numpy", "scipy", "numba")


def load_cached_array(package: Path, name: str) -> np.ndarray | None:
    """Read an array from the cache.

    The result is None if there is no array of this name that was computed by the same code of the package, with the
    same versions of libraries.
    """
    try:
        return np.load(_cache_file(package, name), allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None


def save_cached_array(package: Path, name: str, array: np.ndarray) -> None:
    """Write an array to the cache, and delete arrays that another version of the code or of the libraries computed."""
    file = _cache_file(package, name)
    try:
        with replacing(file) as temporary, temporary.open("wb") as stream:
            np.save(stream, array, allow_pickle=False)
        current = set(file.parent.glob(f"kept-{_cache_state(package)}-*"))
        for old in set(file.parent.glob("kept-*.npy")) - current:
            remove(old)
    except (OSError, SchemaError):
        return  # The disk is full or read-only. The array is not cached, and will be computed again when it is needed.


def _cache_file(package: Path, name: str) -> Path:
    digest = hashlib.sha256(name.encode()).hexdigest()[:16]
    return package / "__pycache__" / f"kept-{_cache_state(package)}-{digest}.npy"


@cache
def _cache_state(package: Path) -> str:
    libraries = [(name, version(name)) for name in LIBRARIES]
    return hashlib.sha256(repr((libraries, signature(), package_digest(package))).encode()).hexdigest()[:16]
