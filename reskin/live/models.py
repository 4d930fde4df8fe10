"""The models of a live board: their estimates, their calibration on the page, and the folder of saved skins."""

import re
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from copy import copy
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from reskin import io
from reskin.errors import DISK_REMEDIES, ParamsError, SchemaError
from reskin.models.inputs import VIEW, Scaler
from reskin.models.trained import SUFFIX, Network
from reskin.recordings.header import NAME
from reskin.universal.model import FILE, MISFIT_MAX, Estimate, Universal

# A reading is outside a network's training distribution if one of the network's inputs is larger than this number of
# standard deviations of the training data. The value is assumed. For models that were trained in the same scene, the
# largest observed input is 6 in scene `quick` and 7 in scene `lab`.
UNKNOWN_SDS = 10.0
UNDO_MAX_N = 100  # largest number of calibration steps that can be undone
# A label is doubtful if it differs from the estimate by more than both of these. In simulation (24 skins, 0 to 30
# earlier labels), no right label of 2,160 differs so much.
LABEL_OFF_MM, LABEL_OFF_SDS = 3.0, 4.0
SKINS = Path("skins")  # default folder of saved skins, in the working directory
MEASURED_FILE = FILE.with_name("measured.json")
NOT_MEASURED = "not measured"

# The model that estimates contacts. If it is an empty sequence of networks, no place and no force is estimated.
Models = Sequence[Network] | Universal


class Prediction(NamedTuple):
    """The predictions of a model for f readings that were taken during contact."""

    target: Float64[np.ndarray, "f 3"]  # x_mm, y_mm and F_N
    sd_mm: Float64[np.ndarray, "f 2"]  # standard deviation of the place; NaN if unknown
    sd_F_N: Float64[np.ndarray, " f"]  # standard deviation of the force; NaN if unknown
    unknown: Bool[np.ndarray, " f"]  # whether a reading is outside the model's training distribution


class NetworkEstimator:
    """An estimator that uses one or more trained networks.

    The prediction is the mean of the networks. Its uncertainty is the standard deviation between the networks.
    """

    def __init__(self, networks: Sequence[Network]) -> None:
        self.channels_n: int = networks[0].card["input"]["channels_n"]
        self.name = f"{len(networks)} network{'s' if len(networks) > 1 else ''}"
        self.networks = networks
        self._inputs = [
            (VIEW[network.card["recipe"]["inputs"]], Scaler.of_arrays(network.tensors)) for network in networks
        ]
        # Each network predicts once here, so that torch is imported and the network is built before the first contact.
        for network in networks:
            network(np.zeros((1, network.card["input"]["channels_n"]), np.float32))

    def set_noload(self, noload_uT: Float[np.ndarray, " ch"]) -> None:
        """Do nothing, because networks use only field changes and not the no-load reading."""

    def __call__(self, db_uT: Float32[np.ndarray, "f ch"]) -> Prediction:
        targets = np.stack([network(db_uT) for network in self.networks]).astype(np.float64)
        sd = targets.std(axis=0, ddof=1) if len(targets) > 1 else np.full((len(db_uT), 3), np.nan)
        inputs_sds = np.stack([np.abs(scaler.encode(view(db_uT))).max(axis=1) for view, scaler in self._inputs])
        unknown = np.asarray((inputs_sds > UNKNOWN_SDS).any(axis=0))
        return Prediction(targets.mean(axis=0), sd[:, :2], sd[:, 2], unknown)

    def describe(self, model_name: str) -> dict[str, str | bool]:
        """Return texts for the page. `model_name` contains the names of the files."""
        networks, several = self.networks, len(self.networks) > 1
        kind = f"mean of {len(networks)} trained networks" if several else "trained network"
        card = networks[0].card
        scores = card.get("scores", {}).get("all", {})
        expected = f"{NOT_MEASURED} for {'their mean' if several else 'this network'}"
        if not several and {"accuracy_pct", "mse_xy_mm2"} <= scores.keys():
            boards = ", ".join(map(str, card.get("test_boards", ()))) or "unknown"
            expected = (
                f"{scores['accuracy_pct']:.0f} % within 1 mm, MSE_xy {scores['mse_xy_mm2']:.2f} mm² "
                f"(scene {card.get('scene', 'unknown')}, tested on boards {boards})"
            )
        model = f"{kind}, file {model_name}" if model_name else kind
        return {"model": model, "expected": expected, "least_force": NOT_MEASURED}


class Step(NamedTuple):
    """A step of the calibration, and the model after it."""

    kind: str  # which presses the step adds, such as "anywhere"
    what: str  # description of the step, such as "calibration to 12 presses"
    model: Universal
    presses_n: Mapping[str, int]  # number of presses of each kind that the model knows
    skin: str = ""  # name of the saved skin that was loaded last


class UniversalEstimator:
    """An estimator that uses a universal model, and calibrates it to the skin while the board is running.

    The estimator calibrates copies of the model. The model that was passed is not changed. Each step of the calibration
    adds to the earlier ones, but if `adapt` or `label` is called again, the new presses replace those of the call
    before, so that the user can repeat bad presses. `undo` reverts the last step. Each step returns a text for the
    user. It raises SchemaError if its data cannot be used, such as presses within the noise; the calibration is then
    unchanged.
    """

    name = "universal model"

    def __init__(self, model: Universal) -> None:
        self.channels_n, self.board = model.channels_n, model.layout
        self._noload_uT: Float[np.ndarray, " ch"] | None = None  # until it is set, the model keeps its own
        self._steps = [Step("", "", copy(model), {"in the file": model.presses_n})]
        self._prepare()

    @property
    def model(self) -> Universal:
        """The calibrated model."""
        return self._steps[-1].model

    @property
    def undoable(self) -> bool:
        """Whether there is a calibration step that `undo` can revert."""
        return len(self._steps) > 1

    def set_noload(self, noload_uT: Float[np.ndarray, " ch"]) -> None:
        """Set the no-load field, and keep the calibration."""
        self._noload_uT = noload_uT
        for step in self._steps:
            step.model.zero(noload_uT, keep=True)
        self._prepare()

    def adapt(self, db_uT: Float[np.ndarray, "n ch"]) -> str:
        """Calibrate to the field changes of presses at unknown places."""
        n, before = len(db_uT), self._estimate(db_uT)
        base = self._last_without("anywhere")
        model = copy(base.model).see(db_uT, changes=True)
        self._learn("anywhere", f"calibration to {n} presses", model, n, base)
        sd_mm = [np.median(estimate.sd_mm.max(axis=1)) for estimate in (before, self._estimate(db_uT))]
        return (
            f"adapted to {n} presses: median standard deviation of the places {sd_mm[0]:.2f} mm before, "
            f"{sd_mm[1]:.2f} mm after"
        )

    def label(
        self, place_mm: Float[np.ndarray, "n 2"], db_uT: Float[np.ndarray, "n ch"], held_out: Bool[np.ndarray, " n"]
    ) -> str:
        """Calibrate to presses at known places, except for presses that are held out to measure the error.

        The forces of the presses were not measured.
        """

        def error_mm() -> float:
            estimated_mm = self._estimate(db_uT[held_out]).place_mm
            return float(np.median(np.linalg.norm(estimated_mm - place_mm[held_out], axis=1)))

        before_mm, n, base = error_mm(), int((~held_out).sum()), self._last_without("at crosses")
        model = copy(base.model).label(place_mm[~held_out], None, db_uT[~held_out], keep=True, changes=True)
        self._learn("at crosses", f"calibration to {n} presses at known places", model, n, base)
        return (
            f"adapted to {n} known places: median error at {held_out.sum()} other places "
            f"{before_mm:.2f} mm before, {error_mm():.2f} mm after"
        )

    def add_label(self, place_mm: tuple[float, float], force_N: float, db_uT: Float[np.ndarray, " ch"]) -> str:
        """Calibrate to one more press, whose place and force are known; the force is NaN if it is unknown."""
        before = self._estimate(db_uT[None])
        model = copy(self.model).label([place_mm], [force_N], db_uT[None], keep=True, changes=True)
        self._learn("with a label that you entered", "calibration to the last labelled press", model, 1)
        error_mm = float(np.linalg.norm(before.place_mm[0] - place_mm))
        forces = "" if np.isnan(force_N) else f", force {before.force_N[0]:.2f} N instead of {force_N:.2f} N"
        return f"calibrated to a labelled press; before, the error of its place was {error_mm:.2f} mm{forces}"

    def contradiction(self, place_mm: tuple[float, float], db_uT: Float[np.ndarray, " ch"]) -> str:
        """Compare the label of one more press with the estimate, which knows the earlier labels but not this one.

        Return a text for the user if they differ so much that the label is probably wrong; otherwise an empty text.
        """
        estimate = self._estimate(db_uT[None])
        (x_mm, y_mm), sd_mm = estimate.place_mm[0], float(estimate.sd_mm.max())
        off_mm = float(np.linalg.norm(estimate.place_mm[0] - place_mm))
        if off_mm <= max(LABEL_OFF_MM, LABEL_OFF_SDS * sd_mm):
            return ""
        earlier = f" with {self.model.labels_n} earlier labels" if self.model.labels_n else ""
        return (
            f"the label is {off_mm:.1f} mm off the estimate{earlier}, x {x_mm:.1f}, y {y_mm:.1f} mm (standard "
            f"deviation {sd_mm:.1f} mm). Keep the label if it is right; otherwise discard it, and press again."
        )

    def refine(self) -> str:
        """Train the network further on the labelled presses (see `Universal.refine`)."""
        self._learn("", "refinement of the network", copy(self.model).refine())
        return f"refined the network on {self.model.labels_n} labelled presses; button Undo reverts it"

    def load(self, file: Path) -> str:
        """Replace all calibration data by a saved calibration."""
        if not file.is_file():  # for example, because another program deleted the file after the page had listed it
            raise SchemaError(f"{file}: the file does not exist any more. Choose another skin.")
        model = copy(self.model).remember(file)
        saved = Step("", "", model, {}, skin=file.stem)
        self._learn(f"in {file.stem}", f"loading of skin {file.stem}", model, model.presses_n, saved)
        return f"loaded {file} (presses: {model.presses_n}, of which labelled: {model.labels_n})"

    def undo(self) -> str:
        """Revert the last calibration step."""
        if not self.undoable:
            return "nothing to undo: the model has not been calibrated on this page"
        what = self._steps.pop().what
        self._prepare()
        return f"undone: {what}"

    def __call__(self, db_uT: Float32[np.ndarray, "f ch"]) -> Prediction:
        estimate, misfit = self._estimate(db_uT), self.model.misfit(db_uT, changes=True)
        target = np.column_stack([estimate.place_mm, estimate.force_N])
        return Prediction(target, estimate.sd_mm, estimate.sd_N, np.asarray(misfit > MISFIT_MAX))

    def _estimate(self, db_uT: Float[np.ndarray, "n ch"]) -> Estimate:
        return self.model.estimate(db_uT, changes=True)

    def _last_without(self, kind: str) -> Step:
        """Return the last step that is not of this kind."""
        return next(step for step in reversed(self._steps) if step.kind != kind)

    def _learn(self, kind: str, what: str, model: Universal, presses_n: int = 0, base: Step | None = None) -> None:
        """Use a model that was calibrated to more presses than that of step `base`, by default the last step."""
        base = base or self._steps[-1]
        if self._noload_uT is not None:
            model.zero(self._noload_uT, keep=True)
        counts = Counter(base.presses_n) + Counter({kind: presses_n})
        self._steps = [*self._steps, Step(kind, what, model, counts, base.skin)][-UNDO_MAX_N - 1 :]
        self._prepare()

    def _prepare(self) -> None:
        # The first estimate of a model is slow, so it is made before the first contact.
        self.model.estimate(np.zeros(self.channels_n), changes=True)
        self.warnings = self.model.warnings

    def describe(self, model_name: str) -> dict[str, str | bool]:
        """Return texts for the page: the model, what it has learnt, and what accuracy was measured for it.

        `model_name` contains the name of the model's file. It is empty for the model that is shipped with reskin.
        """
        step, model = self._steps[-1], self.model
        name = f"universal model, {f'file {model_name}' if model_name else 'shipped with reskin'}"
        learnt = ", ".join(f"{n} press{'es' if n > 1 else ''} {kind}" for kind, n in step.presses_n.items() if n)
        return {
            "model": name + (f", with the saved skin {step.skin}" if step.skin else ""),
            "learnt": f"{learnt}; network refined" if model.skin.data.refined else learnt,
            "undoable": self.undoable, "refinable": model.refinable, **_measured_texts(model),
        }  # fmt: skip


def _measured_texts(model: Universal) -> dict[str, str]:
    """Describe the accuracy that was measured with as many presses and labels as this model knows, or with fewer."""
    (card, measured), least_N = _shipped(), model.layout.force_N[0]
    trained = f"trained with simulated forces from {least_N:.2g} N"
    if measured is None or model.card != card:
        return {"expected": f"{NOT_MEASURED} for this model", "least_force": f"{NOT_MEASURED}; {trained}"}
    found = measured["detection"]
    least_force = (
        f"{_join(found['detected_pct'], '.0f')} % of the lightest recorded presses "
        f"({_join(found['lightest_N'], '.2g')} N) were detected; lighter presses {NOT_MEASURED}; {trained}"
    )
    presses_n = model.presses_n - model.labels_n
    fitting = [
        each for each in measured["places"] if each["presses_n"] <= presses_n and each["labels_n"] <= model.labels_n
    ]
    if model.skin.data.refined:
        expected = f"{NOT_MEASURED} for a refined network"
    elif not fitting:
        expected = f"{NOT_MEASURED} for so few presses"
    else:
        best = fitting[-1]
        when = f"after {best['presses_n']} presses and {best['labels_n']} labels"
        accuracy, error = _join(best["accuracy_pct"], ".0f"), _join(best["median_mm"], ".1f")
        boards = f"{len(best['accuracy_pct'])} {measured['source']} boards of scene {measured['scene']}"
        expected = f"median error {error} mm, {accuracy} % within 1 mm ({boards}, "
        expected += f"{when if best['presses_n'] else 'before calibration'})"
        expected += f"; {NOT_MEASURED} with external fields" if model.external_uT else ""
    return {"expected": expected, "least_force": least_force}


def _join(values: Sequence[float], digits: str) -> str:
    return " and ".join(format(value, digits) for value in values)


@cache
def _shipped() -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Return the card of the shipped model, and its measured results, which `pipeline` has written.

    The results are not in the card, because they are measured after the card has been written and depend on it. They
    are None if they belong to another model file.
    """
    measured = io.read_json(MEASURED_FILE)
    return io.read_json(FILE.with_suffix(".json")), measured if measured["model_sha256"] == io.sha256(FILE) else None


class SkinFolder:
    """A folder of saved calibrations.

    All boards on a page use the same `SkinFolder`, so that two boards cannot save calibrations under the same name.
    """

    def __init__(self, folder: Path = SKINS) -> None:
        if folder.exists() and not folder.is_dir():
            raise ParamsError(f"--skins: {folder} is a file, not a folder. Choose the name of a folder.")
        self.folder = folder
        self._lock = threading.Lock()

    def names(self) -> list[str]:
        """Return the names of all saved skins, in alphabetical order."""
        return sorted(file.stem for file in self.folder.glob(f"*{SUFFIX}") if re.fullmatch(NAME, file.stem))

    def file(self, name: object) -> Path:
        """Return the file of the skin with this name; raise ParamsError if the name is not allowed."""
        if not isinstance(name, str) or not re.fullmatch(NAME, name):
            got = repr(name)[:40] if name else "nothing"
            raise ParamsError(
                f"skin name: {got} is not a name. Use 1 to 64 letters, digits, - and _; begin with a letter or a digit."
            )
        return self.folder / f"{name}{SUFFIX}"

    def save(self, name: object, model: Universal) -> str:
        """Save a calibrated model under a new name; return a text for the user.

        Raises ParamsError or SchemaError if the name is not allowed or exists, the model has not been calibrated to any
        press, or the file cannot be written.
        """
        file = self.file(name)
        if not model.presses_n:
            raise SchemaError(
                "not saved: the model is not yet calibrated to this skin. First use button Adapt or Places."
            )
        with self._lock:
            if file.exists():
                raise ParamsError(f"not saved: {file} exists already. Choose another name.")
            try:
                model.save(file)
            except OSError as error:
                remedy = DISK_REMEDIES.get(error.errno or 0, "Choose another folder with --skins.")
                raise SchemaError(f"not saved: cannot write {file}: {error.strerror}. {remedy}") from None
        return f"saved {file} (presses: {model.presses_n}, of which labelled: {model.labels_n})"
