"""Drift: networks trained on a skin's first contacts and tested on later contacts (paper section 4, figure 5).

The networks receive the change of the field since a no-load reading (a reading without contact). A no-load policy
states when a new no-load reading is taken. Separate networks are trained for each policy. The paper makes statements
about the policies, and about the force bias after many contacts. This experiment tests each statement statistically,
over boards.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from math import ceil
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float, Int, Int64, Shaped
from pydantic import Field, model_validator
from scipy.constants import micro

from pipeline.experiments.results import read_captures, read_losses, write_results
from pipeline.formatting import COLUMNS, show, show_difference, tabulate
from pipeline.paper import FIGURE_5
from pipeline.plot import COLOURS, MARKERS, drawing, svg
from pipeline.settings import SectionWithTraining, Settings, Training
from pipeline.statistics import (
    SUPPORTED,
    UNDECIDED,
    VERDICTS,
    Stat,
    add_seed_sd,
    board_means,
    combine_verdicts,
    interval,
    statistic,
    summarise,
    tally,
    verdict,
)
from pipeline.training.jobs import SceneData, collapse_record, preload_training, train_jobs
from reskin.data import baseline
from reskin.data.baseline import rank, subtract
from reskin.data.rows import Selection
from reskin.data.windows import TRAIN, Part, Policy, Windows, check_one_per_skin, make_parts, make_windows, stack
from reskin.errors import ParamsError
from reskin.metrics import METRICS, score
from reskin.models.inputs import VIEW
from reskin.models.job import TrainingJob, TrainingResult
from reskin.models.recipe import HEADLINE
from reskin.numerics import device
from reskin.physics.aging import baseline_walk
from reskin.schema import Readings
from reskin.seeds import rng_for

LATE_CONTACTS_N = 45_000  # paper figure 5b: "after 45,000 interactions"
FORCE = 2  # column of the force in a target (x_mm, y_mm, F_N)
POINTS_MAX_N = 2000  # largest number of points in the scatter plot
DECIMALS = 3  # forces in N and places in mm are rounded to this many decimals

Count = Annotated[int, Field(ge=1)]
# The no-load policies. A new no-load reading is taken
# - `initial`: only at the start,
# - `regular`: every `regular_n` contacts,
# - `each`: before each contact,
# - `free`: whenever a reading is judged to be free of contact.
PolicyName = Literal["initial", "regular", "each", "free"]
UNIT_COLUMN = {"indentation": "indentation", "pass": "pass_i"}
# Errors by metric. Rows are networks (one per skin and seed), columns are test windows.
Errors = Mapping[str, Float[np.ndarray, "u w"]]


class Drift(SectionWithTraining):
    """Settings section `drift`: windows of contacts for training and testing, and the no-load policies."""

    unit: Literal["indentation", "pass"]  # unit of train_n, test_n and every_n
    train_n: Count
    test_n: Count
    every_n: Count
    policies: Annotated[tuple[PolicyName, ...], Field(min_length=1)]
    regular_n: Count | None = None  # number of indentations between two no-load readings under policy `regular`
    # The trained networks are also tested on readings with additional drift. This drift is a random walk, which is
    # added to all readings after the training contacts. These are the step sizes of the random walks (standard
    # deviation per contact and channel). For simulated scenes only.
    wander_uT: tuple[Annotated[float, Field(ge=0, le=1000)], ...] = ()
    training: Training

    @model_validator(mode="after")
    def _check_windows_and_policies(self) -> "Drift":
        if self.test_n > self.every_n:
            raise ValueError(f"test_n must be at most every_n ({self.every_n}), so that test windows do not overlap")
        if self.train_n > self.every_n:
            what = "the first test window begins after every_n indentations or passes"
            raise ValueError(f"train_n must be at most every_n ({self.every_n}), because {what}")
        if ("regular" in self.policies) != (self.regular_n is not None):
            raise ValueError("regular_n is required if policies contains regular, and not allowed otherwise")
        if len(set(self.policies)) < len(self.policies):
            raise ValueError(f"policies contains a policy more than once: {list(self.policies)}")
        return self


# --- Stage ---


@dataclass(frozen=True)
class WindowPredictions:
    """Predictions of one network for one test window of one skin."""

    policy: str
    board: str
    skin: str
    seed_i: int
    window_i: int
    contacts_n: int  # number of contacts of the skin before the window
    # rms difference between the no-load field that the policy subtracts and the no-load field just before each contact
    noload_off_uT: float
    indentation: Int[np.ndarray, " f"]
    true: Float[np.ndarray, "f 3"]
    predicted: Float[np.ndarray, "f 3"]


def drift(settings: Settings, section: Drift, indentations: Path, results: Path) -> None:
    """Train and test networks for every no-load policy, on every capture of the scene, and write the results."""
    preload_training()
    selection = settings.section(Selection, "selection")
    captures = read_captures(indentations, tuple(settings.captures_in(indentations)))
    if section.wander_uT and captures[0].source != "simulated":
        raise ParamsError(
            f"{settings.where}: drift.wander_uT is {list(section.wander_uT)}, but a recorded scene already contains "
            "real drift, so simulated drift must not be added. Remove drift.wander_uT."
        )
    windows, parts = cut_windows(captures, section, selection)
    jobs = list(make_jobs(parts, section, settings.seed))
    data = SceneData(settings.scene, settings, stack(parts), [])
    trained = train_jobs(data, [job for job, _ in jobs], "drift")

    predictions: dict[str, list[WindowPredictions]] = {name: [] for name in section.training.recipes}
    for (job, tests), result in zip(jobs, trained, strict=True):
        predictions[job.recipe_name] += split_predictions(job, result, tests)
    numbers: dict[str, Any] = section.model_dump(
        mode="json", include={"unit", "train_n", "test_n", "every_n", "regular_n"}, exclude_none=True
    )
    numbers |= {"skins_n": len(captures), "seeds_n": section.training.seeds_n, "dropped": data.rows.dropped}
    numbers |= pace(captures) | {"left_out_units_n": windows.left_out_units_n}
    if section.wander_uT:
        headline = [
            (job, tests, result)
            for (job, tests), result in zip(jobs, trained, strict=True)
            if job.recipe_name == HEADLINE
        ]
        numbers["wander"] = score_wandering(section, selection, captures, headline, settings.seed)
    headline_numbers, plot_data = summarise_headline(section, predictions.pop(HEADLINE), parts, field_sizes(captures))
    numbers |= headline_numbers
    if predictions:
        recipe_scores = {name: score_windows(of_recipe) for name, of_recipe in predictions.items()}
        numbers["variants"] = {
            name: {policy: window_means(table, policy) for policy in section.policies}
            for name, table in recipe_scores.items()
        }
    losses = read_losses(indentations, numbers["dropped"])
    write_results(results, numbers, plot_data, losses, tally(map(collapse_record, trained)))


def cut_windows(captures: Sequence[Readings], section: Drift, selection: Selection) -> tuple[Windows, list[Part]]:
    """Divide all captures into the same windows of contacts, and collect the input rows of each window.

    The rows depend on the no-load policy, so they are collected once per policy. Each `Part` contains the rows of one
    window of one capture under one policy.
    """
    check_one_per_skin(captures)
    units = [rank(getattr(capture, UNIT_COLUMN[section.unit])) for capture in captures]
    units_n = [1 + int(unit_i.max()) for unit_i in units]
    windows = make_windows(units_n, train_n=section.train_n, test_n=section.test_n, every_n=section.every_n)
    policies: dict[str, Policy] = {policy: partial(noload_field, policy, section) for policy in section.policies}
    parts = make_parts(list(zip(captures, units, strict=True)), policies, windows=windows, selection=selection)
    return windows, parts


def noload_field(policy: PolicyName, section: Drift, readings: Readings) -> np.ndarray:
    """Return the no-load field that a policy subtracts from each reading."""
    fields = readings.noload_uT, readings.indentation
    if policy == "regular":
        assert section.regular_n is not None
        return baseline.regular(*fields, regular_n=section.regular_n)
    if policy == "free":
        trained_on = rank(getattr(readings, UNIT_COLUMN[section.unit])) < section.train_n
        within_uT = baseline.alike_within_uT(*(field[trained_on] for field in fields))
        return baseline.free(readings.b_uT, *fields, within_uT=within_uT)
    return (baseline.initial if policy == "initial" else baseline.each)(*fields)


def make_jobs(parts: Sequence[Part], section: Drift, seed: int) -> Iterator[tuple[TrainingJob, list[Part]]]:
    """Yield one training job per skin, policy, recipe and seed, together with the windows that test its network."""
    starts = [i for i, part in enumerate(parts) if part.window_i == TRAIN]
    for start, end in pairwise([*starts, len(parts)]):
        train, tests = parts[start], list(parts[start + 1 : end])
        fold, test = f"{train.readings.skin}-{train.policy}", np.concatenate([part.row_i for part in tests])
        for name, recipe in section.training.recipes.items():
            for seed_i in range(section.training.seeds_n):
                yield TrainingJob("drift", name, recipe, fold, seed, seed_i, train.row_i, test), tests


def split_predictions(job: TrainingJob, trained: TrainingResult, tests: Sequence[Part]) -> Iterator[WindowPredictions]:
    """Yield the predictions of one network, separately for each of its test windows."""
    ends = np.cumsum([len(part.rows) for part in tests])[:-1]
    for part, predicted in zip(tests, np.split(trained.predicted, ends), strict=True):
        yield WindowPredictions(
            part.policy, part.readings.board, part.readings.skin, job.seed_i, part.window_i,
            int(part.readings.n_contacts[0]), part.noload_off_uT, part.rows.indentation, part.rows.target, predicted,
        )  # fmt: skip


def summarise_headline(
    section: Drift, predictions: Sequence[WindowPredictions], parts: Sequence[Part], field: dict[str, float]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Summarise the networks of the headline recipe (the recipe whose results are compared with the paper's).

    Returns the numbers for the tables, and the points of figure 5b. The paper does not say which no-load policy figure
    5b shows. We use `regular` if the scene has this policy, and the first policy of the scene otherwise.
    """
    scores = score_windows(predictions)
    windows = {policy: window_means(scores, policy) for policy in section.policies}
    policy = "regular" if "regular" in windows else section.policies[0]
    window_i = late_window(windows[policy])
    numbers: dict[str, Any] = windows | {"field": field}
    plot_data: dict[str, Any] = {}
    late = late_force(predictions, policy, window_i)
    if late is not None:
        left_pct = force_left_pct(parts, policy, window_i)
        numbers["late"] = {"policy": policy, "contacts_n": windows[policy][window_i]["contacts_n"]} | late[0]
        numbers["late"] |= {} if left_pct is None else {"force_left_pct": left_pct}
        plot_data = {"late": late[1]}
    errors: dict[str, Errors] = {name: network_errors(scores, name) for name in section.policies}
    boards = scores[scores["policy"] == policy].groupby(["skin", "seed_i"])["board"].first().tolist()
    contacts_n = [row["contacts_n"] for row in windows[policy]]
    numbers["findings"] = judge_findings(errors, boards=boards, contacts_n=contacts_n, late=numbers.get("late"))
    numbers["last_window"] = {name: last_window(scores, name) for name in section.policies}
    return numbers, plot_data


# --- Scores of windows ---


def score_windows(predictions: Sequence[WindowPredictions]) -> pd.DataFrame:
    """Return one row of scores per network and window.

    `bias_f_N` is the mean of predicted minus true force. Metrics of force are missing if no force is known.
    """
    rows = []
    for window in predictions:
        row: dict[str, Any] = {
            "policy": window.policy,
            "board": window.board,
            "skin": window.skin,
            "seed_i": window.seed_i,
        }
        row |= {"window_i": window.window_i, "contacts_n": window.contacts_n, "noload_off_uT": window.noload_off_uT}
        row |= score(window.true, window.predicted)
        error_N = (window.predicted.astype(float) - window.true)[:, FORCE]
        if not np.isnan(error_N).all():
            row["bias_f_N"] = float(np.nanmean(error_N))
        rows.append(row)
    return pd.DataFrame(rows)


def _metrics_in(scores: pd.DataFrame, *names: str) -> list[str]:
    return [name for name in names if name in scores and scores[name].notna().all()]


def window_means(scores: pd.DataFrame, policy: str) -> list[dict[str, Any]]:
    """Return one row per window, which contains the means of the metrics over skins and seeds.

    Key `spread` of a row contains the standard deviations.
    """
    rows = []
    for _, window_scores in scores[scores["policy"] == policy].groupby("window_i"):
        values = {name: window_scores[name].to_numpy() for name in _metrics_in(window_scores, *METRICS, "bias_f_N")}
        row: dict[str, Any] = {"contacts_n": round(float(np.mean(window_scores["contacts_n"].to_numpy())))}
        row |= {name: float(scores_of_metric.mean()) for name, scores_of_metric in values.items()}
        row["noload_off_uT"] = float(np.mean(window_scores["noload_off_uT"].to_numpy()))
        row["spread"] = {
            name: float(scores_of_metric.std(ddof=1))
            for name, scores_of_metric in values.items()
            if len(scores_of_metric) > 1
        }
        rows.append(row)
    return rows


def network_errors(scores: pd.DataFrame, policy: str) -> dict[str, Float[np.ndarray, "u w"]]:
    """Return an array of errors for each metric, with one row per network and one column per window.

    Row i belongs to the same skin and seed under every policy, so that row i of two policies can be compared as a pair.
    """
    policy_scores = scores[scores["policy"] == policy]
    return {
        name: np.ascontiguousarray(policy_scores.pivot_table(name, index=["skin", "seed_i"], columns="window_i"))
        for name in _metrics_in(policy_scores, *METRICS)
    }


def last_window(scores: pd.DataFrame, policy: str) -> dict[str, Any]:
    """Summarise the scores of the last window over boards.

    `sd_seeds` is the standard deviation over the networks of one skin, averaged over skins.
    """
    window_scores = scores[(scores["policy"] == policy) & (scores["window_i"] == scores["window_i"].max())]
    contacts_n = round(float(np.mean(window_scores["contacts_n"].to_numpy())))
    rows = window_scores.drop(columns=["policy", "seed_i", "window_i", "contacts_n", "noload_off_uT"]).dropna(
        axis=1, how="all"
    )
    return {"contacts_n": contacts_n} | add_seed_sd(summarise(board_means(rows), boards=True), rows, "board", "skin")


def late_window(rows: Sequence[Mapping[str, Any]]) -> int:
    """Return the index of the first window after 45,000 contacts (paper figure 5b), or else of the last window."""
    late = [i for i, row in enumerate(rows) if row["contacts_n"] >= LATE_CONTACTS_N]
    return late[0] if late else len(rows) - 1


# --- Force bias of late contacts (figure 5b) ---


@dataclass(frozen=True)
class ContactForces:
    """True and predicted forces of the indentations in one window, averaged over the readings of each indentation.

    Indentations with unknown forces are left out.
    """

    skin: Shaped[np.ndarray, " n"]
    true_N: Float[np.ndarray, " n"]
    predicted_N: Float[np.ndarray, " n"]


def contact_forces(predictions: Sequence[WindowPredictions]) -> ContactForces:
    """Average true and predicted forces over the readings of each indentation.

    The readings of one indentation are not independent. The standard error of the force bias must therefore be computed
    over indentations, each of which has one averaged force. All `predictions` must be for the same window, and each for
    a different skin.
    """
    skin = np.concatenate([np.full(len(window.indentation), window.skin) for window in predictions])
    indentation = np.concatenate([window.indentation for window in predictions])
    true_N, predicted_N = (
        np.concatenate([getattr(window, side)[:, FORCE].astype(float) for window in predictions])
        for side in ("true", "predicted")
    )
    known = ~np.isnan(true_N)
    skins, skin_i = np.unique(skin[known], return_inverse=True)
    pairs, pair_i = np.unique(np.stack([skin_i, indentation[known]], axis=1), axis=0, return_inverse=True)
    n = np.bincount(pair_i.ravel(), minlength=len(pairs))
    means = [np.bincount(pair_i.ravel(), values[known], len(pairs)) / n for values in (true_N, predicted_N)]
    return ContactForces(skins[pairs[:, 0]], *means)


def force_bias(contacts: ContactForces) -> dict[str, Any]:
    """Return the force bias, which is the mean of predicted minus true force, and related numbers.

    `bias_se_N` is the standard error of this mean over contacts. `slope` is the least-squares slope of the predicted
    force against the true force.
    """
    error_N = contacts.predicted_N - contacts.true_N
    deviation_N = contacts.true_N - contacts.true_N.mean()
    return {
        "bias_N": float(error_N.mean()),
        "bias_pct": float(100 * error_N.mean() / contacts.true_N.mean()),
        "bias_se_N": float(error_N.std(ddof=1) / np.sqrt(len(error_N))),
        "slope": float(deviation_N @ contacts.predicted_N / (deviation_N @ deviation_N)),
        "indentations_n": len(error_N),
    }


def late_force(
    predictions: Sequence[WindowPredictions], policy: str, window_i: int
) -> tuple[dict[str, Any], dict[str, list[float]]] | None:
    """Return the force bias of one window under one policy, and the points for figure 5b.

    The bias is returned as a mean over seeds, and also separately for each network. The points are the forces that the
    networks of the first seed predict. Returns None if fewer than two contacts have a known force.
    """
    window = [network for network in predictions if (network.policy, network.window_i) == (policy, window_i)]
    seeds = sorted({network.seed_i for network in window})
    contacts = [contact_forces([network for network in window if network.seed_i == seed_i]) for seed_i in seeds]
    if len(contacts[0].true_N) < 2:
        return None
    biases = [force_bias(contacts_of_seed) for contacts_of_seed in contacts]
    # Standard errors over indentations are averaged over seeds. More seeds do not make them smaller, because all seeds
    # have the same indentations.
    means = {name: float(np.mean([bias[name] for bias in biases])) for name in biases[0]}
    means["indentations_n"] = biases[0]["indentations_n"]
    network_bias_N = [force_bias(contact_forces([network]))["bias_N"] for network in window]
    boards = [network.board for network in window]
    return means | {"network_bias_N": network_bias_N, "network_board": boards}, points(contacts[0])


def points(contacts: ContactForces) -> dict[str, list[float]]:
    """Return the true and predicted forces of at most `POINTS_MAX_N` contacts for the figure, rounded to 1 mN."""
    every_n = ceil(len(contacts.true_N) / POINTS_MAX_N)
    sides = {"true_N": contacts.true_N, "predicted_N": contacts.predicted_N}
    return {name: np.round(values[::every_n], DECIMALS).tolist() for name, values in sides.items()}


def force_left_pct(parts: Sequence[Part], policy: str, window_i: int) -> float | None:
    """Return what percentage of the early force remains in window `window_i`, as the mean of `force_left` over skins.

    The early force is the force in the training window. Returns None if `force_left` is unknown for any skin.
    """
    windows = {(part.readings.skin, part.window_i): part.readings for part in parts if part.policy == policy}
    ratios_pct = [force_left(windows[skin, TRAIN], late) for (skin, i), late in windows.items() if i == window_i]
    return None if None in ratios_pct else float(np.mean([value for value in ratios_pct if value is not None]))


def force_left(early: Readings, late: Readings) -> float | None:
    """Return the late force as a percentage of the early force, at equal places and depths.

    The percentage is below 100 if the skin has softened. Returns None if no place was pressed to the same depth both
    early and late with known forces.
    """
    sides = []
    for readings in (early, late):
        stop = np.stack([readings.x_mm, readings.y_mm, readings.depth_mm], axis=1).round(DECIMALS)
        known = ~np.isnan(stop).any(axis=1) & ~np.isnan(readings.Fz_N)
        sides.append((stop[known], readings.Fz_N[known].astype(float)))
    stops, where = np.unique(np.concatenate([stop for stop, _ in sides]), axis=0, return_inverse=True)
    stop_i = np.split(where.ravel(), [len(sides[0][0])])
    n = [np.bincount(side_i, minlength=len(stops)) for side_i in stop_i]
    both = (n[0] > 0) & (n[1] > 0)
    if not both.any():
        return None
    sums_N = [np.bincount(side_i, force_N, len(stops)) for side_i, (_, force_N) in zip(stop_i, sides, strict=True)]
    early_N, late_N = (total_N[both] / side_n[both] for total_N, side_n in zip(sums_N, n, strict=True))
    return float(100 * late_N.sum() / early_N.sum())


# --- Sizes of fields, and time ---


def field_sizes(captures: Sequence[Readings]) -> dict[str, float]:
    """Return the size of the field change by a contact, and the noise of a no-load reading.

    Both sizes are rms values over channels. The field change is always relative to the no-load reading just before the
    contact, whatever the no-load policies of the scene. The noise is estimated from the differences between successive
    no-load readings, because little drift occurs from one to the next.
    """
    changes_uT = [subtract(capture.b_uT, capture.noload_uT)[~np.isnan(capture.x_mm)] for capture in captures]
    steps_uT = [np.diff(capture.noload_uT[_first_rows(capture)].astype(float), axis=0) for capture in captures]
    pairs_n = sum(len(differences_uT) for differences_uT in steps_uT)
    noise_uT = rms(np.concatenate(steps_uT)) / float(np.sqrt(2)) if pairs_n else 0.0
    return {"contact_uT": rms(np.concatenate(changes_uT)), "noload_noise_uT": noise_uT}


def pace(captures: Sequence[Readings]) -> dict[str, float]:
    """Return the median time from one indentation to the next, and the duration of the longest capture, in seconds.

    Captures without times are ignored. Returns an empty dict if no other capture has more than one indentation.
    """
    timed = [capture for capture in captures if np.isfinite(capture.t_s).all()]
    steps_s = [step_s for capture in timed for step_s in np.diff(capture.t_s[_first_rows(capture)])]
    if not steps_s:
        return {}
    return {
        "contact_every_s": float(np.median(steps_s)),
        "lasts_s": max(float(capture.t_s[-1] - capture.t_s[0]) for capture in timed),
    }


def describe_pace(numbers: Mapping[str, Any], source: str) -> str:
    """Return sentences about the times of the contacts; `numbers` contains the values that `pace` returned.

    If the captures are simulated (`source`), a sentence explains why changes of temperature are spread over many
    contacts.
    """
    if "lasts_s" not in numbers:
        return "The times of the contacts are not known."
    every = f"The median time from one contact to the next is {numbers['contact_every_s']:.3g} s"
    text = f"{every}, and the longest capture lasts {numbers['lasts_s']:,.0f} s."
    if source != "simulated":
        return text
    return (
        f"{text} A real rig takes several seconds per contact. The simulated contacts follow one another much faster, "
        "so many more contacts take place while the temperature changes by a given amount."
    )


def _first_rows(readings: Readings) -> Int64[np.ndarray, " n"]:
    return np.unique(rank(readings.indentation), return_index=True)[1]


def rms(values: Float[np.ndarray, "..."]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values.astype(float) ** 2)))


# --- Additional drift of the field at rest ---


def score_wandering(
    section: Drift,
    selection: Selection,
    captures: Sequence[Readings],
    networks: Sequence[tuple[TrainingJob, list[Part], TrainingResult]],
    seed: int,
) -> dict[str, list[dict[str, Any]]]:
    """Test each network again on its last test window, after a random walk has been added to the readings.

    For each policy, returns a list with one row per step size of the walk. A row contains the mean scores over skins
    and seeds. Key `spread` of a row contains the standard deviations.
    """
    from reskin.models.network import Predictor  # imported here because it imports torch, which takes seconds

    trained_on = rank(getattr(captures[0], UNIT_COLUMN[section.unit])) < section.train_n
    after_n = 1 + int(rank(captures[0].indentation)[trained_on].max())
    rows: dict[str, list[dict[str, Any]]] = {}
    for step_uT in section.wander_uT:
        walked = [add_walk(capture, step_uT, after_n=after_n, seed=seed) for capture in captures]
        parts = {part.first_row_i: part for part in cut_windows(walked, section, selection)[1]}
        scores: dict[str, list[dict[str, float]]] = {}
        off_uT: dict[str, list[float]] = {}
        for job, tests, trained in networks:
            part = parts[tests[-1].first_row_i]
            predict = Predictor(trained.weights, job.recipe.architecture, device())
            inputs = trained.scaler.encode(VIEW[job.recipe.inputs](part.rows.db_uT))
            scores.setdefault(part.policy, []).append(score(part.rows.target, trained.scaler.decode(predict(inputs))))
            off_uT.setdefault(part.policy, []).append(part.noload_off_uT)
        for policy, network_scores in scores.items():
            stats = summarise(pd.DataFrame(network_scores)[[name for name in METRICS if name in network_scores[0]]])
            row: dict[str, Any] = {
                "step_uT": step_uT,
                "noload_off_uT": float(np.mean(off_uT[policy])),
                "n": len(network_scores),
            }
            row |= {name: stat["mean"] for name, stat in stats.items()}
            row["spread"] = {name: stat["sd"] for name, stat in stats.items() if "sd" in stat}
            rows.setdefault(policy, []).append(row)
    return rows


def add_walk(readings: Readings, step_uT: float, *, after_n: int, seed: int) -> Readings:
    """Add a random walk to all readings (in contact and without contact) after the first `after_n` contacts.

    The steps of the walk have a standard deviation of `step_uT` per contact and channel.
    """
    since_n = np.maximum(rank(readings.indentation) + 1 - after_n, 0)
    # The random stream does not depend on step_uT, so walks of different step sizes differ only by a factor.
    rng = rng_for(seed, "drift", "wander", readings.skin)
    walk_T = baseline_walk(since_n, readings.b_uT.shape[1], step_T=step_uT * micro, rng=rng)
    walk_uT = (walk_T / micro).astype(np.float32)
    return replace(readings, b_uT=readings.b_uT + walk_uT, noload_uT=readings.noload_uT + walk_uT)


# --- The paper's findings ---

HIGHER_AND_FASTER = (
    '"prediction errors are higher and increase faster when we only make a single no-load measurement at the start"'
)
OFFSET = 'drift "can be offset to a certain extent by more frequent no-load measurements"'
EACH_IS_WORSE = '"errors are also higher when no-load measurements are updated before every contact"'
OVERESTIMATES = (
    '"the model, on average, overestimates the applied force"; "attributed to the softening of the elastomer"'
)
# The 95 % interval of the force bias over a window's indentations extends by this many standard errors to each side.
INDENTATION_SES = 2.0
ERRORS = {"mse_xy_mm2": ("MSE_xy", "mm²"), "mse_f_N2": ("MSE_F", "N²")}  # MSE_F is absent if forces are unknown
PER_CONTACTS_N = 10_000


class Comparison(NamedTuple):
    """A comparison of one quantity with the paper's statement about it.

    The compared values are differences that are positive if the paper's statement is right.

    - text: the compared values in words and numbers, for the table.
    - over_boards: statistics of the differences over boards.
    - over_trainings: 95 % interval over training runs, or None if there is only one network.
    """

    text: str
    over_boards: Stat
    over_trainings: list[float] | None


def compare_networks(
    quantity: str, unit: str, values: Mapping[str, Float[np.ndarray, " u"]], boards: Sequence[str]
) -> Comparison:
    """Compare a quantity between the networks of two policies.

    The networks are compared in pairs that have the same skin and seed. `values` maps each of the two policies to one
    value per network. `boards` contains the board of each pair.
    """
    (policy, first), (other_policy, second) = values.items()
    over_boards, over_trainings = mean_over_boards(first - second, boards)
    text = (
        f"{quantity}: {policy} {first.mean():.3g}, {other_policy} {second.mean():.3g}, "
        f"difference {over_boards['mean']:+.2g}{_show_ends(over_boards, over_trainings)} {unit}"
    )
    return Comparison(text, over_boards, over_trainings)


def _show_ends(over_boards: Stat, over_trainings: list[float] | None) -> str:
    ends = over_boards.get("ci95", over_trainings)
    return "" if ends is None else f" [{ends[0]:+.2g}, {ends[1]:+.2g}]"


def mean_over_boards(
    values: Float[np.ndarray, " u"], boards: Sequence[str]
) -> tuple[dict[str, Any], list[float] | None]:
    """Average the values of each board's networks; return statistics of these averages over boards.

    The second result is the 95 % interval of the mean over networks. It is computed as if all networks were
    independent, although networks of the same board are not.
    """
    by_board = pd.Series(values, dtype=float).groupby(list(boards)).mean()
    return statistic(by_board, boards=True), interval(values.astype(float))


def judge_findings(
    networks: Mapping[str, Errors], *, boards: Sequence[str], contacts_n: Sequence[int], late: Mapping[str, Any] | None
) -> list[dict[str, Any]]:
    """Test each finding of the paper for which the scene has the required policies and quantities.

    Parameters
    ----------
    networks
        Errors of the networks, by policy. Under every policy, row i is a network with the same skin and seed.
    boards
        Board of the networks in row i.
    contacts_n
        Number of contacts of a skin before each window.
    late
        Numbers that `late_force` returns, or None if it returned None.
    """
    frequent = [policy for policy in ("regular", "each") if policy in networks]
    findings = []

    def compare(quantity: str, policy: str, other: str, value: Callable[[np.ndarray], np.ndarray]) -> list[Comparison]:
        return [
            compare_networks(
                f"{title}, {quantity}",
                unit,
                {name: value(networks[name][metric]) for name in (policy, other)},
                boards,
            )
            for metric, (title, unit) in ERRORS.items()
            if metric in networks[policy]
        ]

    def mean(errors: np.ndarray) -> np.ndarray:
        return errors.mean(axis=1)

    if "initial" in networks and frequent:
        means = compare("mean over windows", "initial", frequent[0], mean)
        if len(contacts_n) > 1:
            title = f"growth in {PER_CONTACTS_N:,} contacts"
            growths = compare(title, "initial", frequent[0], partial(growth, contacts_n))
            findings.append(judge_finding("higher_and_faster", HIGHER_AND_FASTER, means + growths))
        findings.append(judge_finding("offset", OFFSET, means))
    if len(frequent) == 2:
        worse = compare("mean over windows", "each", "regular", mean)
        findings.append(judge_finding("each_is_worse", EACH_IS_WORSE, worse))
    if late is not None:
        findings.append(judge_finding("overestimates", OVERESTIMATES, [late_bias(late)]))
    return findings


def growth(contacts_n: Sequence[int], errors: Float[np.ndarray, "u w"]) -> Float[np.ndarray, " u"]:
    """Return how fast the errors of each network grow: the slope of a fitted straight line, per 10,000 contacts."""
    contacts = np.array(contacts_n, float) / PER_CONTACTS_N
    deviation = contacts - contacts.mean()
    return errors @ deviation / (deviation @ deviation)


def late_bias(late: Mapping[str, Any]) -> Comparison:
    """Compare the force bias after many contacts with 0.

    The interval over training runs is made wider if the bias is more uncertain because of the finite number of
    indentations: it extends by at least two standard errors over indentations to each side of the bias. The interval is
    None if there is only one network.
    """
    over_boards, ends_N = mean_over_boards(np.array(late["network_bias_N"]), late["network_board"])
    reach_N = INDENTATION_SES * late["bias_se_N"]
    if ends_N is not None:
        ends_N = [min(ends_N[0], late["bias_N"] - reach_N), max(ends_N[1], late["bias_N"] + reach_N)]
    bias = f"{over_boards['mean']:+.2g}{_show_ends(over_boards, ends_N)} N ({late['bias_pct']:+.2g} %)"
    return Comparison(f"bias of force: {bias}, slope {late['slope']:.3g}", over_boards, ends_N)


def judge_finding(name: str, finding: str, comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """Judge a finding from all comparisons that belong to it; return the row for the table of findings.

    `verdict` combines the verdicts over boards, and `of_trainings` combines the verdicts over training runs.
    """
    judged = combine_verdicts([verdict(comparison.over_boards) for comparison in comparisons])
    trainings = [comparison.over_trainings for comparison in comparisons]
    of_trainings = combine_verdicts([UNDECIDED if ends is None else verdict({"ci95": ends}) for ends in trainings])
    return {
        "id": name,
        "finding": finding,
        "holds": judged == SUPPORTED,
        "verdict": judged,
        "of_trainings": of_trainings,
        "measured": "; ".join(comparison.text for comparison in comparisons),
    }


# --- Tables ---

POLICIES = ("initial", "regular", "each", "free")
WANDER_MEANING = (
    "The networks of figure 5a are tested again on their last test window, after a random walk was added to the "
    "captures as additional drift. At each contact after the training contacts, every channel of the walk changes by a "
    "normally distributed step. The walk is added to contact readings and to no-load readings. The row with a walk of "
    "0 µT repeats the scores of the last window of figure 5a. For comparison, the table of skins states the drift that "
    "the captures have without an added walk: the rms change of the field at rest over 1 to 1,000 contacts."
)
FINDINGS_MEANING = (
    f"{VERDICTS} A finding with several parts is contradicted if one part is contradicted, and supported if all parts "
    "are supported. Column `over these training runs`: the same verdicts, but computed from the 95 % interval over "
    "pairs of networks. The two networks of a pair were trained with different no-load policies, from the same seed "
    "and on the same skin. The interval of the force bias extends by at least two standard errors over indentations to "
    "each side. Several training runs on one skin show how much training runs vary, not how much boards vary. Column "
    "`measured`: the compared values, with the no-load policy of each. Brackets are the 95 % interval over boards or, "
    "if there are too few boards, over training runs."
)


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate scores against contacts, the paper's findings, and scores with an added random walk."""
    policies, error, spread = _policies(numbers), _error(numbers), _spread(numbers)
    lines = []
    for i, first in enumerate(next(iter(policies.values()))[1]):
        line = {"contacts": f"{first['contacts_n']:,}", "source": source}
        for title, rows in policies.values():
            line |= {f"{COLUMNS[metric]} ({title})": show(_stat(rows[i], metric)) for metric in ("accuracy_pct", error)}
        lines.append(line)
    meaning = f"{_protocol(numbers)} {describe_pace(numbers, source)} {FIGURE_5}"
    findings = [
        {
            "finding (paper)": finding["finding"],
            "holds": finding["verdict"],
            "over these training runs": finding["of_trainings"],
            "measured": finding["measured"],
            "source": source,
        }
        for finding in numbers["findings"]
    ]
    result = {
        "drift": tabulate(lines, meaning=meaning, spread=spread),
        "drift_findings": tabulate(findings, meaning=f"{FINDINGS_MEANING} {_possible_reasons(numbers)}"),
    }
    if "wander" in numbers:
        walked = []
        for i, first in enumerate(next(iter(numbers["wander"].values()))):
            line = {"added walk, µT per contact": f"{first['step_uT']:g}", "source": source}
            for policy, (title, _) in policies.items():
                row = numbers["wander"][policy][i]
                line[f"error of the no-load reading, µT ({title})"] = f"{row['noload_off_uT']:.3g}"
                line |= {f"{COLUMNS[name]} ({title})": show(_stat(row, name)) for name in ("accuracy_pct", error)}
            walked.append(line)
        result["drift_wander"] = tabulate(walked, meaning=WANDER_MEANING, spread=spread)
    return result


def _possible_reasons(numbers: Mapping[str, Any]) -> str:
    """Describe two possible reasons for the errors: an outdated no-load reading, and softening of the skin."""
    field, late = numbers["field"], numbers.get("late", {})
    offsets = ", ".join(
        f"{numbers[policy][-1]['noload_off_uT']:.2g} µT ({title})" for policy, (title, _) in _policies(numbers).items()
    )
    text = (
        f"A contact changes the field by {field['contact_uT']:.3g} µT (rms over channels). The noise of a no-load "
        f"reading is {field['noload_noise_uT']:.2g} µT. A no-load reading may be outdated. In the last window, the rms "
        f"difference between the subtracted no-load reading and one just before the contact is, by policy: {offsets}."
    )
    if "force_left_pct" in late:
        left_pct = late["force_left_pct"]
        text += (
            f" After {late['contacts_n']:,} contacts, the force at the same places and depths is {left_pct:.4g} % of "
            "the force in the training window, because the skin has softened. Networks that were trained before the "
            "softening still estimate the early force, so the softening explains a force bias of "
            f"{100 - left_pct:+.2g} %."
        )
    return text


def _policies(numbers: Mapping[str, Any]) -> dict[str, tuple[str, Sequence[Mapping[str, Any]]]]:
    """Return the title and the rows (one per window) of each policy that was tested."""
    titles = {
        "initial": "once at the start",
        "regular": f"every {numbers.get('regular_n')} indentations",
        "each": "before every contact",
        "free": "whenever a reading is judged free of contact",
    }
    return {policy: (titles[policy], numbers[policy]) for policy in POLICIES if policy in numbers}


def _error(numbers: Mapping[str, Any]) -> str:
    """Return the name of the error that is shown beside the accuracy.

    This is the error of the force or, if no force is known, the error of the place.
    """
    [(_, rows), *_] = _policies(numbers).values()
    return "mse_f_N2" if "mse_f_N2" in rows[0] else "mse_xy_mm2"


def _stat(row: Mapping[str, Any], metric: str) -> dict[str, float]:
    return {"mean": row[metric]} | ({"sd": row["spread"][metric]} if metric in row["spread"] else {})


def _spread(numbers: Mapping[str, Any]) -> str:
    """Return a sentence that says what ± means in the tables."""
    [(_, rows), *_] = _policies(numbers).values()
    seeds_n, skins_n = numbers["seeds_n"], numbers["skins_n"]
    if not rows[0]["spread"]:
        return "Each value is of one network."
    if skins_n == 1:
        return f"± is the standard deviation over {seeds_n} network seeds, all tested on the same contacts."
    return f"± is the standard deviation over {skins_n} skins with {seeds_n} network seeds each."


def _protocol(numbers: Mapping[str, Any]) -> str:
    several = {"indentation": "indentations", "pass": "passes"}[numbers["unit"]]
    train, test, every, left_out = (
        f"{numbers[name]:,} {numbers['unit'] if numbers[name] == 1 else several}"
        for name in ("train_n", "test_n", "every_n", "left_out_units_n")
    )
    text = (
        f"Networks are trained on the first {train} of each skin, and tested on {test} after every {every}. Separate "
        "networks are trained for each no-load policy, which states when a new no-load reading is taken. Column "
        "`contacts`: number of contacts of the skin before the test."
    )
    return text + (
        f" The last {left_out} are not used, because they do not fill a test window."
        if numbers["left_out_units_n"]
        else ""
    )


# --- Figures ---

MARGIN = 0.05  # margin of the axes of figure 5b, as a fraction of the range of forces


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Plot scores against contacts (figure 5a), scores against the added random walk, and late forces (figure 5b)."""
    windows = {policy: rows for policy, (_, rows) in _policies(numbers).items()}
    title = f"Networks trained on the first contacts, tested on later contacts ({source})"
    texts = {"drift.svg": _draw_scores(numbers, windows, "contacts_n", title)}
    if "wander" in numbers:
        last_n = next(iter(windows.values()))[-1]["contacts_n"]
        title = f"After {last_n:,} contacts, with an added random walk of the field at rest ({source})"
        texts["drift_wander.svg"] = _draw_scores(numbers, numbers["wander"], "step_uT", title)
    if "late" in numbers:
        texts["drift_force.svg"] = _draw_forces(
            numbers["late"], drawn["late"], _policies(numbers)[numbers["late"]["policy"]][0], source
        )
    return texts


def _draw_scores(
    numbers: Mapping[str, Any], lines: Mapping[str, Sequence[Mapping[str, Any]]], x: str, title: str
) -> str:
    """Plot accuracy and one error against column `x` (`contacts_n` or `step_uT`), with one line per policy."""
    policies, spread = _policies(numbers), _spread(numbers)
    with drawing(7.6, 4.0) as figure:
        for axes, metric in zip(figure.subplots(1, 2), ("accuracy_pct", _error(numbers)), strict=True):
            for policy, (name, _) in policies.items():
                i, rows = POLICIES.index(policy), lines[policy]
                bars = [row["spread"].get(metric, 0.0) for row in rows] if rows[0]["spread"] else None
                style = {"color": COLOURS[i], "marker": MARKERS[i], "markersize": 5, "linewidth": 1.2, "capsize": 2}
                axes.errorbar([row[x] for row in rows], [row[metric] for row in rows], bars, label=name, **style)
            axes.set_ylabel(COLUMNS[metric].replace(", ", " / "))
            if x == "contacts_n":
                axes.set_xlabel("contacts of the skin before the test")
                axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}k" if value else "0")
            else:
                steps_uT = [row[x] for row in next(iter(lines.values())) if row[x] > 0]
                axes.set_xscale("symlog", linthresh=min(steps_uT, default=1.0))
                axes.set_xlabel("added random walk / µT per contact")
            axes.set_xlim(left=0)
            axes.grid(alpha=0.25)
        axes.set_yscale("log")
        figure.axes[0].set_ylim(0, 102)
        bars_are = f"; {spread.removesuffix('.').replace('± is', 'bars:')}" if "±" in spread else ""
        names = figure.axes[0].get_legend_handles_labels()
        figure.legend(*names, loc="outside lower center", ncols=3, frameon=False, title=f"no-load reading{bars_are}")
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        return svg(figure)


def _draw_forces(late: Mapping[str, Any], points: Mapping[str, Sequence[float]], name: str, source: str) -> str:
    with drawing(5.2, 5.0) as figure:
        axes = figure.subplots()
        ends = min(0.0, *points["true_N"], *points["predicted_N"]), max(*points["true_N"], *points["predicted_N"])
        room = MARGIN * (ends[1] - ends[0])
        limits = (ends[0] - room, ends[1] + room)
        axes.plot(limits, limits, color="0.5", linewidth=1, linestyle="--", label="predicted = true")
        axes.scatter(points["true_N"], points["predicted_N"], s=9, color=COLOURS[1], alpha=0.5, linewidths=0)
        axes.set(xlabel="true force / N", ylabel="predicted force / N", xlim=limits, ylim=limits, aspect="equal")
        bias = {"mean": late["bias_N"], "n": late["indentations_n"], "sd": late["bias_se_N"]}
        text = (
            f"bias {show_difference(bias)} N ({late['bias_pct']:+.2g} %)\n"
            f"slope {late['slope']:.3g}, {late['indentations_n']:,} indentations\n"
            f"no-load reading: {name}\n"
            "±: standard error\n"
            f"means of {len(late['network_bias_N'])} networks\n"
            "points: first seed only"
        )
        axes.text(0.03, 0.97, text, transform=axes.transAxes, va="top", fontsize=10)
        axes.legend(loc="lower right", frameon=False)
        axes.grid(alpha=0.25)
        figure.suptitle(f"Force after {late['contacts_n']:,} contacts ({source})", x=0.01, ha="left", fontsize=11)
        return svg(figure)
