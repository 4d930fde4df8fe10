"""Learning for magnetic tactile skins: boards, recordings, simulation, models and calibration.

=====================================  ==========================================================
`open`                                 read contacts from a board as they happen
`record`, `lifted`, `touch`            record a board, while the program of a robot labels the contacts
`load_universal`                       the universal model, which can be calibrated to any skin
`load_model`, `Model`                  a trained network
`load_recording`                       a recording of any kind, as a pandas DataFrame with units
`load_rows`                            contact readings, as training data for networks
`draw_skin`, `draw_board`              simulated skins and boards
`simulate_pokes`, `Pokes`              indentations of a simulated skin
`simulate_recording`                   the recording of a simulated board, with the same files that `record` writes
`ContactRegressor`                     the paper's network as an estimator of scikit-learn
`SCORERS`                              the paper's metrics, for scikit-learn's `cross_val_score`
=====================================  ==========================================================

    >>> import reskin
    >>> skin = reskin.draw_skin(seed=1)
    >>> noload_uT, b_uT, force_N = reskin.simulate_pokes(skin, [[8.0, 8.0, 1.0]])
    >>> b_uT.shape
    (1, 15)

Each of these names is imported when it is first used, so that `import reskin` is quick.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from reskin.errors import missing_package
from reskin.numerics import pin

pin()  # must run before NumPy is imported

if TYPE_CHECKING:
    from reskin.api import (
        Model,
        Pokes,
        draw_board,
        draw_skin,
        lifted,
        load_model,
        load_recording,
        load_rows,
        load_universal,
        open,
        record,
        simulate_pokes,
        simulate_recording,
        touch,
    )
    from reskin.estimators import SCORERS as SCORERS
    from reskin.estimators import ContactRegressor as ContactRegressor

__all__ = [
    "Model",
    "Pokes",
    "draw_board",
    "draw_skin",
    "lifted",
    "load_model",
    "load_recording",
    "load_rows",
    "load_universal",
    "open",
    "record",
    "simulate_pokes",
    "simulate_recording",
    "touch",
]
# Names that need scikit-learn. They are not in `__all__`, so that `from reskin import *` works without it.
_ESTIMATORS = ("SCORERS", "ContactRegressor")


def __getattr__(name: str) -> Any:
    if name in _ESTIMATORS:
        if find_spec("sklearn") is None:
            raise missing_package("scikit-learn", f"reskin.{name}", extra="learn")
        # The module is imported by its name in a string, so that `reskin.code` does not find this import. Otherwise,
        # the training code would count as imported by every stage.
        return getattr(import_module("reskin.estimators"), name)
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from reskin import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *(_ESTIMATORS if find_spec("sklearn") else ())})
