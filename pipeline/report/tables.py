"""Tables of a scene, made from numbers.json and written as Markdown for readers and as CSV for programs."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic import model_validator

from pipeline import scenes
from pipeline.experiments.drift import policies_in
from pipeline.formatting import (
    COLUMNS,
    INTERVAL,
    PAPER_METRICS,
    TITLES,
    beside,
    n_of,
    printed,
    scored,
    scores,
    show,
    show_both,
    show_difference,
    show_with_unit,
    tabulate,
    three_digits,
    to_markdown,
)
from pipeline.paper import ADAPTED_POKES_N, FIGURE_6A, FIGURE_6B, SINGLE_SENSOR, TABLE_2, Number
from pipeline.report.claims import NOT_RUN, NOT_TESTABLE, evaluate, read_claims
from pipeline.report.experiments import experiment_tables
from pipeline.report.figures import unseen_rows
from pipeline.report.numbers import timed_rows
from pipeline.report.table_2 import Model, models, table_2_rows
from pipeline.statistics import Stat
from reskin.config import Strict, parse, read_yaml
from reskin.errors import ParamsError

Numbers = Mapping[str, Any]
Rows = Sequence[Mapping[str, Any]]
SPLITS = {
    "single_random": "random readings held out (as in the paper; one indentation has readings in training and in test)",
    "single_indentation": "random indentations held out (an indentation is never split between training and test)",
    "single_pass": "random passes held out (each pass presses all places to all depths)",
    "single_temporal": "last passes held out (trained on the first passes, tested on the last passes)",
}
BEFORE_TOUCH = {
    "noload": "only the no-load reading before the indentation",
    "scan": "only the number of the indentation in its pass",
}
BEFORE_TOUCH_MEANING = (
    'The rows "position from only ..." show how well the position can be guessed without touching the skin. These '
    "guesses do not use the field change, but only the quantity that the row names: the guess is the mean position of "
    "the two training readings in which this quantity is most similar. The row with the number of the indentation "
    "shows how exactly the rig repeats its order of places in each pass. No network receives this number. After an "
    "indentation, some of its field change remains for a while. The row with the no-load reading shows how much this "
    "remaining field reveals about the order of places. A network may use the remaining field, because it is part of "
    "the field change."
)
SEEN_TIP = (
    "For some skins, the models also predict the position of a tip that only hovers above the skin, because the tip "
    "itself is magnetic. The scores of these skins are therefore no evidence that a touch is sensed, and they are not "
    "comparable with the paper's numbers"
)
HOVER_MEANING = (
    "This control shows whether the chips sense the tip itself. Models that were trained on contacts predict the "
    "position from readings in which the tip hovers above the place that it touches next. One model is the network. "
    "The other model is the mean position of the 2 contacts in training whose field changes are most similar. If the "
    "chips sense no tip, only a few percent of the predictions are within 1 mm, by chance. If at least a quarter of "
    "the predictions from the 2 nearest contacts are within 1 mm (a threshold that we assumed), the chips sense the "
    "magnetism of the tip. |dB| is the length of the vector of field changes; without contact, it includes the noise "
    "of the no-load reading."
)
TABLE_2_SPREAD = (
    "± is the standard deviation, which the paper also reports. In row Single-sensor, each network was trained on one "
    "skin and tested on others. There, n is the number of pairs of a training skin and a test skin, and the standard "
    "deviation is that of the scores of these pairs. In all other rows, n is the number of held-out boards, and the "
    f"standard deviation is that of the scores of these boards. {INTERVAL}"
)
SUMMARY_SPREAD = (
    f"{INTERVAL} In row Single-sensor, n is the number of pairs of a training skin and a test skin, and ± is the "
    "standard deviation of the scores of these pairs. In all other rows, n is the number of held-out boards. The last "
    "number in parentheses is the paper's mean."
)
TARGET = (
    "An earlier version of the simulation was tuned until it agreed with the paper's row Single-sensor. Some of the "
    "tuned variations between skins are still used, so agreement in this row is not evidence."
)
CONSTANT = "constant force: the mean over the tested indentations"
COLLAPSED_MEANING = (
    "A network has collapsed if its output is nearly constant, so that it explains almost nothing of some target on "
    "its own training rows. A collapsed network is trained again with other random draws, at most twice. A network "
    "that collapses every time is kept and included in all means. Very short runs are not checked for collapse."
)
REGISTERED_MEANING = (
    "Registered: before these scores are computed, the mean position error of each board is subtracted from the "
    "predicted positions of this board. This mean error is computed from the labels of the board, so registered "
    "scores are only a diagnosis. The labelled and unlabelled indentations that a method receives are at the same "
    "places of the new board as the tested indentations, but at other depths."
)
CONTROLLED = (
    "The row with 0 pokes has the scores of the network before fine-tuning. To see what fine-tuning changes without "
    "pokes of the new skin, see row Control of table 2."
)
BUDGETS = "The number of training steps is a setting of the scene. It was not chosen by these scores."
DRAWS = (
    "[low, high] is the 95 % interval over n held-out boards (Student's t). With fewer than four boards there is no "
    "interval, and (a; b) are the values of the boards. For each board, training skins are drawn at random, several "
    "times. The value of a board is the mean over all networks that were tested on it."
)
OVER_BOARDS = "± is the standard deviation of the scores of n boards."

QUANTITIES = {
    "field_at_rest_chip_median_uT": "field at rest, median chip, µT",
    "field_at_rest_channel_max_uT": "field at rest, largest channel, µT",
    "change_at_0.5_N_uT": "field change at 0.5 N, µT",
    "change_at_1_N_uT": "field change at 1 N, µT",
    "change_at_2_N_uT": "field change at 2 N, µT",
    "change_at_3_N_uT": "field change at 3 N, µT",
    "change_at_3_N_over_1_N": "field change at 3 N divided by field change at 1 N",
    "weakest_over_strongest_chip": "field change at the weakest chip divided by field change at the strongest chip",
    "rest_changes_in_1_uT": "field at rest, rms change over 1 contact, µT",
    "rest_changes_in_10_uT": "field at rest, rms change over 10 contacts, µT",
    "rest_changes_in_100_uT": "field at rest, rms change over 100 contacts, µT",
    "rest_changes_in_1000_uT": "field at rest, rms change over 1,000 contacts, µT",
    "noise_xy_uT": "noise of one reading, x and y, µT",
    "noise_z_uT": "noise of one reading, z, µT",
    "step_xy_uT": "resolution of a chip (one digital step), x and y, µT",
    "step_z_uT": "resolution of a chip (one digital step), z, µT",
    "rate_hz": "readings per second at one stop",
    "force_median_N": "force, median, N",
    "force_max_N": "force, largest, N",
}
PAIRED = (
    "A difference compares two models on the same test rows. On each skin, scores are averaged over networks, "
    "and the second model's mean is subtracted from the first model's mean. These differences are averaged over the "
    "skins of a board. [low, high] is the 95 % interval over n boards (Student's t). With fewer than four boards there "
    "is no interval, and (a; b) are the values of the boards. If the second model is the single-sensor network, only "
    "the boards on which this network was tested are used, and the interval also accounts for the differences between "
    "its training skins. Our verdicts on the differences are in table claims."
)
FINAL_MEANING = (
    "The final model itself was not tested, because no board was left to test it on. The scores belong to networks "
    "that were trained in the same way, but each without one of the boards, on which it was then tested. These scores "
    "estimate the scores of the final model on a further board."
)
SKINS_MEANING = (
    "Each cell has the mean over skins, then the smallest and the largest value of a skin in brackets, then the "
    "number of skins in parentheses. The field change of a reading is the length of the vector that contains the "
    "changes of all channels. For example, the field change at 1 N is the median over those readings of the skin whose "
    "force is from 0.8 N to 1.2 N (1 N ± 20 %). A dash (–) means that there are too few such readings."
)
SUMMARY_TITLES = {"accuracy_pct": "within 1 mm, %", "r2_f": "R² of F"}
HELD_OUT = "model, tested on held-out boards"  # heading of the first column of a summary
NEW_BOARD = {
    "accuracy_pct": "within 1 mm, %", "mse_xy_mm2": "MSE_xy, mm²", "rms_f_N": "rms error of F, N", "r2_f": "R² of F",
    "coverage_pct": "place in 90 % interval, %", "coverage_f_pct": "force in 90 % interval, %",
}  # fmt: skip
DIFFERENCE = "within 1 mm, minus the shipped model (± over draws)"
NEW_BOARD_SPREAD = "Scores are means over draws, then over boards; (a; b) are the values of the boards."
NOLOAD_AGES = {"each": "before each press", "previous": "before the press before", "initial": "at the start"}
CONTACT = {"false_pct": "false touches, %", "missed_pct": "missed touches, %"}
COMPUTED = (
    "Column computed is the time that a stage takes to compute all its results if its training runs run one after "
    "another. The last run may have taken less time, because training runs run in parallel and are reused."
)
CASES = {
    "area": "area", "what": "what", "reference": "compared with", "error": "error", "limit": "allowed",
    "reason": "reason for the allowed error",
}  # fmt: skip
TABLE_1 = Path(__file__).with_suffix(".yaml")  # table 1 of the paper
SIMULATIONS = {
    "nominal": "nominal skin", "fitted": "law fitted to this board", "refitted": "law of another board, refitted",
}  # fmt: skip
COMPARE_MEANING = (
    "Cosine: between recorded and simulated dB over all channels, mean over presses. Explained: 1 - |simulated - "
    "recorded|² / |recorded|², median over presses. Growth: n in |dB| ~ F^n at one place, median over places. The form "
    "of the law was chosen with data of both boards of scene lab, so only a new board can test it."
)
LOCALISATION = "Localisation (within 1 mm, new skin)"  # row that we add to table 1
OURS = "ours"
CONTACT_TITLES = {
    "rms_uT": "rms of changes, µT",
    "false_pct": "false contacts, %",
    "detected_pct": "detected presses, %",
}
PLACE_TITLES = {"accuracy_pct": "within 1 mm, %", "coverage_pct": "in 90 % interval, %"}
CONTACTS_MEANING = (
    "False contacts: readings without contact above the threshold of the live page. Detected presses: presses above "
    "it if a change of the field is added; values are of boards or pads."
)
PLACES_MEANING = (
    "The model is calibrated, without changes of the field, to 65 presses at half of the places; presses at the other "
    "places are tested with changes. Labels are presses of the calibration; values are of the pressed boards."
)
SHIPPED = "The shipped model, which is made for skins that it has never seen: `reskin.load_universal()`."
NOT_GIVEN = "–"


def make_tables(numbers: Numbers) -> dict[str, pd.DataFrame]:
    """Make every table for which the scene has numbers, by name."""
    source = numbers["provenance"]["source"]
    tables = {}
    if "table2" in numbers:
        tables["table2"] = _table_2(numbers, source)
    if "paired" in numbers:
        tables["paired"] = paired_table(numbers, source)
        boards = paired_boards_table(numbers, source)
        tables |= {} if boards.empty else {"paired_boards": boards}
    if any(name in numbers for name in SPLITS):
        tables["single_sensor"] = _single(numbers, source)
    if "hover" in numbers:
        tables["hover"] = _hover(numbers, source)
    tables |= experiment_tables(numbers, source)
    makers: dict[str, Callable[[Any, str], pd.DataFrame]] = {
        "sweep_pokes": sweep_pokes_table, "sweep_sensors": sweep_sensors_table,
        "audit": audit_table, "drift": drift_table, "compare": compare_table, "chosen": chosen_table,
        "extremes": extremes_table, "accuracy_and_cost": accuracy_and_cost_table, "trainings": _trainings,
        "variants": _variants,
    }  # fmt: skip
    tables |= {name: make(numbers[name], source) for name, make in makers.items() if name in numbers}
    if "new_board" in numbers:
        tables["new_board"] = new_board_table(numbers["new_board"], source)
        contact = new_board_contact_table(numbers["new_board"], source)
        tables |= {} if contact.empty else {"new_board_contact": contact}
    if "interference" in numbers:
        tables |= interference_tables(numbers["interference"])
    if "lobo" in numbers:
        tables["lobo_boards"] = _boards(numbers["lobo"]["by_board"], source)
    if "final_model" in numbers:
        tables["final_model"] = final_model_table(numbers)
    if "described" in numbers:
        columns = {f"{protocol} ({skins['source']})": skins for protocol, skins in numbers["described"].items()}
        tables["skins"] = skins_table(columns)
    tables["captures"] = _captures(numbers, source)
    if ours := measured(numbers):
        tables["table1"] = table1(read_table1(), ours)
    claims = evaluate(numbers, read_claims())
    return tables if set(claims["verdict"]) <= {NOT_RUN, NOT_TESTABLE} else tables | {"claims": claims}


def table_texts(tables: Mapping[str, pd.DataFrame]) -> dict[str, str]:
    """Write every table as Markdown for readers and as CSV for programs: text by file name."""
    texts = {f"{name}.md": to_markdown(table) for name, table in tables.items()}
    return texts | {f"{name}.csv": table.to_csv(index=False) for name, table in tables.items()}


def compare_table(numbers: Numbers, source: str) -> pd.DataFrame:
    """List how each recorded board is oriented, and how well each simulation agrees with it."""
    lines = []
    for board, of_board in numbers["by_board"].items():
        line, orientation = {"board": board, "source": source}, {"orientation": of_board["frames"]["sentence"]}
        simulations = {"fitted": of_board} if "cosine_mean" in of_board else {}
        simulations |= {name: of_board[name] for name in ("refitted", "nominal") if name in of_board}
        for name, agreed in simulations.items():
            grown = agreed.get("growth")
            lines.append(line | {
                "simulation": SIMULATIONS[name], "cosine": f"{agreed['cosine_mean']:.3f}",
                "explained": f"{agreed['explained_median']:.3f}",
                "growth (recorded)": f"{grown['simulated']:.2f} ({grown['recorded']:.2f})" if grown else "–",
            } | orientation)  # fmt: skip
        lines += [line | orientation] * (not simulations)
    return tabulate(lines, meaning=COMPARE_MEANING)


def sweep_pokes_table(rows: Rows, source: str) -> pd.DataFrame:
    """List scores by number of unlabelled pokes of the new skin; the paper gives them for two numbers of pokes."""
    in_table_2 = {0: TABLE_2["triplet"], ADAPTED_POKES_N: TABLE_2["adapted"]}
    lines = [
        {"pokes": str(row["pokes_n"]), "source": source}
        | beside(row, printed(in_table_2.get(row["pokes_n"], {})), show, paper="paper, table 2")
        for row in sorted(rows, key=lambda row: row["pokes_n"])
    ]
    return tabulate(lines, meaning=f"The paper says of its figure 6a: {FIGURE_6A}. {CONTROLLED}")


def sweep_sensors_table(rows: Rows, source: str) -> pd.DataFrame:
    """List scores by the number of training skins for each method."""
    lines = [
        {"training skins": str(row["skins_n"]), "method": TITLES[row["method"]], "source": source} | scored(row)
        for row in sorted(rows, key=lambda row: (row["skins_n"], list(TITLES).index(row["method"])))
    ]
    return tabulate(lines, meaning=f"The paper says of its figure 6b: {FIGURE_6B}.", spread=DRAWS)


def interference_tables(numbers: Numbers) -> dict[str, pd.DataFrame]:
    """List detected contacts and accuracy of places, for each changing field, method and value of `external_uT`."""

    def line(row: Mapping[str, Any], titles: Mapping[str, str]) -> dict[str, str]:
        keys = {"field": row["field"].replace("_", " "), "method": TITLES[row["method"]]}
        return keys | {"external_uT": f"{row['external_uT']:g}"} | scores(row, titles)

    contacts = [line(row, CONTACT_TITLES) for row in numbers["contacts"]]
    places: dict[tuple[str, ...], dict[str, str]] = {}
    for row in numbers["places"]:
        titles = {name: f"{row['labels_n']} labels: {title}" for name, title in PLACE_TITLES.items()}
        places.setdefault((row["field"], row["method"], row["external_uT"]), {}).update(line(row, titles))
    return {
        "interference_contacts": tabulate(contacts, meaning=CONTACTS_MEANING),
        "interference_places": tabulate([*places.values()], meaning=PLACES_MEANING),
    }


def new_board_table(rows: Rows, source: str) -> pd.DataFrame:
    """List the scores on held-out boards by method, split and number of labels."""
    lines = [
        {"method": TITLES[row["method"]], "split": row["split"], "unlabelled presses": row["pokes_n"]}
        | {"labels": row["labels_n"]}
        | {title: show(row.get(metric)) for metric, title in NEW_BOARD.items()}
        | {DIFFERENCE: _over_draws(row.get("minus_shipped", {}).get("accuracy_pct"))}
        | {"source": source}
        for row in rows
        if row["method"] != "contact"
    ]
    return tabulate(lines, spread=NEW_BOARD_SPREAD)


def _over_draws(difference: Numbers | None) -> str:
    """Write a paired difference with its standard deviation over draws."""
    if difference is None:
        return "–"
    return f"{difference['mean']:+.1f}" + (f" ± {difference['sd_draws']:.1f}" if "sd_draws" in difference else "")


def new_board_contact_table(rows: Rows, source: str) -> pd.DataFrame:
    """List missed and false contacts by the age of the no-load reading."""
    lines = [
        {"no-load reading": NOLOAD_AGES[row["split"]]}
        | {title: show(row[metric]) for metric, title in CONTACT.items()}
        | {"source": source}
        for row in rows
        if row["method"] == "contact"
    ]
    return pd.DataFrame(lines)


def drift_table(numbers: Numbers, source: str) -> pd.DataFrame:
    """List accuracy and one error by the number of earlier contacts, for each no-load policy."""
    policies = policies_in(numbers)
    first = next(iter(policies))
    error = "mse_f_N2" if "mse_f_N2" in numbers[first][0] else "mse_xy_mm2"
    lines = []
    for i, window in enumerate(numbers[first]):
        line = {"contacts": f"{window['contacts_n']:,}", "source": source}
        for policy, title in policies.items():
            row = numbers[policy][i]
            for metric in ("accuracy_pct", error):
                stat = Stat(row[metric], numbers["skins_n"] * numbers["seeds_n"], row["spread"].get(metric))
                line[f"{COLUMNS[metric]} ({title})"] = show(stat)
        lines.append(line)
    return tabulate(lines, spread="± is the standard deviation over networks, which differ in their seed or skin.")


def audit_table(rows: Rows, source: str) -> pd.DataFrame:
    """List the checks for leaks of test data; a known and documented leak is marked as such."""
    lines = [
        {name: str(row[name]) for name in ("what", "where", "rule", "found")}
        | {"holds": "yes" if row["holds"] else "no, known" if row["known"] else "NO", "source": source}
        for row in rows
    ]
    return tabulate(lines)


def chosen_table(choices: Mapping[str, Any], source: str) -> pd.DataFrame:
    """List the candidate settings of each stage, and mark the chosen settings.

    The chosen settings had the best scores in a cross-validation that leaves one board out. The boards of this
    cross-validation are not used for other results.
    """
    lines = [
        {
            "stage": stage,
            "candidate": row["recipe_name"],
            "settings": row["settings"],
            "chosen": f"yes, by {choice['by']}" if row["recipe_name"] == choice["recipe_name"] else "",
            "source": source,
        }
        | scored(row)
        for stage, choice in choices.items()
        for row in choice["candidates"]
    ]
    return tabulate(lines, meaning=BUDGETS, spread=OVER_BOARDS)


def _table_2(numbers: Numbers, source: str) -> pd.DataFrame:
    """Tabulate our table 2 beside the paper's, in the paper's order; only ours has a control and a constant force."""
    rows = {model.title: (row, model.paper) for model, row in table_2_rows(numbers).values()}
    constant = numbers.get("constant_force", {}).get("table2")
    if constant:
        rows[CONSTANT] = (constant, {})
    table = _beside_paper(rows, source)
    trainings = numbers.get("trainings", {})
    kept_n = sum(trainings[name]["kept_collapsed_n"] for name in scenes.TABLE_2.values() if name in trainings)
    meaning = [TARGET] * (source == "simulated")
    if kept_n:
        meaning.append(
            f"{kept_n} networks collapsed (their output is nearly constant) in each of their training runs. They are "
            "included in these means."
        )
    table.attrs |= {"spread": TABLE_2_SPREAD} | ({"meaning": " ".join(meaning)} if meaning else {})
    return table


def _single(numbers: Numbers, source: str) -> pd.DataFrame:
    """Tabulate each split of one skin beside the paper's scores, and positions predicted without the field change."""
    rows: dict[str, tuple[Mapping[str, Any], Mapping[str, Number]]] = {}
    seen = [skin for skin, own in numbers.get("hover", {}).items() if own["seen"]]
    for name, split in SPLITS.items():
        if name in numbers:
            skins = numbers.get("single_skins", {}) if name == "single_temporal" else {}
            own = {f"{split}: {skin}": (_stats(scores), skin in seen) for skin, scores in skins.items()}
            own = own or {split: (numbers[name], bool(seen))}
            rows |= {title: (scores, {} if of_seen else SINGLE_SENSOR) for title, (scores, of_seen) in own.items()}
            before = numbers.get("before_touch", {}).get(name, {})
            rows |= {
                f"{split}: position from {BEFORE_TOUCH[by]}": (before[by], {}) for by in BEFORE_TOUCH if by in before
            }
    table = _beside_paper(rows, source)
    meaning = [BEFORE_TOUCH_MEANING] if "before_touch" in numbers else []
    if seen:
        meaning.append(f"{SEEN_TIP} (see table hover for {', '.join(seen)}).")
    if meaning:
        table.attrs["meaning"] = " ".join(meaning)
    return table


def _hover(numbers: Numbers, source: str) -> pd.DataFrame:
    """List, by skin, the scores of a hovering tip's predicted position beside the scores of contacts."""
    skins, lines = numbers.get("single_skins", {}), []
    for skin, hover in numbers["hover"].items():
        contact = skins.get(skin, _means(numbers["single_temporal"]))
        line = {"skin": skin, "source": source, "contacts, within 1 mm, %": f"{contact['accuracy_pct']:.3g}"}
        line |= {
            f"no contact, within 1 mm, % ({model})": f"{hover[key]['accuracy_pct']:.3g}" if key in hover else "–"
            for key, model in (("hover", "2 nearest contacts"), ("hover_network", "network"))
        }
        line |= {"|dB| without contact, µT": f"{hover['hover_uT']:.3g}", "|dB| at 1 N, µT": f"{hover['touch_uT']:.3g}"}
        lines.append(line | {"tip sensed without contact": "yes" if hover["seen"] else "no"})
    return tabulate(lines, meaning=HOVER_MEANING)


def _stats(scores: Mapping[str, float]) -> dict[str, Any]:
    return {name: {"mean": value, "n": 1} for name, value in scores.items()}


def _means(row: Mapping[str, Any]) -> dict[str, float]:
    return {name: stat["mean"] for name, stat in row.items() if isinstance(stat, Mapping) and "mean" in stat}


def _beside_paper(rows: Mapping[str, tuple[Mapping[str, Any], Mapping[str, Number]]], source: str) -> pd.DataFrame:
    lines = [
        {"model": name, "source": source} | beside(ours, printed(paper), show_both)
        for name, (ours, paper) in rows.items()
    ]
    return pd.DataFrame(lines)


def _boards(by_board: Mapping[str, Any], source: str) -> pd.DataFrame:
    places = {
        "as_labelled": "as predicted",
        "registered": "corrected by one offset per board, from its labels (a diagnosis)",
    }
    lines = [
        {"held-out board": board, "trained on skins": str(parts["trained_on_skins_n"]), "positions": title}
        | {"source": source}
        | {name: f"{parts[part][metric]:.3g}" for metric, name in COLUMNS.items() if metric in parts[part]}
        for board, parts in by_board.items()
        for part, title in places.items()
    ]
    return pd.DataFrame(lines)


def _trainings(counts: Mapping[str, Mapping[str, int]], source: str) -> pd.DataFrame:
    """Count, for each experiment, all training runs, collapsed training runs, and collapsed networks that were kept."""
    columns = {
        "training runs": "trainings_n", "collapsed": "collapsed_n", "collapsed every time, kept": "kept_collapsed_n",
    }  # fmt: skip
    lines = [
        {"experiment": experiment, "source": source} | {title: str(counted[name]) for title, name in columns.items()}
        for experiment, counted in counts.items()
    ]
    return tabulate(lines, meaning=COLLAPSED_MEANING)


def _variants(variants: Mapping[str, Any], source: str) -> pd.DataFrame:
    lines = [
        {"experiment": experiment, "recipe": recipe, "source": source} | scored(row)
        for experiment, recipes in variants.items()
        for recipe, row in recipes.items()
    ]
    return pd.DataFrame(lines)


def final_model_table(numbers: Numbers) -> pd.DataFrame:
    """Describe the model that was trained on all boards, how to use it, and the scores on held-out boards."""
    model, source = numbers["final_model"], numbers["provenance"]["source"]
    row, held_out = table_2_rows(numbers)["multi"]
    file = model["file"]
    trained_on = f"{model['boards_n']} {source} boards, {model['skins_n']} skins, {model['rows_n']:,} readings"
    scores_of = {title: show(held_out[metric]) for metric, title in COLUMNS.items() if metric in held_out}
    rows = {
        "file": f"{file}; a JSON file with the same name describes the model",
        "trained on": f"{trained_on}; {model['steps_n']} steps",
        "tested": "no, because all boards were in training. Scores of networks that were trained in the same way, on "
        f"{n_of(held_out)} held-out boards (row {row.title} of table 2): "
        + "; ".join(f"{title} {shown}" for title, shown in scores_of.items()),
        "use with a log": f"reskin predict LOG.csv --model {file} --out contacts.csv",
        "use with a board": f"reskin live --model {file}",
        "use in Python": f'model = reskin.load_model("{file}").zero(noload_uT); model.predict(b_uT)',
        "use without Python": 'model.export_onnx("model.onnx")',
    }
    if source == "simulated":
        rows["limits"] = f"The model was trained on simulated skins, and not tested on real skins. {SHIPPED}"
    elif not model["forces_known"]:
        rows["limits"] = f"The recordings contain no forces, so every force that the model predicts is NaN. {SHIPPED}"
    else:
        rows["limits"] = f"Compare its scores with those of the shipped model before you use it. {SHIPPED}"
    return tabulate([{"final model": name, "": text} for name, text in rows.items()], meaning=FINAL_MEANING)


def _captures(numbers: Numbers, source: str) -> pd.DataFrame:
    """List counts of read and lost data, for the main captures and for other protocols (without counts of 0)."""
    others = numbers.get("capture_by_protocol", {})
    lines = [
        {"protocol": protocol, "what": what, "count": str(count), "source": source}
        for protocol, counts in {"main": numbers["capture"], **others}.items()
        for what, count in _counts(counts).items()
        if protocol == "main" or count
    ]
    meaning = {
        "meaning": "Protocol main has the captures from which the training and test sets (folds) are made. For all "
        "other protocols, counts of 0 are not listed."
    }
    return tabulate(lines, **(meaning if others else {}))


def _counts(protocol_counts: Mapping[str, Any]) -> dict[str, int]:
    """Return the counts of a protocol as a flat mapping; the counts in entry `left_out` get a prefix."""
    counts = {name: count for name, count in protocol_counts.items() if name != "left_out"}
    return counts | {f"left out of training: {name}": count for name, count in protocol_counts["left_out"].items()}


def skins_table(columns: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """Tabulate descriptions of skins, with one column per description, by title.

    If some skins are simulated and some are recorded, another column has the ratio simulated / recorded nearest to 1.
    """
    both_sources = {described["source"] for described in columns.values()} == {"simulated", "recorded"}
    lines = []
    for name, title in QUANTITIES.items():
        values = {column: described["over_skins"].get(name) for column, described in columns.items()}
        if not any(values.values()):
            continue
        line = {"quantity": title} | {
            column: f"{value['mean']:.3g} [{value['least']:.3g} … {value['most']:.3g}] ({value['n']})" if value else "–"
            for column, value in values.items()
        }
        if both_sources:
            means = [(columns[column]["source"], value["mean"]) for column, value in values.items() if value]
            ratios = [
                a / b
                for source_a, a in means
                if source_a == "simulated"
                for source_b, b in means
                if source_b == "recorded"
            ]
            nearest = min(ratios, key=lambda ratio: abs(np.log(ratio)), default=None)
            line["simulated / nearest recorded"] = "–" if nearest is None else f"{nearest:.2g}"
        lines.append(line)
    return tabulate(lines, meaning=SKINS_MEANING)


def table_2_summary(numbers: Numbers) -> pd.DataFrame:
    """Tabulate the main scores on held-out boards, with the paper's means in parentheses."""
    lines = []
    for model, row in table_2_rows(numbers).values():
        line = {HELD_OUT: model.title.replace("Multi-sensor with triplet loss, adapted", "The same, adapted")}
        for metric, title in COLUMNS.items():
            paper = f" ({model.paper[metric][0]:.3g})" if metric in model.paper else ""
            line[f"{title} (paper)" if metric in PAPER_METRICS else title] = show(row.get(metric)) + paper
        lines.append(line | {"n": n_of(row)})
    return tabulate(lines, spread=SUMMARY_SPREAD)


def new_board_summary(numbers: Numbers) -> pd.DataFrame:
    """Tabulate the in-context models' scores on held-out boards with the fewest and the most labels."""
    rows = unseen_rows(numbers)
    ends = sorted({min(row["labels_n"] for row in rows), max(row["labels_n"] for row in rows)})
    by_method = {(row["method"], row["labels_n"]): row for row in rows}
    lines = [
        {HELD_OUT: TITLES[method]}
        | {
            f"{title}, {labels_n} labels": show(by_method[method, labels_n].get(metric))
            for metric, title in SUMMARY_TITLES.items()
            for labels_n in ends
        }
        for method in dict.fromkeys(row["method"] for row in rows)
    ]
    return tabulate(lines, spread=INTERVAL)


def summary_table(numbers: Numbers) -> pd.DataFrame | None:
    """Tabulate a scene's main scores on held-out boards; None if no board was held out."""
    if unseen_rows(numbers):
        return new_board_summary(numbers)
    return table_2_summary(numbers) if numbers.get("table2") else None


def paired_table(numbers: Numbers, source: str) -> pd.DataFrame:
    """List the paired differences between models, beside the differences of the paper's means."""
    known = models(numbers)
    lines = []
    for row in numbers["paired"]:
        first, second = known[row["of"]].paper, known[row["over"]].paper
        gains = {m: f"{first[m][0] - second[m][0]:+.4g}" for m in first if m in second and first != second}
        cells = beside(row, gains, show_difference, paper="paper: difference of means")
        lines.append({"difference": _difference_of(row, known), "source": source} | cells)
    return tabulate(lines, spread=PAIRED)


def paired_boards_table(numbers: Numbers, source: str) -> pd.DataFrame:
    """List the paired differences between models on each held-out board."""
    known = models(numbers)
    lines = [
        {"difference": _difference_of(row, known), "held-out board": board, "source": source}
        | {title: show_difference({"mean": means[m]}) for m, title in COLUMNS.items() if m in means}
        for row in numbers["paired"]
        for board, means in row.get("by_board", {}).items()
    ]
    return tabulate(lines, spread=PAIRED)


def _difference_of(row: Mapping[str, Any], known: Mapping[str, Model]) -> str:
    return f"{known[row['of']].short} − {known[row['over']].short}"


def extremes_table(numbers: Numbers, source: str) -> pd.DataFrame:
    """List laws of physics and stiff, extreme and broken cases with the error, the allowed error and its reason."""
    lines = [
        {title: _with_unit(row[name], row["unit"]) for name, title in CASES.items()}
        | ({"error": row["message"]} if row["message"] else {})
        | {"holds": "yes" if row["holds"] else "NO", "source": source}
        for row in numbers["cases"]
    ]
    return tabulate(lines)


def accuracy_and_cost_table(numbers: Numbers, source: str) -> pd.DataFrame:
    """List the errors of methods and of neglected terms; the run times are shown if they were measured."""
    timed = any("seconds" in row for row in numbers["rows"])
    lines = [
        {name: row[name] for name in ("study", "method", "setting")}
        | {"error": _with_unit(row["error"], row["unit"])}
        | ({"run time, s": f"{row['seconds']:.2g}" if "seconds" in row else "–"} if timed else {})
        | {"source": source}
        for row in numbers["rows"]
    ]
    return tabulate(lines)


def _with_unit(value: str | float | None, unit: str) -> str:
    if value is None or isinstance(value, str):
        return value or "failed"
    return f"{value:.2g}" if unit == "1" else f"{value:.2g} {unit}"


def run_tables(numbers: Numbers, source: str) -> dict[str, pd.DataFrame]:
    """Make the tables that differ between repeats of a run: errors against run times, and the cost of each stage."""
    rows = timed_rows(numbers)
    tables = {"accuracy_and_cost": accuracy_and_cost_table({"rows": rows}, source)} if rows else {}
    lines = [
        {
            "stage": stage,
            "computed, s": f"{cost['computed_s']:.1f}",
            "last run, s": f"{cost['seconds']:.1f}",
            "last run, CPU s": f"{cost['cpu_s']:.1f}" if "cpu_s" in cost else "–",  # missing in older records of costs
            "training runs": str(cost["trainings_n"]),
            "reused training runs": str(cost["reused_n"]),
            "peak memory per process, MB": f"{cost['peak_process_memory_MB']:.0f}",
        }
        for stage, cost in numbers["runtime"]["stages"].items()
    ]
    return tables | {"stages": tabulate(lines, meaning=COMPUTED)}


class Table1(Strict):
    """Table 1 of the paper: the source that the paper cites for each column, and the cells of each row."""

    columns: dict[str, str]
    rows: dict[str, tuple[str, ...]]

    @model_validator(mode="after")
    def _rows_fill_the_columns(self) -> "Table1":
        for name, cells in self.rows.items():
            if len(cells) != len(self.columns):
                raise ValueError(f"row {name!r} must have {len(self.columns)} cells, not {len(cells)}")
        return self


def read_table1(path: Path = TABLE_1) -> Table1:
    """Read the paper's table 1 from its YAML file."""
    return parse(Table1, read_yaml(path), str(path))


def table1(data: Table1, measured: Mapping[str, str]) -> pd.DataFrame:
    """Add our column (`measured`, by row) to the paper's table 1, whose cells remain as printed.

    A row for the localisation is added if we have a result for it.
    """
    rows = data.rows | ({LOCALISATION: (NOT_GIVEN,) * len(data.columns)} if LOCALISATION in measured else {})
    if unknown := sorted(measured.keys() - rows.keys()):
        remedy = "Use names of rows of table 1 (pipeline/report/tables.yaml) in function `measured`."
        raise ParamsError("table 1", "each row with a result of ours", f"one of {sorted(rows)}", unknown, remedy)
    lines = [
        {"property": name, **dict(zip(data.columns, cells, strict=True)), OURS: measured.get(name, NOT_GIVEN)}
        for name, cells in rows.items()
    ]
    sources = " ".join(f"{name}: {source}" for name, source in data.columns.items())
    added = "the last column and the last row" if LOCALISATION in measured else "the last column"
    meaning = (
        f'The cells are printed as in table 1 of the paper, including "?". We added {added}. '
        f"Sources of the other columns: {sources}"
    )
    return tabulate(lines, meaning=meaning)


def measured(numbers: Numbers) -> dict[str, str]:
    """Write our cells of table 1, which are results or settings of the scene; return them by row."""
    source = numbers["provenance"]["source"]
    simulated = source == "simulated"
    described: Mapping[str, Any] = next(iter(numbers.get("described", {}).values()), {"over_skins": {}})
    cells = {}
    if rate := described["over_skins"].get("rate_hz"):
        cells["Frequency"] = (
            f"{three_digits(rate['mean'])} Hz" + ", a setting, computed from the times in the captures" * simulated
        )
    if sleeve := numbers.get("sleeve"):
        area = " x ".join(f"{side:g}" for side in sleeve["area_mm"])
        cells["Area coverage"] = f"{sleeve['chips_n']} chips under {area} mm" + ", a setting" * simulated
    if drift := numbers.get("drift"):
        policies = policies_in(drift)
        policy = "each" if "each" in policies else next(iter(policies))
        last = drift[policy][-1]
        cells["Durable (> 50k contacts)"] = (
            f"{last['accuracy_pct']:.3g} % within 1 mm after {last['contacts_n']:,.0f} contacts (no-load readings: "
            f"{policies[policy]})"
        )
    best = next((row for row in ("adapted", "triplet", "multi") if row in numbers.get("table2", {})), None)
    if best:
        accuracy = show_with_unit(numbers["table2"][best]["accuracy_pct"], "%")
        cells[LOCALISATION] = f"{accuracy} ({models(numbers)[best].short})"
    return {row: f"{text}, {source}" for row, text in cells.items()}
