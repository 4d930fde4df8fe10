"""A capture on disk: `header.json` and the files it vouches for. In: a header and contents. Out: a folder, whole.

Refuses to know what the files mean, and where captures are kept.
"""

import shutil
from collections.abc import Mapping
from pathlib import Path

from pipeline.capture.header import HEADER_FILE, Header, render
from pipeline.core import io


def write_capture(folder: Path, header: Header, contents: Mapping[str, bytes | Path]) -> Header:
    """Write a capture's files (bytes, or copies of paths), hash them into the header, and write that last."""
    with io.replacing(folder) as temporary:
        temporary.mkdir()
        for name, content in contents.items():
            if isinstance(content, Path):
                shutil.copyfile(content, temporary / name)
            else:
                (temporary / name).write_bytes(content)
        return seal(temporary, header)


def seal(folder: Path, header: Header) -> Header:
    """Hash the files that a folder holds into its header, and write that."""
    names = sorted(path.name for path in folder.iterdir() if path.name != HEADER_FILE)
    complete = header.model_copy(update={"files": {name: io.sha256(folder / name) for name in names}})
    io.write_text(folder / HEADER_FILE, render(complete))
    return complete
