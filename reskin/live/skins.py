"""The folder in which `reskin live` saves calibrations. There is one file per skin."""

import re
import threading
import time
from pathlib import Path

from reskin.errors import DISK_REMEDIES, ParamsError, SchemaError
from reskin.models.trained import SUFFIX
from reskin.recordings.header import NAME
from reskin.universal.model import Universal

SKINS = Path("skins")  # default folder, in the working directory
LISTED_S = 1.0  # the list of the files in the folder is read again if it is older than this time


class SkinFolder:
    """A folder of saved calibrations.

    All boards on a page use the same `SkinFolder`, so that two boards cannot save calibrations under the same name.
    """

    def __init__(self, folder: Path = SKINS) -> None:
        if folder.exists() and not folder.is_dir():
            raise ParamsError(f"--skins: {folder} is a file, not a folder. Choose the name of a folder.")
        self.folder = folder
        self._lock = threading.Lock()
        self._names: list[str] = []
        self._listed_s = float("-inf")

    def names(self) -> list[str]:
        """Return the names of all saved skins, in alphabetical order."""
        with self._lock:
            if time.monotonic() - self._listed_s > LISTED_S:
                files = self.folder.glob(f"*{SUFFIX}") if self.folder.is_dir() else ()
                self._names = sorted(file.stem for file in files if re.fullmatch(NAME, file.stem))
                self._listed_s = time.monotonic()
            return self._names

    def file(self, name: object) -> Path:
        """Return the file of the skin with this name.

        Raises
        ------
        ParamsError
            If the name is not allowed. A name has 1 to 64 letters, digits, - and _, and begins with a letter or a
            digit.
        """
        if not isinstance(name, str) or not re.fullmatch(NAME, name):
            got = repr(name)[:40] if name else "nothing"
            raise ParamsError(
                f"skin name: {got} is not a name. Use 1 to 64 letters, digits, - and _; begin with a letter or a digit."
            )
        return self.folder / f"{name}{SUFFIX}"

    def save(self, name: object, model: Universal) -> str:
        """Save a calibrated model under a new name; return a text for the user.

        Raises
        ------
        ParamsError
            If the name is not allowed, or if there is already a saved skin with this name.
        SchemaError
            If the model has not been calibrated to any press, or if the file cannot be written.
        """
        file = self.file(name)
        if not model.presses_n:
            raise SchemaError(
                "not saved: the model is not yet calibrated to this skin. First use button Adapt or Places."
            )
        with self._lock:
            if file.exists():
                raise ParamsError(f"not saved: {file} exists already. Choose another name.")
            try:
                model.save(file)
            except OSError as error:
                remedy = DISK_REMEDIES.get(error.errno or 0, "Choose another folder with --skins.")
                raise SchemaError(f"not saved: cannot write {file}: {error.strerror}. {remedy}") from None
            self._listed_s = float("-inf")
        return f"saved {file} (presses: {model.presses_n}, of which labelled: {model.labels_n})"
