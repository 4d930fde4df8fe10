"""Interference: false contacts and errors of places if the external field changes after the no-load reading.

The earth's field turns relative to a board that moves, and magnets, other skins and iron come near it (paper section 7,
future work). Three methods are compared, each with the shipped model and values of its option `external_uT`, which
states how large the changes are (0: no change is expected):

- `shipped`: the model alone.
- `reference_chip`: the reading of a chip beside the skin is first subtracted (simulated).
- `joints`: the field that a regression predicts from the joint positions of the hand is first subtracted (recorded).

There are two kinds of trials. In a simulated trial, a simulated skin is pressed, and uniform fields and an iron ball
appear. In the recorded trial, the fields are those at the pads of a hand that moves without contact. Places are not
known there, so the recorded changes of the field are added to recorded presses of other boards. Such a sum contains the
noise of both recordings, but no effect of a press on the hand.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Float64, Int64
from pydantic import Field, model_validator
from scipy.constants import micro, milli
from tqdm import tqdm

import reskin
from pipeline import statistics
from pipeline.experiments.results import read_captures, write_results
from pipeline.plot import drawing, svg
from pipeline.scores import make_table, write_scores
from pipeline.settings import Settings
from reskin.config import Strict, parse
from reskin.data.contact import contact_threshold_uT, magnitudes_uT, noise_uT
from reskin.data.grid import CENTRE_MM, points_mm
from reskin.data.rows import Selection, gather
from reskin.errors import ParamsError
from reskin.metrics import METRICS, coverage_pct, score
from reskin.physics.ambient import (
    EARTH_T,
    Instrument,
    ball_field,
    ball_images,
    draw_instrument,
    random_directions,
    readings_uT,
    reference_uT,
)
from reskin.physics.board import BoardDesign, Spreads
from reskin.physics.chip import ChipDesign
from reskin.physics.skin import Skin
from reskin.recordings.fault_policy import FaultPolicy
from reskin.recordings.ingest import read_header
from reskin.recordings.readers import leaphand
from reskin.schema import Readings
from reskin.seeds import rng_for
from reskin.simulation.defaults import nominal
from reskin.universal.force import NORMAL_90
from reskin.universal.model import Universal

SHIPPED, REFERENCE_CHIP, JOINTS = "shipped", "reference_chip", "joints"  # methods
NO_CHANGE = "none"  # name of the field that does not change
SEEN_N = 65  # number of unlabelled presses to which the model is calibrated
QUIET_N = 400  # simulated no-load readings: one second
MOVING_COUNTS = 5.0  # if the standard deviation of a joint's positions is smaller, the joint is at rest
KEYS = ["field", "method", "external_uT"]
CONTACT_METRICS = ("rms_uT", "false_pct", "detected_pct")
PLACE_METRICS = (*METRICS, "coverage_pct")

Size_uT = Annotated[float, Field(ge=0, le=10_000)]
Positive = Annotated[float, Field(gt=0, le=1000)]
Count = Annotated[int, Field(ge=1, le=100_000)]
Changes = Mapping[tuple[str, str], Float[np.ndarray, "f ch"]]  # by field and method
Row = dict[str, Any]


class Iron(Strict):
    """A ball of soft iron above the middle of the skin; distances are from the skin to the surface of the ball."""

    radius_mm: Positive
    distances_mm: tuple[Positive, ...]


class Simulated(Strict):
    """Simulated skins, each on a board of its own, and the fields that appear after the no-load reading."""

    skins_n: Count
    depths_mm: Annotated[tuple[Positive, ...], Field(min_length=1)]  # of the presses at each place of the grid
    uniform_uT: tuple[Size_uT, ...]  # sizes of uniform fields; the direction is random in each reading
    iron: Iron
    readings_n: Count  # number of readings in each field


class Hand(Strict):
    """Recordings of a hand that moves without contact, and of presses on other boards."""

    # Pads (skins on the hand) in each situation: for each pad, the capture on which the regression is trained, and the
    # tested capture.
    situations: dict[str, Annotated[tuple[tuple[str, str], ...], Field(min_length=1)]]
    # Element i is the number of the pad's chip that is at the position of chip i of the boards with presses.
    pad_chips: tuple[int, int, int, int, int]
    labels_mirrored: bool  # whether y of the presses' labels is opposite to y of the board

    @model_validator(mode="after")
    def _check(self) -> "Hand":
        if sorted(self.pad_chips) != list(range(leaphand.CHIPS_N)):
            raise ValueError(f"pad_chips must contain each number from 0 to {leaphand.CHIPS_N - 1} once")
        if NO_CHANGE in self.situations:
            raise ValueError(f"no situation may be called {NO_CHANGE}")
        return self


class Interference(Strict):
    """Settings section `interference`: values of the option, numbers of labels, and the trials."""

    external_uT: Annotated[tuple[Size_uT, ...], Field(min_length=1)]
    labels_n: Annotated[tuple[Annotated[int, Field(ge=0, le=SEEN_N)], ...], Field(min_length=1)]
    draws_n: Count  # number of draws of presses and labels, for each skin
    simulated: Simulated | None = None
    hand: Hand | None = None


@dataclass(frozen=True)
class Presses:
    """Presses of one skin at known places.

    - noload_uT: field without contact.
    - b_uT: one reading of each press, or the mean of several.
    - true: x_mm, y_mm along the board's axes, and F_N.
    """

    board: str
    skin: str
    noload_uT: Float[np.ndarray, " ch"]
    b_uT: Float[np.ndarray, "n ch"]
    true: Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class Sensor:
    """A board without contact.

    - quiet_uT: no-load readings minus their mean, by method.
    - changes_uT: later readings minus the mean no-load reading.
    """

    board: str
    skin: str
    quiet_uT: Mapping[str, Float[np.ndarray, "q ch"]]
    changes_uT: Changes


Trial = tuple[list[Presses], list[Sensor]]


def interference(
    settings: Settings, section: Interference, raw: Path, indentations: Path, scores: Path, results: Path
) -> None:
    """Count false contacts and score places in changing external fields; write the scores."""
    write_scores(scores, run(settings, section, raw, indentations))
    write_results(results, {"draws_n": section.draws_n}, {})


def run(settings: Settings, section: Interference, raw: Path, indentations: Path) -> pd.DataFrame:
    """Return the rows of the table of scores: those of contacts, and those of places (with `labels_n`)."""
    trials = [] if section.simulated is None else simulated_trials(settings, section.simulated)
    if section.hand is not None:
        trials.append(recorded_trial(settings, section.hand, raw, indentations))
    models = {size_uT: reskin.load_universal(external_uT=size_uT) for size_uT in section.external_uT}
    rows: list[Row] = []
    for presses, sensors in trials:
        for sensor in sensors:
            rng = rng_for(settings.seed, "interference", "touches", sensor.skin)
            rows += contact_rows(sensor, presses, models, rng)
        pooled = pool_changes(sensors)
        for skin in tqdm(presses, unit="skin"):
            rows += place_rows(skin, pooled, models, section, settings.seed)
    return make_table({"experiment": "interference"} | row for row in rows)


def summarise(scores: pd.DataFrame, measured: Mapping[str, Any]) -> dict[str, Any]:
    """Average over draws and over the skins of a board, then summarise the boards."""
    in_order = {name: pd.CategoricalDtype(list(scores[name].unique())) for name in ("field", "method")}
    scores = scores.astype(in_order | {"labels_n": "Int64"})
    parts = {"contacts": (KEYS, CONTACT_METRICS), "places": ([*KEYS, "labels_n"], PLACE_METRICS)}
    return dict(measured) | {
        part: [
            dict(zip(keys, key, strict=True))
            | statistics.summarise(rows.groupby("board")[[*metrics]].mean(), boards=True)
            for key, rows in scores[scores[metrics[-1]].notna()].groupby(keys, observed=True)
        ]
        for part, (keys, metrics) in parts.items()
    }


# --- Contacts and places ---


def contact_rows(
    sensor: Sensor, presses: Sequence[Presses], models: Mapping[float, Universal], rng: np.random.Generator
) -> Iterator[Row]:
    """Count readings above the threshold for contact, as `reskin live` does: without contact, and with all presses.

    `rms_uT` is the size of the changes. It can be compared with `external_uT`.
    """
    pressed_uT = np.concatenate([skin.b_uT - skin.noload_uT for skin in presses])
    for (field, method), change_uT in sensor.changes_uT.items():
        quiet_uT = sensor.quiet_uT[method]
        touched_uT = pressed_uT + change_uT[rng.integers(len(change_uT), size=len(pressed_uT))]
        for external_uT, model in models.items():
            matrix = model.suppressor(noise_uT(quiet_uT))
            threshold_uT = contact_threshold_uT(quiet_uT, matrix)
            false, detected = (
                100 * float((magnitudes_uT(db_uT, matrix) > threshold_uT).mean()) for db_uT in (change_uT, touched_uT)
            )
            yield {
                "board": sensor.board, "skin": sensor.skin, "method": method, "field": field,
                "external_uT": external_uT, "rms_uT": float(np.sqrt((change_uT**2).mean())), "false_pct": false,
                "detected_pct": detected,
            }  # fmt: skip


def place_rows(
    presses: Presses, changes_uT: Changes, models: Mapping[float, Universal], section: Interference, seed: int
) -> Iterator[Row]:
    """Calibrate the model to presses without changes of the field, and score it on other presses with them.

    The presses of the calibration, with and without labels, are at a random half of the places. The tested presses are
    at the other places.
    """
    for draw_i in range(section.draws_n):
        rng = rng_for(seed, "interference", presses.skin, draw_i)
        known, tested = split_places(presses.true[:, :2], rng)
        true, b_uT = presses.true[tested], presses.b_uT[tested]
        added = {key: each_uT[rng.integers(len(each_uT), size=len(tested))] for key, each_uT in changes_uT.items()}
        for external_uT, model in models.items():
            model.zero(presses.noload_uT).see(presses.b_uT[known[:SEEN_N]])
            for labels_n in sorted(section.labels_n):
                if labels_n:
                    place_mm, force_N = presses.true[known[:labels_n], :2], presses.true[known[:labels_n], 2]
                    model.label(place_mm, force_N, presses.b_uT[known[:labels_n]])
                for (field, method), added_uT in added.items():
                    found = model.estimate(b_uT + added_uT)
                    half_mm = NORMAL_90 * found.sd_mm
                    yield {
                        "board": presses.board, "skin": presses.skin, "method": method, "field": field,
                        "external_uT": external_uT, "labels_n": labels_n, "draw": draw_i,
                        **score(true, np.column_stack([found.place_mm, found.force_N])),
                        "coverage_pct": coverage_pct(true[:, :2], found.place_mm - half_mm, found.place_mm + half_mm),
                    }  # fmt: skip


def split_places(
    place_mm: Float[np.ndarray, "n 2"], rng: np.random.Generator
) -> tuple[Int64[np.ndarray, " a"], Int64[np.ndarray, " b"]]:
    """Divide presses at random so that no place, rounded to 1 mm, is in both parts; each part is in random order."""
    place_i = np.unique(np.rint(place_mm), axis=0, return_inverse=True)[1].ravel()
    first = rng.permutation(place_i.max() + 1) < (place_i.max() + 1) // 2
    order = rng.permutation(len(place_i))
    return order[first[place_i[order]]], order[~first[place_i[order]]]


def pool_changes(sensors: Sequence[Sensor]) -> Changes:
    """Pool the changes of several sensors in each field; add the field of no change if the sensors lack it."""
    pooled: dict[tuple[str, str], list[np.ndarray]] = {}
    for sensor in sensors:
        for key, change_uT in sensor.changes_uT.items():
            pooled.setdefault(key, []).append(change_uT)
    channels_n = sensors[0].quiet_uT[SHIPPED].shape[1]
    no_change = {(NO_CHANGE, SHIPPED): np.zeros((1, channels_n))}
    return no_change | {key: np.concatenate(changes_uT) for key, changes_uT in pooled.items()}


# --- Simulated fields ---


def simulated_trials(settings: Settings, simulated: Simulated) -> list[Trial]:
    """Simulate skins with the nominal settings of the library: presses on a grid, and readings in external fields."""
    design = parse(BoardDesign, nominal("boards")["rigid"]["design"], "boards")
    spreads, chip = settings.shared_section(Spreads, "spreads"), settings.shared_section(ChipDesign, "chip")
    pokes = np.vstack([np.column_stack([points_mm(), np.full(len(points_mm()), mm)]) for mm in simulated.depths_mm])
    trials: list[Trial] = []
    for i in range(simulated.skins_n):
        board, name = f"b{i}", f"b{i}_s0"
        skin = reskin.draw_skin(name, seed=settings.seed)
        instrument = draw_instrument(design, spreads, chip, seed=settings.seed, name=board)
        rest_uT, b_uT, force_N = reskin.simulate_pokes(skin, pokes, board=instrument.board, seed=settings.seed)
        presses = Presses(board, name, rest_uT.mean(axis=0), b_uT, np.column_stack([pokes[:, :2], force_N]))
        rng = rng_for(settings.seed, "interference", name, "fields")
        trials.append(([presses], [simulated_sensor(board, skin, instrument, simulated, rng)]))
    return trials


def simulated_sensor(
    board: str, skin: Skin, instrument: Instrument, simulated: Simulated, rng: np.random.Generator
) -> Sensor:
    """Simulate the readings of a skin at rest in each field, with the noise of single readings."""
    n, chips_n = simulated.readings_n, len(instrument.turn)
    sd_uT = np.tile(instrument.noise_uT, chips_n)
    direction = random_directions(n, rng)[:, None]
    fields_T = {NO_CHANGE: np.zeros((n, chips_n + 1, 3))}  # at the board's chips and, last, at the reference chip
    for size_uT in simulated.uniform_uT:
        fields_T[f"uniform_{size_uT:g}_uT"] = np.tile(size_uT * micro * direction, (1, chips_n + 1, 1))
    for mm in simulated.iron.distances_mm:
        fields_T[f"iron_{mm:g}_mm"] = np.tile(iron_T(instrument, skin, simulated.iron.radius_mm, mm), (n, 1, 1))

    def read(b_T: Float[np.ndarray, "f c 3"]) -> dict[str, Float[np.ndarray, "f ch"]]:
        read_uT = readings_uT(instrument.board, b_T[:, :-1]) + sd_uT * rng.standard_normal((len(b_T), len(sd_uT)))
        return {SHIPPED: read_uT, REFERENCE_CHIP: read_uT - reference_uT(instrument, b_T[:, -1], rng)}

    changes_uT = {(name, method): read_uT for name, b_T in fields_T.items() for method, read_uT in read(b_T).items()}
    return Sensor(board, skin.name, read(np.zeros((QUIET_N, chips_n + 1, 3))), changes_uT)


def iron_T(instrument: Instrument, skin: Skin, radius_mm: float, distance_mm: float) -> Float[np.ndarray, "c 3"]:
    """Return the field that an iron ball above the middle of the skin adds at the board's chips and the reference chip.

    The ball is magnetised by the earth's field and by the field of the undeformed skin.
    """
    centre_m = np.append(skin.seat_m, skin.thickness_m + (distance_mm + radius_mm) * milli)
    chips_m = np.concatenate([instrument.board.chips_m, instrument.aside.chips_m])
    earth_T = ball_field(chips_m, EARTH_T, centre_m=centre_m, radius_m=radius_mm * milli)
    images_T = ball_images(chips_m, (skin.nodes_m, skin.moments_A_m2), centre_m=centre_m, radius_m=radius_mm * milli)
    return earth_T + images_T


# --- Recorded fields ---


@dataclass(frozen=True)
class Pad:
    """A recording of a pad: changes of the field, no-load readings minus their mean, and joint positions."""

    board: str
    skin: str
    db_uT: Float64[np.ndarray, "f ch"]
    quiet_uT: Float64[np.ndarray, "q ch"]
    joint_counts: Float64[np.ndarray, "f j"]


def recorded_trial(settings: Settings, hand: Hand, raw: Path, indentations: Path) -> Trial:
    """Read the presses and the pads of a scene; subtract what the joints predict at each tested pad."""
    captures = {one.capture: one for one in read_captures(indentations, tuple(settings.captures_in(indentations)))}
    policy = settings.shared_section(FaultPolicy, "faults")
    pads = {
        name: read_pad(readings, raw / name, hand.pad_chips, policy)
        for name, readings in captures.items()
        if read_header(raw / name).layout == "leaphand"
    }
    named = {capture for pairs in hand.situations.values() for pair in pairs for capture in pair}
    missing = named - pads.keys()
    if missing:
        what = f"no recording {', '.join(sorted(missing))} of layout leaphand in scene {settings.scene}"
        raise ParamsError(f"interference.hand.situations: {what}. Run: reskin fetch leaphand --scene {settings.scene}")
    others = [readings for name, readings in captures.items() if name not in pads]
    if not others:
        remedy = f"Run: reskin fetch lab --scene {settings.scene}"
        raise ParamsError(f"scene {settings.scene}: no recordings of presses, which interference needs. {remedy}")
    sensors = [
        Sensor(tested.board, tested.skin, dict.fromkeys((SHIPPED, JOINTS), tested.quiet_uT), {
            (situation, SHIPPED): tested.db_uT,
            (situation, JOINTS): tested.db_uT - predict_changes(pads[first], tested.joint_counts),
        })
        for situation, pairs in hand.situations.items()
        for first, tested in [(first, pads[second]) for first, second in pairs]
    ]  # fmt: skip
    selection = settings.section(Selection, "selection")
    return recorded_presses(others, selection, mirrored=hand.labels_mirrored), sensors


def recorded_presses(captures: Sequence[Readings], selection: Selection, *, mirrored: bool) -> list[Presses]:
    """Return the presses of each skin, as means over the readings of a press."""
    skins: dict[str, list[Readings]] = {}
    for readings in captures:
        skins.setdefault(readings.skin, []).append(readings)
    presses = []
    for skin, own in skins.items():
        rows = gather(own, selection)
        means = pd.DataFrame(np.hstack([rows.db_uT, rows.target]).astype(float)).groupby(rows.indentation).mean()
        db_uT, true = np.split(means[means.iloc[:, -1] > 0].to_numpy(), [-3], axis=1)  # only presses with a known force
        if mirrored:
            true = true * (1, -1, 1) + (0, 2 * CENTRE_MM, 0)
        noload_uT = np.concatenate([readings.noload_uT for readings in own]).mean(axis=0, dtype=float)
        presses.append(Presses(own[0].board, skin, noload_uT, noload_uT + db_uT, true))
    return presses


def read_pad(readings: Readings, raw: Path, chips: Sequence[int], policy: FaultPolicy) -> Pad:
    """Return a recording of a pad, whose chips are put into the order of the boards with presses."""

    def ordered(b_uT: Float[np.ndarray, "f ch"]) -> Float64[np.ndarray, "f ch"]:
        return b_uT.astype(float).reshape(len(b_uT), -1, 3)[:, list(chips)].reshape(b_uT.shape)

    motion = leaphand.read_motion(raw, read_header(raw), policy)
    n = len(motion.noload_uT)
    # The mean of the few no-load readings is computed from the same readings, so their deviations are too small.
    quiet_uT = (motion.noload_uT - motion.noload_uT.mean(axis=0)) * np.sqrt(n / (n - 1))
    changes_uT = ordered(readings.b_uT - readings.noload_uT)
    return Pad(readings.board, readings.skin, changes_uT, ordered(quiet_uT), motion.joint_counts.astype(float))


def predict_changes(known: Pad, joint_counts: Float64[np.ndarray, "f j"]) -> Float64[np.ndarray, "f ch"]:
    """Predict the changes of the field at joint positions: ridge regression on squares and products of positions."""
    from sklearn.linear_model import RidgeCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    moving = known.joint_counts.std(axis=0) > MOVING_COUNTS
    if not moving.any():
        what = (
            f"no joint moves in a recording of {known.board}, so changes of the field cannot be predicted from joints"
        )
        raise ParamsError(f"interference.hand.situations: {what}. Name another recording.")
    ridge = RidgeCV(np.logspace(-2, 4, 13))
    regression = make_pipeline(StandardScaler(), PolynomialFeatures(2), StandardScaler(), ridge)
    regression.fit(known.joint_counts[:, moving], known.db_uT)
    predicted_uT: np.ndarray = regression.predict(joint_counts[:, moving])
    return predicted_uT


# --- Figures ---


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Plot false contacts and the accuracy of places in each field, with a line per method and `external_uT`."""
    panels = {"false contacts / %": (numbers["contacts"], "false_pct")}
    for labels_n in sorted({row["labels_n"] for row in numbers["places"]}):
        own = [row for row in numbers["places"] if row["labels_n"] == labels_n]
        panels[f"within 1 mm / %, {labels_n} labels"] = own, "accuracy_pct"
    names = list(dict.fromkeys(row["field"] for row in numbers["places"]))
    with drawing(2.0 + 1.6 * len(panels), f"Changing external fields ({source})") as figure:
        all_axes = figure.subplots(len(panels), 1, sharex=True)
        for axes, (label, (rows, metric)) in zip(all_axes, panels.items(), strict=True):
            ways = dict.fromkeys((row["method"], row["external_uT"]) for row in numbers["contacts"])
            for method, external_uT in ways:
                own = [row for row in rows if (row["method"], row["external_uT"]) == (method, external_uT)]
                x, name = [names.index(row["field"]) for row in own], method.replace("_", " ")
                axes.plot(x, [row[metric]["mean"] for row in own], label=f"{name}, external_uT {external_uT:g}")
            axes.set(title=label, ylim=(-4, 104))
        axes.set_xticks(range(len(names)), [name.replace("_", " ") for name in names], rotation=45, ha="right")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower left")
        return {"interference.svg": svg(figure)}
