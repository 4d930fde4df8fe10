"""A dump of a port, decoded for looking at. In: bytes. Out: an Arrow table, one row a frame, and an account of bytes.

Refuses to know times, places and forces: a dump has none.
"""

import numpy as np
import pyarrow as pa

from pipeline.capture.header import Wire
from pipeline.capture.stream import decode_all


def decode_dump(data: bytes, wire: Wire, chips_n: int, where: str) -> tuple[pa.Table, dict[str, int]]:
    """Decode a dump; raise `CaptureError` if there is not one frame in it. Units stand in the fields' metadata."""
    frames, account = decode_all(data, wire, chips_n, where)
    names = [f"b{axis}{chip}_uT" for chip in range(chips_n) for axis in "xyz"]
    columns = {name: (frames.b_uT[:, i], "uT") for i, name in enumerate(names)}
    columns |= {f"temperature{chip}_degC": (frames.temperature_degC[:, chip], "degC") for chip in range(chips_n)}
    columns |= {"device_s": (frames.device_s, "s"), "end_byte": (frames.end_byte, "1")}
    fields = [
        pa.field(name, pa.from_numpy_dtype(values.dtype), metadata={"unit": unit})
        for name, (values, unit) in columns.items()
    ]
    arrays = [pa.array(np.ascontiguousarray(values)) for values, _ in columns.values()]
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields)), account
