"""External fields on a moving hand: contacts and places of the universal model with and without `external_uT`.

Run `RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_moving_benchmark.py`, two minutes of processor time.

Three sources are used, and never mixed without saying so. *Simulated*: skins from the prior, fields of simulated
magnets. *Recorded*: field changes of AnySkin pads on a hand that moves without contact (data/leaphand; the pads are
boards like the paper's, whose chips are in another order). *Superposition*: recorded presses of the boards of scene
lab, plus recorded changes of the hand. It contains the noise of both recordings, and no effect of a press on the hand.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.experiments.random_presses import CHECKERBOARD, BoardPresses, draw_presses, raise_forces
from pipeline.training.universal import AS_TRAINED, LAW_ERRORS, draw_prior_skins, split_presses
from reskin.data.contact import CONTACT_SDS
from reskin.data.grid import CENTRE_MM
from reskin.physics import external
from reskin.recordings.readers import lab
from reskin.seeds import rng_for
from reskin.universal.batches import SkinPrior
from reskin.universal.calibration import CalibrationData, LabelledPresses
from reskin.universal.force import NORMAL_90
from reskin.universal.law import CHIPS_MM, to_board, to_chips
from reskin.universal.map import NOMINAL, NOMINAL_SPREADS, new_map
from reskin.universal.model import CalibratedModel, Evaluation, PriorModel, Universal, load_universal
from tests.benchmarks import FULL, size
from tests.recordings.test_recordings import ingest
from tests.universal.skins import SETUP

SEED, POWER = 2021, 0.5  # the power affects only standard deviations, which are not reported
ORDER = [0, 3, 2, 4, 1]  # chips of a pad in the order of the paper's board, from the rotations of their axes
STILL_N = 5  # rows of a recording whose mean is the no-load field
DETECTED = 0.99  # fraction of touches above the threshold, in the recording that determines the threshold


@dataclass(frozen=True)
class Hand:
    """Changes of the field at the pads since the no-load field, along the chips' axes, and joint positions (counts)."""

    db_uT: np.ndarray  # [f pads 15]
    joints: np.ndarray  # [f j]
    noise_uT: float  # rms of the still rows about their mean


def read_hand(shared_data: Path, name: str) -> Hand:
    """Read a recording of the hand; with one skin or none, its first row was recorded before the first movement."""
    rows = np.loadtxt(shared_data / "leaphand" / f"{name}.txt")
    channels_n, first = (60, 0) if rows.shape[1] == 76 else (30, 1)
    b_uT = (
        rows[first:, :channels_n].reshape(len(rows) - first, -1, 5, 3)[:, :, ORDER].reshape(len(rows) - first, -1, 15)
    )
    still_uT = b_uT[:STILL_N]
    noise_uT = float(np.sqrt(still_uT.var(axis=0, ddof=1).mean()))
    return Hand((b_uT - still_uT.mean(axis=0))[STILL_N:], rows[first + STILL_N :, channels_n:], noise_uT)


def boards(shared_data: Path, folder: Path) -> dict[str, BoardPresses]:
    """Return the presses of the boards of scene lab: fields along the chips' axes, places in the board's frame."""
    found = {}
    depths = size((1, 2, 3), (1, 2))
    for board in size(("board1", "board2"), ("board1",)):
        presses, readings, rest_uT = [], [], []
        for depth in depths:
            one, _ = ingest(lab, shared_data / "lab" / f"{board}_depth{depth}.csv", folder)
            db_uT = (one.b_uT - one.noload_uT).astype(float)
            place_mm = np.column_stack([one.x_mm - CENTRE_MM, CENTRE_MM - one.y_mm]).astype(float)
            readings.append((place_mm, one.Fz_N.astype(float), db_uT))
            presses.append([part.reshape(65, 100, *part.shape[1:]).mean(axis=1) for part in readings[-1]])
            rest_uT.append(one.noload_uT.mean(axis=0))
        parts = [
            LabelledPresses(*(np.concatenate(part) for part in zip(*of, strict=True))) for of in (presses, readings)
        ]
        found[board] = BoardPresses(
            board, np.mean(rest_uT, axis=0), *parts, np.repeat(np.arange(65 * len(depths)), 100)
        )
    return found


@pytest.fixture(scope="module")
def lab_boards(shared_data, tmp_path_factory) -> dict[str, BoardPresses]:
    return boards(shared_data, tmp_path_factory.mktemp("lab"))


def magnets_uT(distance_mm: float, sd_uT: float, n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw fields of magnets at this distance from the board's centre, along the board's axes: [n, 15]."""
    cov = external.covariance(np.array(CHIPS_MM), sd_uT, distance_mm)
    return rng.multivariate_normal(np.zeros(15), cov, n, method="eigh")


FIELDS: Mapping[str, Callable[[int, np.random.Generator], np.ndarray]] = {
    "none": lambda n, rng: np.zeros((n, 15)),
    "uniform, 30 uT": lambda n, rng: magnets_uT(1e5, 30.0, n, rng),
    "magnets at 80 mm, 30 uT": lambda n, rng: magnets_uT(80.0, 30.0, n, rng),
    "magnets at 40 mm, 140 uT": lambda n, rng: magnets_uT(40.0, 140.0, n, rng),
    "magnets at 60 mm, 140 uT": lambda n, rng: magnets_uT(60.0, 140.0, n, rng),
}
NETWORKS = ("reading as it is", "mean over chips removed", "left out", "expected external field removed")


def with_networks(model: CalibratedModel, found: Evaluation, db_uT: np.ndarray, networks: str) -> Evaluation:
    """Replace the networks' estimates by those of one of the ways `NETWORKS`."""
    own = found.network
    if networks == "left out":
        nothing = np.full_like(own.sd_mm, 1e6)
        own = replace(own, sd_mm=nothing, sd_log_N=nothing[:, 0])
    elif networks == "reading as it is":
        own = model.evaluate_networks(db_uT)
    elif networks == "mean over chips removed":
        chips_uT = db_uT.reshape(len(db_uT), 5, 3)
        own = model.evaluate_networks((chips_uT - chips_uT.mean(axis=1, keepdims=True)).reshape(db_uT.shape))
    return replace(found, network=own)


def test_networks_and_distance_on_simulated_skins():
    """Compare what the networks receive, and distances of the assumed magnets; this decided both."""
    skins_n, shipped = size(24, 1), load_universal()
    prior = SkinPrior("nominal", NOMINAL, NOMINAL_SPREADS, SETUP)
    skins = draw_prior_skins(prior, skins_n, SEED, "external fields", LAW_ERRORS[AS_TRAINED])
    variants = [(0.0, external.DISTANCE_MM, NETWORKS[0])]
    variants += [(sd_uT, external.DISTANCE_MM, networks) for sd_uT in (30.0, 140.0) for networks in NETWORKS]
    variants += [
        (sd_uT, distance_mm, NETWORKS[3]) for sd_uT in (30.0, 140.0) for distance_mm in (40.0, 60.0, 80.0, 1e5)
    ]
    print(f"\nSIMULATED, {skins_n} skins: % within 1 mm / MSE_xy in mm2; columns: {', '.join(FIELDS)}")
    within = {}
    for sd_uT, distance_mm, networks in size(variants, variants[:3]):
        cov = external.covariance(np.array(CHIPS_MM), sd_uT, distance_mm) if sd_uT else None
        prior_model = PriorModel(new_map(shipped.tables, external_cov=cov), shipped.networks)
        scores = np.zeros((2, len(FIELDS), skins_n, 2))
        for i in range(skins_n):
            pool, tested = split_presses(skins, i, SEED)
            calibration = prior_model.calibrate(CalibrationData(skins.rest_uT[i].astype(float), pool.db_uT))
            for row, labels_n in enumerate((0, 10)):
                model = calibration.with_labels(raise_forces(pool[:labels_n]))
                for column, draw in enumerate(FIELDS.values()):
                    db_uT = tested.db_uT + draw(len(tested), rng_for(SEED, "fields", i, column))
                    found = with_networks(model, model.evaluate(db_uT), db_uT, networks).combined(POWER)
                    scores[row, column, i] = place_scores(found.place_mm - tested.place_mm)
        for labels_n, row in zip((0, 10), scores.mean(axis=2), strict=True):
            within[sd_uT, distance_mm, networks, labels_n] = row[:, 0]
            cells = "  ".join(f"{pct:5.1f} / {mse:.2f}" for pct, mse in row)
            name = f"external_uT {sd_uT:3.0f}, magnets at {distance_mm:6.0f} mm, networks: {networks}"
            print(f"{labels_n:2} labels, {name:82} {cells}")
    if FULL:  # with magnets nearby, the option is better; without external fields, it is worse
        on = within[140.0, external.DISTANCE_MM, NETWORKS[3], 0]
        off = within[0.0, external.DISTANCE_MM, NETWORKS[0], 0]
        assert on[3] > off[3]
        assert on[0] < off[0]


def test_coverage_on_simulated_skins():
    """Compute the coverage of 90 % intervals, in fields of magnets that have the expected size.

    `POWER_uT` and `POWER_PER_LABEL_uT` were chosen on other skins, with the name "external powers".
    """
    skins_n = size(24, 1)
    prior = SkinPrior("nominal", NOMINAL, NOMINAL_SPREADS, SETUP)
    skins = draw_prior_skins(prior, skins_n, SEED, "external powers, test", LAW_ERRORS[AS_TRAINED])
    print(f"\nSIMULATED, {skins_n} skins, magnets at 60 mm: coverage of 90 % intervals")
    for sd_uT in size((0.0, 10.0, 30.0, 70.0, 140.0, 300.0), (0.0, 30.0)):
        for labels_n in size((0, 10, 40), (10,)):
            covered = []
            for i in range(skins_n):
                pool, tested = split_presses(skins, i, SEED)
                model = load_universal(external_uT=sd_uT).zero(to_chips(skins.rest_uT[i][None].astype(float)))
                model.see(model.noload_uT + to_chips(pool.db_uT))
                if labels_n:
                    labels = raise_forces(pool[:labels_n])
                    labelled_uT = model.noload_uT + to_chips(labels.db_uT)
                    model.label(labels.place_mm + CENTRE_MM, labels.force_N, labelled_uT)
                external_uT = magnets_uT(60.0, sd_uT, len(tested), rng_for(SEED, "coverage", i))
                found = model.estimate(model.noload_uT + to_chips(tested.db_uT + external_uT))
                error_mm = np.abs(found.place_mm - CENTRE_MM - tested.place_mm)
                covered.append(100 * float((error_mm <= NORMAL_90 * found.sd_mm).mean()))
            print(f"external_uT {sd_uT:3.0f}, {labels_n:2} labels: {np.mean(covered):.0f} %")
            assert not FULL or 84 < np.mean(covered) < 96


def place_scores(error_mm: np.ndarray) -> tuple[float, float]:
    return 100 * float((np.abs(error_mm) <= 1).all(axis=1).mean()), float((error_mm**2).mean())


PADS = {  # name: recording for the threshold, tested recording, pads
    "alone": ("0skin", "1skinnocontact", [0, 1]),
    "with neighbours": ("fullnocontact1", "fullnocontact2", [1, 2, 3]),
}
OPTIONS_uT = (0.0, 30.0, 100.0, 140.0)


def test_distance_of_magnets_on_recordings(shared_data):
    """Print the most likely distance and size of external fields, by recording (`DISTANCE_MM`)."""
    found = {}
    for name in ("fullnocontact1", "fullnocontact2", "0skin", "1skinnocontact"):
        hand, pads = read_hand(shared_data, name), PADS["with neighbours" if name.startswith("full") else "alone"][2]
        db_uT = to_board(hand.db_uT[:, pads].reshape(-1, 15))
        second_uT2 = db_uT.T @ db_uT / len(db_uT)
        likelihoods = {}
        for distance_mm in (30.0, 35.0, 40.0, 45.0, 50.0, 60.0, 70.0, 85.0, 100.0, 150.0, 300.0):
            unit = external.covariance(np.array(CHIPS_MM), 1.0, distance_mm)
            for sd_uT in (5.0, 7.0, 10.0, 14.0, 20.0, 30.0, 50.0, 70.0, 100.0, 140.0, 200.0, 280.0):
                cov = sd_uT**2 * unit + hand.noise_uT**2 * np.eye(15)
                deviance = np.linalg.slogdet(cov)[1] + np.trace(np.linalg.solve(cov, second_uT2))
                likelihoods[distance_mm, sd_uT] = -len(db_uT) / 2 * deviance
        found[name] = max(likelihoods, key=lambda pair: likelihoods[pair])
    print("\nRECORDED, most likely distance / mm and size / uT:", found)
    assert found["fullnocontact1"][1] > found["0skin"][1]


def test_false_contacts(shared_data, lab_boards):
    """Count false contacts of recorded changes, and detected touches of superpositions."""
    touches_uT = np.concatenate([board.readings.db_uT[::20] for board in lab_boards.values()])
    sizes_uT = np.percentile(np.linalg.norm(touches_uT, axis=1), [1, 50])
    print(f"\n|dB| of touches: 1 % below {sizes_uT[0]:.0f} uT, median {sizes_uT[1]:.0f} uT")
    noise_uT = read_hand(shared_data, "fullnocontact1").noise_uT
    print(f"noise of the hand's pads at rest: {noise_uT:.2f} uT")
    false_pct = {}
    for where, (first, second, pads) in PADS.items():
        hands = [read_hand(shared_data, name) for name in (first, second)]
        changes_uT = [hand.db_uT[:, pads] for hand in hands]
        for name, uT in zip((first, second), changes_uT, strict=True):
            lengths_uT = np.linalg.norm(uT, axis=2)
            lengths = f"median {np.median(lengths_uT):.0f}, largest {lengths_uT.max():.0f} uT"
            print(f"{where}, {name}: |dB| without contact, {lengths}")
        methods = {f"external_uT {sd_uT:.0f}": (sd_uT, changes_uT) for sd_uT in OPTIONS_uT}
        half = len(changes_uT[1]) // 2
        for model in ("ridge", "boosting"):
            other = compensate(model, hands[0].joints, changes_uT[0], hands[1].joints) if where != "alone" else None
            own = compensate(model, hands[1].joints[:half], changes_uT[1][:half], hands[1].joints)
            for trained, predicted in (("the other recording", other), ("the first half", own)):
                if predicted is not None:
                    rest_uT = changes_uT[1] - predicted
                    halves_uT = [rest_uT[:half], rest_uT[half:]]
                    methods[f"{model} from joints, trained on {trained}"] = (0.0, halves_uT)
                    methods[f"{model}, trained on {trained}, external_uT 30"] = (30.0, halves_uT)
        for name, (sd_uT, (threshold_uT, tested_uT)) in methods.items():
            matrix = external.suppressor(external.covariance(np.array(CHIPS_MM), sd_uT), noise_uT)
            strengths = lambda uT, matrix=matrix: np.linalg.norm(to_board(uT.reshape(-1, 15)) @ matrix, axis=1)  # noqa: E731
            live_uT = noise_uT * (np.sqrt(15) + CONTACT_SDS)
            cells = [f"live threshold: {100 * (strengths(tested_uT) > live_uT).mean():5.1f} false"]
            false_pct[where, name] = 100 * (strengths(tested_uT) > live_uT).mean()
            for scale in (1.0, 0.3):
                superposed = [strengths(superpose(scale * touches_uT, uT)) for uT in (threshold_uT, tested_uT)]
                limit_uT = np.quantile(superposed[0], 1 - DETECTED)
                false, found = (100 * (each > limit_uT).mean() for each in (strengths(tested_uT), superposed[1]))
                cells.append(
                    f"touches x {scale:g}: {100 * (superposed[1] > live_uT).mean():5.1f} detected; threshold for "
                    f"{DETECTED:.0%} ({limit_uT:3.0f} uT): {false:5.1f} false, {found:5.1f} detected"
                )
            print(f"{where:16} {name:52} {' | '.join(cells)}")
    assert false_pct["with neighbours", "external_uT 140"] < false_pct["with neighbours", "external_uT 0"]
    assert false_pct["alone", "external_uT 30"] < false_pct["alone", "external_uT 0"]


def superpose(touches_uT: np.ndarray, changes_uT: np.ndarray) -> np.ndarray:
    """Add a recorded change of the hand, drawn at random, to each recorded touch."""
    flat_uT = changes_uT.reshape(-1, 15)
    return touches_uT + flat_uT[rng_for(SEED, "superpose", len(flat_uT)).integers(len(flat_uT), size=len(touches_uT))]


def compensate(model: str, joints: np.ndarray, change_uT: np.ndarray, tested: np.ndarray) -> np.ndarray:
    """Learn field changes [f pads 15] from joint positions; return predictions for tested positions."""
    from sklearn.ensemble import HistGradientBoostingRegressor
    from sklearn.linear_model import RidgeCV
    from sklearn.multioutput import MultiOutputRegressor
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    moving = joints.std(axis=0) > 5  # counts; other joints only have noise
    if model == "ridge":
        learner = make_pipeline(
            StandardScaler(), PolynomialFeatures(2), StandardScaler(), RidgeCV(np.logspace(-2, 4, 13))
        )
    else:
        learner = MultiOutputRegressor(HistGradientBoostingRegressor(max_iter=size(100, 2), random_state=0))
    learner.fit(joints[:, moving], change_uT.reshape(len(change_uT), -1))
    return learner.predict(tested[:, moving]).reshape(len(tested), *change_uT.shape[1:])


def test_places_on_recorded_boards(shared_data, lab_boards):
    """Estimate places of superpositions: recorded presses plus uniform fields, or plus recorded changes of the hand."""
    hand_uT = {
        where: read_hand(shared_data, second).db_uT[:, pads].reshape(-1, 15)
        for where, (_, second, pads) in PADS.items()
    }
    draws_n = size(10, 1)
    print(f"\nmean of both boards, {draws_n} draws: % within 1 mm / MSE_xy in mm2 / force factor / % of 90 % intervals")
    within = {}
    for labels_n in (0, 10):
        for sd_uT in (0.0, 30.0, 140.0):
            for field in ("none", "uniform, up to 50 uT", *(f"hand, pad {where}" for where in PADS)):
                scores = [
                    score_draw(board, sd_uT, field, hand_uT, labels_n, draw_i)
                    for board in lab_boards.values()
                    for draw_i in range(draws_n)
                ]
                pct, mse, factor, covered = np.mean(scores, axis=0)
                within[field, sd_uT, labels_n] = pct
                scores_text = f"{pct:5.1f} / {mse:5.2f} / {factor:.2f} / {covered:.0f}"
                print(f"{labels_n:2} labels, external_uT {sd_uT:3.0f}, {field:26} {scores_text}")
    if FULL:
        for labels_n in (0, 10):
            on, off = (within["hand, pad with neighbours", sd_uT, labels_n] for sd_uT in (140.0, 0.0))
            assert on > off


def score_draw(
    board: BoardPresses, sd_uT: float, field: str, hand_uT: Mapping[str, np.ndarray], labels_n: int, draw_i: int
) -> tuple[float, float, float, float]:
    """Calibrate to 65 presses at random places without external field; score readings in external fields."""
    draw = draw_presses(board, CHECKERBOARD, 65, SEED, draw_i)
    model: Universal = load_universal(external_uT=sd_uT).zero(board.rest_uT)
    model.see(board.rest_uT + board.presses.db_uT[draw.unlabelled], area=True)
    if labels_n:
        labels = raise_forces(board.presses[draw.labels[:labels_n]])
        model.label(labels.place_mm + CENTRE_MM, labels.force_N, board.rest_uT + labels.db_uT)
    rng = rng_for(SEED, "moving", board.board, draw_i)
    tested = board.readings[rng.choice(draw.tested, size(500, 20), replace=False)]
    n = len(tested)
    if field == "none":
        change_uT = np.zeros((n, 15))
    elif field.startswith("uniform"):
        direction = rng.standard_normal((n, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        change_uT = to_chips(np.tile(rng.uniform(0, 50, (n, 1)) * direction, 5))
    else:
        recorded_uT = hand_uT[field.removeprefix("hand, pad ")]
        change_uT = recorded_uT[rng.integers(len(recorded_uT), size=n)]
    found = model.estimate(board.rest_uT + tested.db_uT + change_uT)
    factor = float(np.exp(np.abs(np.log(found.force_N / tested.force_N)).mean()))
    error_mm = found.place_mm - CENTRE_MM - tested.place_mm
    covered = 100 * float((np.abs(error_mm) <= NORMAL_90 * found.sd_mm).mean())
    return *place_scores(error_mm), factor, covered
