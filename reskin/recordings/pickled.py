"""Convert an .npz archive of pickled samples, as the rig of layout `lab` writes it, to a CSV file of layout `lab`.

A pickle can name any function, and loading it calls the function. Here, only the names that NumPy writes for numbers
and arrays are known; any other name is refused.
"""

import pickle
import zipfile
from collections.abc import Mapping
from io import BytesIO
from typing import Any, ClassVar

import numpy as np

from reskin.errors import CaptureError

CHIPS_N = 5
COLUMNS = [f"{quantity}{chip}" for chip in range(CHIPS_N) for quantity in ("T", "Bx", "By", "Bz")]
HEAD = ",".join(["indent", "phase", "x_mm", "y_mm", *COLUMNS, "Fx", "Fy", "Fz"])
PHASES = {"noload": "bl_arr", "contact": "cont_arr"}  # phase -> name of its samples in the archive
BYTES_MAX_N = 500_000_000  # the archives of scene lab have 10 to 30 MB


def to_lab_csv(archive: bytes, where: str) -> bytes:
    """Return the samples of an archive as CSV text.

    The lines are sorted by indentation; in each indentation, the no-load samples come first. Values are rounded to 1e-4
    degC, 1e-4 uT and 1e-6 N. Lines end in CR LF, as in RFC 4180.
    """
    remedy = "Check that the archive is a complete copy, and that it contains the recording of one port at one depth."
    try:
        with zipfile.ZipFile(BytesIO(archive)) as file:
            if (bytes_n := sum(member.file_size for member in file.infolist())) > BYTES_MAX_N:
                raise ValueError(f"unpacked, it has {bytes_n} bytes, which is more than {BYTES_MAX_N}")
            samples = {phase: _samples(file.read(f"{name}.npy")) for phase, name in PHASES.items()}
        rows = [(int(sample["Indent"]), phase, _row(sample)) for phase in PHASES for sample in samples[phase]]
    except Exception as error:  # an archive may contain anything, so any exception is possible
        reason = " ".join(f"{type(error).__name__} {error}".split())[:200]
        raise CaptureError(
            f"{where}: not an .npz archive with samples in the arrays {' and '.join(PHASES.values())}: {reason}. "
            f"{remedy}"
        ) from None
    rows.sort(key=lambda row: row[0])  # the sort is stable, so the no-load rows of an indentation stay first
    return "".join(f"{line}\r\n" for line in [HEAD, *(f"{i},{phase},{cells}" for i, phase, cells in rows)]).encode()


def _samples(npy: bytes) -> Any:
    stream = BytesIO(npy)
    version = np.lib.format.read_magic(stream)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    _, _, dtype = read_header(stream)
    if not dtype.hasobject:
        raise ValueError(f"the array contains values of type {dtype} instead of objects")
    return _Unpickler(stream).load()


def _row(sample: Mapping[str, Any]) -> str:
    place, fields, forces = (sample[key] for key in ("Location", "ReSkin Data", "Force Data"))
    if (len(place), len(fields), len(forces)) != (2, len(COLUMNS), 3):
        raise ValueError(f"a sample has {len(place)} coordinates, {len(fields)} readings and {len(forces)} forces")
    cells = [f"{mm:g}" for mm in place] + [f"{value:.4f}" for value in fields] + [f"{force:.6f}" for force in forces]
    return ",".join(cells)


class _Unpickler(pickle._Unpickler):  # the one in Python: that in C allocates as much memory as a pickle asks for
    KNOWN: ClassVar = {
        ("numpy", "dtype"),
        ("numpy", "ndarray"),
        ("numpy._core.multiarray", "_reconstruct"),
        ("numpy._core.multiarray", "scalar"),
    }

    def find_class(self, module: str, name: str) -> Any:
        module = module.replace("numpy.core", "numpy._core")  # NumPy 2 has renamed the module
        if (module, name) not in self.KNOWN:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which is no number or array")
        return super().find_class(module, name)
