"""Tables and figures of question drift (paper figure 5). In: its numbers and points. Out: tables, SVG by file name.

Same numbers, same bytes. Refuses to know networks and paths.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from pipeline.report.drawing import COLOURS, MARKERS, drawing, svg
from pipeline.report.formatting import COLUMNS, show, tabulate
from pipeline.report.paper import FIGURE_5
from pipeline.report.statistics import VERDICTS

POLICIES = ("initial", "regular", "each", "free")
WALKED = (
    "The networks of figure 5a on their last window again, of captures to which a random walk was added: one normal "
    "step a contact and channel, from the end of training on, in contact and no-load readings alike. The first row is "
    "that of figure 5a. How far fields at rest really go is in the table of skins: rms change over 1 to 1,000 contacts."
)
MARGIN = 0.05  # of the largest force
JUDGED = (
    f"{VERDICTS} A finding of several parts: no, if one part is no; yes, if all are. Of these trainings: judged in the "
    "same words by the 95 % interval over pairs of networks (policies trained from the same seed on the same skin), "
    "each network's value the mean over its windows; for the bias of the force also by two standard errors over "
    "indentations. Several trainings on one skin say how much trainings vary, not how much boards do."
)


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Make a table of scores against contacts, and one of the paper's findings."""
    named, error = _policies(numbers), _error(numbers)
    lines = []
    for i, first in enumerate(next(iter(named.values()))[1]):
        line = {"contacts": f"{first['contacts_n']:,}", "source": source}
        for words, rows in named.values():
            for metric in ("accuracy_pct", error):
                line[f"{COLUMNS[metric]} ({words})"] = show(_stat(rows[i], metric))
        lines.append(line)
    spread = _spread(numbers)
    found = [
        {
            "finding (paper)": one["finding"], "holds": one["verdict"], **_of_trainings(one),
            "measured": one["measured"], "why not": one.get("why", "–"), "source": source,
        }
        for one in numbers["findings"]
    ]  # fmt: skip
    shown = {
        "drift": tabulate(lines, meaning=f"{_protocol(numbers)} {say_pace(numbers, source)} {FIGURE_5}", spread=spread),
        "drift_findings": tabulate(found, meaning=JUDGED),
    }
    return shown | ({"drift_wander": _wander_table(numbers, source)} if "wander" in numbers else {})


def _wander_table(numbers: Mapping[str, Any], source: str) -> pd.DataFrame:
    named = _policies(numbers)
    lines = []
    for i, step_uT in enumerate(row["step_uT"] for row in next(iter(numbers["wander"].values()))):
        line = {"further walk, µT a contact": f"{step_uT:g}", "source": source}
        for policy, (words, _) in named.items():
            row = numbers["wander"][policy][i]
            line[f"no-load reading off by, µT ({words})"] = f"{row['noload_off_uT']:.3g}"
            line |= {f"{COLUMNS[name]} ({words})": show(_stat(row, name)) for name in ("accuracy_pct", _error(numbers))}
        lines.append(line)
    return tabulate(lines, meaning=WALKED, spread=_spread(numbers))


def _spread(numbers: Mapping[str, Any]) -> str:
    """Say over what ± is, which all rows of all policies share."""
    [(_, rows), *_] = _policies(numbers).values()
    seeds_n, skins_n = numbers["seeds_n"], numbers["skins_n"]
    if not rows[0]["spread"]:
        return "One network each."
    if skins_n == 1:
        return f"± is the sd over {seeds_n} network seeds, all tested on the same contacts."
    return f"± is the sd over {skins_n} skins with {seeds_n} network seeds each."


def _legend(numbers: Mapping[str, Any]) -> str:
    """Say what the lines of a figure differ in, and what their bars are."""
    spread = _spread(numbers)
    return (
        f"no-load reading; {spread.removesuffix('.').replace('± is', 'bars:')}" if "±" in spread else "no-load reading"
    )


def _of_trainings(one: Mapping[str, Any]) -> dict[str, str]:
    return {"of these trainings": one["of_trainings"]} if "of_trainings" in one else {}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw scores against contacts (figure 5a), and where force is known predicted against true force (figure 5b)."""
    texts = {"drift.svg": _scores(numbers, source)}
    texts |= {"drift_wander.svg": _wander_figure(numbers, source)} if "wander" in numbers else {}
    return texts | ({"drift_force.svg": _forces(numbers["late"], drawn["late"], source)} if "late" in numbers else {})


def say_pace(numbers: Mapping[str, Any], source: str) -> str:
    """Say how fast contacts follow each other by the capture's own clock, and what that does to a simulated one."""
    if "lasts_s" not in numbers:
        return "When the contacts were is not known."
    every = f"A contact follows the one before after {numbers['contact_every_s']:.3g} s (median)"
    said = f"{every}; the whole capture lasts {numbers['lasts_s']:,.0f} s."
    if source != "simulated":
        return said
    return f"{said} A real rig takes seconds a contact: temperature wanders here over many more contacts than there."


def _scores(numbers: Mapping[str, Any], source: str) -> str:
    with drawing(7.6, 4.0) as figure:
        error = _error(numbers)
        for axes, metric in zip(figure.subplots(1, 2), ("accuracy_pct", error), strict=True):
            for policy, (words, rows) in _policies(numbers).items():
                i = POLICIES.index(policy)
                contacts_n, values = ([row[name] for row in rows] for name in ("contacts_n", metric))
                bars = [row["spread"].get(metric, 0.0) for row in rows] if rows[0]["spread"] else None
                look = {"color": COLOURS[i], "marker": MARKERS[i], "markersize": 5, "linewidth": 1.2, "capsize": 2}
                axes.errorbar(contacts_n, values, bars, label=words, **look)
            axes.set(xlabel="contacts the skin has felt", ylabel=COLUMNS[metric].replace(", ", " / "))
            axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}k" if value else "0")
            axes.set_xlim(left=0)
            axes.grid(alpha=0.25)
        axes.set_yscale("log")
        figure.axes[0].set_ylim(0, 102)
        names = figure.axes[0].get_legend_handles_labels()
        figure.legend(*names, loc="outside lower center", ncols=3, frameon=False, title=_legend(numbers))
        figure.suptitle(f"Trained on first contacts, tested on later ones ({source})", x=0.01, ha="left", fontsize=11)
        return svg(figure)


def _wander_figure(numbers: Mapping[str, Any], source: str) -> str:
    with drawing(7.6, 4.0) as figure:
        error = _error(numbers)
        for axes, metric in zip(figure.subplots(1, 2), ("accuracy_pct", error), strict=True):
            for policy, (words, _) in _policies(numbers).items():
                i, rows = POLICIES.index(policy), numbers["wander"][policy]
                steps_uT = [row["step_uT"] for row in rows]
                bars = [row["spread"].get(metric, 0.0) for row in rows] if rows[0]["spread"] else None
                look = {"color": COLOURS[i], "marker": MARKERS[i], "markersize": 5, "linewidth": 1.2, "capsize": 2}
                axes.errorbar(steps_uT, [row[metric] for row in rows], bars, label=words, **look)
            least_uT = min((step for step in steps_uT if step > 0), default=1.0)
            axes.set_xscale("symlog", linthresh=least_uT)
            axes.set(xlabel="further random walk / µT a contact", ylabel=COLUMNS[metric].replace(", ", " / "))
            axes.set_xlim(left=0)
            axes.grid(alpha=0.25)
        axes.set_yscale("log")
        figure.axes[0].set_ylim(0, 102)
        names = figure.axes[0].get_legend_handles_labels()
        figure.legend(*names, loc="outside lower center", ncols=3, frameon=False, title=_legend(numbers))
        last_n = next(iter(_policies(numbers).values()))[1][-1]["contacts_n"]
        title = f"After {last_n:,} contacts, if the field at rest wandered more ({source})"
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        return svg(figure)


def _forces(late: Mapping[str, Any], points: Mapping[str, Sequence[float]], source: str) -> str:
    with drawing(5.2, 5.0) as figure:
        axes = figure.subplots()
        ends = min(0.0, *points["true_N"], *points["predicted_N"]), max(*points["true_N"], *points["predicted_N"])
        room = MARGIN * (ends[1] - ends[0])
        limits = (ends[0] - room, ends[1] + room)
        axes.plot(limits, limits, color="0.5", linewidth=1, linestyle="--", label="predicted = true")
        axes.scatter(points["true_N"], points["predicted_N"], s=9, color=COLOURS[1], alpha=0.5, linewidths=0)
        axes.set(xlabel="true force / N", ylabel="predicted force / N", xlim=limits, ylim=limits, aspect="equal")
        said = (
            f"bias {late['bias_N']:+.3g} ± {late['bias_se_N']:.1g} N ({late['bias_pct']:+.2g} %)\n"
            f"slope {late['slope']:.3g}, {late['indentations_n']:,} indentations\n"
            f"no-load reading: policy {late['policy']}\n"
            f"means over {len(late['network_bias_N'])} network(s)\n"
            "points: first seed"
        )
        axes.text(0.03, 0.97, said, transform=axes.transAxes, va="top", fontsize=10)
        axes.legend(loc="lower right", frameon=False)
        axes.grid(alpha=0.25)
        figure.suptitle(f"Force after {late['contacts_n']:,} contacts ({source})", x=0.01, ha="left", fontsize=11)
        return svg(figure)


def _policies(numbers: Mapping[str, Any]) -> dict[str, tuple[str, Sequence[Mapping[str, Any]]]]:
    """Name the policies that were tried in words, each with its rows."""
    words = {
        "initial": "once at the start",
        "regular": f"every {numbers.get('regular_n')} indentations",
        "each": "before every contact",
        "free": "whenever judged free of contact",
    }
    return {policy: (words[policy], numbers[policy]) for policy in POLICIES if policy in numbers}


def _error(numbers: Mapping[str, Any]) -> str:
    """Choose what is shown beside accuracy: places where no force is known."""
    [(_, rows), *_] = _policies(numbers).values()
    return "mse_f_N2" if "mse_f_N2" in rows[0] else "mse_xy_mm2"


def _stat(row: Mapping[str, Any], metric: str) -> dict[str, float]:
    return {"mean": row[metric]} | ({"sd": row["spread"][metric]} if metric in row["spread"] else {})


def _protocol(numbers: Mapping[str, Any]) -> str:
    train, test, every, left = (
        _count(numbers[name], numbers["unit"]) for name in ("train_n", "test_n", "every_n", "left_out_units_n")
    )
    said = (
        f"Trained on the first {train} of each skin, tested on {test} after every {every}; each policy of "
        "the no-load reading has networks of its own. Contacts: what the skin had felt before the test."
    )
    return said + (f" The last {left} fill no whole test, and are left out." if numbers["left_out_units_n"] else "")


def _count(n: int, unit: str) -> str:
    several = {"indentation": "indentations", "pass": "passes"}[unit]
    return f"{n:,} {unit if n == 1 else several}"
