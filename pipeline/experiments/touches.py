"""Recordings of a real pad that is touched at one or two of its numbered places (paper section 7, future work).

The experiment estimates the place and the force of a single touch. It tests whether the change of field by two
simultaneous touches is the sum of the changes by the two single touches, and whether two touches can be detected. Each
recording of single touches is split by time into training rows, rows that set thresholds, and test rows.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from jaxtyping import Float32, Float64
from pydantic import Field, model_validator
from scipy.optimize import nnls

from pipeline.experiments.detection import (
    NEIGHBOURS_N,
    NOISE_uT,
    Scores,
    above_pct,
    direction_distance,
    neighbour_distance,
    roc_areas,
    thresholds,
)
from pipeline.experiments.results import write_results
from pipeline.formatting import show_digits
from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.statistics import statistic
from reskin import io
from reskin.config import Strict
from reskin.data.baseline import subtract
from reskin.data.rows import Selection
from reskin.errors import ParamsError
from reskin.models.classical import Ridge, fit
from reskin.models.inputs import shape
from reskin.schema import Readings
from reskin.seeds import rng_for

PLACE_COUNT = re.compile(r"place_(\d+)_rows_n")  # key in the ingest counts of captures with numbered places
ROWS_MIN_N = 20  # a recording is usable only if it has at least this number of rows with enough force
LINEAR = Ridge(inputs="raw", method="ridge", alpha=1.0)  # model that predicts the force
SUMS_N = 100  # number of random sums of two single touches, for each pair of places

Fraction = Annotated[float, Field(gt=0, lt=1)]
Directions = Mapping[int, Float64[np.ndarray, " ch"]]  # mean direction of dB by place number


class Touches(Strict):
    """Settings section `touches`.

    - train_fraction: fraction of each recording, from its start, that is used for training.
    - aside_fraction: fraction of each recording, after the training rows, that sets the thresholds.
    - false_alarm_fraction: fraction of single touches that a detector may report as two touches.
    """

    train_fraction: Fraction
    aside_fraction: Fraction
    false_alarm_fraction: Fraction

    @model_validator(mode="after")
    def _check_test_rows_are_left(self) -> "Touches":
        if self.train_fraction + self.aside_fraction >= 1:
            raise ValueError("train_fraction + aside_fraction must be less than 1, because the rest are the test rows")
        return self


def touches(settings: Settings, section: Touches, indentations: Path, results: Path) -> None:
    """Evaluate all recordings of touches at numbered places, of one or two touches at once."""
    selection = settings.section(Selection, "selection")
    sources = [indentations / f"{name}.parquet" for name in settings.captures_in(indentations)]
    recordings = sort_recordings(
        touched_rows(io.read_readings(file), io.read_ingest_counts(file), selection) for file in sources
    )
    single, double = recordings.single, recordings.double
    counts = {
        "force_min_N": selection.force_min_N,
        "single": {"recordings_n": len(single), "rows_n": sum(len(recording.db_uT) for recording in single)},
        "double": {"recordings_n": len(double), "rows_n": sum(len(recording.db_uT) for recording in double)},
        "left_out": recordings.left_out,
    }
    for name, reason in recordings.left_out.items():
        say(f"{settings.scene}: warning: recording {name} is left out: {reason}")
    if recordings.problem:
        write_results(results, counts | {"not_computed": recordings.problem}, {})
        say(f"{settings.scene}: warning: experiment touches is not computed: {recordings.problem}")
        return
    blocks = [split_by_time(recording, section) for recording in single]
    numbers = counts | {
        "tested_rows_n": sum(len(recording.test.db_uT) for recording in blocks),
        "place": evaluate_places(blocks, double),
        "force": evaluate_forces(blocks, rng_for(settings.seed, "touches", "force")),
        "superposition": evaluate_superposition(blocks, double),
        "detection": evaluate_detection(blocks, double, section, settings.seed),
    }
    write_results(results, numbers, {})
    say(f"{settings.scene} touches: evaluated {len(single)} recordings of one place and {len(double)} of two places")


# --- Recordings ---


@dataclass(frozen=True)
class Touched:
    """The rows of one recording in which the pad is touched with enough force, in order of time.

    `places` contains the numbers of the one or two places that are touched in this recording.
    """

    name: str
    places: tuple[int, ...]
    db_uT: Float32[np.ndarray, "f ch"]
    force_N: Float32[np.ndarray, " f"]

    def __getitem__(self, rows: slice) -> "Touched":
        """Return the recording with only these rows."""
        return Touched(self.name, self.places, self.db_uT[rows], self.force_N[rows])


@dataclass(frozen=True)
class Split:
    """The rows of a recording split by time: training rows, rows that set thresholds (`aside`), and test rows."""

    train: Touched
    aside: Touched
    test: Touched


def touched_rows(readings: Readings, account: Mapping[str, int], selection: Selection) -> Touched:
    """Return the rows of a recording with enough force; raise `ParamsError` unless it has one or two numbered places.

    `account` contains the ingest counts of the recording, whose keys name its places.
    """
    places = tuple(sorted(int(match[1]) for name in account if (match := PLACE_COUNT.fullmatch(name))))
    if len(places) not in (1, 2):
        what = f"one or two numbered places are needed; got {list(places)}"
        remedy = "Only recordings with layout eflash7 have numbered places. Move all others to another scene."
        raise ParamsError(f"capture {readings.capture}: {what}. {remedy}")
    rows = readings.Fz_N >= selection.force_min_N
    db_uT = subtract(readings.b_uT[rows], readings.noload_uT[rows])
    return Touched(readings.capture, places, db_uT, readings.Fz_N[rows])


def split_by_time(recording: Touched, section: Touches) -> Split:
    """Split the rows of a recording by time, in the fractions of the settings."""
    rows_n = len(recording.db_uT)
    fractions = (section.train_fraction, section.train_fraction + section.aside_fraction)
    first, second = (round(fraction * rows_n) for fraction in fractions)
    return Split(recording[:first], recording[first:second], recording[second:])


@dataclass(frozen=True)
class Sorted:
    """The recordings of the scene, sorted by their number of places.

    - single: usable recordings of one place.
    - double: usable recordings of two places.
    - left_out: the reason why a recording is not used, by the name of the recording.
    - problem: the reason why the experiment cannot be computed at all, or None.
    """

    single: list[Touched]
    double: list[Touched]
    left_out: dict[str, str]
    problem: str | None


def sort_recordings(recordings: Iterable[Touched]) -> Sorted:
    """Sort recordings by their number of places, and leave out recordings that cannot be used.

    A recording needs `ROWS_MIN_N` touched rows. Each place of a recording of two places must also have been recorded
    alone. If a place was recorded alone twice, only the first recording is used, so that two periods of time are not
    mixed.
    """
    # Recordings of a single place come first.
    ordered = sorted(recordings, key=lambda recording: (len(recording.places), recording.places, recording.name))
    left_out = {
        recording.name: f"{len(recording.db_uT)} rows with enough force, but {ROWS_MIN_N} are needed"
        for recording in ordered
        if len(recording.db_uT) < ROWS_MIN_N
    }
    usable = [recording for recording in ordered if recording.name not in left_out]
    single: dict[int, Touched] = {}
    double = []
    for recording in usable:
        unknown = sorted(set(recording.places) - single.keys()) if len(recording.places) == 2 else []
        if unknown:
            left_out[recording.name] = f"no recording of place {' and '.join(map(str, unknown))} alone"
        elif len(recording.places) == 2:
            double.append(recording)
        elif recording.places[0] in single:
            left_out[recording.name] = (
                f"recording {single[recording.places[0]].name} of place {recording.places[0]} alone is used instead"
            )
        else:
            single[recording.places[0]] = recording
    problem = None
    if len(single) < 2:
        remedy = "Add recordings of single places to the scene."
        problem = f"places recorded alone: {len(single)}; at least 2 are needed. {remedy}"
    return Sorted(list(single.values()), double, left_out, problem)


def stack_touches(recordings: Sequence[Touched]) -> tuple[Float32[np.ndarray, "f ch"], Float64[np.ndarray, " f"]]:
    """Concatenate recordings of single touches; return the changes of field, and the place number of each row."""
    numbers = np.array([float(recording.places[0]) for recording in recordings])
    place_numbers = np.repeat(numbers, [len(recording.db_uT) for recording in recordings])
    return np.concatenate([recording.db_uT for recording in recordings]), place_numbers


# --- Fields of touches ---


def unit_directions(db_uT: Float32[np.ndarray, "f ch"]) -> Float64[np.ndarray, "f ch"]:
    """Return dB / (|dB| + noise) for each reading.

    This vector has the direction of dB. Its length is nearly 1 for strong readings, and shorter for weak readings,
    whose direction is less certain because of noise.
    """
    return np.asarray(db_uT / (np.linalg.norm(db_uT.astype(np.float64), axis=1, keepdims=True) + NOISE_uT))


def predict_places(
    known_uT: Float32[np.ndarray, "a ch"], places: Float64[np.ndarray, " a"], tested_uT: Float32[np.ndarray, "f ch"]
) -> Float64[np.ndarray, " f"]:
    """Predict the place number of each tested row.

    The prediction is the most frequent place number among the known rows whose directions of dB are nearest.
    """
    from sklearn.neighbors import KNeighborsClassifier  # imported here because importing scikit-learn takes a second

    voters = KNeighborsClassifier(min(NEIGHBOURS_N, len(known_uT))).fit(unit_directions(known_uT), places)
    return np.asarray(voters.predict(unit_directions(tested_uT)))


def directions(
    known_uT: Float32[np.ndarray, "a ch"], places: Float64[np.ndarray, " a"]
) -> dict[int, Float64[np.ndarray, " ch"]]:
    """Return the mean direction of dB of each place (see `unit_directions`)."""
    units = unit_directions(known_uT)
    return {int(place): units[places == place].mean(axis=0) for place in np.unique(places)}


def relative_residual(
    known: Directions, places: Sequence[int], db_uT: Float32[np.ndarray, "f ch"]
) -> Float64[np.ndarray, " f"]:
    """Return the fraction of each row that touches at these places cannot explain, as residual / |dB|.

    Each row is fitted by a sum of the places' directions of dB, each multiplied by an amplitude of 0 or more. The
    forces at the single places were not recorded, so the amplitudes that give the smallest residual are used.
    """
    basis = np.stack([known[place] for place in places], axis=1)
    rows_uT = db_uT.astype(np.float64)
    return np.array([nnls(basis, row_uT)[1] for row_uT in rows_uT]) / np.linalg.norm(rows_uT, axis=1)


def score_unlike_one(
    known_uT: Float32[np.ndarray, "a ch"], known: Directions, tested_uT: Float32[np.ndarray, "f ch"]
) -> Scores:
    """Score how different each tested row is from a single touch, with several detectors of two touches.

    The detectors are those of experiment `contacts` that use no network, and a detector that fits each row by a touch
    at one place. The score of the last detector is the smallest residual among all places.
    """
    residuals = [relative_residual(known, (place,), tested_uT) for place in known]
    return {
        "direction and length": neighbour_distance(shape(known_uT), shape(tested_uT)),
        "direction above noise": direction_distance(known_uT, tested_uT),
        "residual of one place": np.min(residuals, axis=0),
    }


# --- Evaluations ---


def evaluate_places(blocks: Sequence[Split], double: Sequence[Touched]) -> dict[str, Any]:
    """Return how often the place of later single touches is predicted correctly.

    For two touches, also returns how often the predicted place is one of their two places.
    """
    known_uT, place_numbers = stack_touches([block.train for block in blocks])
    right_pct = [
        100 * float(np.isin(predict_places(known_uT, place_numbers, tested.db_uT), tested.places).mean())
        for tested in [*(block.test for block in blocks), *double]
    ]
    singles_n = len(blocks)
    result = {
        "by_time": statistic(right_pct[:singles_n]) | {"chance_pct": 100 / singles_n},
        "by_place": {str(block.test.places[0]): pct for block, pct in zip(blocks, right_pct, strict=False)},
    }
    if not double:
        return result
    return result | {"one_of_two": statistic(right_pct[singles_n:]) | {"chance_pct": 200 / singles_n}}


def evaluate_forces(blocks: Sequence[Split], rng: np.random.Generator) -> dict[str, Any]:
    """Return the mean squared force errors of a ridge regression that predicts the force of single touches from dB.

    - by_time: errors on later rows of the training recordings.
    - place_left_out: errors on recordings of a place that is not in the training recordings.
    - variance: variance of the force, which would be the error of predicting the mean force.
    """
    by_time = [_force_error(blocks, block.test, rng) for block in blocks]
    left_out = [
        _force_error([other_block for other_block in blocks if other_block is not block], block.test, rng)
        for block in blocks
    ]
    spread = [{"mse_f_N2": float(block.test.force_N.var(dtype=np.float64))} for block in blocks]
    errors_by_split = {"by_time": by_time, "place_left_out": left_out, "variance": spread}
    return {way: statistic([row["mse_f_N2"] for row in rows]) for way, rows in errors_by_split.items()}


def _force_error(known: Sequence[Split], tested: Touched, rng: np.random.Generator) -> dict[str, float]:
    train = [block.train for block in known]
    target = np.full((sum(len(recording.force_N) for recording in train), 3), np.nan, np.float32)
    target[:, 2] = np.concatenate([recording.force_N for recording in train])
    fitted = fit(LINEAR, np.concatenate([recording.db_uT for recording in train]), target, rng, weight=None)
    error_N = fitted.predict(tested.db_uT)[:, 2].astype(np.float64) - tested.force_N
    return {"mse_f_N2": float((error_N**2).mean())}


def evaluate_superposition(blocks: Sequence[Split], double: Sequence[Touched]) -> dict[str, Any]:
    """Return the part of the field change of two touches that a sum of two single touches cannot explain, in percent.

    Each reading of two touches is fitted by the directions of single touches (see `relative_residual`). For comparison,
    `single_touches_pct` is the residual of single touches after a fit by the direction of their own place.
    """
    known = directions(*stack_touches([block.train for block in blocks]))
    single_pct = [
        100 * float(np.median(relative_residual(known, block.test.places, block.test.db_uT))) for block in blocks
    ]
    pairs = [explain_pair(known, (recording.places[0], recording.places[1]), recording.db_uT) for recording in double]
    return {"single_touches_pct": statistic(single_pct), "pairs": pairs} | {
        f"mean_{name}": statistic([pair[name] for pair in pairs])
        for name in ("left_over_pct", "stronger_alone_pct", "other_pairs_pct")
        if pairs
    }


def explain_pair(known: Directions, pair: tuple[int, int], db_uT: Float32[np.ndarray, "f ch"]) -> dict[str, Any]:
    """Compare fits of two touches by their two true places, by single places, and by all other pairs of places.

    Returns the median residual of each fit. `rank` is the rank of the true pair among all pairs of places, where the
    pair with rank 1 has the smallest residual.
    """
    residuals = {
        places: float(np.median(relative_residual(known, places, db_uT))) for places in combinations(sorted(known), 2)
    }
    single_residuals = {place: float(np.median(relative_residual(known, (place,), db_uT))) for place in known}
    best_place = min(single_residuals, key=lambda place: single_residuals[place])
    other_residuals = [share for places, share in residuals.items() if places != pair]
    return {
        "places": list(pair), "rows_n": len(db_uT), "left_over_pct": 100 * residuals[pair],
        "weaker_alone_pct": 100 * max(single_residuals[place] for place in pair),
        "stronger_alone_pct": 100 * min(single_residuals[place] for place in pair),
        "best_alone_pct": 100 * single_residuals[best_place], "best_alone": best_place,
        "other_pairs_pct": 100 * float(np.mean(other_residuals)),
        "rank": 1 + sum(share < residuals[pair] for share in other_residuals), "pairs_n": len(residuals),
    }  # fmt: skip


def evaluate_detection(
    blocks: Sequence[Split], double: Sequence[Touched], section: Touches, seed: int
) -> dict[str, Any]:
    """Return how often each detector reports two touches, with thresholds set for a fraction of false alarms.

    Besides recordings of two touches, the detectors are tested on sums of two single touches, and on single touches at
    a place that they do not know.
    """
    known_uT, place_numbers = stack_touches([block.train for block in blocks])
    known = directions(known_uT, place_numbers)

    def scored(blocks_uT: Sequence[Float32[np.ndarray, "_ ch"]]) -> Scores:
        return score_unlike_one(known_uT, known, np.concatenate(blocks_uT))

    limits = thresholds(scored([block.aside.db_uT for block in blocks]), section.false_alarm_fraction)
    single = scored([block.test.db_uT for block in blocks])
    sums = scored(sum_pairs(blocks, rng_for(seed, "touches", "sums")))
    result = {
        "false_alarm_asked_pct": 100 * section.false_alarm_fraction,
        "false_alarm_pct": above_pct(single, limits),
        "sums_called_two_pct": above_pct(sums, limits),
        "unseen_place_called_two_pct": unseen_places_called_two(blocks, section.false_alarm_fraction),
    }
    if not double:
        return result
    double_scores = scored([recording.db_uT for recording in double])
    return result | {"detected_pct": above_pct(double_scores, limits), "auc": roc_areas(single, double_scores)}


def sum_pairs(blocks: Sequence[Split], rng: np.random.Generator) -> list[Float32[np.ndarray, "_ ch"]]:
    """Return simulated double touches for every pair of places, made as in experiment `contacts`.

    Each is the sum of the field changes of two single touches, which are drawn at random from the test rows.
    """
    tested = [block.test.db_uT for block in blocks]
    pairs = [
        (a_uT[rng.integers(len(a_uT), size=SUMS_N)], b_uT[rng.integers(len(b_uT), size=SUMS_N)])
        for i, a_uT in enumerate(tested)
        for b_uT in tested[i + 1 :]
    ]
    return [a_uT + b_uT for a_uT, b_uT in pairs]


def unseen_places_called_two(blocks: Sequence[Split], false_alarm_fraction: float) -> dict[str, float]:
    """Return how often each detector mistakes a single touch at an unknown place for two touches, in percent.

    Each place in turn is made unknown by leaving it out of the known rows. The percentages are means over places.
    """
    called = []
    for block in blocks:
        others = [other_block for other_block in blocks if other_block is not block]
        known_uT, place_numbers = stack_touches([other_block.train for other_block in others])
        known = directions(known_uT, place_numbers)
        aside = score_unlike_one(known_uT, known, stack_touches([other_block.aside for other_block in others])[0])
        limits = thresholds(aside, false_alarm_fraction)
        called.append(above_pct(score_unlike_one(known_uT, known, block.test.db_uT), limits))
    return {name: float(np.mean([row[name] for row in called])) for name in called[0]}


# --- Tables ---

BY_TIME = "later in the same recordings"
ONCE = (
    "Each place was recorded once. Later readings may therefore be recognised by properties of their recording instead "
    "of by their place. Only tests with a recording from another day, or with a place that is left out of training, "
    "exclude this."
)
APART = "Single touches and two touches at once are in different recordings, whose dates are in data/README.md."
NO_MM = "The spacing of the 3 x 3 places is not documented, so no error is given in mm."


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate place and force of one touch, the superposition of two touches, and the detection of two touches."""
    if "not_computed" in numbers:
        return {"touches": _not_computed(numbers, source)}
    result = {"touches": _single(numbers), "touches_detection": _detection(numbers["detection"])}
    if numbers["superposition"]["pairs"]:
        result["touches_superposition"] = _superposition(numbers["superposition"])
    for table in result.values():
        table["source"] = source
    return result


def _single(numbers: Mapping[str, Any]) -> pd.DataFrame:
    place, force = numbers["place"], numbers["force"]
    rows = [
        _row(
            f"place of one touch is predicted correctly, {BY_TIME}",
            place["by_time"],
            "%",
            f"{place['by_time']['chance_pct']:.1f}",
        )
    ]
    if "one_of_two" in place:
        two = place["one_of_two"]
        chance = f"{two['chance_pct']:.1f}"
        rows.append(_row("two touches at once: predicted place is one of the two places", two, "%", chance))
    variance = f"{force['variance']['mean']:.3g} (variance)"
    for way, split in (("by_time", BY_TIME), ("place_left_out", "at a place that is left out of training")):
        rows.append(_row(f"mean squared error of the force of one touch, {split}", force[way], "N²", variance))
    table = pd.DataFrame(rows)
    single, double = numbers["single"], numbers["double"]
    table.attrs["meaning"] = (
        f"Data: {single['rows_n']} rows of {single['recordings_n']} recordings of one touch, and {double['rows_n']} "
        f"rows of {double['recordings_n']} recordings of two touches, with forces of {numbers['force_min_N']:g} N or "
        "more. Place: the most frequent place among the training rows whose changes of field have the most similar "
        "directions. Force: ridge regression on the change of field. Mean ± standard deviation over n recordings. By "
        "chance: the result of a random place, or the variance of the force, which is the error of predicting the mean "
        "force. "
        f"{ONCE} {APART} {NO_MM}"
        f"{_left_out(numbers)}"
    )
    return table


def _not_computed(numbers: Mapping[str, Any], source: str) -> pd.DataFrame:
    rows = [{"recordings": "all", "not used because": numbers["not_computed"]}]
    rows += [{"recordings": name, "not used because": reason} for name, reason in numbers["left_out"].items()]
    table = pd.DataFrame(rows).assign(source=source)
    table.attrs["meaning"] = (
        f"Nothing was computed from {numbers['single']['recordings_n']} usable recordings of one touch and "
        f"{numbers['double']['recordings_n']} usable recordings of two touches."
    )
    return table


def _left_out(numbers: Mapping[str, Any]) -> str:
    return "".join(f" Recording {name} is left out ({reason})." for name, reason in numbers.get("left_out", {}).items())


def _row(what: str, stat: Mapping[str, Any], unit: str, chance: str) -> dict[str, Any]:
    spread = f" ± {stat['sd']:.3g}" if "sd" in stat else ""
    return {"what": what, "result": f"{stat['mean']:.3g}{spread} {unit}", "by chance": chance, "n": stat["n"]}


def _superposition(numbers: Mapping[str, Any]) -> pd.DataFrame:
    rows = [
        {
            "places": " and ".join(map(str, pair["places"])),
            "fit by both places, %": f"{pair['left_over_pct']:.0f}",
            "fit by the better of them alone, %": f"{pair['stronger_alone_pct']:.0f}",
            "fit by the best of all places alone, %": f"{pair['best_alone_pct']:.0f} (place {pair['best_alone']})",
            "fit by other pairs of places, mean, %": f"{pair['other_pairs_pct']:.0f}",
            "rank among all pairs": f"{pair['rank']} of {pair['pairs_n']}",
            "rows": f"{pair['rows_n']}",
        }
        for pair in numbers["pairs"]
    ]
    means = {
        "fit by both places, %": "mean_left_over_pct",
        "fit by the better of them alone, %": "mean_stronger_alone_pct",
        "fit by other pairs of places, mean, %": "mean_other_pairs_pct",
    }  # fmt: skip
    rows.append({"places": "mean"} | {title: show_digits(numbers[name], 0) for title, name in means.items()})
    table = pd.DataFrame(rows).fillna("–")
    table.attrs["meaning"] = (
        "The recorded change of field of two touches is fitted by a sum of the mean directions of single touches at "
        "one or two places. Each direction has an amplitude of 0 or more, which is fitted to each row, because the "
        "force at each place was not recorded. The table shows the residual as a percentage of the change of field "
        "(median over rows). If the direction at a place changes with the force, the residual is larger: for single "
        f"touches, fitted by their own place, it is {show_digits(numbers['single_touches_pct'], 0)} %. A fit by two "
        "amplitudes is always at least as good as a fit by one of them. Therefore compare the fit by both places with "
        f"the fits by other pairs of places, which also have two amplitudes. {APART}"
    )
    return table


def _detection(numbers: Mapping[str, Any]) -> pd.DataFrame:
    columns = {
        "two touches reported as two, %": "detected_pct",
        "single touches reported as two, %": "false_alarm_pct",
        "single, unknown place, reported as two, %": "unseen_place_called_two_pct",
        "sums of two touches reported as two, %": "sums_called_two_pct",
    }
    rows = [
        {"detector": name}
        | {title: f"{numbers[key][name]:.0f}" for title, key in columns.items() if key in numbers}
        | ({"area under the ROC curve": f"{numbers['auc'][name]:.3f}"} if "auc" in numbers else {})
        for name in numbers["false_alarm_pct"]
    ]
    table = pd.DataFrame(rows)
    table.attrs["meaning"] = (
        f"Thresholds are set as in experiment `contacts`, so that {numbers['false_alarm_asked_pct']:g} % of single "
        "touches are reported as two. These single touches were recorded after the training rows and before the tested "
        "rows. At an unknown place: the place was left out of training. A detector that also reports single touches at "
        "an unknown place as two touches responds to anything unfamiliar. Its first column is then no evidence that it "
        f"detects two touches. {APART}"
    )
    return table
