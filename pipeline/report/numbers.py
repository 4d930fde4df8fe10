"""`numbers.json`: every number that any text shows, nested by experiment."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from pipeline.report.formatting import control_of
from pipeline.report.paper import PLATEAU_POKES_N
from pipeline.scenes import EXPERIMENTS, TABLE_2
from pipeline.statistics import (
    AS_LABELLED,
    METHODS,
    REGISTERED,
    by_skin,
    differences,
    over_boards,
    over_folds,
    over_pairs,
    paired,
    paired_with_single,
    records,
    select,
    statistic,
    summarise,
    summarise_differences,
    tally,
    tidy,
    whole,
)
from reskin.metrics import METRICS

Points = Mapping[str, Sequence[dict[str, Any]]]
Seconds = Sequence[Mapping[str, Any]]
CONTROL = "control"  # the recipe of adaptation that fine-tunes as long, without the new skin's pokes
PAIRS = (
    ("multi", "single"), ("triplet", "multi"), ("adapted", "triplet"), ("adapted", CONTROL), (CONTROL, "triplet"),
    ("adapted", "multi"),
)  # fmt: skip
PAPERS_SPLITS = ("single_random", "single_temporal")  # the first of these stands beside the paper's numbers
HONEST = {"by_indentation": "single_indentation", "by_pass": "single_pass"}  # the same skin, more of it held out
SWEPT = ("multi", "triplet", "adapted")
TRAINED_IN = {"lobo": "train_multi", "triplet": "train_triplet", "adapt": "adapt"}
NETWORKS = {METHODS.get(experiment, "network"): experiment for experiment in TRAINED_IN}  # by method
OWN_POKES = "its own"  # of experiment reference_methods: the unlabelled pokes that a method is given
AXES = {"pokes": ("sweep_pokes", "pokes_n"), "sensors": ("sweep_sensors", "skins_n"), "labels": ("labels", "labels_n")}


def learned(table: pd.DataFrame, *, headline: str) -> dict[str, Any]:
    """Compose what the scores say; `headline` names the recipe that stands beside the paper's numbers."""
    recipes = {row: (experiment, headline) for row, experiment in TABLE_2.items()} | {CONTROL: ("adapt", CONTROL)}
    models = {row: select(table, question=experiment, recipe=recipe) for row, (experiment, recipe) in recipes.items()}
    models = {row: group for row, group in models.items() if len(group)}
    table2 = {row: over_pairs(group) if row == "single" else over_boards(group) for row, group in models.items()}
    control = table2.pop(CONTROL, None)
    numbers: dict[str, Any] = {
        "table2": table2,
        "lobo": _lobo(models["multi"]) if "multi" in models else {},
        "adapt": _adapt(models["adapted"], control) if "adapted" in models else {},
        "constant_force": _constants(table, models),
        "paired": [
            {"of": of, "over": over}
            | (paired_with_single if over == "single" else paired)(by_skin(models[of]), by_skin(models[over]))
            for of, over in PAIRS
            if of in models and over in models
        ],
        **_single(table, headline),
    }
    numbers = {name: value for name, value in numbers.items() if value}
    return numbers | _curves(table) | {"variants": _variants(table)}


def _constants(table: pd.DataFrame, models: Mapping[str, pd.DataFrame]) -> dict[str, Any]:
    tested = {"table2": models.get("multi", table[:0]), "labels": select(table, question="labels")}
    found = {name: _constant_force(rows) for name, rows in tested.items()}
    return {name: row for name, row in found.items() if row}


def _adapt(adapted: pd.DataFrame, control: Mapping[str, Any] | None) -> dict[str, Any]:
    """Say how many indentations networks were adapted with, and what as much training without them gives."""
    return {"pokes_n": int(adapted["pokes_n"].iloc[0])} | ({"control": control} if control else {})


def curves_of(points: Points) -> dict[str, list[tuple[str, int, dict[str, float]]]]:
    """Give the points of sweeps as curves: by experiment, the method, the step on its axis, the mean of each score."""
    numbers = _curves(tidy([], points))
    return {
        experiment: [(_curve_name(row), row[axis], _score_means(row)) for row in numbers[key]]
        for experiment, (key, axis) in AXES.items()
        if key in numbers
    }


def timed_learning(numbers: Mapping[str, Any], seconds: Mapping[str, Seconds]) -> dict[str, Any]:
    """Put what was timed here, by stage and name of a training, beside the errors; what was not has no time."""
    joined: dict[str, Any] = {}
    if "baselines" in numbers:
        joined["learning"] = [row | _times(row, seconds) for row in numbers["baselines"]]
    if "sweep_pokes" in numbers:
        took = seconds.get("sweep_pokes", [])
        joined["adaptation"] = []
        for row in numbers["sweep_pokes"]:
            times_s = [training["train_s"] for training in took if f".{row['pokes_n']}pokes." in training["name"]]
            joined["adaptation"].append(row | ({"seconds": float(np.median(times_s))} if times_s else {}))
    if "rivals" in numbers:
        took = seconds.get("reference_methods", [])
        joined["rivals_costs"] = [
            {"method": row["method"]} | row[AS_LABELLED] | _median_times(took, f"{row['method']}.")
            for row in _told(numbers["rivals"])
        ]
    return joined


def _told(rivals: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Take of each method the row with the skin's own pokes."""
    return [row for row in rivals["methods"] if row["pokes"] == OWN_POKES]


def _lobo(rows: pd.DataFrame) -> dict[str, Any]:
    by_board = {
        str(board): {
            "trained_on_skins_n": int(group["trained_on_skins_n"].iloc[0]),
            **{
                places: whole(group, places)[list(METRICS)].mean().dropna().to_dict()
                for places in (AS_LABELLED, REGISTERED)
            },
        }
        for board, group in _parts(rows, "fold", sort=False)
    }
    return {REGISTERED: over_boards(rows, REGISTERED), "by_board": by_board}


def _single(table: pd.DataFrame, headline: str) -> dict[str, Any]:
    """Summarise one skin by how it was split; `single_sensor` is what stands beside the paper's numbers."""
    experiments = (*PAPERS_SPLITS, *HONEST.values())
    numbers = {
        experiment: over_folds(select(table, question=experiment, recipe=headline)) for experiment in experiments
    }
    numbers = {experiment: group for experiment, group in numbers.items() if group}
    papers = next(
        ({"split": experiment} | numbers[experiment] for experiment in PAPERS_SPLITS if experiment in numbers), {}
    )
    honest = {name: numbers[experiment] for name, experiment in HONEST.items() if experiment in numbers}
    by_skin = whole(select(table, question="single_temporal", recipe=headline)).groupby("fold")[list(METRICS)].mean()
    skins = {"single_skins": records(by_skin)} if len(by_skin) > 1 else {}
    return numbers | {"single_sensor": papers | honest} | skins


def _variants(table: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Summarise every recipe of every experiment that leaves models; repeats on one skin are no boards."""
    numbers: dict[str, dict[str, Any]] = {}
    models = table[table["question"].isin([one.name for one in EXPERIMENTS.values() if one.kind == "models"])]
    for (experiment, recipe), group in _parts(models, ["question", "recipe"], sort=False):
        summarise = (
            over_pairs if experiment == "transfer" else over_folds if experiment.startswith("single_") else over_boards
        )
        numbers.setdefault(experiment, {})[recipe] = summarise(group)
    return numbers


def _curves(table: pd.DataFrame) -> dict[str, Any]:
    pokes, sensors, classical, labels = (
        select(table, question=name) for name in ("pokes", "sensors", "baselines", "labels")
    )
    labels = pd.concat([labels, select(table, question="universal")])
    numbers: dict[str, Any] = {}
    if len(pokes):
        numbers["sweep_pokes"] = [{"pokes_n": int(n), **over_boards(group)} for n, group in _parts(pokes, "pokes_n")]
        numbers["contrasts"] = contrasts_of_pokes(pokes)
    if len(sensors):
        numbers["sweep_sensors"] = [
            {"method": method, "skins_n": int(n), **over_boards(group)}
            for method in SWEPT
            for n, group in _parts(select(sensors, method=method), "trained_on_skins_n")
        ]
        numbers["contrasts"] = numbers.get("contrasts", {}) | contrasts_of_sensors(sensors)
    if len(classical):
        networks = select(table[table["question"].isin(list(TRAINED_IN))], architecture="paper")
        networks = networks[networks["recipe"] != CONTROL]
        numbers["baselines"] = list(_methods(pd.concat([networks, classical])))
    if len(labels):
        numbers["labels"] = list(_labels(labels))
    return numbers


def contrasts_of_pokes(rows: pd.DataFrame) -> dict[str, Any]:
    """Compare none with the fewest pokes, with those where the paper sees its plateau, and these with the most.

    What the paper says of its figure 6a, as paired differences a board.
    """
    at = {int(n): group for n, group in _parts(by_skin(rows), "pokes_n")}
    if 0 not in at or len(at) < 2:
        return {}
    known = sorted(at)
    plateau_n = max((pokes_n for pokes_n in known if 0 < pokes_n <= PLATEAU_POKES_N), default=known[1])
    steps = {"pokes_first": (0, known[1]), "pokes_gain": (0, plateau_n), "pokes_plateau": (plateau_n, known[-1])}
    return {
        name: {"from_pokes_n": few, "to_pokes_n": many, **paired(at[many], at[few])}
        for name, (few, many) in steps.items()
        if few < many and (name != "pokes_plateau" or plateau_n == PLATEAU_POKES_N)
    }


def contrasts_of_sensors(rows: pd.DataFrame) -> dict[str, Any]:
    """Compare most with fewest training skins, adapted networks with others, and their gain with few and many skins.

    What the paper says of its figure 6b, as paired differences a board.
    """
    at = {(method, int(n)): group for (method, n), group in _parts(by_skin(rows), ["method", "trained_on_skins_n"])}
    counts = sorted({skins_n for _, skins_n in at})
    adapted = {
        f"sensors_adapted_over_{method}": [
            {"skins_n": skins_n, **paired(at["adapted", skins_n], at[method, skins_n])} for skins_n in counts
        ]
        for method in ("multi", "triplet")
    }
    if len(counts) < 2:
        return adapted
    few, many = counts[0], counts[-1]
    words = {"from_skins_n": few, "to_skins_n": many}
    more = {f"sensors_more_{method}": words | paired(at[method, many], at[method, few]) for method in SWEPT}
    gain_few, gain_many = (differences(at["adapted", n], at["triplet", n]) for n in (few, many))
    return adapted | more | {"sensors_gain_fewer": words | summarise_differences(gain_few - gain_many)}


def _methods(rows: pd.DataFrame) -> Iterator[dict[str, Any]]:
    for (_, recipe), group in _parts(rows, ["question", "recipe"], sort=False):
        first = group.iloc[0]
        words = {"method": first["method"], "inputs": first["inputs"], "name": recipe}
        words |= {"base": first["base"]} if first["base"] else {}
        yield {**words, "rows_n": int(first["trained_on_rows_n"]), **over_boards(group)}


def _labels(rows: pd.DataFrame) -> Iterator[dict[str, Any]]:
    for (method, inputs), group in _parts(rows, ["method", "inputs"], sort=False):
        for labels_n, scored in _parts(group, "labels_n"):
            parts = {places: over_boards(scored, places) for places in (AS_LABELLED, REGISTERED)}
            by_board = records(whole(scored).groupby("board")[list(METRICS)].mean())
            yield {"method": method, "inputs": inputs, "labels_n": int(labels_n), **parts, "by_board": by_board}


def _constant_force(rows: pd.DataFrame) -> dict[str, Any]:
    """Score the mean of the tested forces as a constant answer: its MSE is their variance, MSE_F / (1 - R^2)."""
    tested = whole(rows).dropna(subset=["r2_f"])
    tested = tested[tested["r2_f"] < 1]
    variance_N2 = (tested["mse_f_N2"] / (1 - tested["r2_f"])).groupby(tested["board"]).mean()
    scores = pd.DataFrame({"mse_f_N2": variance_N2, "r2_f": 0.0})
    return summarise(scores, boards=True) if len(scores) else {}


def _curve_name(row: Mapping[str, Any]) -> str:
    words = (row.get("method", "adapted"), row.get("inputs", ""))
    return "_".join(word for word in words if word).replace(", ", "_").replace(" ", "_").replace("+", "and")


def _score_means(row: Mapping[str, Any]) -> dict[str, float]:
    scores = row.get(AS_LABELLED, row)
    return {name: scores[name]["mean"] for name in METRICS if name in scores}


def _parts(rows: pd.DataFrame, by: str | list[str], *, sort: bool = True) -> Iterator[tuple[Any, pd.DataFrame]]:
    """Part rows by what columns say; unsorted ones come as they appear."""
    yield from rows.groupby(by, sort=sort)


def _times(row: Mapping[str, Any], seconds: Mapping[str, Seconds]) -> dict[str, float]:
    """Give the median seconds of a method's trainings; an adapted network was also trained before."""
    experiment = NETWORKS.get(row["method"])
    if experiment is None:
        return _median_times(seconds.get("train_classical", []), f"{row['name']}.")
    times = _median_times(seconds.get(TRAINED_IN[experiment], []), f"{experiment}.{row['name']}.")
    if experiment != "adapt" or not times:
        return times
    base = _median_times(seconds.get("train_triplet", []), f"triplet.{row['base']}.")
    return times | {"train_s": times["train_s"] + base["train_s"]} if base else {}


def _median_times(took: Seconds, start: str) -> dict[str, float]:
    timed = [training for training in took if training["name"].startswith(start)]
    if not timed:
        return {}
    return {
        "train_s": float(np.median([training["train_s"] for training in timed])),
        "inference_us": 1e6 * float(np.median([training["one_reading_s"] for training in timed])),
    }


SINGLE = {
    "by_reading": "single_random", "by_indentation": "single_indentation", "by_pass": "single_pass",
    "by_time": "single_temporal",
}  # fmt: skip
POLICIES = ("initial", "regular", "each")
HOVER = ("hover", "hover_network")  # what tells the place of a tip that does not touch
LENGTHS, PLACE = ("hover_uT", "touch_uT"), ("accuracy_pct", "mse_xy_mm2")
SEEN_PCT = 25.0  # assumed: chips see a tip itself that is placed so often without touching
OF_DRIFT = ("accuracy_pct", "mse_f_N2")
OF_TOUCHES = ("single_touches_pct", "mean_left_over_pct")
SETTINGS = ("scene", "source", "seed")  # of the provenance: equal between equal runs
TIMES = ("median_s", "repeats_n", "train_s", "inference_us", "seconds")  # of a row below `runtime`
ROW_KEYS = ("study", "method", "inputs", "setting", "pokes_n")  # name a row below `runtime`
OF_SHEAR = ("mse_xy_mm2", "mse_fxy_N2", "mse_fz_N2")

Row = Mapping[str, Any]


def compose(
    table: pd.DataFrame, accounts: Iterable[Mapping[str, int]], dropped: Mapping[str, int], *, headline: str
) -> dict[str, Any]:
    """Compose what follows from the data alone; `headline` names the recipe that stands beside the paper's numbers."""
    return {"capture": add_up(accounts) | {"left_out": dict(dropped)}, **learned(table, headline=headline)}


def add_up(accounts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Add the counts of all captures; a quality of one capture's clock is no count."""
    total = Counter({"captures_n": 0})
    for account in accounts:
        total.update({"captures_n": 1} | {name: count for name, count in account.items() if name.endswith("_n")})
    skipped = [count for name, count in total.items() if name.startswith("skipped_") and name.endswith("_bytes_n")]
    return {**total, "lost_bytes_n": sum(skipped)} if skipped else dict(total)


def foretold(tables: Iterable[pa.Table]) -> dict[str, Any]:
    """Summarise over folds how well places are told before their touch: by experiment, and by what tells them."""
    found: dict[str, dict[str, Any]] = {}
    hover: dict[str, dict[str, Any]] = {}
    for table in tables:
        for (experiment, told_by), rows in table.to_pandas().groupby(["question", "told_by"], sort=False):
            if told_by not in HOVER:
                scored = {name: statistic(rows[name].to_list()) for name in METRICS if name in rows}
                found.setdefault(experiment, {})[told_by] = scored
                continue
            for row in rows.to_dict("records"):
                own = hover.setdefault(str(row["fold"]), {name: row[name] for name in LENGTHS})
                own[told_by] = {name: row[name] for name in PLACE}
                if told_by == "hover":
                    own["seen"] = bool(row["accuracy_pct"] >= SEEN_PCT)
    return ({"before_touch": found} if found else {}) | ({"hover": hover} if hover else {})


def count_trainings(
    cards: Sequence[Row], points: Mapping[str, Sequence[Row]], experiments: Mapping[str, Row]
) -> dict[str, dict[str, int]]:
    """Count networks by experiment: trainings in all, those that collapsed, and those of them that had to be kept."""
    trainings: dict[str, list[Row]] = {}
    for card in cards:
        trainings.setdefault(card["question"], []).append(card)
    for experiment, swept in points.items():
        trainings[experiment] = [point for point in swept if "collapsed" in point]
    counted = {experiment: tally(trained) for experiment, trained in trainings.items() if trained}
    return counted | {name: dict(answer["trainings"]) for name, answer in experiments.items() if "trainings" in answer}


def lost_by_protocol(losses: Mapping[str, Row]) -> dict[str, dict[str, Any]]:
    """Add the counts of each further protocol's captures, and what experiments of it left out of their rows."""
    found: dict[str, dict[str, Any]] = {}
    for experiment, lost in losses.items():
        protocol = EXPERIMENTS[experiment].protocol
        if protocol is None or not lost["accounts"]:
            continue
        left_out = found.get(protocol, {"left_out": {}})["left_out"]
        found[protocol] = add_up(lost["accounts"]) | {"left_out": left_out | dict(lost["left_out"])}
    return found


def runtime(trainings_n: int, costs: Mapping[str, Row]) -> dict[str, Any]:
    """What it cost, where it ran here: seconds and memory a stage, and networks trained."""
    return {"stages": {stage: _cost(cost) for stage, cost in costs.items()}, "trainings_n": trainings_n}


def _cost(cost: Row) -> dict[str, float]:
    """Tell what a stage cost when it was computed, its trainings added up, from what its last run took."""
    trainings_s = cost["trainings_s"].values()
    return {
        "computed_s": cost["other_s"] + sum(trainings_s),
        "trainings_n": len(trainings_s),
        **{name: cost[name] for name in ("seconds", "cpu_s", "reused_n", "peak_process_memory_MB") if name in cost},
    }


def answered(studied: Mapping[str, Any], cost: Row, seconds: Mapping[str, Sequence[Row]]) -> dict[str, Any]:
    """Put the answers to experiments about physics beside each other; those about run time stand with what all cost."""
    others = {experiment: answer for experiment, answer in studied.items() if experiment != "runtime"}
    studies = timed(studied["runtime"], seconds.get("runtime", [])) if "runtime" in studied else {}
    return others | {"runtime": {**cost, **studies}}


def timed(answer: Row, seconds: Sequence[Row]) -> dict[str, Any]:
    """Put what was timed here beside the errors of the studies of run time; what was not timed has no time."""

    def key(row: Row) -> tuple[Any, ...]:
        return row["study"], row["method"], row["setting"]

    times = {key(took): took for took in seconds}
    studies = ("quadratures", "integrators")
    joined = {study: [row | times.get(key(row), {}) for row in answer[study]] for study in studies}
    return {"choice": answer["choice"], **joined}


def split(numbers: Row) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split the numbers of a run into numbers.json, which equal runs share, and provenance.json, of this run alone."""
    own = {name: value for name, value in numbers["provenance"].items() if name not in SETTINGS}
    costs: dict[str, Any] = {"stages": numbers["runtime"]["stages"]}
    studies: dict[str, Any] = {}
    for name, value in numbers["runtime"].items():
        if isinstance(value, list):
            costs[name] = [{key: row[key] for key in (*ROW_KEYS, *TIMES) if key in row} for row in value]
            studies[name] = [{key: row[key] for key in row if key not in TIMES} for row in value]
        elif name != "stages":
            studies[name] = value
    settings = {name: numbers["provenance"][name] for name in SETTINGS}
    return {**numbers, "provenance": settings, "runtime": studies}, {**own, "runtime": costs}


def join(numbers: Row, provenance: Row) -> dict[str, Any]:
    """Put numbers.json and provenance.json of a run together again: the inverse of `split`."""
    own = {name: value for name, value in provenance.items() if name != "runtime"}
    return {
        **numbers,
        "provenance": {**numbers["provenance"], **own},
        "runtime": _overlay(numbers["runtime"], provenance["runtime"]),
    }


def _overlay(numbers: Row, costs: Row) -> dict[str, Any]:
    joined = {**numbers, **costs}
    for name in joined:
        if isinstance(joined[name], list):
            joined[name] = [row | times for row, times in zip(numbers[name], costs[name], strict=True)]
    return joined


def headline_scores(numbers: Row) -> dict[str, Any]:
    """Take a scene's headline scores, nested by experiment: means, a place's and a force's, with units in their names.

    Nothing that differs between identical runs: no seconds, no commit, no machine.
    """
    recorded = {
        name for name in ("lobo", "labels") if name in numbers and numbers["provenance"]["source"] == "recorded"
    }
    table2 = numbers.get("table2", {}) | control_of(numbers)
    parts = {
        "table2": {name: _means(row) for name, row in table2.items()},
        "lobo": {"registered": _means(numbers["lobo"]["registered"])} if "lobo" in recorded else {},
        "labels": _best_of_labels(numbers["labels"]) if "labels" in recorded else {},
        "single_sensor": {
            name: _means(numbers[experiment]) for name, experiment in SINGLE.items() if experiment in numbers
        },
        "drift_end": _drift_end(numbers.get("drift", {})),
        "shear": _means(numbers["shear"], OF_SHEAR) if "shear" in numbers else {},
        "touches": _means(numbers.get("touches", {}).get("superposition", {}), OF_TOUCHES),
    }
    return {name: part for name, part in parts.items() if part}


def _means(row: Row, names: Sequence[str] = METRICS) -> dict[str, float]:
    return {name: row[name]["mean"] for name in names if name in row}


def _drift_end(drift: Row) -> dict[str, Any]:
    """Take the last window of each policy, which is a mean over networks already."""
    last = {policy: drift[policy][-1] for policy in POLICIES if policy in drift}
    return {policy: {name: row[name] for name in OF_DRIFT if name in row} for policy, row in last.items()}


def _best_of_labels(rows: Sequence[Row]) -> dict[str, Any]:
    """Take the most accurate method without labels of the new board, and with the most of them."""
    found = {}
    counts = [row["labels_n"] for row in rows]
    for labels_n in sorted({min(counts), max(counts)}):
        best = max(
            (row for row in rows if row["labels_n"] == labels_n),
            key=lambda row: row["as_labelled"]["accuracy_pct"]["mean"],
        )
        method = f"{best['method']} ({best['inputs']})"
        found[f"best_of_{labels_n}_labels"] = {"method": method} | _means(best["as_labelled"])
    return found
