"""Load a trained network with `mlflow.pyfunc.load_model("runs:/RUN_ID/model")`. No pickle file is read.

The model takes changes of field in uT, one row per reading (DataFrame or array, Bx0, By0, Bz0, Bx1, ...), and returns
x_mm, y_mm and force_N.
"""

from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float

from reskin.models.trained import Network, read_network

COLUMNS = ("x_mm", "y_mm", "force_N")


class NetworkModel:
    """The model that MLflow calls."""

    def __init__(self, network: Network) -> None:
        self.network = network

    def predict(self, model_input: pd.DataFrame) -> pd.DataFrame:
        """Predict places and forces from changes of field in uT, [f ch]."""
        db_uT: Float[np.ndarray, "f ch"] = np.atleast_2d(np.asarray(model_input, np.float32))
        return pd.DataFrame(self.network(db_uT), columns=list(COLUMNS))


def _load_pyfunc(path: str) -> NetworkModel:
    """Load the weights that file MLmodel of the run names; MLflow calls this function."""
    return NetworkModel(read_network(Path(path)))
