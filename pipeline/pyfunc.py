"""Load a trained network with `mlflow.pyfunc.load_model("runs:/RUN_ID/model")`, without pickle files.

The model takes field changes in uT, one row per reading (DataFrame or array with columns Bx0, By0, Bz0, Bx1, ...), and
returns x_mm, y_mm and force_N.
"""

from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float

from reskin.models.trained import Network, read_network

COLUMNS = ("x_mm", "y_mm", "force_N")


class NetworkModel:
    """A trained network with the method `predict` that MLflow calls."""

    def __init__(self, network: Network) -> None:
        self.network = network

    def predict(self, model_input: pd.DataFrame) -> pd.DataFrame:
        """Predict x_mm, y_mm and force_N from field changes in uT, one row per reading."""
        db_uT: Float[np.ndarray, "f ch"] = np.atleast_2d(np.asarray(model_input, np.float32))
        return pd.DataFrame(self.network(db_uT), columns=list(COLUMNS))


def _load_pyfunc(path: str) -> NetworkModel:
    """Load the network whose weights are in the file `path`; MLflow calls this function with the path in MLmodel."""
    return NetworkModel(read_network(Path(path)))
