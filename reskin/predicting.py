"""Estimate the contacts in a log with a trained model, and write their places and forces as CSV.

A log is a recording of the field over time (`reskin.logs`). The user has to choose a model that was made for the board
of the log, because only the number of channels is checked.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float, Float32, Float64

from reskin import io
from reskin.errors import ParamsError, SchemaError
from reskin.logs import ContactDetector, LogSummary, quiet_start, step_s
from reskin.metrics import register, score
from reskin.models.trained import SUFFIX, Network, read_network
from reskin.recordings import tables
from reskin.recordings.loading import READ, kind_of, read_log_blocks
from reskin.schema import Readings
from reskin.universal.calibration import is_skin
from reskin.universal.model import FILE, MISFIT_MAX, Universal, is_model, load_universal

# The model can estimate only forces in a certain range. An estimated force is said to be at a limit of this range if it
# differs from the smallest or the largest force of the range by at most this factor.
FORCE_LIMIT = 1.05
ESTIMATED_AT_ONCE_N = 2**15  # number of readings, which limits the memory that a model needs
COLUMNS = ("t_s", "x_mm", "y_mm", "F_N", "contact")


def predict(
    log: Path,
    model: Path | Sequence[Path] | None,
    out: Path,
    *,
    rate_hz: float = 400.0,
    external_uT: float = 0.0,
) -> dict[str, Any]:
    """Estimate the contacts in a log, and write them to a CSV file.

    The file has the columns t_s, x_mm, y_mm, F_N and contact, and one row for each frame of the log, except frames with
    a fault. In rows without contact, x_mm, y_mm and F_N are empty. A log of any length is read and written in blocks;
    its no-load reading and its rate are found in its first 2^18 frames.

    If the file is a table of presses with labels, its rows in contact are estimated and scored against the labels.

    Parameters
    ----------
    log
        The folder of a capture, a table that `reskin decode` wrote, a log that a board wrote to an SD card, or a table
        with labels (columns phase, x_mm, y_mm, ...; see data/README.md).
    model
        The file of a network, of a universal model, or of a calibration; or a list of the files of a universal model
        and of its calibration. With None, it is the universal model that comes with the library.
    out
        The CSV file to write.
    rate_hz
        Number of frames per second. It is used only for a table without times.
    external_uT
        Size of the external fields on a board that moves (see `load_universal`). Only for the universal model.

    Returns
    -------
    dict
        A summary of the log (see `reskin.logs.LogSummary`) or the scores of a table, and counts of dropped frames. For
        the universal model, there are further entries. Two of them count doubtful readings in contact: those whose
        misfit is above `MISFIT_MAX`, and those whose force is at a limit of the model's range. The last entry lists the
        model's warnings.
    """
    files = [] if model is None else [model] if isinstance(model, Path) else list(model)
    models = read_models(files, external_uT)
    if len(files) > 1 and not isinstance(models, Universal):
        raise ParamsError(f"{files[1]}: only one network can be used for a log. Use --model only once.")
    inputs = (log, *files, *(file.with_suffix(".json") for file in files))
    if out.resolve() in {file.resolve() for file in inputs}:
        raise ParamsError(f"--out: {out} is the log, the model or the model's card. Choose another file.")
    if log.is_file() and (kind := kind_of(log)) != "log":
        return _predict_table(*READ[kind](log), models, log, out)
    account: dict[str, int] = {}
    blocks = read_log_blocks(log, rate_hz, account)
    head = next(blocks)
    _check_channels(head.b_uT, models, log)
    quiet_n = quiet_start(head.device_s, head.b_uT, where=str(log))
    quiet_uT = head.b_uT[:quiet_n]
    if isinstance(models, Universal):
        models.zero(quiet_uT, keep=True)
    detector = ContactDetector(quiet_uT, models.suppressor if isinstance(models, Universal) else None)
    summary = LogSummary(step_s(head.device_s), quiet_n, detector.noise_uT)
    doubtful = Counter[str]()
    with io.replacing(out) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(",".join(COLUMNS) + "\n")
        parts = (part for block in chain([head], blocks) for part in block.divide(ESTIMATED_AT_ONCE_N))
        for block in parts:
            db_uT = detector.change_uT(block.b_uT)
            contact = detector.contact(db_uT)
            targets = _targets(models, db_uT[contact])
            if isinstance(models, Universal):
                doubtful.update(_count_doubtful(models, db_uT[contact], targets[:, 2]))
            summary.feed(block.device_s, contact, targets[None, :, 2])
            file.write(render(block.device_s, contact, targets))
    warned = {"model_warnings": models.warnings} if isinstance(models, Universal) else {}
    return summary.counts() | doubtful | warned | account


def _check_channels(b_uT: Float32[np.ndarray, "f ch"], models: Sequence[Network] | Universal, log: Path) -> None:
    channels_n = models.channels_n if isinstance(models, Universal) else models[0].card["input"]["channels_n"]
    if b_uT.shape[1] != channels_n:
        raise SchemaError(
            f"{log}: the log has {b_uT.shape[1]} channels, but the model has {channels_n}. Use a model for this board."
        )


def _targets(models: Sequence[Network] | Universal, db_uT: Float32[np.ndarray, "f ch"]) -> Float64[np.ndarray, "f 3"]:
    if not len(db_uT):
        return np.zeros((0, 3))
    if not isinstance(models, Universal):
        return np.asarray(models[0](db_uT), np.float64)
    found = models.estimate(db_uT + models.noload_uT)
    return np.column_stack([found.place_mm, found.force_N]).astype(np.float32).astype(np.float64)


def _predict_table(
    readings: Readings, counts: Mapping[str, int], models: Sequence[Network] | Universal, table: Path, out: Path
) -> dict[str, Any]:
    """Estimate the readings in contact of a table of presses, and score them against its labels."""
    _check_channels(readings.b_uT, models, table)
    db_uT = readings.b_uT - readings.noload_uT
    if isinstance(models, Universal):
        models.zero(readings.noload_uT, keep=True)
    targets = _targets(models, db_uT)
    io.write_text(out, ",".join(COLUMNS) + "\n" + render(readings.t_s, np.ones(len(readings), bool), targets))
    true = np.column_stack([readings.x_mm, readings.y_mm, readings.Fz_N]).astype(np.float64)
    scores = score(true, targets)
    return {
        "readings_n": len(readings),
        "accuracy_pct": scores["accuracy_pct"],
        "accuracy_registered_pct": score(true, register(true, targets))["accuracy_pct"],
        **({"rms_force_N": float(np.sqrt(scores["mse_f_N2"]))} if "mse_f_N2" in scores else {}),
        **({"model_warnings": models.warnings} if isinstance(models, Universal) else {}),
        **counts,
    }


def _count_doubtful(
    model: Universal, db_uT: Float32[np.ndarray, "c ch"], force_N: Float[np.ndarray, " c"]
) -> dict[str, int]:
    """Count the readings in contact whose misfit is above `MISFIT_MAX`, or whose force is at a limit of the range."""
    misfit = model.misfit(db_uT + model.noload_uT) if len(db_uT) else np.zeros(0)
    lowest_N, highest_N = model.layout.force_N
    at_limit = (force_N <= FORCE_LIMIT * lowest_N) | (force_N >= highest_N / FORCE_LIMIT)
    return {
        "unknown_skin_readings_n": int((misfit > MISFIT_MAX).sum()),
        "force_at_limit_readings_n": int(at_limit.sum()),
    }


def warnings(counts: Mapping[str, Any]) -> list[str]:
    """Return warnings for the user if the counts that `predict` returned show that some estimates are doubtful."""
    sentences, contact_n = list(counts.get("model_warnings", [])), counts.get("contact_readings_n")
    if unknown_n := counts.get("unknown_skin_readings_n"):
        sentences.append(
            f"unknown skin: the misfit is above {MISFIT_MAX:g} in {unknown_n} of {contact_n} readings in contact. "
            "Check the order of the chips in the log, and use a model for this kind of skin."
        )
    if limit_n := counts.get("force_at_limit_readings_n"):
        sentences.append(
            f"{limit_n} of {contact_n} readings in contact are at a limit of the model's force range; the true force "
            "may be outside it."
        )
    return sentences


def read_models(files: Sequence[Path], external_uT: float = 0.0) -> Sequence[Network] | Universal:
    """Read the models in the given files.

    `files` may contain one or several trained networks, a universal model, a calibration, or a universal model and a
    calibration of it. A calibration without a universal model is one of the universal model that comes with the
    library. If `files` is empty, this universal model is returned without a calibration.

    `external_uT` is explained in `load_universal`. It must be 0 for networks.
    """
    made = [file for file in files if is_model(file)]
    others = [file for file in files if file not in made and file.suffix == SUFFIX and file.is_file()]
    calibrations = [file for file in others if is_skin(file)]
    if not (made or calibrations):
        if files and external_uT:
            raise ParamsError(f"{files[0]}: networks have no option for external fields. Use the universal model.")
        return [read_network(file) for file in files] or load_universal(external_uT=external_uT)
    if missing := [file for file in files if not file.exists()]:
        raise ParamsError(f"{missing[0]}: file not found. Check the path.")
    if max(len(made), len(calibrations)) > 1 or len(made) + len(calibrations) < len(files):
        kind = "universal model" if made else "calibration"
        remedy = "Pass only this file, or one universal model and one calibration."
        raise ParamsError(f"{(made or calibrations)[0]}: a {kind} cannot be combined with other models. {remedy}")
    calibration, model = calibrations[0] if calibrations else None, made[0] if made else FILE
    return load_universal(calibration, file=model, external_uT=external_uT)


def render(t_s: Float64[np.ndarray, " f"], contact: Bool[np.ndarray, " f"], targets: Float64[np.ndarray, "c 3"]) -> str:
    """Return the estimates of the readings in contact as lines of a CSV file with the columns `COLUMNS`.

    Places and forces have three decimals. They are empty in rows without contact.
    """
    values = np.full((len(contact), 3), np.nan)
    values[contact] = np.round(targets, 3)
    # `from_pandas` converts NaN to null, which is an empty field in CSV.
    columns = [pa.array(column, from_pandas=True) for column in (np.round(t_s, 4), *values.T)]
    table = pa.table(dict(zip(COLUMNS, [*columns, pa.array(contact.astype(np.int8))], strict=True)))
    return tables.render_csv(table).partition("\n")[2]
