"""Stage touches: recordings of numbered places, one touched or two -> which place, which force, one or two (section 7).

Places have no millimetres here, so none is asked. Each place was recorded once: by time means that its first part is
known, which tells recordings apart as well; what is leak-free is asked of recordings that were never seen. Refuses to
know millimetres and simulated skins.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float32
from pydantic import Field, model_validator

from pipeline.experiments.answer import write_answer
from pipeline.experiments.touches import fields
from pipeline.experiments.touches.recordings import Blocks, Touched, in_blocks, joined, sort_recordings, touched
from pipeline.report.statistics import statistic
from pipeline.settings import Settings
from pipeline.stage import say
from reskin import io
from reskin.config import Strict
from reskin.data.rows import Selection
from reskin.models.classical import Ridge, fit
from reskin.seeds import rng_for

Fraction = Annotated[float, Field(gt=0, lt=1)]
LINEAR = Ridge(inputs="raw", method="ridge", alpha=1.0)  # of force
SUMS_N = 100  # sums of two single touches, of each pair of places, drawn


class Touches(Strict):
    """How a recording is cut by time, and how many single touches a threshold may call two."""

    train_fraction: Fraction
    aside_fraction: Fraction
    false_alarm_fraction: Fraction

    @model_validator(mode="after")
    def _something_is_left(self) -> "Touches":
        if self.train_fraction + self.aside_fraction >= 1:
            raise ValueError("train_fraction and aside_fraction leave rows to test: together less than 1")
        return self


def read(settings: Settings) -> Touches:
    """Read section touches."""
    return settings.section(Touches, "touches")


def of_places(blocks: Sequence[Blocks], double: Sequence[Touched]) -> dict[str, Any]:
    """Name the place of single touches by time, and of two touches: is the answer one of both?"""
    known_uT, numbers = joined([one.train for one in blocks])
    right_pct = [
        100 * float(fields.is_one_of(fields.name_places(known_uT, numbers, part.db_uT), part.places).mean())
        for part in [*(one.test for one in blocks), *double]
    ]
    singles_n = len(blocks)
    told = {
        "by_time": statistic(right_pct[:singles_n]) | {"chance_pct": 100 / singles_n},
        "by_place": {str(one.test.places[0]): pct for one, pct in zip(blocks, right_pct, strict=False)},
    }
    if not double:
        return told
    return told | {"one_of_two": statistic(right_pct[singles_n:]) | {"chance_pct": 200 / singles_n}}


def of_forces(blocks: Sequence[Blocks], rng: np.random.Generator) -> dict[str, Any]:
    """Fit force to fields of single touches: tested later in the same recordings, and in recordings left out."""
    by_time = [_force_error(blocks, one.test, rng) for one in blocks]
    left_out = [_force_error([other for other in blocks if other is not one], one.test, rng) for one in blocks]
    spread = [{"mse_f_N2": float(one.test.force_N.var(dtype=np.float64))} for one in blocks]
    ways = {"by_time": by_time, "place_left_out": left_out, "variance": spread}
    return {way: statistic([row["mse_f_N2"] for row in rows]) for way, rows in ways.items()}


def _force_error(known: Sequence[Blocks], asked: Touched, rng: np.random.Generator) -> dict[str, float]:
    train = [one.train for one in known]
    target = np.full((sum(len(part.force_N) for part in train), 3), np.nan, np.float32)
    target[:, 2] = np.concatenate([part.force_N for part in train])
    fitted = fit(LINEAR, np.concatenate([part.db_uT for part in train]), target, rng, weight=None)
    error_N = fitted.predict(asked.db_uT)[:, 2].astype(np.float64) - asked.force_N
    return {"mse_f_N2": float((error_N**2).mean())}


def of_superposition(blocks: Sequence[Blocks], double: Sequence[Touched]) -> dict[str, Any]:
    """Explain two touches by the directions of single ones, beside what these leave of single touches themselves."""
    known = fields.directions(*joined([one.train for one in blocks]))
    own_pct = [100 * float(np.median(fields.left_over(known, one.test.places, one.test.db_uT))) for one in blocks]
    pairs = [fields.explain_pair(known, (one.places[0], one.places[1]), one.db_uT) for one in double]
    return {"single_touches_pct": statistic(own_pct), "pairs": pairs} | {
        f"mean_{name}": statistic([pair[name] for pair in pairs])
        for name in ("left_over_pct", "stronger_alone_pct", "other_pairs_pct")
        if pairs
    }


def of_detection(blocks: Sequence[Blocks], double: Sequence[Touched], section: Touches, seed: int) -> dict[str, Any]:
    """Tell two touches from one at a set share of false alarms; with the two controls that say what was told."""
    known_uT, numbers = joined([one.train for one in blocks])
    known = fields.directions(known_uT, numbers)

    def scored(parts: Sequence[Float32[np.ndarray, "_ ch"]]) -> fields.Scores:
        return fields.oddness(known_uT, known, np.concatenate(parts))

    limits = fields.limits_of(scored([one.aside.db_uT for one in blocks]), section.false_alarm_fraction)
    single = scored([one.test.db_uT for one in blocks])
    sums = scored(sums_of(blocks, rng_for(seed, "touches", "sums")))
    told = {
        "false_alarm_asked_pct": 100 * section.false_alarm_fraction,
        "false_alarm_pct": fields.called_pct(single, limits),
        "sums_called_two_pct": fields.called_pct(sums, limits),
        "unseen_place_called_two_pct": of_unseen_places(blocks, section.false_alarm_fraction),
    }
    if not double:
        return told
    both = scored([one.db_uT for one in double])
    return told | {"detected_pct": fields.called_pct(both, limits), "auc": fields.areas(single, both)}


def sums_of(blocks: Sequence[Blocks], rng: np.random.Generator) -> list[Float32[np.ndarray, "_ ch"]]:
    """Add tested single touches of each two places, as question contacts does of boards without two touches."""
    tested = [one.test.db_uT for one in blocks]
    drawn = [
        (a_uT[rng.integers(len(a_uT), size=SUMS_N)], b_uT[rng.integers(len(b_uT), size=SUMS_N)])
        for i, a_uT in enumerate(tested)
        for b_uT in tested[i + 1 :]
    ]
    return [a_uT + b_uT for a_uT, b_uT in drawn]


def of_unseen_places(blocks: Sequence[Blocks], false_alarm_fraction: float) -> dict[str, float]:
    """Call two what is one: single touches of each place, by detectors that know all other places; mean over places."""
    called = []
    for one in blocks:
        others = [other for other in blocks if other is not one]
        known_uT, numbers = joined([other.train for other in others])
        known = fields.directions(known_uT, numbers)
        aside = fields.oddness(known_uT, known, joined([other.aside for other in others])[0])
        limits = fields.limits_of(aside, false_alarm_fraction)
        called.append(fields.called_pct(fields.oddness(known_uT, known, one.test.db_uT), limits))
    return {name: float(np.mean([row[name] for row in called])) for name in called[0]}


def touches(settings: Settings, indentations: Path, answer: Path) -> None:
    """Answer what can be asked of touches at numbered places."""
    section, selection = read(settings), settings.section(Selection, "selection")
    sources = [indentations / f"{name}.parquet" for name in settings.captures_in(indentations)]
    found = sort_recordings(touched(io.read_readings(file), io.read_account(file), selection) for file in sources)
    single, double = found.single, found.double
    counts = {
        "force_min_N": selection.force_min_N,
        "single": {"recordings_n": len(single), "rows_n": sum(len(one.db_uT) for one in single)},
        "double": {"recordings_n": len(double), "rows_n": sum(len(one.db_uT) for one in double)},
        "left_out": found.left_out,
    }
    for name, reason in found.left_out.items():
        say(f"{settings.scene}: warning: {name} left out: {reason}")
    if found.problem:
        write_answer(answer, counts | {"not_computed": found.problem}, {})
        say(f"{settings.scene}: warning: touches not computed: {found.problem}")
        return
    blocks = [in_blocks(one, section.train_fraction, section.aside_fraction) for one in single]
    numbers = counts | {
        "tested_rows_n": sum(len(one.test.db_uT) for one in blocks),
        "place": of_places(blocks, double),
        "force": of_forces(blocks, rng_for(settings.seed, "touches", "force")),
        "superposition": of_superposition(blocks, double),
        "detection": of_detection(blocks, double, section, settings.seed),
    }
    write_answer(answer, numbers, {})
    say(f"{settings.scene}: {len(single)} recordings of one place, {len(double)} of two")
