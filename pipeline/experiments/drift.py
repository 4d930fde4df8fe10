"""Drift: networks trained on a skin's first contacts and tested on later contacts (paper section 4, figure 5).

The networks receive the change of the field since a no-load reading (a reading without contact). A no-load policy says
when a new no-load reading is taken. Separate networks are trained for each policy.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from math import ceil
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float32, Int64
from pydantic import Field, model_validator

from pipeline import statistics
from pipeline.description import first_rows, rank, rms
from pipeline.experiments.results import read_captures, read_losses, write_results
from pipeline.formatting import COLUMNS, show_difference
from pipeline.plot import COLOURS, drawing, svg
from pipeline.scores import make_table, select, write_scores
from pipeline.settings import SectionWithTraining, Settings, Training
from pipeline.training.jobs import SceneData, collapse_record, make_jobs, preload_training, train_jobs
from reskin.data.rows import Selection, contacts, gather
from reskin.data.splits import NO_POOL, Fold
from reskin.errors import ParamsError
from reskin.metrics import METRICS, score
from reskin.models.recipe import HEADLINE
from reskin.schema import LABELS, Readings

LATE_CONTACTS_N = 45_000  # paper figure 5b: "after 45,000 interactions"
FORCE = 2  # column of the force in a target (x_mm, y_mm, F_N)
POINTS_MAX_N = 2000  # largest number of points in the scatter plot
# Constants of policy `free`: number of latest states with which a reading is compared (usually, five of them are
# contacts and five are not), how many of them must be alike, and the distance of readings that are alike, as a multiple
# of the median distance between the no-load readings of successive indentations. They were chosen on all passes of the
# recording of scene `eflesh`, which can therefore not be used to test them.
STATES_N, ALIKE_MIN_N, ALIKE_FACTOR = 10, 4, 2.0
DECIMALS = 3  # forces in N and places in mm are rounded to this many decimals
ERRORS = ["mse_xy_mm2", "mse_f_N2"]
NETWORK = ["board", "skin", "seed"]  # columns that identify a network of one policy

Count = Annotated[int, Field(ge=1)]
# When a new no-load reading is taken: only at the start, every `regular_n` contacts, before each contact, or whenever a
# reading is judged to be free of contact.
PolicyName = Literal["initial", "regular", "each", "free"]
POLICIES = {
    "initial": "once at the start", "regular": "every {regular_n} indentations", "each": "before every contact",
    "free": "whenever a reading is judged free of contact",
}  # fmt: skip


class Drift(SectionWithTraining):
    """Settings section `drift`: windows of contacts for training and testing, and the no-load policies."""

    unit: Literal["indentation", "pass"]  # unit of train_n, test_n and every_n
    train_n: Count  # the first train_n units are for training
    test_n: Count  # number of units in a test window
    every_n: Count  # a test window begins after every so many units
    policies: Annotated[tuple[PolicyName, ...], Field(min_length=1)]
    regular_n: Count | None = None  # number of indentations between two no-load readings under policy `regular`
    training: Training

    @model_validator(mode="after")
    def _check_windows_and_policies(self) -> "Drift":
        if max(self.train_n, self.test_n) > self.every_n:
            raise ValueError(f"train_n and test_n must be at most every_n ({self.every_n}), so that no windows overlap")
        if ("regular" in self.policies) != (self.regular_n is not None):
            raise ValueError("regular_n is required if policies contains regular, and not allowed otherwise")
        if len(set(self.policies)) < len(self.policies):
            raise ValueError(f"policies contains a policy more than once: {list(self.policies)}")
        return self


class Results(NamedTuple):
    """Results of the experiment.

    scores: one row per network and test window, in the table of scores.
    measured: numbers that are not computed from the scores.
    points: the points of figure 5b.
    trainings: the numbers of trained and of collapsed networks.
    """

    scores: pd.DataFrame
    measured: dict[str, Any]
    points: dict[str, list[float]]
    trainings: dict[str, int]


def drift(settings: Settings, section: Drift, indentations: Path, scores: Path, results: Path) -> None:
    """Train and test networks for every no-load policy, on every capture of the scene, and write the results."""
    preload_training()
    found = run(settings, section, read_captures(indentations, tuple(settings.captures_in(indentations))))
    write_scores(scores, found.scores)
    losses = read_losses(indentations, found.measured["dropped"])
    write_results(results, found.measured, {"late": found.points}, losses, found.trainings)


def run(settings: Settings, section: Drift, captures: Sequence[Readings]) -> Results:
    """Train networks on the first window of each capture under each policy, and test them on its later windows."""
    selection = settings.section(Selection, "selection")
    series = cut(captures, section, selection)
    rows = gather([window.readings for windows in series for window in windows], selection)
    tests_of = {f"{train.readings.skin}-{train.policy}": tests for train, *tests in series}
    folds = [
        Fold("drift", name, train.row, np.concatenate([test.row for test in tests]), NO_POOL)
        for (name, tests), (train, *_) in zip(tests_of.items(), series, strict=True)
    ]
    data = SceneData(settings.scene, settings, rows, folds)
    jobs = make_jobs(data, section.training, folds)
    trained = train_jobs(data, jobs, "drift")
    dropped = {reason: n // len(section.policies) for reason, n in rows.dropped.items()}  # the same for all policies
    late = late_window(series, section)
    measured = measure(captures, series, section, late) | {"dropped": dropped}

    scores, forces = [], []
    for job, result in zip(jobs, trained, strict=True):
        tests = tests_of[job.fold]
        parts = np.split(result.predicted, np.cumsum([len(test.row) for test in tests])[:-1])
        for window_i, (test, predicted) in enumerate(zip(tests, parts, strict=True)):
            true_N, predicted_N = rows.target[test.row, FORCE].astype(float), predicted[:, FORCE].astype(float)
            network: dict[str, Any] = {"method": test.policy, "board": test.readings.board, "skin": test.readings.skin}
            network |= {"recipe": job.recipe_name, "seed": job.seed_i, "contacts_n": test.contacts_n}
            row = {"experiment": "drift", **network, "window_i": window_i, "rows_n": len(test.row)}
            row |= {"noload_off_uT": test.noload_off_uT, **score(rows.target[test.row], predicted)}
            scores.append(row | {"bias_f_N": pd.Series(predicted_N - true_N).mean()})  # NaN if no force is known
            if (test.policy, window_i, job.recipe_name) == (*late, HEADLINE):
                readings = {"indentation": rows.indentation[test.row], "true_N": true_N, "predicted_N": predicted_N}
                forces.append(pd.DataFrame(network | readings))
    by_indentation = pd.concat(forces).dropna().groupby([*NETWORK, "indentation"], sort=False, as_index=False)
    force_means = by_indentation[["true_N", "predicted_N"]].mean()
    if force_means["indentation"].nunique() > 1:
        measured["late"] |= late_bias(force_means)
    else:
        del measured["late"]
    return Results(make_table(scores), measured, points(force_means), statistics.tally(map(collapse_record, trained)))


# --- Windows ---


class Window(NamedTuple):
    """The readings of a range of a capture's contacts, with the no-load field of one policy.

    row: the numbers of the readings in contact among the rows of all windows.
    contacts_n: the number of contacts of the skin before the window.
    noload_off_uT: difference between the no-load field of the policy and the one just before each contact, as an rms
        over readings and channels.
    """

    policy: PolicyName
    readings: Readings
    row: Int64[np.ndarray, " f"]
    contacts_n: int
    noload_off_uT: float


def cut(captures: Sequence[Readings], section: Drift, selection: Selection) -> list[list[Window]]:
    """Cut each capture into windows for each policy: first its training window, then its test windows.

    All captures have the same windows, which are within the shortest capture.
    """
    skins = [capture.skin for capture in captures]
    if twice := [capture.capture for capture in captures if skins.count(capture.skin) > 1]:
        remedy = "Record all contacts of a skin in one capture. If the skins differ, give each skin its own name."
        what = f"several captures are of the same skin, and their order in time is unknown: {', '.join(twice)}"
        raise ParamsError(f"experiment drift: {what}. {remedy}")
    shortest_n = min(len(np.unique(unit(capture, section))) for capture in captures)
    starts = range(section.every_n, shortest_n - section.test_n + 1, section.every_n)
    if not starts:
        rule = f"at least drift.every_n + drift.test_n = {section.every_n + section.test_n} units long"
        remedy = "Record a longer capture, or reduce drift.every_n or drift.test_n in the scene."
        raise ParamsError("experiment drift", "the shortest capture", rule, shortest_n, remedy)
    spans = [(0, section.train_n), *((start, start + section.test_n) for start in starts)]
    series: list[list[Window]] = []
    rows_n = 0
    for capture in captures:
        unit_i = unit(capture, section)
        for policy in section.policies:
            noload_uT = noload_field(policy, section, capture)
            off_uT = noload_uT.astype(float) - capture.noload_uT
            series.append([])
            for start, end in spans:
                inside = (unit_i >= start) & (unit_i < end)
                readings = take(replace(capture, noload_uT=noload_uT), inside)
                row = rows_n + np.arange(contacts(readings, selection).sum())
                series[-1].append(Window(policy, readings, row, int(readings.n_contacts[0]), rms(off_uT[inside])))
                rows_n += len(row)
    return series


def unit(readings: Readings, section: Drift) -> Int64[np.ndarray, " f"]:
    """Number the indentations or passes of a capture in order of time; return the number of each reading."""
    return rank(readings.pass_i if section.unit == "pass" else readings.indentation)


def take(readings: Readings, selected: Bool[np.ndarray, " f"]) -> Readings:
    """Return those readings for which `selected` is True."""
    arrays = [name for name in Readings.__dataclass_fields__ if name not in LABELS]
    return replace(readings, **{name: getattr(readings, name)[selected] for name in arrays})


def noload_field(policy: PolicyName, section: Drift, readings: Readings) -> Float32[np.ndarray, "f ch"]:
    """Return the no-load field in uT that a policy subtracts from each reading."""
    noload_uT, press_i = readings.noload_uT, rank(readings.indentation)
    match policy:
        case "initial":
            return noload_uT[np.zeros_like(press_i)]
        case "regular":
            assert section.regular_n is not None
            return noload_uT[first_rows(readings)[press_i - press_i % section.regular_n]]
        case "each":
            return noload_uT
        case "free":
            early = unit(readings, section) < section.train_n
            return free_field(readings, alike_within_uT(take(readings, early)))


def alike_within_uT(early: Readings) -> float:
    """Return the distance in uT below which two readings are alike, from the first readings of a capture."""
    noload_uT = early.noload_uT[first_rows(early)].astype(float)
    return ALIKE_FACTOR * float(np.median([_distance_uT(a, b) for a, b in pairwise(noload_uT)]))


def free_field(readings: Readings, within_uT: float) -> Float32[np.ndarray, "f ch"]:
    """Return, for each reading, the latest earlier reading that `follow_free` judges to be free of contact."""
    # The readings in the order in which a board sends them: the no-load reading of each indentation is before its rows.
    first = first_rows(readings)
    sent_uT = np.insert(readings.b_uT, first, readings.noload_uT[first], axis=0)
    followed_uT = np.stack(list(follow_free(sent_uT, within_uT)))
    return followed_uT[np.arange(len(readings)) + rank(readings.indentation)]


def follow_free(readings: Iterable[np.ndarray], within_uT: float) -> Iterator[Float32[np.ndarray, " ch"]]:
    """Yield, after each reading, the latest reading that was probably free of contact.

    This is judged from the readings alone: different presses give different readings, but all readings without contact
    are alike, which means that their distance is below `within_uT`. Consecutive readings that are alike, such as those
    of a press that is held, form one state, however long it lasts. A state is free of contact if at least `ALIKE_MIN_N`
    of the latest `STATES_N` states are alike, including the state itself. During a long contact, such as that of a
    sliding finger, the result does not change. The first reading must be free of contact.
    """
    states: deque[np.ndarray] = deque(maxlen=STATES_N)
    free_uT: np.ndarray | None = None
    for reading in readings:
        if states and _distance_uT(states[-1], reading) < within_uT:
            states[-1] = reading
        else:
            states.append(reading)
        alike_n = sum(_distance_uT(state, reading) < within_uT for state in states)
        if free_uT is None or alike_n >= ALIKE_MIN_N:
            free_uT = reading
        yield free_uT


def _distance_uT(a: np.ndarray, b: np.ndarray) -> float:
    """Return the distance of two readings: the root mean square of their difference over the channels."""
    return float(np.sqrt(np.mean((a - b) ** 2)))


def late_window(series: Sequence[Sequence[Window]], section: Drift) -> tuple[PolicyName, int]:
    """Return the policy of figure 5b, and the number of its test window: the first after 45,000 contacts, or the last.

    The paper does not state the policy; we use `regular` if the scene has it, and the first policy otherwise.
    """
    policy = "regular" if "regular" in section.policies else section.policies[0]
    windows = zip(*(tests for _, *tests in series), strict=True)
    contacts_n = [np.mean([test.contacts_n for test in tests]) for tests in windows]
    return policy, next((i for i, n in enumerate(contacts_n) if n >= LATE_CONTACTS_N), len(contacts_n) - 1)


# --- Measured on the captures ---


def measure(
    captures: Sequence[Readings], series: Sequence[Sequence[Window]], section: Drift, late: tuple[PolicyName, int]
) -> dict[str, Any]:
    """Return settings and counts of the experiment, and how much the skin has softened until the late window."""
    measured = section.model_dump(
        mode="json", include={"unit", "train_n", "test_n", "every_n", "regular_n"}, exclude_none=True
    )
    measured |= {"skins_n": len(captures), "seeds_n": section.training.seeds_n}
    policy, late_i = late
    ends = [(train, tests[late_i]) for train, *tests in series if train.policy == policy]
    late_numbers: dict[str, Any] = {
        "policy": policy,
        "window_i": late_i,
        "contacts_n": round(np.mean([window.contacts_n for _, window in ends])),
    }
    left_pct = float(np.mean([force_left_pct(early.readings, window.readings) for early, window in ends]))
    if not np.isnan(left_pct):
        late_numbers["force_left_pct"] = left_pct
    return measured | {"late": late_numbers}


def force_left_pct(early: Readings, late: Readings) -> float:
    """Return the late force as a percentage of the early force, at equal places and depths.

    The percentage is below 100 if the skin has softened. The result is NaN if no place was pressed to the same depth
    both early and late with known forces.
    """
    sides = []
    for readings in (early, late):
        stop = {name: getattr(readings, name).round(DECIMALS) for name in ("x_mm", "y_mm", "depth_mm")}
        known = pd.DataFrame(stop | {"force_N": readings.Fz_N.astype(float)}).dropna()
        sides.append(known.groupby(list(stop))["force_N"].mean())
    early_N, late_N = pd.concat(sides, axis=1, join="inner").sum()
    return float(100 * late_N / early_N) if early_N else float("nan")


# --- Numbers ---


def summarise(scores: pd.DataFrame, measured: Mapping[str, Any]) -> dict[str, Any]:
    """Summarise the scores of the headline recipe by policy and window, and for the paper's statements."""
    scores = select(scores, recipe=HEADLINE)
    windows = {str(policy): window_means(rows) for policy, rows in scores.groupby("method", sort=False)}
    return {**measured, **windows, "claims": claims(scores, measured.get("late"))}


def window_means(scores: pd.DataFrame) -> list[dict[str, Any]]:
    """Average the scores of each window over skins and seeds; key `spread` contains the standard deviations."""
    windows = []
    for _, window in scores.groupby("window_i"):
        known = [name for name in (*METRICS, "bias_f_N") if name in window.dropna(axis=1)]
        means = {name: float(window[name].mean()) for name in (*known, "noload_off_uT")}
        spread = {name: float(window[name].std()) for name in known if len(window) > 1}
        windows.append({"contacts_n": round(window["contacts_n"].mean())} | means | {"spread": spread})
    return windows


def late_bias(forces: pd.DataFrame) -> dict[str, Any]:
    """Return the force bias, which is the mean of predicted minus true force, and the slope between both forces.

    Statistics are over indentations, and are averaged over seeds: more seeds do not make the standard error smaller,
    because all seeds have the same indentations.
    """
    biases = []
    for _, of_seed in forces.groupby("seed"):
        true_N, predicted_N = of_seed["true_N"], of_seed["predicted_N"]
        error_N = predicted_N - true_N
        bias = {"bias_N": error_N.mean(), "bias_pct": 100 * error_N.mean() / true_N.mean()}
        biases.append(bias | {"bias_se_N": error_N.sem(), "slope": true_N.cov(predicted_N) / true_N.var()})
    of_networks = forces.groupby(NETWORK, sort=False)[["true_N", "predicted_N"]].mean()
    return {str(name): float(mean) for name, mean in pd.DataFrame(biases).mean().items()} | {
        "indentations_n": forces["indentation"].nunique(),
        "network_bias_N": (of_networks["predicted_N"] - of_networks["true_N"]).tolist(),
        "network_board": of_networks.index.get_level_values("board").tolist(),
    }


def claims(scores: pd.DataFrame, late: Mapping[str, Any] | None) -> dict[str, Any]:
    """Compute the statistics over boards by which the paper's statements about drift are judged.

    higher, faster: errors with only one no-load reading at the start minus errors with more frequent no-load readings,
        as a mean over windows and as a growth per 10,000 contacts.
    each_is_worse: errors with a no-load reading before each contact minus errors with regular no-load readings.
    lasting: scores in the last window with a no-load reading before each contact.
    overestimates: error of the force in the late window of figure 5b.
    """
    errors = [name for name in ERRORS if name in scores.dropna(axis=1)]
    by_network = scores.assign(contacts_n=scores["contacts_n"] / 10_000).groupby(["method", *NETWORK])
    means = by_network[errors].mean()
    policies, windows_n = set(scores["method"]), scores["window_i"].nunique()
    frequent = [policy for policy in ("regular", "each") if policy in policies]

    def compare(values: Any, policy: str, other: str) -> statistics.Summary:
        return claim(values.loc[policy] - values.loc[other], errors)

    found: dict[str, Any] = {}
    if "initial" in policies and frequent:
        found["higher"] = compare(means, "initial", frequent[0])
        if windows_n > 1:
            growth = by_network[["contacts_n", *errors]].apply(
                lambda network: pd.Series(np.polyfit(network["contacts_n"], network[errors], 1)[0], errors)
            )
            found["faster"] = compare(growth, "initial", frequent[0])
    if len(frequent) == 2:
        found["each_is_worse"] = compare(means, "each", "regular")
    if "each" in policies:
        last = scores[(scores["method"] == "each") & (scores["window_i"] == windows_n - 1)]
        lasting = claim(last, ["accuracy_pct", *errors], differences=False)
        found["lasting"] = {"contacts_n": round(last["contacts_n"].mean())} | lasting
    if late is not None:
        found["overestimates"] = claim(select(scores, method=late["policy"], window_i=late["window_i"]), ["bias_f_N"])
    return found


def claim(networks: pd.DataFrame, metrics: Sequence[str], *, differences: bool = True) -> statistics.Summary:
    """Summarise values of networks over boards, with the standard deviation over seeds."""
    rows = networks.reset_index()[[*NETWORK, *metrics]].groupby(NETWORK, as_index=False).mean()
    summary = statistics.summarise(statistics.board_means(rows), boards=True, differences=differences)
    return statistics.add_seed_sd(summary, rows, "board", "skin")


def points(forces: pd.DataFrame) -> dict[str, list[float]]:
    """Return the forces of at most `POINTS_MAX_N` indentations for figure 5b, as predicted with the first seed."""
    shown = forces[forces["seed"] == forces["seed"].min()]
    every_n = max(1, ceil(len(shown) / POINTS_MAX_N))
    return {name: shown[name][::every_n].round(DECIMALS).tolist() for name in ("true_N", "predicted_N")}


# --- Figures ---


def policies_in(numbers: Mapping[str, Any]) -> dict[str, str]:
    """Return the title of each no-load policy that was tested."""
    return {name: title.format_map(numbers) for name, title in POLICIES.items() if name in numbers}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Plot scores against contacts (figure 5a), and predicted against true forces after many contacts (figure 5b)."""
    texts = {"drift.svg": _draw_scores(numbers, source)}
    return texts | ({"drift_force.svg": _draw_forces(numbers, drawn["late"], source)} if "late" in numbers else {})


def _draw_scores(numbers: Mapping[str, Any], source: str) -> str:
    titles = policies_in(numbers)
    error = "mse_f_N2" if "mse_f_N2" in numbers[next(iter(titles))][0] else "mse_xy_mm2"
    networks_n = numbers["skins_n"] * numbers["seeds_n"]
    with drawing(5.6, f"Networks of the first contacts, tested on later ones ({source})") as figure:
        panels = figure.subplots(2, 1, sharex=True)
        for axes, metric in zip(panels, ("accuracy_pct", error), strict=True):
            for policy, title in titles.items():
                rows = numbers[policy]
                bars = [row["spread"][metric] for row in rows] if networks_n > 1 else None
                look = {"color": COLOURS[list(POLICIES).index(policy)], "label": title}
                axes.errorbar([row["contacts_n"] for row in rows], [row[metric] for row in rows], bars, **look)
            axes.set_ylabel(COLUMNS[metric].replace(", ", " / "))
        panels[0].set_ylim(0, 102)
        panels[1].set(yscale="log", xlabel="contacts of the skin before the test", xlim=(0, None))
        panels[1].xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}k" if value else "0")
        bars_are = f"; bars: standard deviation of {networks_n} networks" if networks_n > 1 else ""
        names = panels[0].get_legend_handles_labels()
        figure.legend(*names, loc="outside lower left", alignment="left", title=f"no-load reading{bars_are}")
        figure.align_ylabels()
        return svg(figure)


def _draw_forces(numbers: Mapping[str, Any], points: Mapping[str, Sequence[float]], source: str) -> str:
    late = numbers["late"]
    with drawing(4.6, f"Force after {late['contacts_n']:,} contacts ({source})") as figure:
        axes = figure.subplots()
        ends_N = min(0.0, *points["true_N"], *points["predicted_N"]), max(*points["true_N"], *points["predicted_N"])
        axes.plot(ends_N, ends_N, color="0.5", marker="", linestyle="--", label="predicted = true")
        axes.scatter(points["true_N"], points["predicted_N"], s=9, color=COLOURS[1], alpha=0.5, linewidths=0)
        axes.set(xlabel="true force / N", ylabel="predicted force / N", aspect="equal")
        bias = {"mean": late["bias_N"], "n": late["indentations_n"], "sd": late["bias_se_N"]}
        text = (
            f"bias {show_difference(bias)} N ({late['bias_pct']:+.2g} %)\n"
            f"slope {late['slope']:.3g}, {late['indentations_n']:,} indentations\n"
            f"no-load reading: {policies_in(numbers)[late['policy']]}\n"
            "±: standard error\n"
            f"means of {len(late['network_bias_N'])} networks\n"
            "points: first seed only"
        )
        axes.text(0.03, 0.97, text, transform=axes.transAxes, va="top", fontsize=8.5)
        axes.legend(loc="lower right")
        return svg(figure)
