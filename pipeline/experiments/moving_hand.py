"""Contacts and places of the universal model on a moving hand, with and without its option `external_uT`.

When a robot moves a skin, the earth's field turns relative to the skin, and magnets and other skins come near. With
`external_uT`, the universal model expects external fields of this size. The experiment counts how often a change of an
external field is mistaken for a contact, and how much it shifts the estimated place of a press. Column `source` of the
tables states the kind of each result:

- *recorded*: changes of the field at the pads of a hand that moves without contact;
- *superposed*: recorded presses of other boards, plus recorded changes of the hand. A superposition contains the noise
  of both recordings, but no effect of a press on the hand;
- *simulated*: skins from the prior of the shipped model, in fields that are computed.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float
from pydantic import Field, model_validator

from pipeline.experiments.compare import Compare, make_setup
from pipeline.experiments.known_boards import align_boards
from pipeline.experiments.random_presses import (
    CHECKERBOARD,
    BoardPresses,
    board_presses,
    draw_presses,
    place_scores,
    raise_forces,
)
from pipeline.experiments.results import read_captures, write_results
from pipeline.formatting import show, tabulate
from pipeline.plot import COLOURS, MARKERS, drawing, svg
from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.statistics import statistic
from pipeline.training.jobs import SceneData
from pipeline.training.universal import draw_prior_skins, law_error
from reskin.config import Strict
from reskin.data.contact import CONTACT_SDS, magnitudes_uT
from reskin.data.grid import CENTRE_MM
from reskin.data.rows import Selection, gather
from reskin.errors import ParamsError, SchemaError
from reskin.physics import external
from reskin.physics.magnet import MU0_4PI, field_of_each
from reskin.physics.skin import SkinDesign
from reskin.recordings.fault_policy import FaultPolicy
from reskin.recordings.ingest import read_header
from reskin.recordings.readers import leaphand
from reskin.schema import Readings
from reskin.seeds import rng_for
from reskin.universal.batches import NOMINAL_NAME, NOISE_uT, SkinPrior
from reskin.universal.force import NORMAL_90
from reskin.universal.law import CHIPS_MM, Setup, to_board, to_chips
from reskin.universal.map import NOMINAL, NOMINAL_SPREADS
from reskin.universal.model import load_universal
from reskin.universal.population import PLACES_N

Size_uT = Annotated[float, Field(ge=0, le=10_000)]
Count = Annotated[int, Field(ge=1, le=100_000)]
Fraction = Annotated[float, Field(gt=0, lt=1)]

# If the standard deviation of a joint's positions is smaller than this, the joint is at rest, and the positions differ
# only by noise.
MOVING_COUNTS = 5
TOUCH_STEP = 20  # a press has 100 nearly equal readings; only every twentieth reading of the boards is used as a touch
NO_FIELD, TURNED, MAGNET = "none", "turned in the earth's field", "beside a moving magnet"
OTHER, FIRST_HALF = "the other recording", "the first half"
# Candidates for the distance of the source of a field change, and for the size of its field (see `find_source`).
DISTANCES_MM = (30.0, 35.0, 40.0, 45.0, 50.0, 60.0, 70.0, 85.0, 100.0, 150.0, 300.0)
SIZES_uT = (5.0, 7.0, 10.0, 14.0, 20.0, 30.0, 50.0, 70.0, 100.0, 140.0, 200.0, 280.0)

Changes = Float[np.ndarray, "f 15"]  # changes of the field since the no-load field, along the chips' axes
Row = dict[str, Any]


class Group(Strict):
    """Recordings of pads (skins on a hand) in one situation.

    Each pad was recorded twice. Element i of `threshold` and element i of `tested` are the captures (recorded files) of
    pad i. The first capture sets thresholds, and the second capture tests them.
    """

    name: str
    threshold: Annotated[tuple[str, ...], Field(min_length=1)]
    tested: Annotated[tuple[str, ...], Field(min_length=1)]


class MovingHand(Strict):
    """Settings section `moving_hand`: recordings of the hand, sizes of external fields, and numbers of random draws."""

    groups: Annotated[tuple[Group, ...], Field(min_length=1)]
    # The chips of a pad are numbered differently from the chips of the boards in `presses`. Element i is the number of
    # the pad's chip that is at the position of chip i of the boards.
    pad_chips: tuple[int, int, int, int, int]
    external_uT: Annotated[tuple[Size_uT, ...], Field(min_length=1)]  # values of the option, for contacts
    # Values of the option, if field changes that are predicted from joint positions are subtracted first.
    compensated_uT: tuple[Size_uT, ...]
    boosting_iterations_n: Count
    # Field changes of recorded presses are multiplied by each of these factors, to get weaker or stronger touches.
    touch_scales: Annotated[tuple[Annotated[float, Field(gt=0)], ...], Field(min_length=1)]
    detected_fraction: Fraction
    places_uT: Annotated[tuple[Size_uT, ...], Field(min_length=1)]  # sizes of the external field in tests of places
    labels_n: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
    draws_n: Count  # number of draws of presses and labels, for each board
    readings_n: Count  # number of tested readings in each draw
    skins_n: Annotated[int, Field(ge=2, le=10_000)]  # number of simulated skins
    changes_n: Count  # number of changes of the external field, for each simulated skin
    turned_uT: Size_uT  # size of the field in which a simulated skin is turned
    magnet_uT: Size_uT  # rms of a component of the magnet's field at its smallest distance
    magnet_mm: tuple[Annotated[float, Field(ge=20)], Annotated[float, Field(ge=20)]]  # smallest and largest distance
    presses: Compare  # skin and orientation of the boards on which presses were recorded

    @model_validator(mode="after")
    def _check(self) -> "MovingHand":
        if sorted(self.pad_chips) != list(range(leaphand.CHIPS_N)):
            raise ValueError(f"pad_chips must contain each number from 0 to {leaphand.CHIPS_N - 1} once")
        if self.magnet_mm[0] > self.magnet_mm[1]:
            raise ValueError("magnet_mm must contain the smallest distance, then the largest distance")
        names = [NO_FIELD, *(group.name for group in self.groups)]
        if len(set(names)) < len(names):
            raise ValueError(f"groups must have different names, and none may be called {NO_FIELD}")
        return self


class Skin(NamedTuple):
    """A skin, with data in the form that the universal model expects.

    - name: name of the skin.
    - rest_uT: no-load field, in the chips' axes.
    - db_uT: field changes of presses, in the chips' axes.
    - place_mm, force_N: places of the presses, in the coordinates of labels, and their forces.
    """

    name: str
    rest_uT: Float[np.ndarray, " ch"]
    db_uT: Float[np.ndarray, "m ch"]
    place_mm: Float[np.ndarray, "m 2"]
    force_N: Float[np.ndarray, " m"]


@dataclass(frozen=True)
class Pad:
    """A recording of one pad.

    - db_uT: field changes, with one row per reading.
    - joint_counts: positions of the hand's joints at each reading.
    - noise_uT: standard deviation of the noise of a channel.
    """

    db_uT: Changes
    joint_counts: Float[np.ndarray, "f j"]
    noise_uT: float

    def __getitem__(self, rows: slice) -> "Pad":
        return Pad(self.db_uT[rows], self.joint_counts[rows], self.noise_uT)

    def without(self, expected_uT: Changes) -> "Pad":
        """Return the pad with an expected change subtracted from every row."""
        return Pad(self.db_uT - expected_uT, self.joint_counts, self.noise_uT)


Pair = tuple[Pad, Pad]  # a pad's rows for the threshold, and its tested rows


def moving_hand(settings: Settings, section: MovingHand, raw: Path, indentations: Path, results: Path) -> None:
    """Count false contacts, and score places, in recorded, superposed and simulated changes of external fields."""
    seed = settings.seed
    captures = {one.capture: one for one in read_captures(indentations, tuple(settings.captures_in(indentations)))}
    policy = settings.shared_section(FaultPolicy, "faults")
    pads = {
        name: read_pad(readings, raw / name, section, policy)
        for name, readings in captures.items()
        if read_header(raw / name).layout == "leaphand"
    }
    groups = {group.name: pairs_of(group, pads) for group in section.groups}
    setup = make_setup(section.presses, settings.shared_section(SkinDesign, "skin"))
    boards = read_boards(settings, section.presses, [one for name, one in captures.items() if name not in pads])
    touches_uT = np.concatenate([to_chips(board.readings.db_uT[::TOUCH_STEP]) for board in boards])
    contacts = [row for name, pairs in groups.items() for row in contact_rows(name, pairs, touches_uT, section, seed)]
    counts = f"{len(pads)} recordings of pads and {len(boards)} boards"
    say(f"{settings.scene} moving_hand: counted contacts for {counts}")
    recorded_uT = {name: np.concatenate([tested.db_uT for _, tested in pairs]) for name, pairs in groups.items()}
    superposed = [row for board in boards for row in board_rows(board, recorded_uT, section, seed)]
    say(f"{settings.scene} moving_hand: scored places in recorded field changes of the hand")
    skins = simulated_skins(setup, section.skins_n, seed, "moving hand")
    fields_uT = [draw_fields(skin, section, seed) for skin in skins]
    simulated = [
        row
        for skin, of_skin in zip(skins, fields_uT, strict=True)
        for row in simulated_place_rows(skin, of_skin, section, seed)
    ]
    numbers = {
        "recordings": [describe_pad(name, captures[name].board, pad) for name, pad in pads.items()],
        "contacts": contacts,
        "superposed_places": summarise_places(superposed, "board"),
        "simulated_contacts": simulated_contact_rows(skins, fields_uT, section, seed),
        "simulated_places": summarise_places(simulated, "skin"),
        "boards_n": len(boards),
        "touches_n": len(touches_uT),
        "magnet_mm": list(section.magnet_mm),
    }
    settings_shown = ("detected_fraction", "draws_n", "skins_n", "turned_uT", "magnet_uT")
    write_results(results, numbers | {name: getattr(section, name) for name in settings_shown}, {})


# --- Recordings ---


def read_pad(readings: Readings, raw: Path, section: MovingHand, policy: FaultPolicy) -> Pad:
    """Return the field changes, the joint positions and the noise of a pad.

    The pad's chips are put into the order of the boards in `presses`.
    """
    motion = leaphand.read_motion(raw, read_header(raw), policy)
    db_uT = readings.b_uT.astype(float) - readings.noload_uT
    ordered_uT = db_uT.reshape(len(db_uT), -1, 3)[:, section.pad_chips].reshape(db_uT.shape)
    noise_uT = float(np.sqrt(motion.noload_uT.var(axis=0, ddof=1).mean()))
    return Pad(ordered_uT, motion.joint_counts.astype(float), noise_uT)


def pairs_of(group: Group, pads: Mapping[str, Pad]) -> list[Pair]:
    """Return the pairs of recordings of a group; raise `ParamsError` if a capture is missing, or a pair incomplete."""
    where = f"moving_hand.groups: {group.name}"
    missing = [capture for capture in (*group.threshold, *group.tested) if capture not in pads]
    if missing:
        known = ", ".join(sorted(pads)) or "none"
        what = f"no capture {missing[0]} of layout leaphand in the scene (it has: {known})"
        raise ParamsError(f"{where}: {what}. Add this capture to the scene, or correct its name in the group.")
    if len(group.threshold) != len(group.tested):
        what = f"{len(group.threshold)} captures in threshold, but {len(group.tested)} in tested"
        remedy = "For every pad, list one capture in threshold and one in tested, in the same order of the pads."
        raise ParamsError(f"{where}: {what}. {remedy}")
    return [(pads[first], pads[second]) for first, second in zip(group.threshold, group.tested, strict=True)]


def read_boards(settings: Settings, section: Compare, captures: Sequence[Readings]) -> list[BoardPresses]:
    """Return the boards with recorded presses, in the board's axes; raise `ParamsError` if the scene has none."""
    if not captures:
        remedy = "Run: reskin fetch lab --scene " + settings.scene
        raise ParamsError(f"scene {settings.scene}: no recordings of presses, which moving_hand needs. {remedy}")
    data = SceneData(settings.scene, settings, gather(captures, settings.section(Selection, "selection")), [])
    known = align_boards(data, section, captures)
    return [board_presses(known, board) for board in known.presses]


def skin_of_board(board: BoardPresses) -> Skin:
    """Return the presses of a recorded board as inputs of the universal model."""
    presses = raise_forces(board.presses)
    rest_uT, db_uT = to_chips(board.rest_uT[None])[0], to_chips(presses.db_uT)
    return Skin(board.board, rest_uT, db_uT, presses.place_mm + CENTRE_MM, presses.force_N)


def simulated_skins(setup: Setup, skins_n: int, seed: int, name: str) -> list[Skin]:
    """Draw skins from the prior of the shipped model, with errors of the law as in the training of the model.

    name: name of the random stream.
    """
    prior = SkinPrior(NOMINAL_NAME, NOMINAL, NOMINAL_SPREADS, setup)
    drawn = draw_prior_skins(prior, skins_n, seed, name, law_error())
    parts = zip(drawn.rest_uT, drawn.db_uT, drawn.place_mm, drawn.force_N, strict=True)
    return [
        Skin(
            f"skin {i}", to_chips(rest_uT[None].astype(float))[0], to_chips(db_uT.astype(float)),
            place_mm.astype(float) + CENTRE_MM, force_N.astype(float),
        )
        for i, (rest_uT, db_uT, place_mm, force_N) in enumerate(parts)
    ]  # fmt: skip


def describe_pad(capture: str, pad_name: str, pad: Pad) -> Row:
    """Describe one recording by its noise, its field changes, and the most likely source of these changes.

    The source is described by its distance from the pad and by the size of its field.
    """
    length_uT = np.linalg.norm(pad.db_uT, axis=1)
    distance_mm, size_uT = find_source(to_board(pad.db_uT), pad.noise_uT)
    return {
        "capture": capture, "pad": pad_name, "rows_n": len(length_uT), "noise_uT": pad.noise_uT,
        "median_uT": float(np.median(length_uT)), "max_uT": float(length_uT.max()),
        "source_distance_mm": distance_mm, "source_size_uT": size_uT,
    }  # fmt: skip


def find_source(db_uT: Changes, noise_uT: float) -> tuple[float, float]:
    """Return the distance and the size of a source that make the field changes most likely, among the candidates.

    `db_uT` are field changes in the board's axes.
    """
    second_uT2 = db_uT.T @ db_uT / len(db_uT)
    likelihoods = {}
    for distance_mm in DISTANCES_MM:
        unit = external.covariance(np.array(CHIPS_MM), 1.0, distance_mm)
        for size_uT in SIZES_uT:
            cov = size_uT**2 * unit + noise_uT**2 * np.eye(len(unit))
            likelihoods[distance_mm, size_uT] = -np.linalg.slogdet(cov)[1] - np.trace(np.linalg.solve(cov, second_uT2))
    return max(likelihoods, key=lambda pair: likelihoods[pair])


# --- Contacts ---


def contact_rows(group: str, pairs: Sequence[Pair], touches_uT: Changes, section: MovingHand, seed: int) -> list[Row]:
    """Count false contacts of a group of pads, and detected superposed touches, with every method of compensation."""
    methods: list[tuple[Row, Sequence[Pair], tuple[float, ...]]] = [
        ({"method": "none", "trained_on": None}, pairs, section.external_uT)
    ]
    for learner in ("ridge", "boosting"):
        for trained_on in (OTHER, FIRST_HALF):
            learnt = [compensate(learner, trained_on, pair, section.boosting_iterations_n) for pair in pairs]
            methods.append(({"method": learner, "trained_on": trained_on}, learnt, section.compensated_uT))
    return [
        {"group": group} | method | {"external_uT": external_uT, "readings_n": sum(len(pair[1].db_uT) for pair in used)}
        | count_contacts(used, touches_uT, external_uT, section, rng_for(seed, "moving hand", "superpose", group))
        for method, used, options in methods
        for external_uT in options
    ]  # fmt: skip


def compensate(learner: str, trained_on: str, pair: Pair, boosting_iterations_n: int) -> Pair:
    """Predict field changes with a regression, and subtract them from the readings.

    The inputs of the regression are the positions of the moving joints. The regression is trained either on the pad's
    other recording, or on the first half of the tested recording. In both cases, thresholds are set on the first half
    of the tested recording, and tested on the second half.
    """
    from sklearn.ensemble import HistGradientBoostingRegressor
    from sklearn.linear_model import RidgeCV
    from sklearn.multioutput import MultiOutputRegressor
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    tested = pair[1]
    half = len(tested.db_uT) // 2
    known = pair[0] if trained_on == OTHER else tested[:half]
    moving = known.joint_counts.std(axis=0) > MOVING_COUNTS
    if not moving.any():
        what = "in a recording, no joint moves, so field changes cannot be predicted from joint positions"
        raise SchemaError(f"moving_hand: {what}. Remove the recording from moving_hand.groups of the scene.")
    if learner == "ridge":
        regression = make_pipeline(
            StandardScaler(), PolynomialFeatures(2), StandardScaler(), RidgeCV(np.logspace(-2, 4, 13))
        )
    else:
        boosting = HistGradientBoostingRegressor(max_iter=boosting_iterations_n, random_state=0)
        regression = MultiOutputRegressor(boosting)
    regression.fit(known.joint_counts[:, moving], known.db_uT)
    rest = tested.without(regression.predict(tested.joint_counts[:, moving]))
    return rest[:half], rest[half:]


def count_contacts(
    pairs: Sequence[Pair], touches_uT: Changes, external_uT: float, section: MovingHand, rng: np.random.Generator
) -> Row:
    """Count contacts per 100 readings at the threshold of `reskin live`, and at thresholds for a stated detection rate.

    A touch is simulated: the field change of a recorded press is multiplied by a factor, and a random field change of a
    random pad is added. Each factor has its own threshold, which `detected_fraction` of the touches exceed. Thresholds
    are set with field changes from the recordings for thresholds. Detected touches are then counted with field changes
    from the tested recordings.
    """
    model = load_universal(external_uT=external_uT)
    matrices = [[model.suppressor(pad.noise_uT) for pad in pair] for pair in pairs]
    still = [magnitudes_uT(tested.db_uT, of_pair[1]) for (_, tested), of_pair in zip(pairs, matrices, strict=True)]
    live_uT = [
        live_threshold(tested.noise_uT, of_pair[1]) for (_, tested), of_pair in zip(pairs, matrices, strict=True)
    ]
    false = np.concatenate([strength_uT > limit_uT for strength_uT, limit_uT in zip(still, live_uT, strict=True)])
    row: Row = {"live_false_pct": 100 * float(false.mean()), "thresholds": []}
    pad_i = rng.integers(len(pairs), size=len(touches_uT))
    for scale in section.touch_scales:
        superposed = np.zeros((2, len(touches_uT)))
        for i, pair in enumerate(pairs):
            own = pad_i == i
            for part, pad in enumerate(pair):
                changes_uT = pad.db_uT[rng.integers(len(pad.db_uT), size=own.sum())]
                superposed[part, own] = magnitudes_uT(scale * touches_uT[own] + changes_uT, matrices[i][part])
        threshold_uT = float(np.quantile(superposed[0], 1 - section.detected_fraction))
        row["thresholds"].append({
            "touch_scale": scale, "threshold_uT": threshold_uT,
            "false_pct": 100 * float((np.concatenate(still) > threshold_uT).mean()),
            "detected_pct": 100 * float((superposed[1] > threshold_uT).mean()),
            "live_detected_pct": 100 * float((superposed[1] > np.array(live_uT)[pad_i]).mean()),
        })  # fmt: skip
    return row


def live_threshold(noise_uT: float, suppressor: Float[np.ndarray, "15 15"] | None) -> float:
    """Return the strength of a field change above which `reskin live` reports a contact.

    `noise_uT` is the noise of one channel. `reskin live` adds `CONTACT_SDS` times this noise to the median strength of
    many no-load readings. Here, no such readings are needed: the median is replaced by the root mean square strength
    that noise alone would have, which is about as large.
    """
    channels_n = 3 * len(CHIPS_MM) if suppressor is None else float((suppressor**2).sum())
    return noise_uT * (np.sqrt(channels_n) + CONTACT_SDS)


# --- Simulated fields ---


def draw_fields(skin: Skin, section: MovingHand, seed: int) -> dict[str, Changes]:
    """Draw changes of each kind of external field, relative to the field at the time of the no-load reading."""
    rng = rng_for(seed, "moving hand", skin.name, "fields")
    n = section.changes_n
    return {
        NO_FIELD: np.zeros((n, 15)),
        TURNED: turn(section.turned_uT, n, rng),
        MAGNET: move_magnet(section.magnet_uT, section.magnet_mm, n, rng),
    }


def turn(field_uT: float, n: int, rng: np.random.Generator) -> Changes:
    """Draw changes of a uniform field on a board that is turned from one random orientation to n other orientations."""
    direction = _directions(1 + n, rng)
    return to_chips(np.tile(field_uT * (direction[1:] - direction[0]), len(CHIPS_MM)))


def move_magnet(size_uT: float, distance_mm: tuple[float, float], n: int, rng: np.random.Generator) -> Changes:
    """Draw field changes of a magnet that moves from one random position relative to the board to n other positions.

    The magnet is a dipole of constant size in random orientation. Its distance from the board's centre is uniformly
    distributed, and its direction is random. size_uT: root mean square of a component of the magnet's field at the
    smallest distance.
    """
    near_mm, far_mm = distance_mm
    places_m = 1e-3 * rng.uniform(near_mm, far_mm, (1 + n, 1)) * _directions(1 + n, rng)
    # The mean square of |B| of a dipole with moment m at distance d, over all directions, is 2 (mu0/4pi m / d^3)^2.
    moment_A_m2 = 1e-6 * size_uT * np.sqrt(3 / 2) * (1e-3 * near_mm) ** 3 / MU0_4PI * _directions(1 + n, rng)
    chips_m = 1e-3 * np.column_stack([CHIPS_MM, np.zeros(len(CHIPS_MM))])
    field_uT = 1e6 * np.moveaxis(field_of_each(places_m, moment_A_m2, chips_m), 1, 0).reshape(1 + n, -1)
    return to_chips(field_uT[1:] - field_uT[0])


def _directions(n: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    vectors = rng.standard_normal((n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def simulated_contact_rows(
    skins: Sequence[Skin], fields_uT: Sequence[Mapping[str, Changes]], section: MovingHand, seed: int
) -> list[Row]:
    """Count false contacts and detected presses on simulated skins.

    They are counted with the threshold of `reskin live` on all skins, and with another threshold, which a fraction
    `detected_fraction` of the presses exceeds. This threshold is set with every second skin and tested with the others.
    """
    noise_uT = float(np.sqrt(np.mean(np.square(NOISE_uT))))
    sd_uT = np.tile(NOISE_uT, len(CHIPS_MM))
    rows = []
    for field in fields_uT[0]:
        still_uT, pressed_uT = [], []
        for skin, of_skin in zip(skins, fields_uT, strict=True):
            rng = rng_for(seed, "moving hand", "noise", skin.name, field)
            n = len(of_skin[field])
            still_uT.append(of_skin[field] + sd_uT * rng.standard_normal((n, len(sd_uT))))
            # No noise is added here, because the presses of a simulated skin already contain noise.
            pressed_uT.append(skin.db_uT[rng.integers(len(skin.db_uT), size=n)] + of_skin[field])
        for external_uT in section.external_uT:
            matrix = load_universal(external_uT=external_uT).suppressor(noise_uT)
            still, pressed = (
                [magnitudes_uT(each_uT, matrix) for each_uT in of_skins] for of_skins in (still_uT, pressed_uT)
            )
            live_uT = live_threshold(noise_uT, matrix)
            limit_uT = float(np.quantile(np.concatenate(pressed[::2]), 1 - section.detected_fraction))
            rows.append({
                "field": field, "external_uT": external_uT, "readings_n": sum(map(len, still)),
                "live_false_pct": _above_pct(still, live_uT),
                "live_detected_pct": _above_pct(pressed, live_uT), "threshold_uT": limit_uT,
                "false_pct": _above_pct(still[1::2], limit_uT), "detected_pct": _above_pct(pressed[1::2], limit_uT),
            })  # fmt: skip
    return rows


def _above_pct(strengths_uT: Sequence[Float[np.ndarray, " f"]], limit_uT: float) -> float:
    return 100 * float((np.concatenate(strengths_uT) > limit_uT).mean())


# --- Places ---


def board_rows(board: BoardPresses, fields_uT: Mapping[str, Changes], section: MovingHand, seed: int) -> Iterator[Row]:
    """Score the estimated places of a board's presses, to which field changes of the moving hand are added.

    The model is calibrated without such field changes, to 65 unlabelled presses at random places. The board's places
    are coloured like the squares of a checkerboard: labels are at the places of one colour, and tests are at the places
    of the other colour.
    """
    skin = skin_of_board(board)
    readings_uT = to_chips(board.readings.db_uT)
    for draw_i in range(section.draws_n):
        draw = draw_presses(board, CHECKERBOARD, PLACES_N, seed, draw_i)
        rng = rng_for(seed, "moving hand", board.board, draw_i)
        tested = rng.choice(draw.tested, min(section.readings_n, len(draw.tested)), replace=False)
        true = Skin(
            skin.name, skin.rest_uT, readings_uT[tested], board.readings.place_mm[tested] + CENTRE_MM,
            board.readings.force_N[tested],
        )  # fmt: skip
        superposed_uT = {NO_FIELD: np.zeros_like(true.db_uT)} | {
            name: recorded_uT[rng.integers(len(recorded_uT), size=len(tested))]
            for name, recorded_uT in fields_uT.items()
        }
        for row in score_places(skin, draw.unlabelled, draw.labels, true, superposed_uT, section):
            yield {"board": board.board} | row


def simulated_place_rows(skin: Skin, fields_uT: Mapping[str, Changes], section: MovingHand, seed: int) -> Iterator[Row]:
    """Score the estimated places of presses on a simulated skin, in external fields.

    The model is calibrated to other presses of the skin, without external fields.
    """
    rng = rng_for(seed, "moving hand", skin.name, "presses")
    order = rng.permutation(len(skin.db_uT))
    pool, tested = order[:PLACES_N], order[PLACES_N:]
    true = Skin(skin.name, skin.rest_uT, skin.db_uT[tested], skin.place_mm[tested], skin.force_N[tested])
    drawn = {name: of_field[rng.integers(len(of_field), size=len(tested))] for name, of_field in fields_uT.items()}
    for row in score_places(skin, pool, pool, true, drawn, section):
        yield {"skin": skin.name} | row


def score_places(
    skin: Skin,
    unlabelled: np.ndarray,
    labels: np.ndarray,
    true: Skin,
    changes_uT: Mapping[str, Changes],
    section: MovingHand,
) -> Iterator[Row]:
    """Calibrate the universal model to presses of a skin, and score tested presses in each external field."""
    for external_uT in section.places_uT:
        model = load_universal(external_uT=external_uT).zero(skin.rest_uT)
        model.see(skin.rest_uT + skin.db_uT[unlabelled], area=True)
        for labels_n in section.labels_n:
            chosen = labels[:labels_n]
            if labels_n:
                model.label(skin.place_mm[chosen], skin.force_N[chosen], skin.rest_uT + skin.db_uT[chosen])
            for field, change_uT in changes_uT.items():
                found = model.estimate(skin.rest_uT + true.db_uT + change_uT)
                error_mm = found.place_mm - true.place_mm
                yield {
                    "field": field, "external_uT": external_uT, "labels_n": labels_n, **place_scores(error_mm),
                    "coverage_pct": 100 * float((np.abs(error_mm) <= NORMAL_90 * found.sd_mm).mean()),
                    "force_factor": float(np.exp(np.abs(np.log(found.force_N / true.force_N)).mean())),
                }  # fmt: skip


def summarise_places(rows: Sequence[Row], unit: str) -> list[Row]:
    """Average scores over draws, then summarise them over units, which are boards or simulated skins."""
    keys = ["field", "external_uT", "labels_n"]
    summary = []
    for key, group in pd.DataFrame(rows).groupby(keys, sort=False):
        means = group.drop(columns=keys).groupby(unit).mean()
        row: Row = dict(zip(keys, key, strict=True))
        summary.append(row | {str(name): statistic(means[name].to_numpy(), boards=unit == "board") for name in means})
    return summary


# --- Report ---

OF_RECORDINGS = (
    "Recorded on a hand that moves without contact. Change: difference between a reading and the no-load field, as the "
    "length over all 15 channels. Source: a dipole whose field would explain the changes best. Its distance from the "
    "pad is one of {distances_n} candidates from {least:g} to {most:g} mm. Its size is the standard deviation of a "
    "component of its field. If the changes are hardly larger than the noise, they say little about the distance."
)
OF_CONTACTS = (
    "Recorded. False contacts: readings of the tested recordings whose change is above a threshold, although nothing "
    "touches the pad. There are several thresholds: the threshold of `reskin live`, and the thresholds that "
    "{detected:g} % of superposed touches exceed (table moving_hand_detection). Compensation: a regression predicts "
    "the field change from the joint positions, and the prediction is subtracted from the reading. The regression is "
    "trained on the other recording of the pad, or on the first half of the tested recording. In both cases, only the "
    "second half of the tested recording is then tested."
)
OF_DETECTION = (
    "Superposed touches: the field change of each of {touches_n} recorded readings of presses is multiplied by a "
    "factor, and a field change that was recorded on the moving hand is added. Threshold: {detected:g} % of the "
    "superposed touches exceed it, with field changes of the hand from the recordings for thresholds. Detected: "
    "percentage of the superposed touches that exceed this threshold, or the threshold of `reskin live`, with field "
    "changes of the hand from the tested recordings. The recordings for thresholds are other recordings of the same "
    "pads or, with compensation, the first halves of the tested recordings. Superposed touches contain the noise of "
    "both recordings, but no effect of a press on the hand."
)
OF_SIMULATED = (
    "Simulated: {skins_n} skins from the prior of the shipped model. Turned in the earth's field: in a uniform field "
    "of {turned:g} uT, a skin is turned from one random orientation to others. Moving magnet: a dipole moves from one "
    "random position to others, {near:g} to {far:g} mm from the middle of the board. At the smallest distance, a "
    "component of its field has a root mean square of {magnet:g} uT. "
)
OF_THRESHOLD = (
    "The first two results are for the threshold of `reskin live`. The other threshold is the one that {detected:g} % "
    "of the presses exceed. It is set with every second skin, and tested with the other skins. The presses have all "
    "forces of the prior."
)
OF_PLACES = (
    "Superposed: a field change that was recorded on the moving hand (in the tested recordings) is added to each "
    "tested press of {boards_n} recorded boards. With external field `none`, nothing is added. The model is calibrated "
    "without such field changes, to {presses_n} presses at random places. The places are coloured like the squares of "
    "a checkerboard: labels are at places of one colour, and tests are at places of the other colour. Means over "
    "{draws_n} random draws, then over boards; (a; b) are the values of the boards."
)
OF_SIMULATED_PLACES = (
    "The model is calibrated without external fields, to {presses_n} presses at random places. The labels are the "
    "first of these presses. Other presses are tested. ±: standard deviation over skins."
)
METHODS = {
    "none": "none", "ridge": "ridge regression, trained on {trained_on}",
    "boosting": "gradient boosting, trained on {trained_on}",
}  # fmt: skip
RECORDED, SUPERPOSED, SIMULATED = "recorded", "superposed", "simulated"


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate recorded, superposed and simulated results in separate tables."""
    detected, (near_mm, far_mm) = 100 * numbers["detected_fraction"], numbers["magnet_mm"]
    simulated = OF_SIMULATED.format(
        skins_n=numbers["skins_n"], turned=numbers["turned_uT"], near=near_mm, far=far_mm, magnet=numbers["magnet_uT"]
    )
    distances = {"distances_n": len(DISTANCES_MM), "least": DISTANCES_MM[0], "most": DISTANCES_MM[-1]}
    notes = {
        "moving_hand_recordings": OF_RECORDINGS.format(**distances),
        "moving_hand": OF_CONTACTS.format(detected=detected),
        "moving_hand_detection": OF_DETECTION.format(detected=detected, touches_n=numbers["touches_n"]),
        "moving_hand_simulated": simulated + OF_THRESHOLD.format(detected=detected),
        "moving_hand_places": OF_PLACES.format(
            boards_n=numbers["boards_n"], presses_n=PLACES_N, draws_n=numbers["draws_n"]
        ),
        "moving_hand_places_simulated": simulated + OF_SIMULATED_PLACES.format(presses_n=PLACES_N),
    }
    lines = {
        "moving_hand_recordings": [_recording_line(row) for row in numbers["recordings"]],
        "moving_hand": [_contact_line(row, detected) for row in numbers["contacts"]],
        "moving_hand_detection": [_detection_line(row) for row in numbers["contacts"]],
        "moving_hand_simulated": [_simulated_line(row) for row in numbers["simulated_contacts"]],
        "moving_hand_places": _place_lines(numbers["superposed_places"], SUPERPOSED),
        "moving_hand_places_simulated": _place_lines(numbers["simulated_places"], SIMULATED),
    }
    return {name: tabulate(lines[name], meaning=meaning) for name, meaning in notes.items()}


def _recording_line(row: Mapping[str, Any]) -> Row:
    return {
        "recording": row["capture"], "pad": row["pad"], "readings": row["rows_n"],
        "noise, uT": round(row["noise_uT"], 1), "median change, uT": round(row["median_uT"]),
        "largest change, uT": round(row["max_uT"]), "distance of the source, mm": round(row["source_distance_mm"]),
        "size of the source, uT": round(row["source_size_uT"]), "source": RECORDED,
    }  # fmt: skip


def _contact_line(row: Mapping[str, Any], detected_pct: float) -> Row:
    false = {"threshold of live": round(row["live_false_pct"], 1)}
    for part in row["thresholds"]:
        false[f"{detected_pct:g} % of touches x {part['touch_scale']:g}"] = round(part["false_pct"], 1)
    titled = {f"false contacts per 100, {name}": per_100 for name, per_100 in false.items()}
    return _method_cells(row) | {"readings": row["readings_n"]} | titled | {"source": RECORDED}


def _method_cells(row: Mapping[str, Any]) -> Row:
    method = METHODS[row["method"]].format(trained_on=row["trained_on"])
    return {"pads": row["group"], "compensation": method, "external_uT": f"{row['external_uT']:g}"}


def _detection_line(row: Mapping[str, Any]) -> Row:
    line = _method_cells(row)
    for part in row["thresholds"]:
        name = f"touches x {part['touch_scale']:g}: "
        line |= {
            f"{name}threshold, uT": round(part["threshold_uT"]),
            f"{name}detected, %": round(part["detected_pct"], 1),
            f"{name}detected by live, %": round(part["live_detected_pct"], 1),
        }
    return line | {"source": SUPERPOSED}


def _simulated_line(row: Mapping[str, Any]) -> Row:
    return {
        "external field": row["field"], "external_uT": f"{row['external_uT']:g}", "readings": row["readings_n"],
        "false contacts per 100 readings": round(row["live_false_pct"], 1),
        "detected, %": round(row["live_detected_pct"], 1), "other threshold, uT": round(row["threshold_uT"]),
        "other threshold: false contacts per 100": round(row["false_pct"], 1),
        "other threshold: detected, %": round(row["detected_pct"], 1), "source": SIMULATED,
    }  # fmt: skip


def _place_lines(rows: Sequence[Mapping[str, Any]], source: str) -> list[Row]:
    """Write one line for each number of labels and field, with columns for each value of the option."""
    lines: dict[tuple[str, int], Row] = {}
    for row in sorted(rows, key=lambda row: row["labels_n"]):
        cells = {"external field": row["field"], "labels": row["labels_n"]}
        line = lines.setdefault((row["field"], row["labels_n"]), cells)
        option = f"external_uT={row['external_uT']:g}: "
        for name, title in (("accuracy_pct", "within 1 mm, %"), ("mse_xy_mm2", "MSE_xy, mm²")):
            line[option + title] = show(row[name])
        line[option + "in 90 % interval, %"] = round(row["coverage_pct"]["mean"])
    # Without a change of the external field, nothing is added to the recorded presses, so the result is recorded.
    alone = RECORDED if source == SUPERPOSED else source
    return [line | {"source": alone if field == NO_FIELD else source} for (field, _), line in lines.items()]


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw false contacts and the accuracy of places against `external_uT`, with one panel for each kind of result."""
    with drawing(9.5, 8.5) as figure:
        panels = figure.subplots(2, 2).ravel()
        plain = [row for row in numbers["contacts"] if row["method"] == "none"]
        false = ((plain, "group", RECORDED), (numbers["simulated_contacts"], "field", SIMULATED))
        for axes, (rows, key, kind) in zip(panels[:2], false, strict=True):
            for i, name in enumerate(dict.fromkeys(row[key] for row in rows)):
                own = [row for row in rows if row[key] == name]
                x, y = ([row[part] for row in own] for part in ("external_uT", "live_false_pct"))
                axes.plot(x, y, marker=MARKERS[i], color=COLOURS[i], label=name)
            axes.set(ylabel="false contacts per 100 readings", title=f"Contacts, {kind}", ylim=(-4, 104))
        places = ((numbers["superposed_places"], SUPERPOSED), (numbers["simulated_places"], SIMULATED))
        for axes, (rows, kind) in zip(panels[2:], places, strict=True):
            styles = dict(zip(sorted({row["labels_n"] for row in rows}), ("-", "--", ":", "-."), strict=False))
            for i, field in enumerate(dict.fromkeys(row["field"] for row in rows)):
                for labels_n, style in styles.items():
                    own = [row for row in rows if (row["field"], row["labels_n"]) == (field, labels_n)]
                    x, y = [row["external_uT"] for row in own], [row["accuracy_pct"]["mean"] for row in own]
                    axes.plot(x, y, style, marker=MARKERS[i], color=COLOURS[i], label=f"{field}, {labels_n} labels")
            axes.set(ylabel="within 1 mm / %", title=f"Places, {kind}", ylim=(0, 100))
        for axes in panels:
            axes.set(xlabel="external_uT / µT")
            axes.legend(fontsize=9, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.14), handlelength=3.5)
        return {"moving_hand.svg": svg(figure)}
