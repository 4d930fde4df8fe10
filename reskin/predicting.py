"""Estimate the contacts in a log with a trained model, and write their places and forces as CSV.

A log is a recording of the field over time (`reskin.logs`). The user has to choose a model that was made for the board
of the log, because only the number of channels is checked.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Float32

from reskin import io
from reskin.errors import ParamsError, SchemaError
from reskin.logs import Estimator, LogEstimates, describe, estimate, quiet_start
from reskin.models.trained import SUFFIX, Network, read_network
from reskin.recordings import tables
from reskin.recordings.loading import read_any_log
from reskin.universal.calibration import is_skin
from reskin.universal.model import FILE, MISFIT_MAX, Universal, is_model, load_universal

# The model can estimate only forces in a certain range. An estimated force is said to be at a limit of this range if it
# differs from the smallest or the largest force of the range by at most this factor.
FORCE_LIMIT = 1.05


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
    a fault. In rows without contact, x_mm, y_mm and F_N are empty.

    Parameters
    ----------
    log
        The folder of a capture, a table that `reskin decode` wrote, or a log that a board wrote to an SD card.
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
        A summary of the log (see `reskin.logs.describe`), and counts of dropped frames. For the universal model, there
        are further entries. Two of them count doubtful readings in contact: those whose misfit is above `MISFIT_MAX`,
        and those whose force is at a limit of the model's range. The last entry lists the model's warnings.
    """
    files = [] if model is None else [model] if isinstance(model, Path) else list(model)
    models = read_models(files, external_uT)
    if len(files) > 1 and not isinstance(models, Universal):
        raise ParamsError(f"{files[1]}: only one network can be used for a log. Use --model only once.")
    inputs = (log, *files, *(file.with_suffix(".json") for file in files))
    if out.resolve() in {file.resolve() for file in inputs}:
        raise ParamsError(f"--out: {out} is the log, the model or the model's card. Choose another file.")
    t_s, b_uT, _, counts = read_any_log(log, rate_hz)
    channels_n = models.channels_n if isinstance(models, Universal) else models[0].card["input"]["channels_n"]
    if b_uT.shape[1] != channels_n:
        raise SchemaError(
            f"{log}: the log has {b_uT.shape[1]} channels, but the model has {channels_n}. Use a model for this board."
        )
    estimators: Sequence[Estimator]
    if isinstance(models, Universal):
        models.zero(b_uT[: quiet_start(t_s, b_uT, where=str(log))], keep=True)
        estimators = [universal := _UniversalOfLog(models)]
        find_suppressor = models.suppressor
    else:
        estimators, universal, find_suppressor = models, None, None
    estimates = estimate(t_s, b_uT, estimators, where=str(log), find_suppressor=find_suppressor)
    io.write_text(out, render(estimates))
    return describe(estimates) | ({} if universal is None else universal.count_suspects(estimates)) | counts


class _UniversalOfLog:
    """Adapter with which the universal model can be used as an `Estimator`. It stores the misfit of each reading."""

    def __init__(self, model: Universal) -> None:
        self._model = model
        self._misfit = np.empty(0)

    def __call__(self, db_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f 3"]:
        b_uT = db_uT + self._model.noload_uT
        result, self._misfit = self._model.estimate(b_uT), self._model.misfit(b_uT)
        return np.column_stack([result.place_mm, result.force_N]).astype(np.float32)

    def count_suspects(self, estimates: LogEstimates) -> dict[str, Any]:
        """Count the readings in contact whose estimates are doubtful.

        These are the readings whose misfit is above `MISFIT_MAX`, and the readings whose estimated force is at a limit
        of the model's range. The result also contains the warnings of the model.
        """
        force_N = estimates.targets[0, estimates.contact, 2]
        lowest_N, highest_N = self._model.layout.force_N
        at_limit = (force_N <= FORCE_LIMIT * lowest_N) | (force_N >= highest_N / FORCE_LIMIT)
        return {
            "unknown_skin_readings_n": int((self._misfit[estimates.contact] > MISFIT_MAX).sum()),
            "force_at_limit_readings_n": int(at_limit.sum()),
            "model_warnings": self._model.warnings,
        }


def warnings(counts: Mapping[str, Any]) -> list[str]:
    """Return warnings for the user if the counts that `predict` returned show that some estimates are doubtful."""
    sentences, contact_n = list(counts.get("model_warnings", [])), counts["contact_readings_n"]
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
    calibrations = [file for file in files if file not in made and file.is_file() and _is_calibration(file)]
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


def _is_calibration(file: Path) -> bool:
    try:
        return is_skin(file)
    except SchemaError:
        if file.suffix == SUFFIX:
            raise
        return False  # The error is reported later, by `read_network`.


def render(estimates: LogEstimates) -> str:
    """Return the estimates of a single model as the text of a CSV file.

    Places and forces have three decimals. They are empty in rows without contact.
    """
    (target,) = estimates.targets
    target = np.where(estimates.contact[:, None], np.round(target, 3), np.nan)
    fields = dict(zip(("x_mm", "y_mm", "F_N"), target.T, strict=True))
    table = {"t_s": pa.array(np.round(estimates.t_s, 4))}
    # `from_pandas` converts NaN to null, which is an empty field in CSV.
    table |= {name: pa.array(values, from_pandas=True) for name, values in fields.items()}
    return tables.render_csv(pa.table(table | {"contact": pa.array(estimates.contact.astype(np.int8))}))
