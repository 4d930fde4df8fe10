"""Write models in MLflow's format, and load them without pickle files.

The input of every model is a table of field changes since the no-load reading, in uT. It has one row per reading, and
columns Bx0, By0, Bz0, Bx1, ... The output has columns x_mm, y_mm and force_N. The universal model can also be
calibrated by MLflow's `params`:

noload_uT      no-load reading of the skin (one value per channel)
presses_uT     field changes of presses at unknown places, one press after the other
labelled_uT    field changes of presses at known places, one press after the other
labels         x_mm, y_mm and force_N of each of these presses, one press after the other

    >>> import mlflow
    >>> model = mlflow.pyfunc.load_model("models:/reskin-universal@champion")  # doctest: +SKIP
    >>> model.predict(readings, params={"noload_uT": noload_uT, "presses_uT": presses_uT.ravel()})  # doctest: +SKIP
"""

import json
import platform
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
from jaxtyping import Float

from reskin import draw_skin, io, simulate_pokes
from reskin.models.trained import Network, read_network
from reskin.universal.model import Universal, is_model, load_universal

LOADER = "pipeline.pyfunc"
FOLDER = "model"  # folder of a model among the artifacts of a run
COLUMNS = ("x_mm", "y_mm", "force_N")
EXAMPLE, SERVING_EXAMPLE = "input_example.json", "serving_input_example.json"
LABEL_N = len(COLUMNS)  # number of values in a label: x, y and force
# The example of a model's input consists of EXAMPLE_N readings: those with the largest field changes among the first
# EXAMPLE_OF_N readings of a capture.
EXAMPLE_N, EXAMPLE_OF_N = 3, 2000
PARAMS = ("noload_uT", "presses_uT", "labelled_uT", "labels")


def channel_names(channels_n: int) -> list[str]:
    """Name the channels of a reading: Bx0, By0, Bz0, Bx1, ...

    >>> channel_names(6)
    ['Bx0', 'By0', 'Bz0', 'Bx1', 'By1', 'Bz1']
    """
    return [f"B{axis}{chip_i}" for chip_i in range(channels_n // 3) for axis in "xyz"]


# --- Loading ---


class NetworkModel:
    """A trained network with the method `predict` that MLflow calls."""

    def __init__(self, network: Network) -> None:
        self.network = network

    def predict(self, model_input: pd.DataFrame, params: Mapping[str, Any] | None = None) -> pd.DataFrame:
        """Predict x_mm, y_mm and force_N from field changes in uT, one row per reading."""
        db_uT: Float[np.ndarray, "f ch"] = np.atleast_2d(np.asarray(model_input, np.float32))
        return pd.DataFrame(self.network(db_uT), columns=list(COLUMNS))


class UniversalModel:
    """The universal model with the method `predict` that MLflow calls; `params` calibrate it to a skin.

    The last calibration is kept, so that a program that sends single readings with equal `params` waits for calibration
    only once.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self._key: str | None = None
        self._calibrated: Universal

    def predict(self, model_input: pd.DataFrame, params: Mapping[str, Any] | None = None) -> pd.DataFrame:
        """Predict x_mm, y_mm and force_N from field changes in uT, one row per reading."""
        given = {name: np.asarray((params or {}).get(name, []), float) for name in PARAMS}
        key = json.dumps({name: values.tolist() for name, values in given.items()})
        if key != self._key:
            self._calibrated, self._key = self._calibrate(**given), key
        db_uT: Float[np.ndarray, "f ch"] = np.atleast_2d(np.asarray(model_input, np.float32))
        return pd.DataFrame(self._calibrated(db_uT), columns=list(COLUMNS))

    def _calibrate(
        self,
        noload_uT: Float[np.ndarray, "*ch"],
        presses_uT: Float[np.ndarray, "*nch"],
        labelled_uT: Float[np.ndarray, "*mch"],
        labels: Float[np.ndarray, "*m3"],
    ) -> Universal:
        model = load_universal(file=self.file)
        rest_uT = noload_uT if noload_uT.size else typical_noload_uT(model)
        model.zero(rest_uT[None])
        if presses_uT.size:
            model.see(presses_uT.reshape(-1, model.channels_n) + rest_uT)
        if labelled_uT.size or labels.size:
            places_and_forces = labels.reshape(-1, LABEL_N)
            readings_uT = labelled_uT.reshape(-1, model.channels_n) + rest_uT
            model.label(places_and_forces[:, :2], places_and_forces[:, 2], readings_uT)
        return model


def typical_noload_uT(model: Universal) -> Float[np.ndarray, " ch"]:
    """Return the no-load reading of a nominal skin, along the chips' axes."""
    return np.asarray(model.layout.to_chips(model.tables.rest_uT[None])[0])


def _load_pyfunc(path: str) -> NetworkModel | UniversalModel:
    """Load the model whose weights are in the file `path`; MLflow calls this function with the path in MLmodel.

    This function also makes a first prediction, which compiles code and imports PyTorch. Otherwise a server would
    answer its first request late.
    """
    file = Path(path)
    model: NetworkModel | UniversalModel
    if is_model(file):
        model, channels_n = UniversalModel(file), load_universal(file=file).channels_n
    else:
        network = read_network(file)
        model, channels_n = NetworkModel(network), network.card["input"]["channels_n"]
    model.predict(pd.DataFrame(np.ones((1, channels_n))))
    return model


# --- Writing ---


def write_model_files(
    folder: Path, weights: Path, example_uT: Float[np.ndarray, "f ch"], *, run_id: str, created: str
) -> dict[str, Any]:
    """Write a model in MLflow's format to a folder; return the content of its file MLmodel.

    The folder contains the weights and their card. MLmodel names the loader, the signature and the file of the example.
    The example is written twice: as input of `predict`, and as body of a request to `mlflow models serve`.

    Parameters
    ----------
    folder
        An empty folder.
    weights
        The model's weights (.safetensors); its card is beside it.
    example_uT
        Field changes of some readings, with the model's number of channels; there may be no readings.
    run_id, created
        Id of the run that the model belongs to; time at which the model was made, in ISO format.
    """
    names = channel_names(example_uT.shape[1])
    for file in (weights, weights.with_suffix(".json")):
        (folder / file.name).write_bytes(file.read_bytes())
    about = {
        "artifact_path": FOLDER,
        "flavors": {
            "python_function": {
                "loader_module": LOADER,
                "data": weights.name,
                "python_version": platform.python_version(),
            }
        },
        "run_id": run_id,
        "utc_time_created": created,
        "signature": {
            "inputs": json.dumps([_column(name) for name in names]),
            "outputs": json.dumps([_column(name) for name in COLUMNS]),
            "params": json.dumps([_param(name) for name in PARAMS]) if is_model(weights) else None,
        },
    }
    if len(example_uT):
        table = {"columns": names, "data": np.asarray(example_uT, float).round(4).tolist()}
        io.write_json(folder / EXAMPLE, table)
        io.write_json(folder / SERVING_EXAMPLE, {"dataframe_split": table})
        about["saved_input_example_info"] = {
            "artifact_path": EXAMPLE,
            "pandas_orient": "split",
            "serving_input_path": SERVING_EXAMPLE,
            "type": "dataframe",
        }
    io.write_text(
        folder / "MLmodel", json.dumps(about, indent=2)
    )  # MLflow reads this file as YAML, and JSON is valid YAML
    return about


def _column(name: str) -> dict[str, Any]:
    return {"type": "double", "name": name, "required": True}


def _param(name: str) -> dict[str, Any]:
    return {"name": name, "type": "double", "default": [], "shape": [-1]}


def read_example(files: Iterable[Path]) -> Float[np.ndarray, "f ch"] | None:
    """Return field changes of a few contact readings from the first existing file; None if no file exists."""
    for file in files:
        if file.exists():
            with pq.ParquetFile(file) as table:
                batch = next(table.iter_batches(EXAMPLE_OF_N, columns=["b_uT", "noload_uT"]))
            b_uT, noload_uT = (np.array(batch[name].to_pylist()) for name in ("b_uT", "noload_uT"))
            db_uT = b_uT - noload_uT
            strongest = np.argsort(np.nan_to_num(np.linalg.norm(db_uT, axis=1)))[-EXAMPLE_N:]
            return np.asarray(db_uT[np.sort(strongest)])
    return None


def simulated_example() -> Float[np.ndarray, "f ch"]:
    """Return field changes of a few presses of a simulated skin on the paper's board."""
    noload_uT, b_uT, _ = simulate_pokes(draw_skin(seed=1), [[8.0, 8.0, 1.0], [4.0, 10.0, 0.8], [11.0, 6.0, 1.2]])
    return b_uT - noload_uT
