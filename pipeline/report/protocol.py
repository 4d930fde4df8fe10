"""What the paper ran, and what a scene ran: numbers of boards, skins, readings and networks, by experiment."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from pipeline import paper
from pipeline.formatting import tabulate
from pipeline.report.table_2 import Results

# What the paper ran (sections 3 to 6).
SINGLE_READINGS_N = 50_000  # section 4: "We collect a total of 50K samples"
SINGLE_TEST_N = 5_000  # section 4
BOARDS_N, SKINS_N, SKIN_INDENTATIONS_N = 6, 18, 10_000  # section 5: "~10,000 indentations each"
TRANSFER_TRAIN_N, TRANSFER_TEST_N = 3, 9  # section 5: "individually train on 3 different sensors and test on 9 other"
VARIATION_INDENTATIONS_N, VARIATION_SKINS_N = 10_000, 5  # figure 4: "five different sensors"
DRIFT_INDENTATIONS_N, DRIFT_TRAIN_N = 50_000, 5_000  # section 4
DRIFT_TEST_N = 1_000  # section 4: "test sets comprising 1000 indentations after every 5000 indentations"
SWEEP_TEST_SKINS_N = 3  # section 5: "We use data from three unseen sensors as the test set"
SPLITS = {
    "single_random": "random readings held out",
    "single_indentation": "random indentations held out",
    "single_pass": "random passes held out",
    "single_temporal": "last passes held out",
}
MEANING = (
    "The numbers in column paper are from sections 3 to 6 of the paper. The numbers in column this scene were counted "
    "in the results of this scene."
)


@dataclass(frozen=True)
class Protocol:
    """An experiment of the paper: the section of the page that shows it, and what the paper and this scene ran."""

    section: str
    experiment: str
    paper: str
    ours: str


def protocols(numbers: Results) -> list[Protocol]:
    """List the experiments of the paper that the scene ran."""
    makers: tuple[Callable[[Results], Iterator[Protocol]], ...] = (_single, _boards, _variation, _drift, _sweeps, _hand)
    return [protocol for make in makers for protocol in make(numbers)]


def protocol_table(numbers: Results, source: str) -> pd.DataFrame:
    """Tabulate what the paper ran and what this scene ran."""
    lines = [
        {"experiment": protocol.experiment, "paper": protocol.paper, "this scene": protocol.ours, "source": source}
        for protocol in protocols(numbers)
    ]
    return tabulate(lines, meaning=MEANING)


def _single(numbers: Results) -> Iterator[Protocol]:
    counted = numbers.get("protocol", {})
    papers = f"{SINGLE_READINGS_N:,} readings of one skin: a random {paper.SINGLE_TRAIN_N:,} for training, "
    papers += f"{SINGLE_TEST_N:,} for testing"
    for name in SPLITS:
        if name not in counted:
            continue
        row = counted[name]
        times = _times(row["folds_n"], "skin" if name == "single_temporal" else "split", row["seeds_n"])
        ours = f"{row['trained_on_rows_n']:,} readings of one skin for training, {row['rows_n']:,} for testing; {times}"
        yield Protocol("single", f"one skin, {SPLITS[name]}", papers if name == "single_random" else "–", ours)


def _boards(numbers: Results) -> Iterator[Protocol]:
    counted = numbers.get("protocol", {})
    if transfer := counted.get("transfer"):
        yield Protocol(
            "headline",
            "table 2, one training skin",
            f"{TRANSFER_TRAIN_N} training skins, one network for each, tested on {TRANSFER_TEST_N} other skins",
            f"{transfer['folds_n']} training skins, {_networks(transfer['seeds_n'])} for each, tested on "
            f"{transfer['skins_n']} "
            f"other skins of {transfer['boards_n']} boards",
        )
    if lobo := counted.get("lobo"):
        yield Protocol(
            "headline",
            "table 2, many training skins",
            f"{_boards_and_skins(BOARDS_N, SKINS_N)}, about {SKIN_INDENTATIONS_N:,} indentations of "
            "each; each board held out in turn",
            f"{_boards_and_skins(lobo['boards_n'], lobo['skins_n'])}, {_each_skin(numbers)}; each board held out in "
            f"turn: {_count(lobo['trained_on_skins_n'], 'training skin')}, {_networks(lobo['seeds_n'])} per board",
        )
    if "adapt" in counted and "adapt" in numbers:
        yield Protocol(
            "headline",
            "table 2, adaptation",
            f"{paper.ADAPTED_POKES_N} unlabelled indentations of the new skin",
            f"{numbers['adapt']['pokes_n']} unlabelled indentations of the new skin; "
            f"{_networks(counted['adapt']['seeds_n'])} per skin",
        )


def _each_skin(numbers: Results) -> str:
    """Write the mean number of indentations per skin, or of readings if the number of indentations is unknown."""
    described: Mapping[str, Any] = next(iter(numbers.get("described", {}).values()), {"counts": {}})
    counts, skins_n = described["counts"], numbers["protocol"]["lobo"]["skins_n"]
    for name in ("indentations", "readings"):
        if count := counts.get(f"{name}_n"):
            return f"{round(count / skins_n):,} {name} of each"
    return "with an unknown number of readings"


def _variation(numbers: Results) -> Iterator[Protocol]:
    places = numbers.get("variation", {}).get("places", [])
    if places:
        skins_n = len(places[0]["skins"]["skins"])
        yield Protocol(
            "variation",
            "figure 4",
            f"{VARIATION_INDENTATIONS_N:,} indentations of a skin; {VARIATION_SKINS_N} skins; two places",
            f"{places[0]['time']['contacts_n']:,} indentations of a skin; {skins_n} skins; {len(places)} places",
        )


def _drift(numbers: Results) -> Iterator[Protocol]:
    drift = numbers.get("drift", {})
    policy = next((name for name in ("initial", "regular", "each", "free") if name in drift), None)
    if policy is None or "unit" not in drift:
        return
    last_n = f"{drift[policy][-1]['contacts_n']:,} indentations of {_count(drift['skins_n'], 'skin')}"
    train, test, every = (_count(drift[f"{name}_n"], drift["unit"]) for name in ("train", "test", "every"))
    papers = f"{DRIFT_INDENTATIONS_N:,} indentations of one skin: trained on the first {DRIFT_TRAIN_N:,}, "
    yield Protocol(
        "drift",
        "figure 5",
        f"{papers}tested on {DRIFT_TEST_N:,} after every {DRIFT_TRAIN_N:,}",
        f"{last_n}: trained on the first {train}, tested on {test} after every {every}; "
        f"{_networks(drift['seeds_n'])} per policy of no-load readings",
    )


def _sweeps(numbers: Results) -> Iterator[Protocol]:
    if pokes := numbers.get("sweep_pokes"):
        yield Protocol(
            "pokes", "figure 6a", "subsets of the new skin's indentations, up to more than "
            f"{paper.PLATEAU_POKES_N}", f"{_listed([row['pokes_n'] for row in pokes])} indentations of the new skin",
        )  # fmt: skip
    if sensors := numbers.get("sweep_sensors"):
        counts = sorted({row["skins_n"] for row in sensors})
        yield Protocol(
            "sensors",
            "figure 6b",
            f"tested on {SWEEP_TEST_SKINS_N} skins; the numbers of training skins can only be read from the figure",
            f"{_listed(counts)} training skins; tested on {_count(sensors[0]['accuracy_pct']['n'], 'held-out board')}",
        )


def _hand(numbers: Results) -> Iterator[Protocol]:
    manual, flexible = (numbers.get(name, {}) for name in ("manual", "flexible"))
    if "skins_n" in manual:
        yield Protocol(
            "manual",
            "hand pokes",
            f"{paper.MANUAL_POKES_N} pokes of one skin",
            f"{manual['pokes_n']} pokes of {_on_boards(manual)}",
        )
    if "skins_n" in flexible:
        yield Protocol(
            "flexible",
            "flexible boards",
            "one flexible board; the number of skins is not stated",
            f"{_on_boards(flexible)}, adapted with {flexible['pokes_n']} indentations of each skin",
        )


def _on_boards(row: Mapping[str, Any]) -> str:
    skins, boards = _count(row["skins_n"], "skin"), _count(row["boards_n"], "board")
    return f"{skins} on {boards}, {_networks(row['seeds_n'])} each"


def _boards_and_skins(boards_n: int, skins_n: int) -> str:
    return f"{_count(boards_n, 'board')}, {_count(skins_n, 'skin')}"


def _count(n: int, what: str) -> str:
    plural = "es" if what.endswith("s") else "s"
    return f"{n:,} {what}" + plural * (n != 1)


def _networks(n: int) -> str:
    return _count(n, "network")


def _times(n: int, what: str, seeds_n: int) -> str:
    return f"{_count(n, what)}, {_networks(seeds_n)} each"


def _listed(counts: Sequence[int]) -> str:
    return ", ".join(f"{n:,}" for n in counts[:-1]) + f" and {counts[-1]:,}" if len(counts) > 1 else f"{counts[0]:,}"
