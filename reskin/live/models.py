"""The models of a live board: their estimates, their calibration on the page, and the folder of saved skins."""

import re
import threading
from collections.abc import Mapping, Sequence
from copy import copy
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from reskin import io
from reskin.errors import DISK_REMEDIES, ParamsError, SchemaError
from reskin.models.inputs import VIEW, Scaler
from reskin.models.trained import SUFFIX, Network
from reskin.recordings.header import NAME
from reskin.universal.calibration import check_presses
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


class Labels(NamedTuple):
    """The labels and the field changes of m presses at known places."""

    place_mm: Float64[np.ndarray, "m 2"]
    force_N: Float64[np.ndarray, " m"]  # NaN if the force is unknown
    db_uT: Float64[np.ndarray, "m ch"]

    def followed_by(self, other: "Labels") -> "Labels":
        return Labels(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


class LearningState(NamedTuple):
    """The calibration data of a `UniversalEstimator` after one calibration step, except for the no-load reading."""

    origin: Universal  # the model before the calibration, which was passed to the estimator or loaded from a file
    origin_name: str  # the name of the saved skin that was loaded; empty if none was loaded
    presses_uT: Float64[np.ndarray, "n ch"]  # field changes of presses at unknown places
    guided: Labels  # presses at places that the page showed
    typed: Labels  # presses whose places the user entered
    step: str  # description of the calibration step, such as "the 12 presses"
    refined: Mapping[str, np.ndarray] = MappingProxyType({})  # weights of the network, if it was refined on the page

    @property
    def labels(self) -> Labels:
        return self.guided.followed_by(self.typed)

    @classmethod
    def start(cls, origin: Universal, origin_name: str = "", step: str = "") -> "LearningState":
        """Return the state of a model that has not yet been calibrated to presses on the page."""
        none_uT = np.zeros((0, origin.channels_n))
        none = Labels(np.zeros((0, 2)), np.zeros(0), none_uT)
        return cls(origin, origin_name, none_uT, none, none, step)


class UniversalEstimator:
    """An estimator that uses a universal model, and calibrates it to the skin while the board is running.

    The estimator calibrates a copy of the model. The model that was passed is not changed. The calibration uses the
    no-load reading, presses at unknown places (`adapt`) and presses at known places (`label` and `add_label`). If
    `adapt` or `label` is called again, the new presses replace those of the earlier call, so that the user can repeat
    bad presses. `undo` reverts the last calibration step. Each step returns a text for the user. It raises SchemaError
    if its data cannot be used, such as presses within the noise; the calibration is then unchanged.
    """

    name = "universal model"

    def __init__(self, model: Universal) -> None:
        self.channels_n, self.board = model.channels_n, model.layout
        self._noload_uT: Float[np.ndarray, " ch"] | None = None  # until it is set, the model keeps its own
        # The last state is the current one. The earlier states are stored so that `undo` can return to them.
        self._states = [LearningState.start(model)]
        self._use(self.learnt)

    @property
    def learnt(self) -> LearningState:
        """The current calibration data of the model."""
        return self._states[-1]

    @property
    def undoable(self) -> bool:
        """Whether there is a calibration step that `undo` can revert."""
        return len(self._states) > 1

    @property
    def model(self) -> Universal:
        """The calibrated model."""
        return self._model

    def set_noload(self, noload_uT: Float[np.ndarray, " ch"]) -> None:
        """Set the no-load field, and repeat the calibration with it."""
        self._noload_uT = noload_uT
        self._use(self.learnt)

    def adapt(self, db_uT: Float[np.ndarray, "n ch"]) -> str:
        """Calibrate to the field changes of presses at unknown places."""
        check_presses(db_uT)
        before = self._estimate(db_uT)
        step = f"calibration to {len(db_uT)} presses"
        self._learn(self.learnt._replace(presses_uT=db_uT.astype(np.float64), step=step))
        after = self._estimate(db_uT)
        sd_mm = [np.median(estimate.sd_mm.max(axis=1)) for estimate in (before, after)]
        return (
            f"adapted to {len(db_uT)} presses: median standard deviation of the places {sd_mm[0]:.2f} mm before, "
            f"{sd_mm[1]:.2f} mm after"
        )

    def label(
        self, place_mm: Float[np.ndarray, "n 2"], db_uT: Float[np.ndarray, "n ch"], held_out: Bool[np.ndarray, " n"]
    ) -> str:
        """Calibrate to presses at known places, except for presses that are held out to measure the error.

        The forces of the presses were not measured.
        """
        check_presses(db_uT[~held_out])

        def error_mm() -> float:
            estimated_mm = self._estimate(db_uT[held_out]).place_mm
            return float(np.median(np.linalg.norm(estimated_mm - place_mm[held_out], axis=1)))

        before_mm, kept_n = error_mm(), int((~held_out).sum())
        guided = Labels(place_mm[~held_out], np.full(kept_n, np.nan), db_uT[~held_out].astype(np.float64))
        self._learn(self.learnt._replace(guided=guided, step=f"calibration to {kept_n} presses at known places"))
        return (
            f"adapted to {kept_n} known places: median error at {held_out.sum()} other places "
            f"{before_mm:.2f} mm before, {error_mm():.2f} mm after"
        )

    def add_label(self, place_mm: tuple[float, float], force_N: float, db_uT: Float[np.ndarray, " ch"]) -> str:
        """Calibrate to one more press, whose place and force are known; the force is NaN if it is unknown."""
        check_presses(db_uT[None])
        before = self._estimate(db_uT[None])
        one = Labels(np.array([place_mm], float), np.array([force_N]), db_uT[None].astype(np.float64))
        typed = self.learnt.typed.followed_by(one)
        self._learn(self.learnt._replace(typed=typed, step="calibration to the last labelled press"))
        error_mm = float(np.linalg.norm(before.place_mm[0] - one.place_mm[0]))
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
        earlier = f" with {self._model.labels_n} earlier labels" if self._model.labels_n else ""
        return (
            f"the label is {off_mm:.1f} mm off the estimate{earlier}, x {x_mm:.1f}, y {y_mm:.1f} mm (standard "
            f"deviation {sd_mm:.1f} mm). Keep the label if it is right; otherwise discard it, and press again."
        )

    def refine(self) -> str:
        """Train the network further on the labelled presses (see `Universal.refine`)."""
        refined = copy(self._model).refine()
        data = refined.skin.data
        self._learn(self.learnt._replace(refined=data.refined, step="refinement of the network"))
        return f"refined the network on {len(data.labels)} labelled presses; button Undo reverts it"

    def load(self, file: Path) -> str:
        """Replace all calibration data by a saved calibration."""
        if not file.is_file():  # for example, because another program deleted the file after the page had listed it
            raise SchemaError(f"{file}: the file does not exist any more. Choose another skin.")
        origin = copy(self.learnt.origin).remember(file)
        self._learn(LearningState.start(origin, file.stem, f"loading of skin {file.stem}"))
        return f"loaded {file} (presses: {origin.presses_n}, of which labelled: {origin.labels_n})"

    def undo(self) -> str:
        """Revert the last calibration step."""
        if not self.undoable:
            return "nothing to undo: the model has not been calibrated on this page"
        step = self._states.pop().step
        self._use(self.learnt)
        return f"undone: {step}"

    def __call__(self, db_uT: Float32[np.ndarray, "f ch"]) -> Prediction:
        estimate, misfit = self._estimate(db_uT), self._model.misfit(db_uT, changes=True)
        target = np.column_stack([estimate.place_mm, estimate.force_N])
        return Prediction(target, estimate.sd_mm, estimate.sd_N, np.asarray(misfit > MISFIT_MAX))

    def _estimate(self, db_uT: Float[np.ndarray, "n ch"]) -> Estimate:
        return self._model.estimate(db_uT, changes=True)

    def _learn(self, state: LearningState) -> None:
        """Calibrate the model with the data of a new state, and keep the previous state for `undo`.

        If the calibration fails, the previous state stays in use.
        """
        self._use(state)
        self._states = [*self._states, state][-UNDO_MAX_N - 1 :]

    def _use(self, state: LearningState) -> None:
        model = copy(state.origin)
        if self._noload_uT is not None:
            model.zero(self._noload_uT, keep=True)
        if len(state.presses_uT):
            model.see(state.presses_uT, changes=True)
        if len(state.labels.force_N):
            model.label(*state.labels, keep=True, changes=True)
        if state.refined:
            model.use_refined(state.refined)
        # The first estimate of a model is slow, so it is made before the first contact.
        model.estimate(np.zeros(self.channels_n), changes=True)
        self._model, self.warnings = model, model.warnings

    def describe(self, model_name: str) -> dict[str, str | bool]:
        """Return texts for the page: the model, what it has learnt, and what accuracy was measured for it.

        `model_name` contains the name of the model's file. It is empty for the model that is shipped with reskin.
        """
        state, model = self.learnt, self.model
        name = f"universal model, {f'file {model_name}' if model_name else 'shipped with reskin'}"
        counts = {
            f"in {state.origin_name or 'the file'}": state.origin.presses_n,
            "anywhere": len(state.presses_uT),
            "at crosses": len(state.guided.db_uT),
            "with a label that you entered": len(state.typed.db_uT),
        }
        learnt = ", ".join(
            f"{count} press{'es' if count > 1 else ''} {what}" for what, count in counts.items() if count
        )
        return {
            "model": name + (f", with the saved skin {state.origin_name}" if state.origin_name else ""),
            "learnt": f"{learnt}; network refined" if state.refined else learnt,
            "undoable": self.undoable, "refinable": model.refinable,
            "expected": _expected_accuracy(model), "least_force": _least_force(model),
        }  # fmt: skip


def _expected_accuracy(model: Universal) -> str:
    """Describe the accuracy that was measured with as many presses and labels as this model knows, or with fewer."""
    measured = _measured_of(model)
    if measured is None:
        return f"{NOT_MEASURED} for this model"
    if model.skin.data.refined:
        return f"{NOT_MEASURED} for a refined network"
    presses_n = model.presses_n - model.labels_n
    fitting = [
        each for each in measured["places"] if each["presses_n"] <= presses_n and each["labels_n"] <= model.labels_n
    ]
    if not fitting:
        return f"{NOT_MEASURED} for so few presses"
    best = fitting[-1]
    when = "before calibration"
    if best["presses_n"]:
        when = f"after {best['presses_n']} presses and {best['labels_n']} labels"
    accuracy, error = _join(best["accuracy_pct"], ".0f"), _join(best["median_mm"], ".1f")
    boards = f"{len(best['accuracy_pct'])} {measured['source']} boards of scene {measured['scene']}"
    text = f"median error {error} mm, {accuracy} % within 1 mm ({boards}, {when})"
    return text if not model.external_uT else f"{text}; {NOT_MEASURED} with external fields"


def _least_force(model: Universal) -> str:
    measured, least_N = _measured_of(model), model.layout.force_N[0]
    trained = f"trained with simulated forces from {least_N:.2g} N"
    if measured is None:
        return f"{NOT_MEASURED}; {trained}"
    found = measured["detection"]
    return (
        f"{_join(found['detected_pct'], '.0f')} % of the lightest recorded presses "
        f"({_join(found['lightest_N'], '.2g')} N) were detected; lighter presses {NOT_MEASURED}; {trained}"
    )


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


def _measured_of(model: Universal) -> dict[str, Any] | None:
    card, measured = _shipped()
    return measured if model.card == card else None


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
