"""Tables of experiments, made from their entries in numbers.json: one function for each experiment, in `TABLES`."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pandas as pd

from pipeline import paper
from pipeline.experiments.gripper import PRESSES
from pipeline.experiments.sensitivity import READINGS
from pipeline.formatting import COLUMNS, INTERVAL, TITLES, beside, printed, scores, show, show_difference, tabulate

Numbers = Mapping[str, Any]
Tables = dict[str, pd.DataFrame]
OVER_SEEDS = "± is the standard deviation over networks that differ only in their random seed."
OVER_BOARDS = f"{INTERVAL} {OVER_SEEDS.replace('±', '± (seeds)')}"


def _ours_and_paper(rows: Sequence[tuple[str, str, str]], source: str) -> list[dict[str, str]]:
    return [{"what": what, "ours": ours, "paper": theirs, "source": source} for what, ours, theirs in rows]


SHEAR = {
    "mse_fxy_N2": "MSE_Fxy, N²", "mse_fz_N2": "MSE_Fz, N²", "mse_xy_mm2": "MSE_xy, mm²", "accuracy_pct": "accuracy, %",
    "explained_fxy": "explained variance of Fxy", "explained_fz": "explained variance of Fz",
}  # fmt: skip
SHEAR_NOTE = (
    "All passes drag along the same paths, so each held-out line has the path of a line in every other pass. The paper "
    "states neither its forces, nor its split, nor whether its MSE_Fxy is the mean over two axes, as ours, or the sum."
)


def shear(numbers: Numbers, source: str) -> Tables:
    """List the scores of both splits beside the paper's."""
    splits = {"random readings held out": numbers, "whole lines held out": numbers["by_line"]}
    lines = [
        {"split": split, "source": source} | beside(row, printed(paper.SHEAR), show, columns=SHEAR)
        for split, row in splits.items()
    ]
    return {"shear": tabulate(lines, meaning=SHEAR_NOTE)}


VARIANTS = ("before", "after", "control", "grid")
MANUAL_NOTE = (
    "Networks that were trained without the skin's board are adapted with hand pokes, of which only the order along a "
    "line is known, and tested on the robot's grid. Control: trained as long, without pokes of the skin."
)


def manual(numbers: Numbers, source: str) -> Tables:
    """List the scores before and after adaptation with hand pokes, and the differences on the same skins."""
    rows = [(TITLES[name], numbers[name], paper.MANUAL.get(name, {}), show) for name in VARIANTS if name in numbers]
    for pair, difference in numbers["paired"].items():
        gains = paper.GAINS["by_hand"] if pair == "after_minus_before" else {}
        rows.append(
            (" minus ".join(TITLES[name] for name in pair.split("_minus_")), difference, gains, show_difference)
        )
    lines = [{"networks": title, "source": source} | beside(row, printed(of), write) for title, row, of, write in rows]
    return {"manual": tabulate(lines, meaning=MANUAL_NOTE, spread=OVER_BOARDS)}


FLEXIBLE_NOTE = (
    "The networks of one fold predict all flexible boards, so the intervals do not include the variation between "
    f"choices of training boards. The paper reports {paper.FLEXIBLE_BIAS} without a number, and its accuracy is "
    "approximate."
)


def flexible(numbers: Numbers, source: str) -> Tables:
    """List scores and force biases on flexible boards, for the paper's inputs and, if they were used, for `shape`."""
    inputs = {"change of field": numbers}
    inputs |= {"its direction and length": numbers["shape"]} if "shape" in numbers else {}
    lines = [
        {"networks": TITLES[name], "inputs": title, "source": source}
        | beside(row[name], printed(paper.FLEXIBLE if name == "after" else {}), show)
        | {"bias of F, N": show_difference(row["bias_f_N"][name])}
        | {"bias of F, %": show_difference(row["bias_f_pct"][name])}
        | {"field change / that on rigid boards": show(numbers["strength_ratio"])}
        for title, row in inputs.items()
        for name in VARIANTS
        if name in row
    ]
    return {"flexible": tabulate(lines, meaning=FLEXIBLE_NOTE, spread=OVER_BOARDS)}


SLEEVE = COLUMNS | {"median_error_mm": "median error, mm", "p95_error_mm": "95 % of errors below, mm"}
SLEEVE_NOTE = (
    "The methods are trained on the first pokes of one skin, and tested on its last pokes. The paper states no score "
    f"here: {paper.SLEEVE_WORDS}."
)


def sleeve(numbers: Numbers, source: str) -> Tables:
    """List the scores of each method, and our set-up beside the paper's."""
    near = f"median error < {numbers['near_mm']:g} mm from a border, mm"
    parts = {"near_seam": near, "inside": "median error elsewhere, mm"}
    lines = [
        {"method": TITLES.get(name, f"network, recipe {name}"), "source": source}
        | scores(row, SLEEVE)
        | {title: show(row.get(part, {}).get("median_error_mm")) for part, title in parts.items()}
        | {"seeds": str(row["accuracy_pct"]["n"])}
        for name, row in ({"network": numbers} | numbers["variants"]).items()
    ]
    set_up = [
        ("chips", str(numbers["chips_n"]), str(paper.SLEEVE["chips_n"])),
        ("rate, Hz", f"{numbers['rate_hz']:.1f}", f"{paper.SLEEVE['rate_hz']:g}"),
        ("skin, mm", "{:g} x {:g}".format(*numbers["area_mm"]), paper.SLEEVE_SKIN),
        ("pokes for training and for testing", f"{numbers['trained_n']}, {numbers['tested_n']}", "–"),
    ]
    return {
        "sleeve": tabulate(lines, meaning=SLEEVE_NOTE, spread=OVER_SEEDS),
        "sleeve_set_up": tabulate(_ours_and_paper(set_up, source)),
    }


VARIATION_NOTE = (
    "Differences between pokes at the same place and depth are rms values over the channels; the change of field is "
    f"the field minus the no-load reading of the same poke. Paper: {paper.FIGURE_4}."
)


def variation(numbers: Numbers, source: str) -> Tables:
    """List the differences between the fields of equal indentations, over time and between skins.

    Cells of differences over time also have the duration and the rise of the chips' temperature, if they are known.
    """
    took = f", {numbers['shown_s']:,.0f} s" if "shown_s" in numbers else ""
    took += f", {numbers['warmer_K']:+.2g} K" if "warmer_K" in numbers else ""
    lines = []
    for place in numbers["places"]:
        time, skins = place["time"], place["skins"]
        over = f"{time['visits_n']} pokes over {time['contacts_n']:,} contacts{took}"
        rows = [
            (over, "as read", time["raw_change_uT"], time["raw_change_pct"]),
            (over, "change", time["db_change_uT"], time["db_change_pct"]),
        ]
        if "spread_uT" in skins:
            rows.append((f"{len(skins['skins'])} skins", "change", skins["spread_uT"], skins["spread_pct"]))
        lines += [
            {"place, mm": f"{place['x_mm']:g}, {place['y_mm']:g}", "depth, mm": f"{numbers['depth_mm']:g}"}
            | {"compared": compared, "field": field, "difference, µT": f"{rms_uT:.3g}"}
            | {"difference, % of the change": f"{pct:.3g}", "source": source}
            for compared, field, rms_uT, pct in rows
        ]
    return {"variation": tabulate(lines, meaning=VARIATION_NOTE)}


SENSITIVITY_NOTE = (
    "The response is the change of field along its mean direction in one half of the fillings; the other half is "
    "tested. A step is resolved if, at this and all larger differences of weight, the reading under the larger weight "
    "has the larger response in at least 95 % of the pairs of readings."
)


def sensitivity(numbers: Numbers, source: str) -> Tables:
    """List the smallest resolved steps of weight, and how often the mean response rises with the weight."""
    rise, neighbours = numbers["monotonic"], numbers["monotonic"]["neighbours"]

    def least(steps_N: Numbers, name: str) -> str:
        """Write the smallest step; if even the finest step was resolved, it is an upper bound."""
        if name not in steps_N:
            return f"none up to {numbers['range_N']:g}"
        return f"{'≤ ' if steps_N[name] <= numbers['step_N'] else ''}{steps_N[name]:.3g}"

    bound = f"< {paper.SENSITIVITY_N:g} ({paper.SENSITIVITY_ML:g} mL of water)"
    rows = [
        (f"smallest resolved step{what}, {title}, N", least(numbers[key], name), theirs)
        for name, title in READINGS.items()
        for what, key, theirs in (("", "smallest_step_N", bound), (" from the size of dB alone", "by_length_N", "–"))
    ]
    expected = f" (from noise: {neighbours['expected_falls_n']:.1f})" if "expected_falls_n" in neighbours else ""
    rows += [
        ("smallest step above the noise, N", f"{rise['step_N']:.3g}" if "step_N" in rise else "none", "–"),
        ("rises over this step", f"{rise['pairs_n'] - rise['falls_n']} of {rise['pairs_n']}", paper.MONOTONIC),
        ("falls between neighbouring levels", f"{neighbours['falls_n']} of {numbers['levels_n'] - 1}{expected}", "–"),
        ("rank correlation of weight and mean response", f"{rise['spearman']:.4f}", "–"),
        ("gain (slope of a fitted line), µT/N", f"{numbers['gain_uT_per_N']:.3g}", "–"),
        ("noise of one reading along the response, µT", f"{numbers['noise_uT']:.2g}", "–"),
    ]
    return {"sensitivity": tabulate(_ours_and_paper(rows, source), meaning=SENSITIVITY_NOTE)}


TURNING = {
    "contacts_true_n": "true contacts", "contacts_n": "contacts found",
    "false_readings_n": "readings without contact detected as contact",
    "missed_readings_n": "readings in contact that were missed", "mse_f_N2": "MSE_F, N²", "accuracy_pct": "accuracy, %",
}  # fmt: skip
LOGS = TURNING | {
    "mse_xy_mm2": "MSE_xy, mm²", "contact_readings_n": "readings in contact",
    "missed_force_max_N": "largest force of a missed reading, N", "force_max_N": "largest estimated force, N",
    "force_true_max_N": "largest true force, N",
}  # fmt: skip
LOGS_NOTE = (
    "Networks that were trained without this board predict the readings that are detected as contact. The board does "
    f"not rotate, so the earth's field is subtracted with the no-load reading. {OVER_SEEDS}"
)
TURNING_NOTE = (
    "The same log, as if the board pitched once per step in the earth's field, while the wearer walks north, which is "
    "the worst direction. The reference chip is not under the skin, and has the same noise as the others."
)


def logs(numbers: Numbers, source: str) -> Tables:
    """List the contacts of a log and, if the true contacts are known, scores; then scores on a board that pitches."""
    account = numbers["account"]
    rows = [
        ("rate, Hz", f"{numbers['rate_hz']:.0f}", f"{paper.LOG_RATE_HZ:.0f}"),
        ("duration, s", f"{numbers['duration_s']:.1f}", "–"),
        ("readings", str(numbers["readings_n"]), "–"),
        ("readings lost to failed reads and stuck chips", str(account["rows_read_n"] - account["rows_n"]), "–"),
        ("frames missing from gaps between times", str(account["gap_frames_n"]), "–"),
        *((title, _of_log(numbers, name), "–") for name, title in LOGS.items()),
    ]
    known = {"contacts_true_n": numbers.get("contacts_true_n", "unknown")}
    turned = [
        {"pitch, °": f"± {row['pitch_deg']:g}", "readings": readings}
        | {title: _of_log(known | scored, name) for name, title in TURNING.items()}
        | {"source": source}
        for row in numbers.get("turning", ())
        for readings, scored in (("as logged", row), ("reference chip subtracted", row["reference_chip"]))
    ]
    turning = {"logs_turning": tabulate(turned, meaning=TURNING_NOTE, spread=OVER_SEEDS)} if turned else {}
    return {"logs": tabulate(_ours_and_paper(rows, source), meaning=LOGS_NOTE)} | turning


def _of_log(numbers: Numbers, name: str) -> str:
    """Write a count, or a score with its standard deviation over networks."""
    if not isinstance(numbers.get(name), float):
        return str(numbers.get(name, "unknown"))
    spread = numbers.get("spread", {})
    return f"{numbers[name]:.3g}" + (f" ± {spread[name]:.2g}" if name in spread else "")


FEEDBACK = {"networks": "multi", "map": "shipped"}
GRIPPER_NOTE = (
    "A controller closes a gripper until the estimated force equals the aim, while the object's stiffness varies "
    "between a third of its nominal value and three times this value. The known press has the force of the aim, and "
    f"either corrects all estimates by one factor, or is a label of the model. {OVER_BOARDS}"
)


def gripper(numbers: Numbers, source: str) -> Tables:
    """List how often and how accurately each force was held, by estimator."""
    within = f"within {numbers['within_pct']:g} % of the aim, % of runs"
    lines = [
        {"aim, N": f"{row['aim_N']:g}", "force estimated by": TITLES[FEEDBACK[row["feedback"]]]}
        | {"one known press": PRESSES[row["press"]], f"mean force {within}": f"{row['held_pct']:.0f}"}
        | {f"always {within}": f"{row['always_pct']:.0f}", "mean absolute error, %": show(row["error_pct"])}
        | {"median of runs, %": f"{row['median_error_pct']:.1f}", "worst run, %": f"{row['worst_error_pct']:.0f}"}
        | {"runs": str(row["runs_n"]), "source": source}
        for row in numbers["rows"]
    ]
    return {"gripper": tabulate(lines, meaning=GRIPPER_NOTE)}


TABLES: dict[str, Callable[[Numbers, str], Tables]] = {
    "shear": shear, "manual": manual, "flexible": flexible, "sleeve": sleeve, "variation": variation,
    "sensitivity": sensitivity, "logs": logs, "gripper": gripper,
}  # fmt: skip
