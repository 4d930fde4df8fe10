"""Tables of a scene: numbers.json -> rows, as Markdown for people and CSV for programs."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from pipeline import scenes
from pipeline.experiments.neglected_effects import neglected_effects_table
from pipeline.report.checklist import checklist, claims_table
from pipeline.report.formatting import (
    COLUMNS,
    INTERVAL,
    OF_FORCE,
    SHORT,
    beside,
    n_of,
    paired_boards_table,
    paired_table,
    scored,
    scores,
    show,
    show_both,
    stability_table,
    table_2_rows,
    tabulate,
    to_markdown,
    verification_table,
)
from pipeline.report.paper import ADAPTED_POKES_N, FIGURE_6A, FIGURE_6B, SINGLE_SENSOR, TABLE_2, Number
from pipeline.report.parts import experiment_tables
from pipeline.report.table1 import measured, read_table1, table1

QUANTITIES = {
    "field_at_rest_chip_median_uT": "field at rest, median chip, µT",
    "field_at_rest_channel_max_uT": "field at rest, largest channel, µT",
    "change_at_0.5_N_uT": "change of field at 0.5 N, µT",
    "change_at_1_N_uT": "change of field at 1 N, µT",
    "change_at_2_N_uT": "change of field at 2 N, µT",
    "change_at_3_N_uT": "change of field at 3 N, µT",
    "change_at_3_N_over_1_N": "change of field at 3 N over that at 1 N",
    "weakest_over_strongest_chip": "change at the weakest chip over the strongest",
    "rest_changes_in_1_uT": "field at rest, rms change from one contact to the next, µT",
    "rest_changes_in_10_uT": "field at rest, rms change over 10 contacts, µT",
    "rest_changes_in_100_uT": "field at rest, rms change over 100 contacts, µT",
    "rest_changes_in_1000_uT": "field at rest, rms change over 1,000 contacts, µT",
    "noise_xy_uT": "noise of one reading, x and y, µT",
    "noise_z_uT": "noise of one reading, z, µT",
    "step_xy_uT": "step of a chip, x and y, µT",
    "step_z_uT": "step of a chip, z, µT",
    "rate_hz": "readings a second at one stop",
    "force_median_N": "force, median, N",
    "force_max_N": "force, largest, N",
}
ALIKE = 2.0  # assumed: means within this factor count as alike
MEANING_OF_SKINS = (
    "Mean over skins [least … most] (number of skins); a change of field is the length of the vector of all channels, "
    "the median over readings within 20 % of the force. – : too few readings."
)
COMPARED = f" Alike: the means are within a factor of {ALIKE:g} of a recorded one."


def skins_table(columns: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """Put descriptions side by side by title; compare simulated with recorded ones where there are both."""
    both = {described["source"] for described in columns.values()} == {"simulated", "recorded"}
    lines = []
    for name, title in QUANTITIES.items():
        values = {column: described["over_skins"].get(name) for column, described in columns.items()}
        if not any(values.values()):
            continue
        line = {"quantity": title} | {column: _show_quantity(value) for column, value in values.items()}
        if both:
            means = [(columns[column]["source"], value["mean"]) for column, value in values.items() if value]
            line["simulated against recorded"] = _compare(means)
        lines.append(line)
    table = pd.DataFrame(lines)
    table.attrs["meaning"] = MEANING_OF_SKINS + COMPARED * both
    return table


def _show_quantity(value: Mapping[str, float] | None) -> str:
    if value is None:
        return "–"
    return f"{value['mean']:.3g} [{value['least']:.3g} … {value['most']:.3g}] ({value['n']})"


def _compare(means: Sequence[tuple[str, float]]) -> str:
    """Compare simulated with recorded means by the ratio that is nearest to 1."""
    ratios = [a / b for side, a in means if side == "simulated" for of, b in means if of == "recorded"]
    if not ratios:
        return "–"
    nearest = min(ratios, key=lambda ratio: abs(np.log(ratio)))
    if 1 / ALIKE <= nearest <= ALIKE:
        return "alike"
    return f"differs: {nearest:.2g} times the nearest recorded"


SPLIT_WORDS = {
    "single_random": "random readings held out (the paper's way: readings of one indentation on both sides)",
    "single_indentation": "random indentations held out (all readings of one on the same side)",
    "single_pass": "random passes held out (each visits every place and depth again)",
    "single_temporal": "first passes → last passes",
}
SURENESS = {"coverage_pct": "in 90 % intervals, %", "half_width_mm": "half of them, mm (median)"}
BEFORE_TOUCH = {
    "noload": "the no-load reading before the poke alone",
    "scan": "the number of the poke in its pass alone",
}  # what tells a place: words
BEFORE_TOUCH_MEANING = (
    "Told before the touch: the place by the 2 nearest training rows, on the rows and folds above, from no change of "
    "field. The number in the pass says how far the rig repeats its order; no network sees it. The no-load reading "
    "says what a skin that remembers its pokes gives away of that order; it is in every change of field, so a network "
    "that is tested on the skin it learnt on may have used it."
)
SEEN_TIP = (
    "Not beside the paper's numbers: a tip that only hovers is placed too, so the indenter itself is magnetic and "
    "these scores are no evidence of touch"
)
HOVER_MEANING = (
    "Hover control: rows of the tested passes in which the gauge feels nothing, at the place that is touched next, "
    "answered by what was learnt on contacts. A skin that feels nothing is placed by chance, a few in a hundred. A tip "
    "that the nearest contacts place a quarter of the time is called seen (assumed): its own magnetism is read. |dB| "
    "without contact holds the noise of the no-load reading too."
)
TABLE_2_SPREAD = (
    "± is the sd, as in the paper: over n boards held out, or over n pairs of a training and a test skin for one skin "
    f"on others. {INTERVAL} (for one skin on others: over its training skins and the boards that it was tested on)."
)
TARGET = (
    "The row of one skin on others was a calibration target of an earlier simulated skin: spreads that were set with "
    "it in view remain, so agreement there is no evidence."
)
CONSTANT = "a constant force, the mean of the tested presses"
COLLAPSED_MEANING = (
    "Collapsed: a network that explains next to nothing of some target on its own training rows, as it answers nearly "
    "the same to any input. It is trained again with other draws, at most twice; what collapses every time is kept in "
    "all means; those of train_* and adapt are also named in the audit. Trainings too short to have left their start "
    "are not judged."
)
PLACES = (
    "Registered: after one offset a board (uses its labels: a diagnosis). Labels and unlabelled pokes are indentations "
    "of the new board at places where it is also tested, at other depths."
)
TRAINING_ROWS = (
    "Training rows of the first fold; a classical method is given at most so many, drawn at random. Settings of "
    "classical methods were not searched."
)
CONTROLLED = (
    "0 is the network as it was trained, all others are fine-tuned: what that does without pokes is the control of "
    "table 2."
)
BUDGETS = "How many steps there are is a budget of each scene, and no part of the choice."
DRAWS = (
    "[low, high] is the 95 % interval over n held-out boards (Student's t), each with its own draw of training skins; "
    "networks of one board are averaged first."
)
OF_BOARDS = "± is the sd over n boards."

Numbers = Mapping[str, Any]
Rows = Sequence[Mapping[str, Any]]


def make_tables(numbers: Numbers) -> dict[str, pd.DataFrame]:
    """Make every table that the numbers can fill, by name."""
    source = numbers["provenance"]["source"]
    tables = {}
    if "table2" in numbers:
        tables["table2"] = _table_2(numbers, source)
    if "paired" in numbers:
        orders = {"paired": paired_table, "paired_boards": paired_boards_table}
        made = {name: make(numbers, source) for name, make in orders.items()}
        tables |= {name: table for name, table in made.items() if not table.empty}
    if any(name in numbers for name in SPLIT_WORDS):
        tables["single_sensor"] = _single(numbers, source)
    if "hover" in numbers:
        tables["hover"] = _hover(numbers, source)
    tables |= experiment_tables(numbers, source)
    makers: dict[str, Callable[[Any, str], pd.DataFrame]] = {
        "sweep_pokes": sweep_pokes_table, "sweep_sensors": sweep_sensors_table, "baselines": baselines_table,
        "audit": audit_table, "chosen": chosen_table, "verification": verification_table,
        "stability": stability_table, "left_out": neglected_effects_table, "trainings": _trainings,
        "variants": _variants,
    }  # fmt: skip
    tables |= {name: make(numbers[name], source) for name, make in makers.items() if name in numbers}
    if "labels" in numbers:
        constant = numbers.get("constant_force", {}).get("labels")
        tables["labels"] = labels_table(numbers["labels"], source, constant)
        tables["labels_boards"] = labels_boards_table(numbers["labels"], source)
    if "lobo" in numbers:
        tables["lobo_boards"] = _boards(numbers["lobo"]["by_board"], source)
    if "described" in numbers:
        titled = {f"{protocol} ({skins['source']})": skins for protocol, skins in numbers["described"].items()}
        tables["skins"] = skins_table(titled)
    tables["captures"] = _captures(numbers, source)
    tables["table1"] = table1(read_table1(), measured(numbers))
    tables["checklist"] = checklist(numbers)
    claims = claims_table(tables["checklist"])
    return tables if claims.empty else tables | {"claims": claims}


def table_texts(tables: Mapping[str, pd.DataFrame]) -> dict[str, str]:
    """Write every table twice, by file name: as Markdown for people and as CSV for programs."""
    texts = {f"{name}.md": to_markdown(table) for name, table in tables.items()}
    return texts | {f"{name}.csv": table.to_csv(index=False) for name, table in tables.items()}


def sweep_pokes_table(rows: Rows, source: str) -> pd.DataFrame:
    """List scores by the number of unlabelled pokes of the new skin; the paper gives numbers for two of them."""
    printed = {0: TABLE_2["triplet"], ADAPTED_POKES_N: TABLE_2["adapted"]}
    lines = [
        {"pokes": str(row["pokes_n"]), "source": source}
        | beside(row, _printed(printed.get(row["pokes_n"], {})), show, paper="paper, table 2")
        for row in sorted(rows, key=lambda row: row["pokes_n"])
    ]
    return tabulate(lines, meaning=f"The paper on its figure 6a: {FIGURE_6A}. {CONTROLLED}")


def sweep_sensors_table(rows: Rows, source: str) -> pd.DataFrame:
    """List scores by the number of training skins for each method."""
    lines = [
        {"training skins": str(row["skins_n"]), "method": SHORT[row["method"]], "source": source} | scored(row)
        for row in sorted(rows, key=lambda row: (row["skins_n"], list(SHORT).index(row["method"])))
    ]
    return tabulate(lines, meaning=f"The paper on its figure 6b: {FIGURE_6B}.", spread=DRAWS)


def baselines_table(rows: Rows, source: str) -> pd.DataFrame:
    """List classical methods and networks on the same folds, the most accurate first."""
    lines = [
        {"method": row["method"], "inputs": row["inputs"], "training rows": str(row["rows_n"]), "source": source}
        | scored(row)
        for row in sorted(rows, key=lambda row: -row["accuracy_pct"]["mean"])
    ]
    return tabulate(lines, meaning=TRAINING_ROWS)


def labels_table(rows: Rows, source: str, constant: Numbers | None = None) -> pd.DataFrame:
    """List scores by how many labelled indentations of the new skin were at hand."""
    places = {metric: f"{title} (registered)" for metric, title in COLUMNS.items() if metric not in OF_FORCE}
    sure = SURENESS if any(metric in row["as_labelled"] for row in rows for metric in SURENESS) else {}
    lines = [
        {"method": row["method"], "inputs": row["inputs"], "labels": str(row["labels_n"]), "source": source}
        | scores(row["as_labelled"])
        | scores(row["registered"], places)
        | scores(row["as_labelled"], sure)
        | {"n": n_of(row["as_labelled"])}
        for row in rows
    ]
    if constant:
        words = {"method": CONSTANT, "inputs": "–", "labels": "all", "source": source}
        lines.append(words | scores(constant) | {"n": n_of(constant)})
    return tabulate(lines, meaning=PLACES)


def labels_boards_table(rows: Rows, source: str) -> pd.DataFrame:
    """List the same board by board."""
    lines = [
        {"method": row["method"], "inputs": row["inputs"], "labels": str(row["labels_n"]), "held-out board": board}
        | {title: f"{own[metric]:.3g}" for metric, title in COLUMNS.items() if metric in own}
        | {"source": source}
        for row in rows
        for board, own in row.get("by_board", {}).items()
    ]
    return tabulate(lines, spread="As labelled; networks and draws of a board are averaged.")


def audit_table(rows: Rows, source: str) -> pd.DataFrame:
    """List what was searched for leaks; a leak that is known and stated is told from one that is not."""
    lines = [
        {name: str(row[name]) for name in ("what", "where", "rule", "found")}
        | {"holds": "yes" if row["holds"] else "no, known" if row["known"] else "NO", "source": source}
        for row in rows
    ]
    return tabulate(lines)


def chosen_table(arms: Mapping[str, Any], source: str) -> pd.DataFrame:
    """List the candidates of each arm and which was chosen, by leave-one-board-out on boards of their own."""
    lines = []
    for arm, choice in arms.items():
        for row in choice["candidates"]:
            chosen = f"yes, by {choice['by']}" if row["recipe_name"] == choice["recipe_name"] else ""
            words = {"arm": arm, "candidate": row["recipe_name"], "settings": row["settings"], "chosen": chosen}
            lines.append(words | {"source": source} | scored(row))
    return tabulate(lines, meaning=BUDGETS, spread=OF_BOARDS)


def _table_2(numbers: Numbers, source: str) -> pd.DataFrame:
    """Put each row beside the paper's row of the same kind, in the paper's order; the control is ours."""
    rows = {model.title: (row, model.paper) for model, row in table_2_rows(numbers).values()}
    constant = numbers.get("constant_force", {}).get("table2")
    if constant:
        rows[CONSTANT] = (constant, {})
    table = _beside_paper(rows, source)
    trainings = numbers.get("trainings", {})
    asked = [trainings[experiment] for experiment in scenes.TABLE_2.values() if experiment in trainings]
    words = [TARGET] * (source == "simulated")
    if kept_n := sum(counts["kept_collapsed_n"] for counts in asked):
        words.append(f"{kept_n} networks collapsed every time that they were trained, and are in these means.")
    table.attrs |= {"spread": TABLE_2_SPREAD} | ({"meaning": " ".join(words)} if words else {})
    return table


def _single(numbers: Numbers, source: str) -> pd.DataFrame:
    """Put each split of one skin beside the paper, and below it what tells its places before the touch."""
    rows: dict[str, tuple[Mapping[str, Any], Mapping[str, Number]]] = {}
    seen = [skin for skin, own in numbers.get("hover", {}).items() if own["seen"]]
    for name, words in SPLIT_WORDS.items():
        if name in numbers:
            skins = numbers.get("single_skins", {}) if name == "single_temporal" else {}
            own = {f"{words}: {skin}": (_stats(scores), skin in seen) for skin, scores in skins.items()}
            own = own or {words: (numbers[name], bool(seen))}
            rows |= {title: (scores, {} if of_seen else SINGLE_SENSOR) for title, (scores, of_seen) in own.items()}
            told = numbers.get("before_touch", {}).get(name, {})
            rows |= {f"{words}: place from {BEFORE_TOUCH[by]}": (told[by], {}) for by in BEFORE_TOUCH if by in told}
    table = _beside_paper(rows, source)
    meaning = [BEFORE_TOUCH_MEANING] if "before_touch" in numbers else []
    if seen:
        meaning.append(f"{SEEN_TIP} (table hover: {', '.join(seen)}).")
    if meaning:
        table.attrs["meaning"] = " ".join(meaning)
    return table


def _hover(numbers: Numbers, source: str) -> pd.DataFrame:
    """List what a tip that does not touch gives away, skin by skin, beside the scores of contacts."""
    skins, lines = numbers.get("single_skins", {}), []
    for skin, own in numbers["hover"].items():
        contact = skins.get(skin, _means(numbers["single_temporal"]))
        line = {"skin": skin, "source": source, "contacts, within 1 mm, %": f"{contact['accuracy_pct']:.3g}"}
        line |= {
            f"no contact, within 1 mm, % ({words})": f"{own[by]['accuracy_pct']:.3g}" if by in own else "–"
            for by, words in (("hover", "2 nearest contacts"), ("hover_network", "network"))
        }
        line |= {"|dB| without contact, µT": f"{own['hover_uT']:.3g}", "|dB| at 1 N, µT": f"{own['touch_uT']:.3g}"}
        lines.append(line | {"the tip": "is seen without touch" if own["seen"] else "is not seen"})
    return tabulate(lines, meaning=HOVER_MEANING)


def _stats(scores: Mapping[str, float]) -> dict[str, Any]:
    return {name: {"mean": value, "n": 1} for name, value in scores.items()}


def _means(row: Mapping[str, Any]) -> dict[str, float]:
    return {name: stat["mean"] for name, stat in row.items() if isinstance(stat, Mapping) and "mean" in stat}


def _beside_paper(rows: Mapping[str, tuple[Mapping[str, Any], Mapping[str, Number]]], source: str) -> pd.DataFrame:
    lines = [
        {"model": name, "source": source} | beside(ours, _printed(paper), show_both)
        for name, (ours, paper) in rows.items()
    ]
    return pd.DataFrame(lines)


def _printed(paper: Mapping[str, Number]) -> dict[str, str]:
    return {metric: f"{mean:g} ± {sd:g}" for metric, (mean, sd) in paper.items()}


def _boards(by_board: Mapping[str, Any], source: str) -> pd.DataFrame:
    places = {"as_labelled": "as labelled", "registered": "after one offset a board (uses its labels: a diagnosis)"}
    lines = [
        {"held-out board": board, "trained on skins": str(parts["trained_on_skins_n"]), "places": words}
        | {"source": source}
        | {title: f"{parts[part][metric]:.3g}" for metric, title in COLUMNS.items() if metric in parts[part]}
        for board, parts in by_board.items()
        for part, words in places.items()
    ]
    return pd.DataFrame(lines)


def _trainings(counts: Mapping[str, Mapping[str, int]], source: str) -> pd.DataFrame:
    """List how many networks were trained, how many of those collapsed, and how many of them had to be kept."""
    columns = {
        "trainings": "trainings_n", "collapsed": "collapsed_n", "collapsed every time, kept": "kept_collapsed_n",
    }  # fmt: skip
    lines = [
        {"question": experiment, "source": source} | {title: str(counted[name]) for title, name in columns.items()}
        for experiment, counted in counts.items()
    ]
    return tabulate(lines, meaning=COLLAPSED_MEANING)


def _variants(variants: Mapping[str, Any], source: str) -> pd.DataFrame:
    lines = [
        {"question": experiment, "recipe": recipe, "source": source} | scored(row)
        for experiment, recipes in variants.items()
        for recipe, row in recipes.items()
    ]
    return pd.DataFrame(lines)


def _captures(numbers: Numbers, source: str) -> pd.DataFrame:
    """List what was read and lost, of the main captures and of each further protocol's; of these, no 0."""
    further = numbers.get("capture_by_protocol", {})
    lines = [
        {"protocol": protocol, "what": what, "count": str(count), "source": source}
        for protocol, account in {"main": numbers["capture"], **further}.items()
        for what, count in _counts(account).items()
        if protocol == "main" or count
    ]
    meaning = {"meaning": "Main: the captures that folds are drawn on. Of other protocols no 0 is listed."}
    return tabulate(lines, **(meaning if further else {}))


def _counts(account: Mapping[str, Any]) -> dict[str, int]:
    counts = {name: count for name, count in account.items() if name != "left_out"}
    return counts | {f"left out of training: {name}": count for name, count in account["left_out"].items()}
