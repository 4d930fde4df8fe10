"""A log and a model -> contacts, places and forces over time, as a CSV. The path of stage logs, for anybody's files.

Refuses to know scenes and folds: whether the model ever saw the log's board is for its user to know.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline import io
from pipeline.capture import columns, sd_card
from pipeline.errors import ParamsError, SchemaError, complain
from pipeline.evaluation.logs import Estimates, describe, estimate
from pipeline.learning.card import FORMAT
from pipeline.stages._networks import Network

ANSWERS = ("x_mm", "y_mm", "Fz_N")


def predict(log: Path, model: Path, out: Path) -> dict[str, Any]:
    """Write t_s, x_mm, y_mm, F_N and contact of every sound line of a log; give the account of what was read.

    Places and forces are left empty where there is no contact.
    """
    network = read_network(model)
    if out.resolve() == log.resolve():
        raise ParamsError(complain("--out", "the file to write", "another than the log", out, "Choose another --out."))
    t_s, b_uT, _, account = sd_card.read_log(log)
    channels_n = network.card["input"]["channels_n"]
    if b_uT.shape[1] != channels_n:
        remedy = "Take a model of such boards."
        raise SchemaError(complain(log, "channels", f"the {channels_n} of the model", b_uT.shape[1], remedy))
    found = estimate(t_s, b_uT, [network], where=str(log))
    io.write_text(out, render(found))
    return describe(found) | account


def read_network(model: Path) -> Network:
    """Read a model and the card beside it; raise if it does not answer x, y and F from changes of field."""
    card_file = model.with_suffix(".json")
    for file, what in ((model, "the model"), (card_file, "the card beside the model")):
        if not file.is_file():
            raise ParamsError(complain(file, what, "there", "nothing", "Give --model a trained .safetensors file."))
    card = io.read_json(card_file)
    form, answers = (card.get(name) if isinstance(card, dict) else None for name in ("format", "output"))
    if form != FORMAT:
        raise SchemaError(complain(card_file, "format", FORMAT, form, "Train the model again."))
    if tuple(answers or ()) != ANSWERS:
        rule = f"for {', '.join(ANSWERS)}"
        raise SchemaError(complain(card_file, "the model's answers", rule, list(answers or ()), "Take another model."))
    return Network(card, io.read_tensors(model)[0])


def render(found: Estimates) -> str:
    """Write estimates as CSV: mm and N to three decimals, empty off contact."""
    answer = np.where(found.contact[:, None], np.round(found.answer, 3), np.nan)
    fields = dict(zip(("x_mm", "y_mm", "F_N"), answer.T, strict=True))
    table = {"t_s": pa.array(np.round(found.t_s, 4))}
    # from_pandas: NaN becomes null, which CSV writes as an empty field
    table |= {name: pa.array(values, from_pandas=True) for name, values in fields.items()}
    return columns.render(pa.table(table | {"contact": pa.array(found.contact.astype(np.int8))}))
