"""What a model is told of one skin: its field at rest, pokes, labelled pokes; kept in a file from one day to the next.

All in the board's axes, places seen from the middle. Refuses to know what is learnt from it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.core import io
from pipeline.core.errors import SchemaError
from pipeline.twin.asked import CHANNELS_N, labels_of, learnt_rows_of
from pipeline.twin.opinion import FULL_SET_N

FORMAT = "reskin-skin-1"
SHAPES: Mapping[str, tuple[int, ...]] = {  # behind the number of pokes
    "pokes_uT": (CHANNELS_N,),
    "even_uT": (CHANNELS_N,),
    "labelled_mm": (2,),
    "labelled_N": (),
    "labelled_uT": (CHANNELS_N,),
}
FILE_BYTES_MAX_N = 2**20  # a full set of pokes and LABELS_MAX_N labels take a third of it
REMEDY = "Take a file that `save` wrote."

Labelled = tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, " m"], Float[np.ndarray, "m ch"]]  # mm, N, uT


def none() -> Float[np.ndarray, "0 ch"]:
    """Give no poke."""
    return np.zeros((0, CHANNELS_N))


@dataclass(frozen=True)
class Shown:
    """What experts are told of a skin: its field at rest, pokes (at most a full set), and labelled ones."""

    rest_uT: Float[np.ndarray, " ch"]
    pokes_uT: Float[np.ndarray, "c ch"] = field(default_factory=none)
    even_uT: Float[np.ndarray, "e ch"] = field(default_factory=none)  # those that lie evenly over the skin
    labelled: Labelled = field(default_factory=lambda: (np.zeros((0, 2)), np.zeros(0), none()))


def write_shown(shown: Shown, file: Path) -> None:
    """Write it as safetensors; the model that learns from it is not in the file."""
    values = (shown.pokes_uT, shown.even_uT, *shown.labelled)
    io.write_tensors(file, {"rest_uT": shown.rest_uT, **dict(zip(SHAPES, values, strict=True))}, {"format": FORMAT})


def is_shown(file: Path) -> bool:
    """Say whether `write_shown` wrote a file; raise SchemaError on a small one that is damaged or no safetensors."""
    return file.stat().st_size <= FILE_BYTES_MAX_N and io.read_tensors(file)[1].get("format") == FORMAT


def read_shown(file: Path, reach_mm: Float[np.ndarray, "2 2"]) -> Shown:
    """Read it again; raise SchemaError on what no skin within `reach_mm` of its middle was ever told."""
    if file.is_file() and (bytes_n := file.stat().st_size) > FILE_BYTES_MAX_N:
        raise SchemaError(file, "a saved skin", f"at most {FILE_BYTES_MAX_N:,} bytes", f"{bytes_n:,}", REMEDY)
    found, words = io.read_tensors(file, digest_needed=True)
    if words.get("format") != FORMAT:
        raise SchemaError(file, "format", FORMAT, words.get("format"), REMEDY)
    got = {name: values.shape for name, values in sorted(found.items())}
    counts_n = {name: shape[0] for name, shape in got.items() if shape and name != "rest_uT"}
    of_skin = {"rest_uT": (CHANNELS_N,)} | {name: (counts_n.get(name, 0), *shape) for name, shape in SHAPES.items()}
    if got != of_skin or max(counts_n["pokes_uT"], counts_n["even_uT"]) > FULL_SET_N:
        rule = f"rest_uT, {', '.join(SHAPES)} of {CHANNELS_N} channels and at most {FULL_SET_N} unlabelled pokes"
        raise SchemaError(file, "arrays", rule, got, REMEDY)
    fields_uT = {name: learnt_rows_of(values) for name, values in found.items() if values.shape[1:] == (CHANNELS_N,)}
    labels_n = len(fields_uT["labelled_uT"])
    place_mm, force_N = labels_of(
        found["labelled_mm"].astype(float), found["labelled_N"].astype(float), labels_n, reach_mm
    )
    rest_uT = learnt_rows_of(found["rest_uT"])[0]
    return Shown(rest_uT, fields_uT["pokes_uT"], fields_uT["even_uT"], (place_mm, force_N, fields_uT["labelled_uT"]))
