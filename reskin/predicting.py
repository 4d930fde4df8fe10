"""Frames and a model -> contacts, places and forces over time, as a CSV. The path of stage logs, for anybody's files.

Refuses to know scenes and folds: whether the model ever saw the log's board is for its user to know.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pyarrow as pa
from pydantic import Field

from reskin import io
from reskin.board.decode import read_frames
from reskin.board.stream import decode_all
from reskin.config import Strict, parse
from reskin.errors import CaptureError, ParamsError, SchemaError, require
from reskin.live.contacts import Answers, Estimates, describe, estimate, quiet_start
from reskin.models.inputs import VIEW
from reskin.models.trained import FORMAT, Network
from reskin.recordings import tables
from reskin.recordings.header import LOG_FILE, RATE_MAX_HZ, STREAM_FILE
from reskin.recordings.ingest import read_header, timer
from reskin.recordings.readers import sd_card
from reskin.universal.calibration import CHANNELS_N, is_calibration
from reskin.universal.model import Universal, load_universal

PARQUET_MAGIC = b"PAR1"
ANSWERS = ("x_mm", "y_mm", "Fz_N")


class CardRecipe(Strict, extra="ignore"):
    """What of its recipe a network needs to answer."""

    architecture: Literal["paper", "released"]
    inputs: Literal["raw", "shape"]


class CardInput(Strict, extra="ignore"):
    """What a network is shown."""

    quantity: Literal["change of field"]
    unit: Literal["uT"]
    channels_n: Annotated[int, Field(ge=3, le=192, multiple_of=3)]  # of at most 64 chips


class Card(Strict, extra="ignore"):
    """What of a model's card its use depends on; the rest tells people where it comes from."""

    format: str
    recipe: CardRecipe
    input: CardInput
    output: dict[str, str]
    collapsed: bool


def predict(log: Path, model: Path | None, out: Path, *, rate_hz: float = 400.0) -> dict[str, Any]:
    """Write t_s, x_mm, y_mm, F_N and contact of every sound frame of a log; give the account of what was read.

    Without a model the map of simulated skins answers, which comes with the project (`twin.shipped`). Places and forces
    are left empty where there is no contact. `rate_hz` gives a decoded dump without a clock its time.
    """
    models = read_models([] if model is None else [model])
    read = (log,) if model is None else (log, model, model.with_suffix(".json"))
    if out.resolve() in {file.resolve() for file in read}:
        rule = "another than the log, the model and its card"
        raise ParamsError("--out", "the file to write", rule, out, "Choose another --out.")
    t_s, b_uT, _, account = read_any_log(log, rate_hz)
    channels_n = CHANNELS_N if isinstance(models, Universal) else models[0].card["input"]["channels_n"]
    if b_uT.shape[1] != channels_n:
        remedy = "Take a model of such boards."
        raise SchemaError(log, "channels", f"the {channels_n} of the model", b_uT.shape[1], remedy)
    answers: Sequence[Answers]
    if isinstance(models, Universal):
        answers = [models.zero(b_uT[: quiet_start(t_s, b_uT, where=str(log))], keep=True)]
    else:
        answers = models
    found = estimate(t_s, b_uT, answers, where=str(log))
    io.write_text(out, render(found))
    return describe(found) | account


def read_any_log(log: Path, rate_hz: float) -> sd_card.Log:
    """Read the frames of a capture's folder, of a table that `reskin decode` wrote, or of an SD card's log."""
    if log.is_dir():
        return _read_capture(log)
    if not 0 < rate_hz <= RATE_MAX_HZ:
        raise ParamsError("--rate-hz", "the rate", f"above 0, at most {RATE_MAX_HZ:g}", rate_hz, "Count frames.")
    if _is_parquet(log):
        return sd_card.keep_whole(*read_frames(io.read_table(log), rate_hz, str(log)), str(log))
    return sd_card.read_log(log)


def _is_parquet(file: Path) -> bool:
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        return stream.read(len(PARQUET_MAGIC)) == PARQUET_MAGIC


def _read_capture(folder: Path) -> sd_card.Log:
    """Read what `reskin record` wrote; frames past the last known arrival have no time, and are dropped."""
    header = read_header(folder)
    if header.layout == "sd-card":
        return sd_card.read_log(folder / LOG_FILE)
    if header.wire is None:
        raise CaptureError(folder, "layout", "native or sd-card", header.layout, "Give what reskin record wrote.")
    stream = folder / STREAM_FILE
    frames, account = decode_all(io.read_bytes(stream), header.wire, header.chips_n, str(stream))
    t_s = timer(folder, header)(frames, 0)
    timed = np.isfinite(t_s)
    kept = frames.where(timed)
    *log, counts = sd_card.keep_whole(t_s[timed], kept.b_uT, kept.temperature_degC, str(stream))
    return *log, account | {"dropped_no_time_frames_n": int((~timed).sum())} | counts  # type: ignore[return-value]


def read_models(files: Sequence[Path]) -> Sequence[Network] | Universal:
    """Read trained networks, or one skin that the universal model was told of (`save`); of no file, that model."""
    skins = [file for file in files if file.is_file() and is_calibration(file)]
    if not skins:
        return [read_network(file) for file in files] or load_universal()
    if len(files) > 1:
        raise ParamsError(skins[0], "a saved skin", "given alone", f"{len(files)} models", "Give one.")
    return load_universal(skins[0])


def _remedy(model: Path) -> str:
    """Say how to get a model file that is missing; stages write them to data/models/SCENE/STAGE."""
    if there := sorted(file.name for file in model.parent.glob("*.safetensors")):
        return f"Models in its folder: {', '.join(there[:3])}{', ...' if there[3:] else ''}"
    if model.parts[-5:-3] != ("data", "models"):
        return "Give the path of a trained .safetensors file."
    scene = model.parts[-3]
    return (
        f"Scene {scene} writes it: in the checkout, run `reskin scenes use {scene}` and then `make repro`, which takes "
        "from the cache what was computed there before."
    )


def read_network(model: Path) -> Network:
    """Read a model and the card beside it; raise if it does not answer x, y and F from changes of field."""
    card_file = model.with_suffix(".json")
    if model.is_file() and is_calibration(model):
        remedy = "Load it with reskin.load_universal."
        raise ParamsError(model, "the model", "a trained network", "a saved skin", remedy)
    if not model.is_file():
        raise ParamsError(f"{model}: model file not found. {_remedy(model)}")
    if not card_file.is_file():
        raise ParamsError(f"{card_file}: card of the model not found. Copy it with its .safetensors file.")
    content = io.read_json(card_file)
    form = content.get("format") if isinstance(content, dict) else None
    if form != FORMAT:
        raise SchemaError(card_file, "format", FORMAT, form, "Train the model again.")
    card, tensors = parse(Card, content, str(card_file)), io.read_tensors(model)[0]
    if tuple(card.output) != ANSWERS:
        rule, got = f"for {', '.join(ANSWERS)}", ", ".join(card.output) or "none"
        raise SchemaError(card_file, "the model's answers", rule, got, "Take another model.")
    if card.collapsed:
        rule, got = "one that learnt", "one that answers nearly the same to any input"
        raise SchemaError(card_file, "the model", rule, got, "Take the model of another seed.")
    _check_inputs(card, tensors, card_file)
    require("torch", model)
    return Network(content, tensors)


def _check_inputs(card: Card, tensors: Mapping[str, np.ndarray], where: Path) -> None:
    """Raise if the network does not take what its card says that it is shown."""
    shown_n = VIEW[card.recipe.inputs](np.zeros((1, card.input.channels_n), np.float32)).shape[1]
    taken_n = tensors["input_shift"].size if "input_shift" in tensors else 0
    if shown_n != taken_n:
        what = f"inputs of {card.input.channels_n} channels shown as {card.recipe.inputs}"
        rule = f"the {taken_n} that the network beside it takes"
        raise SchemaError(where, what, rule, shown_n, "Take the card of this model.")


def render(found: Estimates) -> str:
    """Write estimates as CSV: mm and N to three decimals, empty off contact."""
    (answer,) = found.answers  # of one model
    answer = np.where(found.contact[:, None], np.round(answer, 3), np.nan)
    fields = dict(zip(("x_mm", "y_mm", "F_N"), answer.T, strict=True))
    table = {"t_s": pa.array(np.round(found.t_s, 4))}
    # from_pandas: NaN becomes null, which CSV writes as an empty field
    table |= {name: pa.array(values, from_pandas=True) for name, values in fields.items()}
    return tables.render_csv(pa.table(table | {"contact": pa.array(found.contact.astype(np.int8))}))
