"""Texts of the page about the model in use: its name, calibration data, expected accuracy and lightest tested force.

The expected accuracies are results of the pipeline. Each model has a card, which is a JSON file with information about
the model. The accuracy of a trained network is in the network's card. The accuracy of the universal model that is
shipped with the package is in `reskin/universal/measured.json`. It is not in the card of this model, because the
accuracy is measured after the card has been written and depends on it. The accuracy of other universal models was not
measured.
"""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from reskin import io
from reskin.config import Strict, parse
from reskin.live.tracker import LearningState, Models, NetworkEstimator, UniversalEstimator
from reskin.models.trained import Network
from reskin.universal.model import FILE, Universal

MEASURED_FILE = FILE.with_name("measured.json")
NOT_MEASURED = "not measured"
ByBoard = Annotated[tuple[float, ...], Field(min_length=1)]  # one value per recorded board


class MeasuredAccuracy(Strict):
    """The measured accuracy of a model on recorded boards that were not used for training, after a calibration."""

    presses_n: int  # number of presses at unknown places in the calibration
    labels_n: int  # number of labelled presses in the calibration
    accuracy_pct: ByBoard  # percentage of readings whose error is at most 1 mm along x and along y
    median_mm: ByBoard  # median error of the place
    mse_xy_mm2: ByBoard


class MeasuredDetection(Strict):
    """The measured detection of light touches on recorded boards."""

    lightest_N: ByBoard  # force of the lightest recorded presses
    detected_pct: ByBoard  # percentage of these presses that were detected
    false_alarm_pct: ByBoard  # percentage of readings without contact that were reported as a contact


class Measured(Strict):
    """The results of the shipped universal model on the recorded boards of a scene."""

    scene: str
    source: Literal["recorded"]
    model_sha256: str  # digest of the model file whose results these are
    places: tuple[MeasuredAccuracy, ...]  # sorted by presses_n, and then by labels_n
    detection: MeasuredDetection


def describe(
    estimator: NetworkEstimator | UniversalEstimator | None, models: Models, model_name: str
) -> dict[str, str | bool]:
    """Return the texts `model`, `learnt`, `expected` and `least_force` of the page, and whether `undo` and `refine`
    are possible.

    `models` are the models that the user has chosen. `model_name` contains the names of their files. It is empty for
    the universal model that is shipped with the package.
    """
    if isinstance(estimator, UniversalEstimator):
        state, model = estimator.learnt, estimator.model
        name = f"universal model, {f'file {model_name}' if model_name else 'shipped with reskin'}"
        return {
            "model": name + (f", with the saved skin {state.origin_name}" if state.origin_name else ""),
            "learnt": _learnt(state), "undoable": estimator.undoable, "refinable": model.refinable,
            "expected": _expected_of_universal(model), "least_force": _least_force_of_universal(model),
        }  # fmt: skip
    if isinstance(estimator, NetworkEstimator) and not isinstance(models, Universal):
        kind = "trained network" if len(models) == 1 else f"mean of {len(models)} trained networks"
        return {
            "model": f"{kind}, file {model_name}" if model_name else kind, "learnt": "",
            "undoable": False, "refinable": False,
            "expected": _expected_of_networks(models), "least_force": NOT_MEASURED,
        }  # fmt: skip
    return {"model": "", "learnt": "", "undoable": False, "refinable": False, "expected": "", "least_force": ""}


def _learnt(state: LearningState) -> str:
    counts = {
        f"in {state.origin_name or 'the file'}": state.origin.presses_n,
        "anywhere": len(state.presses_uT),
        "at crosses": len(state.guided.db_uT),
        "with a label that you entered": len(state.typed.db_uT),
    }
    learnt = ", ".join(f"{count} press{'es' if count > 1 else ''} {what}" for what, count in counts.items() if count)
    return f"{learnt}; network refined" if state.refined else learnt


def _expected_of_universal(model: Universal) -> str:
    measured = _measured_of(model)
    if measured is None:
        return f"{NOT_MEASURED} for this model"
    if model.skin.data.refined:
        return f"{NOT_MEASURED} for a refined network"
    own_n = model.presses_n - model.labels_n, model.labels_n
    fitting = [each for each in measured.places if each.presses_n <= own_n[0] and each.labels_n <= own_n[1]]
    if not fitting:
        return f"{NOT_MEASURED} for so few presses"
    best = fitting[-1]
    when = f"after {best.presses_n} presses and {best.labels_n} labels" if best.presses_n else "before calibration"
    accuracy, error = _join(best.accuracy_pct, ".0f"), _join(best.median_mm, ".1f")
    boards = f"{len(best.accuracy_pct)} {measured.source} boards of scene {measured.scene}"
    text = f"median error {error} mm, {accuracy} % within 1 mm ({boards}, {when})"
    return text if not model.external_uT else f"{text}; {NOT_MEASURED} with external fields"


def _least_force_of_universal(model: Universal) -> str:
    measured, least_N = _measured_of(model), model.layout.force_N[0]
    trained = f"trained with simulated forces from {least_N:.2g} N"
    if measured is None:
        return f"{NOT_MEASURED}; {trained}"
    found = measured.detection
    return (
        f"{_join(found.detected_pct, '.0f')} % of the lightest recorded presses ({_join(found.lightest_N, '.2g')} N) "
        f"were detected; lighter presses {NOT_MEASURED}; {trained}"
    )


def _expected_of_networks(networks: Sequence[Network]) -> str:
    scores = networks[0].card.get("scores", {}).get("all", {})
    if len(networks) > 1 or not {"accuracy_pct", "mse_xy_mm2"} <= scores.keys():
        return f"{NOT_MEASURED} for {'their mean' if len(networks) > 1 else 'this network'}"
    card = networks[0].card
    boards = ", ".join(map(str, card.get("test_boards", ()))) or "unknown"
    return (
        f"{scores['accuracy_pct']:.0f} % within 1 mm, MSE_xy {scores['mse_xy_mm2']:.2f} mm² "
        f"(scene {card.get('scene', 'unknown')}, tested on boards {boards})"
    )


def _join(values: Sequence[float], digits: str) -> str:
    return " and ".join(format(value, digits) for value in values)


def _measured_of(model: Universal) -> Measured | None:
    """Return the results of a model if it is the shipped universal model, and if these results belong to its file."""
    card, measured = _shipped()
    return measured if model.card == card else None


@cache
def _shipped() -> tuple[dict[str, Any], Measured | None]:
    """Return the card of the shipped model, and its results; None if they are results of another model file."""
    measured = read_measured(MEASURED_FILE)
    return io.read_json(FILE.with_suffix(".json")), measured if measured.model_sha256 == io.sha256(FILE) else None


def read_measured(file: Path) -> Measured:
    """Read the results of the shipped universal model."""
    return parse(Measured, io.read_json(file), str(file))
