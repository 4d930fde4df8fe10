"""The table of scores of a scene: one row for each scored set of predictions.

Each stage that scores predictions writes its rows to a file in `data/scores/<scene>`, and the report reads all of them.
The tables, figures and numbers of a report are computed from this table. The metrics come from `reskin.metrics`.

The predictions of a network on its test rows have a joint row for all skins, a second joint row in which the places on
each board were first registered, and one row for each skin.
"""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from reskin import io
from reskin.metrics import METRICS, TRUTH

NAMES = (
    "experiment", "method", "recipe", "inputs", "architecture", "base", "fold", "board", "skin", "places", "split",
    "field",
)  # fmt: skip
COUNTS = (
    "seed", "draw", "external_uT", "labels_n", "pokes_n", "contacts_n", "trained_on_skins_n", "trained_on_rows_n",
    "rows_n",
)  # fmt: skip
KEYS = (*NAMES, *COUNTS)  # all other columns are metrics
ALL_SKINS = ""  # value of column `skin` in joint rows, which are for all skins on which a network was tested
# Values of column `places`. In rows AS_LABELLED, predicted positions are scored without a correction. In rows
# REGISTERED, the mean error of each board, which is estimated from its labels, was first subtracted from the positions.
AS_LABELLED, REGISTERED = "as_labelled", "registered"
# Values of column `method` for networks, by experiment.
METHODS = {"lobo": "multi", "triplet": "triplet", "adapt": "adapted"}

Row = dict[str, Any]


def make_table(rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Make the table from its rows: columns `KEYS`, then metrics, and the mean and variance of the true forces.

    A name that a row lacks is "", and a count or a metric that it lacks is NaN.
    """
    rows = list(rows)
    metrics = dict.fromkeys([*METRICS, *(name for row in rows for name in row if name not in KEYS)])
    table = pd.DataFrame([dict.fromkeys(NAMES, "") | dict(row) for row in rows], columns=[*KEYS, *metrics])
    return table.astype(dict.fromkeys((*COUNTS, *metrics), float))


def write_scores(file: Path, table: pd.DataFrame) -> None:
    """Write the rows of one stage."""
    io.write_table(file, pa.Table.from_pandas(table, preserve_index=False))


def read_scores(files: Iterable[Path]) -> pd.DataFrame:
    """Read the rows of several stages into one table."""
    return join([io.read_table(file).to_pandas() for file in files])


def join(parts: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Join tables that may have different metrics."""
    metrics = dict.fromkeys([*METRICS, *(name for part in parts for name in part if name not in KEYS)])
    known = [part.dropna(axis=1, how="all") for part in parts]  # without empty columns, which change types
    return pd.concat(known or [make_table([])], ignore_index=True).reindex(columns=[*KEYS, *metrics])


# --- Rows of networks ---


def rows_of_cards(cards: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Tabulate the scores of trained networks from their model cards (see `pipeline.training.jobs.model_card`)."""
    return rows_of_networks((_keys_of_card(card), card["scores"]) for card in cards)


def rows_of_networks(scored: Iterable[tuple[Mapping[str, Any], Mapping[str, Any]]]) -> pd.DataFrame:
    """Tabulate the scores of networks.

    If each network is adapted to one skin, the networks of the same fold and seed also have a joint row for all their
    skins.

    scored: pairs of a network's keys (columns `KEYS`) and its scores, which `reskin.metrics.score_groups` returned.
    """
    rows = [row for keys, scores in scored for row in _rows(keys, scores)]
    # Joint rows by fold and seed. There are several rows for a fold and seed if each network is adapted to one skin.
    groups: dict[Hashable, list[Row]] = {}
    for row in (row for row in rows if row["skin"] == ALL_SKINS):
        groups.setdefault(tuple(row.get(key) for key in KEYS if key != "rows_n"), []).append(row)
    return make_table([*map(_pool, groups.values()), *(row for row in rows if row["skin"] != ALL_SKINS)])


def _keys_of_card(card: Mapping[str, Any]) -> Row:
    keys = {"experiment": card["question"], "fold": card["fold"], "recipe": card["recipe_name"]}
    keys |= {"seed": card["seed_i"], "method": METHODS.get(card["question"], "single")}
    keys |= {key: card["recipe"][key] for key in ("inputs", "architecture")}
    keys |= {"trained_on_skins_n": len(card["train_skins"]), "trained_on_rows_n": card["train_rows_n"]}
    tuning = card.get("tuning")
    return keys | ({"base": tuning["settings"]["base"], "pokes_n": tuning["pokes_n"]} if tuning else {})


def _rows(keys: Mapping[str, Any], scores: Mapping[str, Any]) -> list[Row]:
    """Return the rows of one network: two joint rows for all skins, and one row for each skin."""
    boards = {*scores["board_of"].values()}
    joint = {**keys, "skin": ALL_SKINS, "board": boards.pop() if len(boards) == 1 else "", "rows_n": scores["rows_n"]}
    rows = [joint | {"places": AS_LABELLED} | scores["all"], joint | {"places": REGISTERED} | scores["registered"]]
    for skin, skin_scores in scores["by_skin"].items():
        rows.append({**keys, "skin": skin, "board": scores["board_of"][skin], "places": AS_LABELLED, **skin_scores})
    return rows


def _pool(rows: Sequence[Row]) -> Row:
    """Average the scores of the networks of one fold and seed, weighted by the number of test rows of each network."""
    rows_n = np.array([row["rows_n"] for row in rows])
    known = [name for name in (*METRICS, *TRUTH) if all(name in row for row in rows)]
    parts = {name: np.array([row[name] for row in rows]) for name in known}
    scores = {name: float(np.average(values, weights=rows_n)) for name, values in parts.items()}
    if "r2_f" in parts:
        between_N2 = (parts["force_mean_N"] - scores["force_mean_N"]) ** 2
        scores["force_var_N2"] += float(np.average(between_N2, weights=rows_n))
        scores["r2_f"] = 1 - scores["mse_f_N2"] / scores["force_var_N2"]
    return {**rows[0], **scores, "rows_n": int(rows_n.sum())}


# --- Selections ---


def metrics_of(rows: pd.DataFrame) -> list[str]:
    """Return the columns of metrics that have a value in these rows."""
    return [str(name) for name in rows if name not in (*KEYS, *TRUTH) and rows[name].notna().any()]


def select(rows: pd.DataFrame, **values: str | float) -> pd.DataFrame:
    """Select the rows that have the given values in these columns."""
    for column, value in values.items():
        rows = rows[rows[column] == value]
    return rows


def whole(rows: pd.DataFrame, places: str = AS_LABELLED) -> pd.DataFrame:
    """Select the joint rows for all skins that a network was tested on, one row per network."""
    return select(rows, skin=ALL_SKINS, places=places)


def by_skin(rows: pd.DataFrame) -> pd.DataFrame:
    """Select the rows for single skins."""
    return rows[rows["skin"] != ALL_SKINS]


def to_csv(table: pd.DataFrame) -> str:
    """Return the table as CSV text with six significant digits, as in numbers.json; empty columns are left out."""
    names = [name for name in table if name not in KEYS or not table[name].isin(["", np.nan]).all()]
    return table[names].convert_dtypes().to_csv(index=False, float_format="%.6g")
