"""Compute the content of `numbers.json`: every number that reports show, by experiment."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from operator import itemgetter
from typing import Any

import pandas as pd

from pipeline.catalogue import EXPERIMENTS, module_of
from pipeline.paper import PLATEAU_POKES_N
from pipeline.scenes import TABLE_2
from pipeline.scores import AS_LABELLED, REGISTERED, by_skin, select, whole
from pipeline.statistics import (
    differences,
    over_boards,
    over_folds,
    over_pairs,
    paired,
    paired_with_single,
    records,
    statistic,
    summarise,
    summarise_differences,
    tally,
)
from pipeline.training.before_contact import MAGNITUDES, PLACE
from reskin.metrics import METRICS

Row = Mapping[str, Any]

CONTROL = "control"  # recipe of adaptation that fine-tunes for equally many steps, without the new skin's pokes
# Pairs of rows of table 2. The scores of the second row are subtracted from those of the first row.
PAIRS = (
    ("multi", "single"), ("triplet", "multi"), ("adapted", "triplet"), ("adapted", CONTROL), (CONTROL, "triplet"),
    ("adapted", "multi"),
)  # fmt: skip
PAPERS_SPLITS = (
    "single_random",
    "single_temporal",
)  # the first of these splits that the scene ran is compared with the paper
# Splits in which the readings of an indentation, or of a pass, are never divided between training and test.
STRICTER = {"by_indentation": "single_indentation", "by_pass": "single_pass"}
SWEPT = ("multi", "triplet", "adapted")
BEFORE_TOUCH = ("noload", "scan")  # methods that predict the position from what is known before the contact
HOVER = ("hover", "hover_network")  # methods that predict the position of a tip that does not touch the skin
SEEN_PCT = 25.0  # assumed: if a hovering tip is located with at least this accuracy, the chips sense the tip
SETTINGS = ("scene", "source", "seed")  # keys of the provenance that do not differ between repeats of a run
PAPER_METRICS = ("accuracy_pct", "mse_xy_mm2", "mse_f_N2")
SHEAR_METRICS = ("mse_xy_mm2", "mse_fxy_N2", "mse_fz_N2")


def learning_numbers(table: pd.DataFrame, *, headline: str) -> dict[str, Any]:
    """Compute the numbers of all training runs from the table of scores.

    `headline` is the recipe that is compared with the paper's numbers.
    """
    recipes = {row: (experiment, headline) for row, experiment in TABLE_2.items()} | {CONTROL: ("adapt", CONTROL)}
    models = {row: select(table, experiment=experiment, recipe=recipe) for row, (experiment, recipe) in recipes.items()}
    models = {row: group for row, group in models.items() if len(group)}
    table2 = {row: over_pairs(group) if row == "single" else over_boards(group) for row, group in models.items()}
    control = table2.pop(CONTROL, None)
    adapt: dict[str, Any] = {}
    if "adapted" in models:
        adapt = {"pokes_n": int(models["adapted"]["pokes_n"].iloc[0])} | ({"control": control} if control else {})
    constant_force = {"table2": _constant_force(models["multi"])} if "multi" in models else {}
    numbers: dict[str, Any] = {
        "table2": table2,
        "lobo": _lobo(models["multi"]) if "multi" in models else {},
        "adapt": adapt,
        "constant_force": {name: row for name, row in constant_force.items() if row},
        "paired": [
            {"of": method, "over": other}
            | (paired_with_single if other == "single" else paired)(by_skin(models[method]), by_skin(models[other]))
            for method, other in PAIRS
            if method in models and other in models
        ],
        **_single(table, headline),
        "protocol": _protocol(table, headline),
    }
    numbers = {name: value for name, value in numbers.items() if value}
    return numbers | _sweeps(table) | {"variants": _variants(table)}


def _lobo(rows: pd.DataFrame) -> dict[str, Any]:
    """Summarise networks of experiment lobo: mean scores after registration of the places, and scores of each board."""
    by_board = {
        str(board): {
            "trained_on_skins_n": int(group["trained_on_skins_n"].iloc[0]),
            **{
                places: whole(group, places)[list(METRICS)].mean().dropna().to_dict()
                for places in (AS_LABELLED, REGISTERED)
            },
        }
        for board, group in _groups(rows, "fold", sort=False)
    }
    return {REGISTERED: over_boards(rows, REGISTERED), "by_board": by_board}


def _protocol(table: pd.DataFrame, headline: str) -> dict[str, dict[str, int]]:
    """Count boards, skins, folds, seeds and rows per fold for training and testing, by experiment."""
    counts = {}
    names = [experiment.name for experiment in EXPERIMENTS.values() if experiment.kind == "models"]
    networks = select(table[table["experiment"].isin(names)], recipe=headline)
    for experiment, rows in _groups(networks, "experiment", sort=False):
        folds, skins = whole(rows), by_skin(rows)
        counts[str(experiment)] = {
            "folds_n": folds["fold"].nunique(), "seeds_n": folds["seed"].nunique(),
            "boards_n": skins["board"].nunique(), "skins_n": skins["skin"].nunique(),
        } | {
            name: int(folds[name].median()) for name in ("trained_on_skins_n", "trained_on_rows_n", "rows_n")
        }  # fmt: skip
    return counts


def _single(table: pd.DataFrame, headline: str) -> dict[str, Any]:
    """Summarise networks of one skin by split; `single_sensor` is compared with the paper."""
    experiments = (*PAPERS_SPLITS, *STRICTER.values())
    numbers = {
        experiment: over_folds(select(table, experiment=experiment, recipe=headline)) for experiment in experiments
    }
    numbers = {experiment: group for experiment, group in numbers.items() if group}
    like_paper = next(
        ({"split": experiment} | numbers[experiment] for experiment in PAPERS_SPLITS if experiment in numbers), {}
    )
    stricter = {name: numbers[experiment] for name, experiment in STRICTER.items() if experiment in numbers}
    by_skin = whole(select(table, experiment="single_temporal", recipe=headline)).groupby("fold")[list(METRICS)].mean()
    skins = {"single_skins": records(by_skin)} if len(by_skin) > 1 else {}
    return numbers | {"single_sensor": like_paper | stricter} | skins


def _variants(table: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Summarise every recipe of the experiments of kind `models` over skin pairs, repeats on one skin, or boards."""
    numbers: dict[str, dict[str, Any]] = {}
    names = [experiment.name for experiment in EXPERIMENTS.values() if experiment.kind == "models"]
    models = table[table["experiment"].isin(names) & (table["recipe"] != "")]
    for (experiment, recipe), group in _groups(models, ["experiment", "recipe"], sort=False):
        summarise = (
            over_pairs if experiment == "transfer" else over_folds if experiment.startswith("single_") else over_boards
        )
        numbers.setdefault(experiment, {})[recipe] = summarise(group)
    return numbers


def _sweeps(table: pd.DataFrame) -> dict[str, Any]:
    """Summarise the sweeps over pokes and over training skins."""
    pokes, sensors = (select(table, experiment=name) for name in ("pokes", "sensors"))
    numbers: dict[str, Any] = {}
    if len(pokes):
        numbers["sweep_pokes"] = [{"pokes_n": int(n), **over_boards(group)} for n, group in _groups(pokes, "pokes_n")]
        numbers["contrasts"] = contrasts_of_pokes(pokes)
    if len(sensors):
        numbers["sweep_sensors"] = [
            {"method": method, "skins_n": int(n), **over_boards(group)}
            for method in SWEPT
            for n, group in _groups(select(sensors, method=method), "trained_on_skins_n")
        ]
        numbers["contrasts"] = numbers.get("contrasts", {}) | contrasts_of_sensors(sensors)
    return numbers


def contrasts_of_pokes(rows: pd.DataFrame) -> dict[str, Any]:
    """Compute paired differences over boards for the paper's statements on its figure 6a.

    Three differences are computed: fewest pokes minus no pokes, plateau minus no pokes, and most pokes minus plateau.
    Here, plateau means the number of pokes at which the paper's plateau begins.
    """
    groups = {int(n): group for n, group in _groups(by_skin(rows), "pokes_n")}
    if 0 not in groups or len(groups) < 2:
        return {}
    counts = sorted(groups)
    plateau_n = max((pokes_n for pokes_n in counts if 0 < pokes_n <= PLATEAU_POKES_N), default=counts[1])
    steps = {"pokes_first": (0, counts[1]), "pokes_gain": (0, plateau_n), "pokes_plateau": (plateau_n, counts[-1])}
    return {
        name: {"from_pokes_n": few, "to_pokes_n": many, **paired(groups[many], groups[few])}
        for name, (few, many) in steps.items()
        if few < many and (name != "pokes_plateau" or plateau_n == PLATEAU_POKES_N)
    }


def contrasts_of_sensors(rows: pd.DataFrame) -> dict[str, Any]:
    """Compute paired differences over boards for the paper's statements on its figure 6b.

    Three kinds of differences are computed: most training skins minus fewest training skins, adapted networks minus
    other networks, and the gain from adaptation with the fewest training skins minus the gain with the most.
    """
    groups = {
        (method, int(n)): group for (method, n), group in _groups(by_skin(rows), ["method", "trained_on_skins_n"])
    }
    counts = sorted({skins_n for _, skins_n in groups})
    adapted = {
        f"sensors_adapted_over_{method}": [
            {"skins_n": skins_n, **paired(groups["adapted", skins_n], groups[method, skins_n])} for skins_n in counts
        ]
        for method in ("multi", "triplet")
    }
    if len(counts) < 2:
        return adapted
    few, many = counts[0], counts[-1]
    counts_n = {"from_skins_n": few, "to_skins_n": many}
    more = {f"sensors_more_{method}": counts_n | paired(groups[method, many], groups[method, few]) for method in SWEPT}
    gain_few, gain_many = (differences(groups["adapted", n], groups["triplet", n]) for n in (few, many))
    return adapted | more | {"sensors_gain_fewer": counts_n | summarise_differences(gain_few - gain_many)}


def _constant_force(rows: pd.DataFrame) -> dict[str, Any]:
    """Score a constant prediction, the mean of the tested forces; its MSE is their variance, MSE_F / (1 - R^2)."""
    tested = whole(rows).dropna(subset=["r2_f"])
    tested = tested[tested["r2_f"] < 1]
    variance_N2 = (tested["mse_f_N2"] / (1 - tested["r2_f"])).groupby(tested["board"]).mean()
    scores = pd.DataFrame({"mse_f_N2": variance_N2, "r2_f": 0.0})
    return summarise(scores, boards=True) if len(scores) else {}


def _groups(rows: pd.DataFrame, by: str | list[str], *, sort: bool = True) -> Iterator[tuple[Any, pd.DataFrame]]:
    """Group rows by columns; unsorted groups are in the order of their first rows."""
    yield from rows.groupby(by, sort=sort)


def add_up(ingest_counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Add up the counts of captures (keys that end in `_n`); `lost_bytes_n` is the total number of skipped bytes."""
    total = Counter({"captures_n": 0})
    for counts in ingest_counts:
        total.update({"captures_n": 1} | {name: count for name, count in counts.items() if name.endswith("_n")})
    skipped = [count for name, count in total.items() if name.startswith("skipped_") and name.endswith("_bytes_n")]
    return {**total, "lost_bytes_n": sum(skipped)} if skipped else dict(total)


def experiment_numbers(results: Mapping[str, Any], table: pd.DataFrame) -> dict[str, Any]:
    """Return the numbers of experiments: those that they measured, and summaries of their rows of the table of scores.

    results: content of the files that the experiments wrote, by experiment.
    """
    numbers = {}
    for name, result in results.items():
        measured = result["numbers"]
        scores = select(table, experiment=name)
        numbers[name] = module_of(name).summarise(scores, measured) if EXPERIMENTS[name].scores else measured
    return numbers


def before_touch_numbers(table: pd.DataFrame) -> dict[str, Any]:
    """Summarise the scores of positions that were predicted from readings before the contact.

    `before_touch`: scores by experiment and predictor, summarised over folds. `hover`: for each fold (one skin), the
    scores of the position of a hovering tip, and `seen`, which says whether the chips sense the tip itself.
    """
    before: dict[str, dict[str, Any]] = {}
    hover: dict[str, dict[str, Any]] = {}
    controls = table[table["method"].isin([*BEFORE_TOUCH, *HOVER])]
    for (experiment, method), rows in _groups(controls, ["experiment", "method"], sort=False):
        if method in BEFORE_TOUCH:
            before.setdefault(experiment, {})[method] = {name: statistic(rows[name]) for name in PLACE}
            continue
        for row in rows.to_dict("records"):
            skin_scores = hover.setdefault(str(row["fold"]), {name: row[name] for name in MAGNITUDES})
            skin_scores[method] = {name: row[name] for name in PLACE}
            if method == "hover":
                skin_scores["seen"] = bool(row["accuracy_pct"] >= SEEN_PCT)
    return ({"before_touch": before} if before else {}) | ({"hover": hover} if hover else {})


def count_trainings(cards: Sequence[Row], results: Mapping[str, Row]) -> dict[str, dict[str, int]]:
    """Count training runs by experiment: all runs, collapsed runs, and collapsed runs that were kept.

    results: results of sweeps and other experiments, by name.
    """
    trainings: dict[str, list[Row]] = {}
    for card in cards:
        trainings.setdefault(card["question"], []).append(card)
    counted = {experiment: tally(trained) for experiment, trained in trainings.items()}
    return counted | {name: dict(result["trainings"]) for name, result in results.items() if "trainings" in result}


def lost_by_protocol(losses: Mapping[str, Row]) -> dict[str, dict[str, Any]]:
    """Add up the counts of captures for each protocol except the main one; `left_out`: counts of unused rows."""
    by_protocol: dict[str, dict[str, Any]] = {}
    for experiment, lost in losses.items():
        protocol = EXPERIMENTS[experiment].protocol
        if protocol is None or not lost["accounts"]:
            continue
        left_out = by_protocol.get(protocol, {"left_out": {}})["left_out"]
        by_protocol[protocol] = add_up(lost["accounts"]) | {"left_out": left_out | dict(lost["left_out"])}
    return by_protocol


def timed_rows(numbers: Row) -> list[dict[str, Any]]:
    """Return the rows of experiment accuracy_and_cost with their run times on this machine, if they were measured."""
    key = itemgetter("study", "method", "setting")
    seconds = {key(row): row["seconds"] for row in numbers["runtime"].get("accuracy_and_cost", ())}
    rows = numbers.get("accuracy_and_cost", {"rows": []})["rows"]
    return [row | ({"seconds": seconds[key(row)]} if key(row) in seconds else {}) for row in rows]


def split(numbers: Row) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split the numbers of a run into numbers.json, which is equal for repeats of the run, and provenance.json."""
    of_run = {name: value for name, value in numbers["provenance"].items() if name not in SETTINGS}
    shared = {name: value for name, value in numbers.items() if name != "runtime"}
    settings = {name: numbers["provenance"][name] for name in SETTINGS}
    return shared | {"provenance": settings}, of_run | {"runtime": numbers["runtime"]}


def join(numbers: Row, provenance: Row) -> dict[str, Any]:
    """Join numbers.json and provenance.json of a run: the inverse of `split`."""
    of_run = {name: value for name, value in provenance.items() if name != "runtime"}
    return {**numbers, "provenance": {**numbers["provenance"], **of_run}, "runtime": provenance["runtime"]}


def headline_scores(numbers: Row) -> dict[str, Any]:
    """Select the means that `dvc metrics` and `dvc exp show` show for a scene.

    `new_board`: scores of the shipped model on split checkerboard with the most presses, by number of labels.
    """
    new_board = numbers.get("new_board", ())
    shipped = [row for row in new_board if (row["method"], row["split"]) == ("shipped", "checkerboard")]
    most_n = max((row["pokes_n"] for row in shipped), default=0)
    shipped = [row for row in shipped if row["pokes_n"] == most_n]
    parts: dict[str, Any] = {
        "table2": {name: _means(row, PAPER_METRICS) for name, row in numbers.get("table2", {}).items()},
        "single_sensor": _means(numbers.get("single_sensor", {}), PAPER_METRICS),
        "shear": _means(numbers.get("shear", {}), SHEAR_METRICS),
        "new_board": {
            f"labels_{row['labels_n']}": _means(row, PAPER_METRICS) for row in shipped if row["pokes_n"] == most_n
        },
    }
    return {name: part for name, part in parts.items() if part}


def _means(row: Row, names: Sequence[str] = METRICS) -> dict[str, float]:
    return {name: row[name]["mean"] for name in names if name in row}
