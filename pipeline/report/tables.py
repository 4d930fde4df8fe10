"""Tables of a scene, made from numbers.json: one function per table, in the paper's order.

A table holds what a reader sees: its cells are numbers or texts such as "84 [73, 91]". A function is called only if
numbers.json has the key that its decorator names. Cells without a value are shown as a dash, and columns without any
value are left out.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd

from pipeline import paper
from pipeline.experiments.drift import policies_in
from pipeline.experiments.gripper import PRESSES
from pipeline.experiments.sensitivity import READINGS
from pipeline.formatting import COLUMNS, NONE, TITLES, show, show_difference, show_with_sd, three_digits
from pipeline.report.claims import NOT_RUN, NOT_TESTABLE, evaluate, read_claims
from pipeline.report.numbers import timed_rows
from pipeline.statistics import Stat

Numbers = Mapping[str, Any]  # numbers.json of a scene, or a part of it
Line = dict[str, Any]  # the cells of a row of a table, by column title
Make = Callable[[Numbers], pd.DataFrame]
TABLES: dict[str, tuple[str, Make]] = {}  # for each table: the key of numbers.json that it needs, and its function

PLACES = {name: COLUMNS[name] for name in ("accuracy_pct", "mse_xy_mm2")}
ONE_TRAINING_SKIN = "Leave-one-board-out, one training skin"
CONTROL = "Control: fine-tuned equally long, without pokes of the new skin"
SPLITS = {
    "single_random": "random readings", "single_indentation": "random indentations", "single_pass": "random passes",
    "single_temporal": "last passes",
}  # fmt: skip
BEFORE_TOUCH = {"noload": "no-load reading only", "scan": "number in the pass only"}
HOVER = {"hover": "2 nearest contacts", "hover_network": "network"}
SHEAR = {
    "mse_fxy_N2": "MSE_Fxy, N²", "mse_fz_N2": "MSE_Fz, N²", **PLACES, "explained_fxy": "explained variance of Fxy",
    "explained_fz": "explained variance of Fz",
}  # fmt: skip
ADAPTATION = ("before", "after", "control", "grid")
SLEEVE = COLUMNS | {"median_error_mm": "median error, mm", "p95_error_mm": "95 % of errors below, mm"}
LOGS = {
    "contacts_true_n": "true contacts", "contacts_n": "contacts found", "false_readings_n": "false readings",
    "missed_readings_n": "missed readings", "mse_f_N2": "MSE_F, N²", "accuracy_pct": "within 1 mm, %",
    "mse_xy_mm2": "MSE_xy, mm²", "contact_readings_n": "readings in contact",
    "missed_force_max_N": "largest force of a missed reading, N", "force_max_N": "largest estimated force, N",
    "force_true_max_N": "largest true force, N",
}  # fmt: skip
FORCE_FROM = {"networks": TITLES["multi"], "shipped": TITLES["shipped"]}
INTERFERENCE = {"rms_uT": "rms of changes, µT", "false_pct": "false contacts, %", "detected_pct": "detected presses, %"}
COVERED = {"accuracy_pct": COLUMNS["accuracy_pct"], "coverage_pct": "in 90 % interval, %"}
NEW_BOARD = {
    **PLACES, "rms_f_N": "rms error of F, N", "r2_f": "R² of F", "coverage_pct": "place in 90 % interval, %",
    "coverage_f_pct": "force in 90 % interval, %",
}  # fmt: skip
CONTACT = {"false_pct": "false touches, %", "missed_pct": "missed touches, %"}
NOLOAD_AGES = {"each": "before each press", "previous": "before the press before", "initial": "at the start"}
SIMULATIONS = {
    "fitted": "law fitted to this board", "refitted": "law of another board, refitted", "nominal": "nominal skin",
}  # fmt: skip
LOCALISATION = "Localisation (within 1 mm, new skin)"  # row that we add to table 1
SKINS = {
    "field_at_rest_chip_median_uT": "field at rest, median chip, µT",
    "field_at_rest_channel_max_uT": "field at rest, largest channel, µT",
    "change_at_0.5_N_uT": "field change at 0.5 N, µT", "change_at_1_N_uT": "field change at 1 N, µT",
    "change_at_2_N_uT": "field change at 2 N, µT", "change_at_3_N_uT": "field change at 3 N, µT",
    "change_at_3_N_over_1_N": "field change at 3 N / at 1 N",
    "weakest_over_strongest_chip": "field change, weakest / strongest chip",
    "rest_changes_in_1_uT": "field at rest, rms change over 1 contact, µT",
    "rest_changes_in_10_uT": "field at rest, rms change over 10 contacts, µT",
    "rest_changes_in_100_uT": "field at rest, rms change over 100 contacts, µT",
    "rest_changes_in_1000_uT": "field at rest, rms change over 1,000 contacts, µT",
    "noise_xy_uT": "noise of a reading, x and y, µT", "noise_z_uT": "noise of a reading, z, µT",
    "step_xy_uT": "digital step of a chip, x and y, µT", "step_z_uT": "digital step of a chip, z, µT",
    "rate_hz": "readings per second at one stop", "force_median_N": "force, median, N",
    "force_max_N": "force, largest, N",
}  # fmt: skip


def make_tables(numbers: Numbers) -> dict[str, pd.DataFrame]:
    """Make every table for which the scene has numbers, by name."""
    made = {name: make(numbers) for name, (key, make) in TABLES.items() if key in numbers}
    return {name: _filled(table) for name, table in made.items() if len(table)}


def run_tables(numbers: Numbers) -> dict[str, pd.DataFrame]:
    """Make the tables that differ between repeats of a run; numbers: joined with provenance.json."""
    timed = accuracy_and_cost({"accuracy_and_cost": {"rows": timed_rows(numbers)}})
    tables = {"accuracy_and_cost": timed, "stages": stages(numbers)}
    return {name: _filled(table) for name, table in tables.items() if len(table)}


def table_texts(tables: Mapping[str, pd.DataFrame]) -> dict[str, str]:
    """Write every table as CSV: text by file name."""
    return {f"{name}.csv": table.to_csv(index=False) for name, table in tables.items()}


def _filled(table: pd.DataFrame) -> pd.DataFrame:
    table = table.dropna(axis="columns", how="all").astype(object)
    return table.where(table.notna(), NONE)


def of(key: str) -> Callable[[Make], Make]:
    """Register a function as the table of its name, for scenes whose numbers.json has this key."""

    def register(make: Make) -> Make:
        TABLES[make.__name__] = (key, make)
        return make

    return register


def cells(
    row: Numbers,
    columns: Mapping[str, str] = COLUMNS,
    printed: Numbers | None = None,
    write: Callable[[Any], str] = show,
) -> Line:
    """Write the metrics of a row, each beside the value that the paper prints, if there are such values."""
    line: Line = {}
    for metric, title in columns.items():
        line[title] = write(row[metric]) if metric in row else None
        value = (printed or {}).get(metric)
        if printed is not None:
            line[f"{title} (paper)"] = "{:g} ± {:g}".format(*value) if isinstance(value, tuple) else value
    return line


def scored(row: Numbers, printed: Numbers | None = None, write: Callable[[Any], str] = show) -> Line:
    """Write the scores of a row, and the number n of boards, pairs of skins or repeats that they are averaged over."""
    stat = row.get("accuracy_pct", row.get("mse_f_N2"))
    return cells(row, printed=printed, write=write) | {"n": str(stat["n"]) if isinstance(stat, Mapping) else "1"}


@dataclass(frozen=True)
class Model:
    """A row of table 2: title, short title, and the paper's scores (empty if the paper has no such row)."""

    title: str
    short: str
    paper: Mapping[str, paper.Number]


def models(numbers: Numbers) -> dict[str, Model]:
    """Return the rows of table 2 in the paper's order, and the control.

    If networks had only one training skin, the title of their row says so.
    """
    titles = paper.TABLE_2_ROWS | {"control": CONTROL}
    pokes_n = numbers.get("adapt", {}).get("pokes_n", paper.ADAPTED_POKES_N)
    titles["adapted"] = titles["adapted"].replace(str(paper.ADAPTED_POKES_N), str(pokes_n))
    found = {row: Model(title, TITLES[row], paper.TABLE_2.get(row, {})) for row, title in titles.items()}
    boards = numbers.get("lobo", {"by_board": {}})["by_board"].values()
    if not boards or max(board["trained_on_skins_n"] for board in boards) > 1:
        return found
    one_skin = {row: titles[row].replace("Multi-sensor", ONE_TRAINING_SKIN) for row in ("triplet", "adapted")}
    return found | {
        "multi": Model(ONE_TRAINING_SKIN, "one training skin", paper.TABLE_2["single"]),
        "triplet": Model(one_skin["triplet"], "one training skin + triplet", {}),
        "adapted": Model(one_skin["adapted"], TITLES["adapted"], {}),
    }


@of("table2")
def table2(numbers: Numbers) -> pd.DataFrame:
    """Our table 2 beside the paper's; only ours has a control and a constant force."""
    control = numbers.get("adapt", {}).get("control")
    ours = numbers["table2"] | ({"control": control} if control else {})
    lines = [
        {"model": model.title} | scored(ours[row], model.paper, show_with_sd)
        for row, model in models(numbers).items()
        if row in ours
    ]
    constant = numbers.get("constant_force", {}).get("table2")
    return pd.DataFrame(
        lines + ([{"model": "constant force"} | scored(constant, {}, show_with_sd)] if constant else [])
    )


@of("paired")
def paired(numbers: Numbers) -> pd.DataFrame:
    """Paired differences between models, beside the differences of the paper's means."""
    known, lines = models(numbers), []
    for row in numbers["paired"]:
        first, second = known[row["of"]], known[row["over"]]
        both = first.paper.keys() & second.paper.keys() if first.paper != second.paper else ()
        printed = {metric: f"{first.paper[metric][0] - second.paper[metric][0]:+.4g}" for metric in both}
        lines.append({"difference": f"{first.short} − {second.short}"} | scored(row, printed, show_difference))
    return pd.DataFrame(lines)


@of("lobo")
def lobo_boards(numbers: Numbers) -> pd.DataFrame:
    """Scores of each held-out board; registered: after the mean place error of the board is subtracted."""
    registered = {metric: f"{title} (registered)" for metric, title in PLACES.items()}
    return pd.DataFrame(
        {"held-out board": board, "training skins": str(row["trained_on_skins_n"])}
        | cells(row["as_labelled"])
        | cells(row["registered"], registered)
        for board, row in numbers["lobo"]["by_board"].items()
    )


@of("variants")
def variants(numbers: Numbers) -> pd.DataFrame:
    """Scores of every recipe of the experiments that have several."""
    return pd.DataFrame(
        {"experiment": experiment, "recipe": recipe} | scored(row)
        for experiment, recipes in numbers["variants"].items()
        for recipe, row in recipes.items()
        if len(recipes) > 1
    )


@of("new_board")
def new_board(numbers: Numbers) -> pd.DataFrame:
    """Scores of the in-context models on boards never seen, by number of labels."""
    return pd.DataFrame(
        {"method": TITLES[row["method"]], "split": row["split"], "presses without labels": row["pokes_n"]}
        | {"labels": row["labels_n"]}
        | cells(row, NEW_BOARD)
        | {"within 1 mm, minus shipped": _over_draws(row.get("minus_shipped", {}).get("accuracy_pct"))}
        for row in numbers["new_board"]
        if row["method"] != "contact"
    )


def _over_draws(difference: Numbers | None) -> str | None:
    """Write a paired difference with its standard deviation over draws."""
    if difference is None:
        return None
    return f"{difference['mean']:+.1f}" + (f" ± {difference['sd_draws']:.1f}" if "sd_draws" in difference else "")


@of("new_board")
def new_board_contact(numbers: Numbers) -> pd.DataFrame:
    """Missed and false contacts by the age of the no-load reading."""
    rows = [row for row in numbers["new_board"] if row["method"] == "contact"]
    return pd.DataFrame({"no-load reading": NOLOAD_AGES[row["split"]]} | cells(row, CONTACT) for row in rows)


@of("compare")
def compare(numbers: Numbers) -> pd.DataFrame:
    """How well each simulation agrees with each recorded board."""
    lines = []
    for board, row in numbers["compare"]["by_board"].items():
        simulated = {title: row if name == "fitted" else row.get(name, {}) for name, title in SIMULATIONS.items()}
        agreed: dict[str | None, Numbers] = {title: one for title, one in simulated.items() if "cosine_mean" in one}
        for simulation, one in (agreed or {None: {}}).items():
            growth = one.get("growth", {})
            shown = {"cosine": one.get("cosine_mean"), "explained": one.get("explained_median")}
            shown |= {"growth": growth.get("simulated"), "growth, recorded": growth.get("recorded")}
            line = {title: value if value is None else f"{value:.2f}" for title, value in shown.items()}
            lines.append({"board": board, "simulation": simulation} | line)
    return pd.DataFrame(lines)


@of("provenance")
def single_sensor(numbers: Numbers) -> pd.DataFrame:
    """Scores on one skin by what was held out, beside the paper's, and of controls that do not use a touch."""
    lines, hover = [], numbers.get("hover", {})
    for experiment, held_out in SPLITS.items():
        if experiment not in numbers:
            continue
        by_skin = numbers.get("single_skins", {}) if experiment == "single_temporal" else {}
        for skin, row in (by_skin or {None: numbers[experiment]}).items():
            seen = hover[skin]["seen"] if skin in hover else any(one["seen"] for one in hover.values())
            line = {"held out": held_out, "skin": skin, "predicted from": "field change"}
            lines.append(line | scored(row, {} if seen else paper.SINGLE_SENSOR, show_with_sd))
        for method, row in numbers.get("before_touch", {}).get(experiment, {}).items():
            lines.append({"held out": held_out, "predicted from": BEFORE_TOUCH[method]} | scored(row, {}, show_with_sd))
        for skin, row in hover.items() if experiment == "single_temporal" else ():
            for method, title in HOVER.items():
                line = {"held out": held_out, "skin": skin, "predicted from": f"hovering tip, {title}"}
                lines += [line | scored(row[method])] if method in row else []
    return pd.DataFrame(lines)


@of("variation")
def variation(numbers: Numbers) -> pd.DataFrame:
    """Differences between the fields of equal indentations, over time and between skins (figure 4)."""
    lines = []
    for place in numbers["variation"]["places"]:
        time, skins = place["time"], place["skins"]
        over = [("pokes over time", time["visits_n"], "as read", time["raw_change_uT"], time["raw_change_pct"])]
        over += [("pokes over time", time["visits_n"], "change", time["db_change_uT"], time["db_change_pct"])]
        if "spread_uT" in skins:
            over += [("skins", len(skins["skins"]), "change", skins["spread_uT"], skins["spread_pct"])]
        lines += [
            {"place, mm": f"{place['x_mm']:g}, {place['y_mm']:g}", "between": between, "n": str(n), "field": field}
            | {"difference, µT": show(rms_uT), "difference, % of the change": show(pct)}
            for between, n, field, rms_uT, pct in over
        ]
    return pd.DataFrame(lines)


@of("drift")
def drift(numbers: Numbers) -> pd.DataFrame:
    """Scores by the number of earlier contacts, for each policy of no-load readings (figure 5)."""
    found = numbers["drift"]
    policies, lines = policies_in(found), []
    for windows in zip(*(found[policy] for policy in policies), strict=True):
        line = {"contacts": f"{windows[0]['contacts_n']:,}"}
        for title, row in zip(policies.values(), windows, strict=True):
            for metric in ("accuracy_pct", "mse_f_N2" if "mse_f_N2" in row else "mse_xy_mm2"):
                stat = Stat(row[metric], found["skins_n"] * found["seeds_n"], row["spread"].get(metric))
                line[f"{COLUMNS[metric]} ({title})"] = show(stat)
        lines.append(line)
    return pd.DataFrame(lines)


@of("sweep_pokes")
def sweep_pokes(numbers: Numbers) -> pd.DataFrame:
    """Scores by number of pokes of the new skin (figure 6a), beside two rows of the paper's table 2."""
    printed = {0: paper.TABLE_2["triplet"], paper.ADAPTED_POKES_N: paper.TABLE_2["adapted"]}
    rows = sorted(numbers["sweep_pokes"], key=lambda row: row["pokes_n"])
    return pd.DataFrame({"pokes": str(row["pokes_n"])} | scored(row, printed.get(row["pokes_n"], {})) for row in rows)


@of("sweep_sensors")
def sweep_sensors(numbers: Numbers) -> pd.DataFrame:
    """Scores by number of training skins, for each method (figure 6b)."""
    rows = sorted(numbers["sweep_sensors"], key=lambda row: (row["skins_n"], list(TITLES).index(row["method"])))
    return pd.DataFrame(
        {"training skins": str(row["skins_n"]), "method": TITLES[row["method"]]} | scored(row) for row in rows
    )


@of("shear")
def shear(numbers: Numbers) -> pd.DataFrame:
    """Scores of places and all components of the force, beside the paper's."""
    splits = {"random readings": numbers["shear"], "whole lines": numbers["shear"]["by_line"]}
    return pd.DataFrame({"held out": split} | cells(row, SHEAR, paper.SHEAR) for split, row in splits.items())


@of("manual")
def manual(numbers: Numbers) -> pd.DataFrame:
    """Scores before and after adaptation with hand pokes, and the differences on the same skins."""
    found = numbers["manual"]
    lines = [
        {"networks": TITLES[name]} | scored(found[name], paper.MANUAL.get(name, {}))
        for name in ADAPTATION
        if name in found
    ]
    for pair, difference in found["paired"].items():
        title = " − ".join(TITLES[name] for name in pair.split("_minus_"))
        gains = paper.GAINS["by_hand"] if pair == "after_minus_before" else {}
        printed = {metric: f"{gain:+g}" for metric, gain in gains.items()}
        lines.append({"networks": title} | scored(difference, printed, show_difference))
    return pd.DataFrame(lines)


@of("flexible")
def flexible(numbers: Numbers) -> pd.DataFrame:
    """Scores and force biases on flexible boards, for the paper's inputs and, if they were used, for `shape`."""
    found = numbers["flexible"]
    inputs = {"field change": found} | ({"direction and length": found["shape"]} if "shape" in found else {})
    return pd.DataFrame(
        {"networks": TITLES[name], "inputs": title}
        | scored(row[name], paper.FLEXIBLE if name == "after" else {})
        | {"bias of F, N": show_difference(row["bias_f_N"][name])}
        | {"bias of F, %": show_difference(row["bias_f_pct"][name])}
        for title, row in inputs.items()
        for name in ADAPTATION
        if name in row
    )


def _of_paper(rows: list[tuple[str, str, Any]]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=["what", "ours", "paper"])


@of("sensitivity")
def sensitivity(numbers: Numbers) -> pd.DataFrame:
    """Smallest resolved steps of weight, and how often the mean response rises with the weight."""
    found = numbers["sensitivity"]
    rise = found["monotonic"]
    near = rise["neighbours"]

    def least(steps_N: Numbers, name: str) -> str:
        """Write the smallest step; if even the finest step was resolved, it is an upper bound."""
        if name not in steps_N:
            return f"none up to {found['range_N']:g}"
        return f"{'≤ ' if steps_N[name] <= found['step_N'] else ''}{steps_N[name]:.3g}"

    rows: list[tuple[str, str, Any]] = []
    for name, title in READINGS.items():
        smallest = least(found["smallest_step_N"], name)
        rows += [
            (f"smallest resolved step, {title}, N", smallest, f"< {paper.SENSITIVITY_N:g}"),
            (f"the same, from the size of dB alone, {title}, N", least(found["by_length_N"], name), None),
        ]
    return _of_paper([
        *rows,
        ("smallest step above the noise, N", show(rise["step_N"]) if "step_N" in rise else "none", None),
        ("rises over this step", f"{rise['pairs_n'] - rise['falls_n']} of {rise['pairs_n']}", paper.MONOTONIC),
        ("falls between neighbouring levels", f"{near['falls_n']} of {found['levels_n'] - 1}", None),
        ("falls expected from noise", f"{near['expected_falls_n']:.1f}" if "expected_falls_n" in near else NONE, None),
        ("rank correlation of weight and mean response", f"{rise['spearman']:.4f}", None),
        ("gain, µT/N", show(found["gain_uT_per_N"]), None),
        ("noise of a reading along the response, µT", f"{found['noise_uT']:.2g}", None),
    ])  # fmt: skip


@of("logs")
def logs(numbers: Numbers) -> pd.DataFrame:
    """Contacts found in a log, and scores if the true contacts are known."""
    found = numbers["logs"]
    account = found["account"]
    return _of_paper([
        ("rate, Hz", f"{found['rate_hz']:.0f}", f"{paper.LOG_RATE_HZ:.0f}"),
        ("duration, s", f"{found['duration_s']:.1f}", None),
        ("readings", str(found["readings_n"]), None),
        ("readings lost to failed reads and stuck chips", str(account["rows_read_n"] - account["rows_n"]), None),
        ("frames missing from gaps between times", str(account["gap_frames_n"]), None),
        *((title, _of_log(found, name), None) for name, title in LOGS.items() if name in found),
    ])  # fmt: skip


def _of_log(row: Numbers, name: str) -> str:
    """Write a count, or a score with its standard deviation over networks."""
    if isinstance(row[name], int):
        return str(row[name])
    spread = row.get("spread", {})
    return f"{row[name]:.3g}" + (f" ± {spread[name]:.2g}" if name in spread else "")


@of("sleeve")
def sleeve(numbers: Numbers) -> pd.DataFrame:
    """Scores of each method on a skin over many boards; n is the number of seeds."""
    found = numbers["sleeve"]
    parts = {"near_seam": f"median error < {found['near_mm']:g} mm from a border, mm"}
    parts |= {"inside": "median error elsewhere, mm"}
    return pd.DataFrame(
        {"method": TITLES.get(name, f"network, recipe {name}")}
        | cells(row, SLEEVE)
        | {title: show(row[part]["median_error_mm"]) for part, title in parts.items() if part in row}
        | {"n": str(row["accuracy_pct"]["n"])}
        for name, row in ({"network": found} | found["variants"]).items()
    )


@of("gripper")
def gripper(numbers: Numbers) -> pd.DataFrame:
    """How often and how accurately a gripper held each force, by estimator."""
    found = numbers["gripper"]
    within = f"within {found['within_pct']:g} %, % of runs"
    return pd.DataFrame(
        {"aim, N": f"{row['aim_N']:g}", "force from": FORCE_FROM[row["feedback"]], "known press": PRESSES[row["press"]]}
        | {f"mean {within}": f"{row['held_pct']:.0f}", f"always {within}": f"{row['always_pct']:.0f}"}
        | {"mean error, %": show(row["error_pct"]), "median error, %": f"{row['median_error_pct']:.1f}"}
        | {"largest error, %": f"{row['worst_error_pct']:.0f}", "runs": str(row["runs_n"])}
        for row in found["rows"]
    )


@of("interference")
def interference_contacts(numbers: Numbers) -> pd.DataFrame:
    """False and detected contacts, for each changing field, method and value of `external_uT`."""
    rows = numbers["interference"]["contacts"]
    return pd.DataFrame(_interference(row) | cells(row, INTERFERENCE) for row in rows)


@of("interference")
def interference_places(numbers: Numbers) -> pd.DataFrame:
    """Scores of places in changing fields, by number of labels of the calibration."""
    rows = numbers["interference"]["places"]
    return pd.DataFrame(_interference(row) | {"labels": str(row["labels_n"])} | cells(row, COVERED) for row in rows)


def _interference(row: Numbers) -> Line:
    keys = {"field": row["field"].replace("_", " "), "method": TITLES[row["method"]]}
    return keys | {"external_uT": f"{row['external_uT']:g}"}


@of("provenance")
def table1(numbers: Numbers) -> pd.DataFrame:
    """Table 1 of the paper as printed, with a column and a row of ours; empty if we have no cell of it."""
    ours = _ours_of_table_1(numbers)
    table = pd.DataFrame(paper.TABLE_1)
    if LOCALISATION in ours:
        table.loc[len(table)] = {"property": LOCALISATION}
    return table.assign(ours=table["property"].map(ours)) if ours else table.head(0)


def _ours_of_table_1(numbers: Numbers) -> dict[str, str]:
    """Write our cells of table 1, which are results or settings of the scene, by row."""
    cells_of: dict[str, str] = {}
    described: Numbers = next(iter(numbers.get("described", {}).values()), {"over_skins": {}})
    if rate := described["over_skins"].get("rate_hz"):
        cells_of["Frequency"] = f"{three_digits(rate['mean'])} Hz"
    if found := numbers.get("sleeve"):
        width_mm, length_mm = found["area_mm"]
        cells_of["Area coverage"] = f"{found['chips_n']} chips under {width_mm:g} x {length_mm:g} mm"
    if found := numbers.get("drift"):
        policies = policies_in(found)
        last = found["each" if "each" in policies else next(iter(policies))][-1]
        cells_of["Durable (> 50k contacts)"] = (
            f"{show(last['accuracy_pct'])} % within 1 mm after {last['contacts_n']:,} contacts"
        )
    best = next((row for row in ("adapted", "triplet", "multi") if row in numbers.get("table2", {})), None)
    if best:
        cells_of[LOCALISATION] = f"{show(numbers['table2'][best]['accuracy_pct'])} % ({models(numbers)[best].short})"
    return cells_of


@of("final_model")
def final_model(numbers: Numbers) -> pd.DataFrame:
    """What the model that was trained on all boards was made from."""
    found = numbers["final_model"]
    counts = {"boards": "boards_n", "skins": "skins_n", "readings": "rows_n", "training steps": "steps_n"}
    return pd.DataFrame([{"file": found["file"]} | {title: f"{found[name]:,}" for title, name in counts.items()}])


@of("chosen")
def chosen(numbers: Numbers) -> pd.DataFrame:
    """Candidate settings of each stage, scored by cross-validation over boards that have no other use."""
    return pd.DataFrame(
        {"stage": stage, "candidate": row["recipe_name"], "settings": row["settings"]}
        | {"chosen": f"yes, by {choice['by']}" if row["recipe_name"] == choice["recipe_name"] else ""}
        | scored(row)
        for stage, choice in numbers["chosen"].items()
        for row in choice["candidates"]
    )


@of("extremes")
def extremes(numbers: Numbers) -> pd.DataFrame:
    """Laws of physics and stiff, extreme and broken cases: error, allowed error and its reason."""
    return pd.DataFrame(
        {"area": row["area"], "what": row["what"], "compared with": row["reference"]}
        | {"error": row["message"] or _with_unit(row["error"], row["unit"])}
        | {"allowed": _with_unit(row["limit"], row["unit"]), "reason": row["reason"]}
        | {"holds": "yes" if row["holds"] else "NO"}
        for row in numbers["extremes"]["cases"]
    )


@of("accuracy_and_cost")
def accuracy_and_cost(numbers: Numbers) -> pd.DataFrame:
    """Errors of numerical methods and of neglected terms; with run times if they were measured."""
    return pd.DataFrame(
        {name: row[name] for name in ("study", "method", "setting")}
        | {"error": _with_unit(row["error"], row["unit"])}
        | {"run time, s": f"{row['seconds']:.2g}" if "seconds" in row else None}
        for row in numbers["accuracy_and_cost"]["rows"]
    )


def _with_unit(value: float | None, unit: str) -> str:
    return "failed" if value is None else f"{value:.2g} {unit}".removesuffix(" 1")


@of("audit")
def audit(numbers: Numbers) -> pd.DataFrame:
    """Checks for leaks of test data, counted by experiment; a leak that the paper's protocol has is known."""
    checks = pd.DataFrame(
        {"what": row["what"], "experiment": re.split("[/.]", row["where"])[0], "rule": row["rule"]}
        | {"holds": "yes" if row["holds"] else "no, known" if row["known"] else "NO", "found": str(row["found"])}
        for row in numbers["audit"]
    )
    groups = checks.groupby(["what", "experiment", "rule", "holds"], sort=False)["found"]
    return groups.agg(checks="size", found="first").reset_index().rename(columns={"found": "found, for example"})


@of("described")
def skins(numbers: Numbers) -> pd.DataFrame:
    """Field, noise, resolution and forces of the readings, over skins."""
    (described,) = numbers["described"].values()
    found = {title: described["over_skins"].get(name) for name, title in SKINS.items()}
    return pd.DataFrame(
        {"quantity": title, "mean": show(row["mean"]), "least": show(row["least"]), "most": show(row["most"])}
        | {"skins": str(row["n"])}
        for title, row in found.items()
        if row
    )


@of("capture")
def captures(numbers: Numbers) -> pd.DataFrame:
    """Counts of read and lost data: one column per protocol."""
    protocols = {"main": numbers["capture"]} | numbers.get("capture_by_protocol", {})
    columns = {}
    for protocol, counts in protocols.items():
        counted = {name: count for name, count in counts.items() if name != "left_out"}
        counted |= {f"left out of training: {name}": count for name, count in counts["left_out"].items()}
        titled = {name.removesuffix("_n").replace("_", " "): count for name, count in counted.items()}
        columns[protocol] = pd.Series(titled, dtype=object)
    return pd.DataFrame(columns).rename_axis("what").reset_index()


@of("provenance")
def claims(numbers: Numbers) -> pd.DataFrame:
    """One verdict on each claim of the paper; empty if the scene tests none."""
    table = evaluate(numbers, read_claims())
    return table.head(0) if set(table["verdict"]) <= {NOT_RUN, NOT_TESTABLE} else table


def stages(numbers: Numbers) -> pd.DataFrame:
    """Time and memory of the last run of each stage, which may have reused trainings."""
    return pd.DataFrame(
        {"stage": stage, "time, s": f"{cost['seconds']:.1f}", "CPU time, s": f"{cost['cpu_s']:.1f}"}
        | {"peak memory per process, MB": f"{cost['peak_process_memory_MB']:.0f}"}
        for stage, cost in numbers["runtime"]["stages"].items()
    )
