"""Accuracy on a later day on which the skin slides on its base in another way, with presses of both days.

`RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_days_benchmark.py` prints the tables of docs/learning.md. All
skins are simulated. Their parameters and the errors of the law (differences between the fields of a skin and those that
the simulated law predicts) are drawn as in training, with other seeds. On the later day, either nothing has changed, or
the parameters of the slide are drawn again from the prior, or these parameters and the errors of the law are drawn
again. Except in the last test, no recorded press is used.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations, product
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float

from reskin.data.grid import CENTRE_MM
from reskin.recordings.readers import lab
from reskin.seeds import rng_for
from reskin.universal import map, model
from reskin.universal.batches import ERROR_OF_NOMINAL, NOISE_uT, add_error
from reskin.universal.calibration import CalibrationData, LabelledPresses, no_labels
from reskin.universal.law import to_board, to_chips
from reskin.universal.map import NOMINAL, NOMINAL_SPREADS, SLIDE, condition_on_noload, new_map
from reskin.universal.model import calibrate_day, load_universal
from reskin.universal.population import PLACES_N, THICKNESSES, TIPS, draw_law, draw_skin
from tests.benchmarks import FULL, size
from tests.recordings.test_recordings import ingest
from tests.universal.skins import SETUP

CHOICE_SEED, SEED = 1, 2
CHOICE_SKINS_N, SKINS_N, COVERAGE_SKINS_N = 24, size(96, 1), 24
PRESSES_N, LABELS_N = size((0, 5, 12, 65), (5,)), size((0, 10, 40), (10,))
CHOICE_PRESSES_N, RECORDED_PRESSES_N = (1, 3, 12), (0, 5, 12)
# These pairs of correlations between the two days are tried. The first value is the correlation of the slide, and the
# second value is the correlation of the law's errors.
CORRELATIONS = (0.0, 0.0), (0.0, 0.5), (0.0, 0.7), (0.0, 0.85), (0.0, 1.0), (0.5, 0.7)
LOG_ODDS_MIN = -np.inf, 0.0, 2.0, 5.0, np.inf
WAYS = TOGETHER, ALONE, BY_DAY = "all presses together", "new presses alone", "by day"
UNCHANGED, CHANGED, OTHER_ERRORS = "unchanged", "changed", "changed, other errors"
NORMAL_90 = 1.645
FULL_ONLY = pytest.mark.skipif(
    not FULL, reason="at the tiny size, this test would only repeat the other test and tests/universal"
)


@dataclass(frozen=True)
class SkinOnTwoDays:
    """Presses on one skin, with equal places and forces on both days. The first `PLACES_N` presses are for calibration.

    first_uT: field changes on the first day. later_uT: field changes on the later day, for each kind of change.
    """

    rest_uT: Float[np.ndarray, " ch"]
    place_mm: Float[np.ndarray, "m 2"]
    force_N: Float[np.ndarray, " m"]
    first_uT: Float[np.ndarray, "m ch"]
    later_uT: dict[str, Float[np.ndarray, "m ch"]]


def draw_skins(skins_n: int, seed: int) -> Iterator[SkinOnTwoDays]:
    for i in range(skins_n):
        yield draw_two_days(partial(rng_for, seed, "days", i))


def draw_two_days(rng: Callable[[str], np.random.Generator]) -> SkinOnTwoDays:
    """Simulate one skin; `rng` returns the random generator of a name."""
    law, other = (draw_law(NOMINAL, NOMINAL_SPREADS, rng(name)) for name in ("law", "slide"))
    changed = replace(law, **{name: getattr(other, name) for name in SLIDE})
    thickness, tip = (float(rng("size").choice(list(sizes), p=list(sizes.values()))) for sizes in (THICKNESSES, TIPS))
    design = SETUP.design.model_copy(update={"thickness_mm": thickness * SETUP.design.thickness_mm})
    setup = replace(SETUP, design=design, tip_radius_mm=tip * SETUP.tip_radius_mm, rule=SETUP.coarse_rule)
    order = rng("order").permutation(2 * PLACES_N)
    days = {}
    for day, own, errors in (
        ("first", law, "errors"), (UNCHANGED, law, "errors"), (CHANGED, changed, "errors"),
        (OTHER_ERRORS, changed, "other errors"),
    ):  # fmt: skip
        db_uT, rest_uT, place_mm, force_N = draw_skin(own, setup, rng("skin"))
        as_batch = (values[None].astype(np.float32) for values in (db_uT, place_mm, np.log(force_N)))
        noise_uT = np.tile(NOISE_uT, len(setup.chips_mm)) * rng(day).standard_normal(db_uT.shape)
        days[day] = (add_error(*as_batch, ERROR_OF_NOMINAL, rng(errors))[0] + noise_uT)[order].astype(float)
    return SkinOnTwoDays(rest_uT, place_mm[order], force_N[order], days.pop("first"), days)


def presses(skin: SkinOnTwoDays, db_uT: np.ndarray, which: slice) -> LabelledPresses:
    return LabelledPresses(skin.place_mm[which], skin.force_N[which], db_uT[which])


TESTED = slice(PLACES_N, None)
Score = tuple[float, float]  # percentage within 1 mm, and MSE_xy in mm²


def score_place(place_mm: np.ndarray, true_mm: np.ndarray) -> Score:
    off_mm = place_mm - true_mm
    return 100 * float((np.abs(off_mm) <= 1).all(axis=1).mean()), float((off_mm**2).mean())


class TwoDays:
    """Calibrations on the later day of one skin, after a first day with `PLACES_N` presses and some labels."""

    def __init__(self, skin: SkinOnTwoDays, labels_n: int) -> None:
        shipped = load_universal()
        self.skin, self.networks = skin, shipped.networks
        self.rest_map = condition_on_noload(new_map(shipped.tables), skin.rest_uT)
        labels = presses(skin, skin.first_uT, slice(labels_n))
        unpressed = CalibrationData.at_rest(skin.rest_uT)
        self.first_data = replace(unpressed, presses_uT=skin.first_uT[:PLACES_N], labels=labels)
        self.first = calibrate_day(self.rest_map, self.networks, self.first_data, None)

    def new_data(self, change: str, n: int) -> CalibrationData:
        return replace(
            self.first_data, presses_uT=self.skin.later_uT[change][PLACES_N - n : PLACES_N], labels=no_labels()
        )

    def log_odds(self, change: str, n: int) -> float:
        return float(self.first.same_slide_log_odds(self.new_data(change, n).presses_uT).sum())

    def score(self, change: str, n: int, way: str) -> Score:
        data, last = self.new_data(change, n), self.first if way == BY_DAY else None
        if way == TOGETHER:
            data = data.joined_to(self.first_data)
        calibration = calibrate_day(self.rest_map, self.networks, data, last)
        tested = presses(self.skin, self.skin.later_uT[change], TESTED)
        (estimate,) = calibration.with_labels(calibration.data.labels).estimate(tested.db_uT, [1.0])
        return score_place(estimate.place_mm, tested.place_mm)


@FULL_ONLY
@pytest.mark.timeout(3600)
def test_correlations_and_log_odds_limit_in_use_are_nearly_optimal(monkeypatch):
    """Compare the correlations, and then the limit of the log odds above which the slide counts as unchanged.

    Days with unchanged and with changed errors of the law have equal weight.
    """
    skins = list(draw_skins(CHOICE_SKINS_N, CHOICE_SEED))
    # No log odds reach this limit, so the slide always counts as changed.
    monkeypatch.setattr(model, "SAME_SLIDE_LOG_ODDS_MIN", np.inf)
    by_pair = {}
    for pair in CORRELATIONS:
        with monkeypatch.context() as settings:
            settings.setattr(map, "SLIDE_CORRELATION", pair[0])
            settings.setattr(map, "ERROR_CORRELATION", pair[1])
            days = [TwoDays(skin, labels_n) for skin, labels_n in product(skins, LABELS_N)]
            changes = CHANGED, OTHER_ERRORS
            scores = [day.score(change, CHOICE_PRESSES_N[-1], BY_DAY) for day, change in product(days, changes)]
            by_pair[pair] = np.mean(scores, axis=0)
        print(f"correlation of slide {pair[0]:g}, of errors {pair[1]:g}: {by_pair[pair].round(3)}")
    by_limit: dict[float, list[Score]] = {limit: [] for limit in LOG_ODDS_MIN}
    for skin, labels_n in product(skins, LABELS_N):
        days = TwoDays(skin, labels_n)
        for change, n in product(skin.later_uT, CHOICE_PRESSES_N):
            same, changed = days.score(change, n, TOGETHER), days.score(change, n, BY_DAY)
            for limit, scores in by_limit.items():
                scores.append(same if days.log_odds(change, n) >= limit else changed)
    for limit, scores in by_limit.items():
        print(f"the slide is the same from log odds of {limit:g}: {np.mean(scores, axis=0).round(3)}")
    monkeypatch.undo()
    # the settings in use are the best ones, or worse by less than a percentage point
    within_pct = {pair: score[0] for pair, score in by_pair.items()}
    assert within_pct[map.SLIDE_CORRELATION, map.ERROR_CORRELATION] > max(within_pct.values()) - 1
    of_limits = {limit: np.mean(scores, axis=0)[0] for limit, scores in by_limit.items()}
    assert of_limits[model.SAME_SLIDE_LOG_ODDS_MIN] > max(of_limits.values()) - 1


@pytest.mark.timeout(3600)
def test_accuracy_on_a_later_day():
    scores: dict[tuple[str, int, int], list[tuple[Score, ...]]] = {}
    cosines: dict[str, list[np.ndarray]] = {}
    for skin in draw_skins(SKINS_N, SEED):
        for change, db_uT in skin.later_uT.items():
            product_uT2 = (db_uT * skin.first_uT).sum(axis=1)
            lengths_uT2 = np.linalg.norm(db_uT, axis=1) * np.linalg.norm(skin.first_uT, axis=1)
            cosines.setdefault(change, []).append(product_uT2 / lengths_uT2)
        by_labels_n = {labels_n: TwoDays(skin, labels_n) for labels_n in LABELS_N}
        for change, n in product(skin.later_uT, PRESSES_N):
            alone = by_labels_n[LABELS_N[0]].score(change, n, ALONE)
            for labels_n, days in by_labels_n.items():
                together = days.score(change, n, TOGETHER)
                same = days.log_odds(change, n) >= model.SAME_SLIDE_LOG_ODDS_MIN
                # If `same` is true, calibration by day uses all presses together.
                by_day = together if same else days.score(change, n, BY_DAY)
                scores.setdefault((change, labels_n, n), []).append((together, alone, by_day))
    for change, of_skins in cosines.items():
        print(f"cosine of equal presses, slide {change}: 5, 50, 95 % quantiles {np.percentile(of_skins, [5, 50, 95])}")
    print(
        f"| slide | labels | new presses | {TOGETHER} | {ALONE} | {BY_DAY} | {BY_DAY} minus the better of the others |"
    )
    print("|---|---|---|---|---|---|---|")
    for change, labels_n, n in sorted(scores, key=lambda row: (list(cosines).index(row[0]), *row[1:])):
        of_ways = np.array(scores[change, labels_n, n])
        cells = [f"{within:.1f} / {mse:.2f}" for within, mse in of_ways.mean(axis=0)]
        gains = []
        for i, sign in enumerate((1, -1)):
            better = (sign * of_ways[:, :2, i].mean(axis=0)).argmax()
            gain = of_ways[:, 2, i] - of_ways[:, better, i]
            gains.append(f"{gain.mean():+.2f} ± {gain.std() / np.sqrt(len(gain)):.2f}")
        print(f"| {change} | {labels_n} | {n} | {' | '.join(cells)} | {' / '.join(gains)} |")
    for (change, labels_n, _), of_skins in scores.items():
        if change == CHANGED and labels_n:
            together, alone, by_day = np.mean(of_skins, axis=0)[:, 0]
            assert by_day > max(together, alone)


@FULL_ONLY
@pytest.mark.timeout(3600)
def test_interval_coverage_and_force_errors_on_a_later_day(tmp_path):
    n, file = 12, tmp_path / "first.safetensors"
    scores: dict[tuple[str, int, str], list[tuple[float, float, float]]] = {}
    for skin, labels_n in product(draw_skins(COVERAGE_SKINS_N, SEED), LABELS_N):
        rest_uT, centre_mm = to_chips(skin.rest_uT[None]), load_universal().layout.centre_mm
        b_uT = to_chips(skin.first_uT[:PLACES_N]) + rest_uT
        first = load_universal().zero(rest_uT, turned=False).see(b_uT)
        if labels_n:
            first.label(skin.place_mm[:labels_n] + centre_mm, skin.force_N[:labels_n], b_uT[:labels_n])
        first.save(file)
        for change, way in product(skin.later_uT, WAYS):
            later_uT = to_chips(skin.later_uT[change]) + rest_uT
            if way == ALONE:
                later = load_universal().zero(rest_uT, turned=False)
            else:
                later = load_universal(file, new_day=way == BY_DAY).zero(rest_uT, keep=True)
            found = later.see(later_uT[PLACES_N - n : PLACES_N]).estimate(later_uT[TESTED])
            off_mm = np.abs(found.place_mm - centre_mm - skin.place_mm[TESTED])
            off_log = np.log(found.force_N / skin.force_N[TESTED])
            covered = float((off_mm <= NORMAL_90 * found.sd_mm).mean())
            force_covered = float((np.abs(off_log) <= NORMAL_90 * found.sd_log_N).mean())
            scores.setdefault((change, labels_n, way), []).append((covered, force_covered, float((off_log**2).mean())))
    print(
        "| slide | labels | way | place in 90 % interval, % | force in 90 % interval, % | force wrong by a factor of |"
    )
    print("|---|---|---|---|---|---|")
    for row, of_skins in sorted(scores.items()):
        place, force, square = np.mean(of_skins, axis=0)
        cells = " | ".join(str(cell) for cell in row)
        print(f"| {cells} | {100 * place:.0f} | {100 * force:.0f} | {np.exp(np.sqrt(square)):.2f} |")
    for change, labels_n in product((CHANGED, OTHER_ERRORS), LABELS_N):
        together, by_day = (np.mean(scores[change, labels_n, way], axis=0)[0] for way in (TOGETHER, BY_DAY))
        assert abs(by_day - 0.9) < abs(together - 0.9)


def read_depth(file: Path, folder: Path) -> tuple[np.ndarray, LabelledPresses]:
    """Return the no-load field and the means of all presses of one depth, along the board's axes and in its frame."""
    rows, _ = ingest(lab, file, folder)
    place_mm = np.column_stack([rows.x_mm - CENTRE_MM, CENTRE_MM - rows.y_mm]).astype(float)
    parts = place_mm, rows.Fz_N.astype(float), to_board(rows.b_uT.astype(float) - rows.noload_uT)
    means = [part.reshape(PLACES_N, -1, *part.shape[1:]).mean(axis=1) for part in parts]
    return to_board(rows.noload_uT.mean(axis=0)[None].astype(float))[0], LabelledPresses(*means)


@FULL_ONLY
@pytest.mark.timeout(3600)
def test_accuracy_if_recorded_depths_are_used_as_days(shared_data, tmp_path):
    """Use recordings at one depth as the first day, and recordings at another depth as the later day.

    These recordings are not from different days, so this does not test a change from day to day. Labels are at tested
    places. No setting was chosen on these recordings.
    """
    scores: dict[tuple[int, int, str], list[Score]] = {}
    odds = []
    for name in ("board1", "board2"):
        order = rng_for(SEED, "recorded", name).permutation(PLACES_N)
        files = [shared_data / "lab" / f"{name}_depth{depth}.csv" for depth in (1, 2, 3)]
        rests_uT, depths = zip(*(read_depth(file, tmp_path) for file in files), strict=True)
        depths, place_mm = [presses[order] for presses in depths], depths[0].place_mm[order]
        np.testing.assert_allclose([presses.place_mm for presses in depths], [place_mm] * len(depths), atol=1e-9)
        new_n = max(RECORDED_PRESSES_N)
        # The last `new_n` presses are not tested on the later day.
        presses_i = np.concatenate([np.arange(PLACES_N), np.arange(PLACES_N - new_n)])
        for first, later in permutations([presses[presses_i] for presses in depths], 2):
            skin = SkinOnTwoDays(
                np.mean(rests_uT, axis=0), first.place_mm, first.force_N, first.db_uT, {CHANGED: later.db_uT}
            )
            for labels_n in LABELS_N:
                days = TwoDays(skin, labels_n)
                odds.append(days.log_odds(CHANGED, new_n))
                for n, way in product(RECORDED_PRESSES_N, WAYS):
                    scores.setdefault((labels_n, n, way), []).append(days.score(CHANGED, n, way))
    print(f"log odds of the same slide from {new_n} presses: {np.round(odds, 1).tolist()}")
    print(f"| labels | new presses | {' | '.join(WAYS)} |\n|---|---|---|---|---|")
    for labels_n, n in product(LABELS_N, RECORDED_PRESSES_N):
        means = [np.mean(scores[labels_n, n, way], axis=0) for way in WAYS]
        print(f"| {labels_n} | {n} | {' | '.join(f'{within:.1f} / {mse:.2f}' for within, mse in means)} |")
        if labels_n:  # labels of the first depth must improve the estimates
            assert means[WAYS.index(BY_DAY)][0] > means[WAYS.index(ALONE)][0]
