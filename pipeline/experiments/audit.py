"""Audit: check that no information about test rows leaked into training.

The audit checks the folds (divisions into training and test rows), the networks and the choice of settings. The stage
fails if it finds a leak.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from jaxtyping import Float, Float32, Int

from pipeline.experiments.results import write_results
from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.training.choice import settings_of, without_budget
from pipeline.training.jobs import SceneData, read_data
from reskin import io
from reskin.config import Strict, parse
from reskin.data.rows import Rows
from reskin.data.splits import Fold
from reskin.errors import LeakError, ParamsError
from reskin.models.inputs import FIT, VIEW
from reskin.models.recipe import HEADLINE
from reskin.seeds import rng_for

SKINS_UNSEEN = ("lobo", "sensors", "transfer")  # experiments that test on skins without training rows
SKIN_SHARED = ("single_temporal", "single_indentation", "single_pass")  # experiments that train and test on one skin
# The experiment that splits the readings of an indentation between training and test, as the paper does in section 4.
PAPERS_SPLIT = "single_random"
RULES = {
    "readings": "no test reading is used for training or adaptation",
    "boards": "no test board is in training",
    "skins": "no test skin is in training",
    "indentations": "no test indentation is in training",
    "copies": "no test capture is a copy of a training skin",
    "pool indentations": "no indentation for adaptation is tested",
    "pool skins": "all skins for adaptation are held out",
    "scaler": "the scaler was fitted to the training rows alone",
    "base": "the adapted network was pretrained on the same fold with the same seed",
    "pokes": "all indentations for adaptation are in the pool of the fold, and none of them is tested",
    "settings: boards": "no tested board was used to choose the settings",
    "settings: skins": "no tested skin was used to choose the settings",
    "settings: recipe": "the recipe is the chosen one; differences are only listed",
}


class AuditSettings(Strict):
    """Settings section `audit`.

    - settings: whether the training settings were chosen by a study on other boards, or set so that training is fast.
    - similar_skins: pairs of different skins whose readings are so similar that one skin could be a copy of the other.
      The audit accepts these pairs, and lists them in the report.
    - weak_skins: skins whose fields are too weak to be compared with other skins. The audit accepts these skins, and
      lists them in the report.
    """

    settings: Literal["chosen", "for speed"]
    similar_skins: tuple[tuple[str, str], ...] = ()
    weak_skins: tuple[str, ...] = ()


@dataclass(frozen=True)
class Check:
    """The result of one check of the audit.

    - what: name of the rule in `RULES`.
    - where: name of the fold or the network that was checked.
    - found: what the check found.
    - holds: whether the rule holds.
    - known: if true, a violation of the rule is reported in the results, but does not fail the stage.
    - remedy: what to do about a violation; used only in the error message.
    """

    what: str
    where: str
    found: str
    holds: bool
    known: bool = False
    remedy: str = "Check section split of the scene, and run stage split again."

    @property
    def rule(self) -> str:
        return RULES[self.what]


def audit(
    settings: Settings,
    section: AuditSettings,
    indentations: Path,
    folds: Path,
    models: Path,
    choice: Path,
    results: Path,
) -> None:
    """Check every fold, every network and the settings; raise `LeakError` for a leak."""
    data = read_data(settings, indentations, folds)
    checks = [check for fold in data.folds for check in check_fold(data, fold, section)]
    checks += check_networks(data, models)
    if section.settings == "chosen":
        checks += check_settings(data, choice, models)
    for check in checks:
        if not (check.holds or check.known):
            where = f"audit of {settings.scene}, {check.where}, {check.what}"
            raise LeakError(f"{where}: {check.found}. Rule: {check.rule}. {check.remedy}")
    rows = [{"rule": check.rule} | asdict(check) for check in checks]
    write_results(results, [{key: value for key, value in row.items() if key != "remedy"} for row in rows], {})
    known_n = sum(check.known for check in checks)
    say(f"{settings.scene}: {len(checks)} checks found no leak, apart from {known_n} known or accepted ones")


# --- Folds ---


def check_fold(data: SceneData, fold: Fold, section: AuditSettings) -> Iterator[Check]:
    """Check that neither the test rows of a fold nor copies of them were used for training or adaptation."""
    where, rows = f"{fold.experiment}/{fold.name}", data.rows
    known = (*SKINS_UNSEEN, *SKIN_SHARED, PAPERS_SPLIT)
    if fold.experiment not in known:
        remedy = "Add the experiment to SKINS_UNSEEN or SKIN_SHARED in pipeline/experiments/audit.py."
        raise ParamsError(f"fold {where}", "the experiment", f"one of {', '.join(known)}", fold.experiment, remedy)
    if not (len(fold.train) and len(fold.test)):
        got = f"{len(fold.train)} to train on, {len(fold.test)} to test on"
        remedy = "Change section split of the scene, and run stage split again."
        raise ParamsError(f"fold {where}: one side of the fold has no rows: {got}. {remedy}")
    yield disjoint("readings", where, fold.test, np.concatenate([fold.train, fold.pool]))
    if fold.experiment in SKINS_UNSEEN:
        for what, label in (("boards", rows.board), ("skins", rows.skin), ("indentations", rows.indentation)):
            yield disjoint(what, where, label[fold.test], label[fold.train])
        yield check_copies(data, fold, section)
    else:
        tested, trained = rows.indentation[fold.test], rows.indentation[fold.train]
        yield disjoint("indentations", where, tested, trained, known=fold.experiment == PAPERS_SPLIT)
    if len(fold.pool):
        yield disjoint("pool indentations", where, rows.indentation[fold.pool], rows.indentation[fold.test])
        foreign = np.setdiff1d(rows.skin[fold.pool], rows.skin[fold.test])
        yield Check("pool skins", where, f"{len(foreign)} skins are not held out{names(foreign)}", not len(foreign))


def disjoint(what: str, where: str, ours: np.ndarray, others: np.ndarray, *, known: bool = False) -> Check:
    """Check that two sides have no value in common; with `known`, common values are reported as a known leak."""
    shared, n = np.intersect1d(ours, others), len(np.unique(ours))
    found = f"{len(shared)} of {n} on both sides{names(shared)}"
    return Check(what, where, found, not len(shared), known=known and len(shared) > 0)


def names(values: Sequence[Any] | np.ndarray) -> str:
    """Format the first three values for the end of a message; return an empty string if there are none."""
    return f": {', '.join(map(str, values[:3]))}{', ...' if len(values) > 3 else ''}" if len(values) else ""


# --- Copies ---

# Standard deviation of the noise of one reading in uT, on the x, y and z axes of a chip. In the lab's recordings, it is
# 3.0 to 3.3 uT on x and y, and 4.4 to 5.0 uT on z.
NOISE_uT = np.array([3.3, 3.3, 5.0])
# Only indentations with at least this |dB|, in units of a reading's noise, are compared. The direction of a weaker dB
# is dominated by noise.
STRONG_NOISES = 10.0
# An indentation looks copied if its distance from another indentation is at most this, in units of a reading's noise.
# Two readings of the same contact differ by 1.4 units (22 uT over 15 channels). A copy that was disguised by adding 5
# uT to each channel differs by 1.3 units from its original.
COPY_DISTANCE_NOISES = 2.0
# A copy may be disguised by multiplying all its fields by a factor. The ratio |dB of the copy| / |dB of the original|
# is then the same for all indentations, within this relative tolerance. Between different skins, the ratio varies with
# the depth of the indentation.
FACTOR_TOLERANCE = 0.1
# A capture counts as a copy if at least this fraction of its indentations look copied. We measured these fractions:
# - 0 % between four recorded skins,
# - at most 11 % between independent simulated skins (60 skins, 4 random draws),
# - at least 55 % in a copy in which up to 8 uT were added to single readings,
# - 42 % in a copy in which each channel was multiplied by a random gain with a spread of 5 %.
COPIED_SHARE_MAX = 0.3
# Largest number of pairs of indentations that are compared for a fold. The comparison then takes at most a second. The
# number is exceeded if SAMPLE_MIN_N requires more pairs.
PAIRS_MAX_N = 100_000_000
SAMPLE_MIN_N = 100  # smallest number of indentations sampled from a capture, if it has as many
CHUNK_PAIRS_N = 4_000_000  # number of pairs that are compared at once, in 16 MB of memory


def check_copies(data: SceneData, fold: Fold, section: AuditSettings) -> Check:
    """Check that no test capture is a copy of a training skin's captures under another name.

    A random sample of each test capture's indentations is compared with all indentations of the training skins.
    """
    where, rows, scene = f"{fold.experiment}/{fold.name}", data.rows, f"pipeline/scenes/{data.scene}.yaml"
    capture, test_uT = strong_fields(rows, fold.test, rows.capture)
    train_skin, train_uT = strong_fields(rows, fold.train, rows.skin)
    weak = np.setdiff1d(rows.skin[fold.test], rows.skin[fold.test][np.isin(rows.capture[fold.test], capture)])
    weak = weak if len(train_skin) else np.union1d(weak, rows.skin[fold.train])
    unaccepted = np.setdiff1d(weak, section.weak_skins)
    if len(unaccepted) or not (len(train_skin) and len(capture)):
        found = f"not compared, because the fields are too weak{names(weak)}"
        remedy = f"To accept weak skins, write in section audit of {scene}: weak_skins: [{', '.join(unaccepted)}]"
        return Check("copies", where, found, holds=False, known=not len(unaccepted), remedy=remedy)
    rng = rng_for(data.settings.seed, "audit", fold.experiment, fold.name)
    captures = np.unique(capture)
    sample_n = max(SAMPLE_MIN_N, PAIRS_MAX_N // len(train_uT) // len(captures))
    shares: dict[tuple[str, str, str], float] = {}  # by test capture, its skin, and training skin
    for name in captures:
        sample_uT = rng.permutation(test_uT[capture == name])[:sample_n]
        skin = str(rows.skin[fold.test][rows.capture[fold.test] == name][0])
        shares |= {(str(name), skin, other): share for other, share in copied_shares(sample_uT, train_skin, train_uT)}
    accepted = {frozenset(pair) for pair in section.similar_skins}
    similar = {key: share for key, share in shares.items() if share >= COPIED_SHARE_MAX}
    copies = {key: share for key, share in similar.items() if frozenset(key[1:]) not in accepted}
    (name, skin, other), share = max((copies or shares).items(), key=lambda item: item[1])
    found = f"{100 * share:.1f} % of the indentations of capture {name} match skin {other}"
    remedy = (
        f"If both are the same recording, remove one of them: reskin remove {data.scene} {name}. If they are different "
        f"recordings, write in section audit of {scene}: similar_skins: [[{skin}, {other}]]"
    )
    return Check("copies", where, found, holds=not similar, known=bool(similar) and not copies, remedy=remedy)


def strong_fields(
    rows: Rows, row: Int[np.ndarray, " a"], name: np.ndarray
) -> tuple[np.ndarray, Float32[np.ndarray, "n ch"]]:
    """Average dB over the readings of each indentation; return names and means of indentations well above the noise."""
    means_uT = pd.DataFrame(rows.db_uT[row].astype(float)).groupby(rows.indentation[row]).mean().to_numpy()
    first = row[np.unique(rows.indentation[row], return_index=True)[1]]
    strong = np.linalg.norm(means_uT, axis=1) > STRONG_NOISES * noise_uT(means_uT.shape[1])
    return name[first][strong], means_uT[strong].astype(np.float32)


def noise_uT(ch_n: int) -> float:
    """Return the norm, over `ch_n` channels, of the noise of one reading."""
    return float(np.sqrt(ch_n / len(NOISE_uT) * (NOISE_uT**2).sum()))


def copied_shares(
    db_uT: Float32[np.ndarray, "n ch"], skin: np.ndarray, train_uT: Float32[np.ndarray, "m ch"]
) -> Iterator[tuple[str, float]]:
    """Yield each training skin with the fraction of the indentations `db_uT` that look copied from it."""
    nearest, off_uT = nearest_rays(db_uT, train_uT)
    similar = off_uT < COPY_DISTANCE_NOISES * noise_uT(db_uT.shape[1])
    factor = np.linalg.norm(db_uT, axis=1) / np.linalg.norm(train_uT[nearest], axis=1)
    for name in np.unique(skin):
        factors = factor[similar & (skin[nearest] == name)]
        copied = np.abs(factors / np.median(factors) - 1) < FACTOR_TOLERANCE if len(factors) else factors
        yield str(name), float(copied.sum() / len(db_uT))


def nearest_rays(
    db_uT: Float32[np.ndarray, "n ch"], others_uT: Float32[np.ndarray, "m ch"]
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Find, for each row of `db_uT`, the row of `others_uT` whose direction is nearest.

    Returns the index of that row, and the distance in uT between the row of `db_uT` and the line through the origin and
    that row. The distance does not change if `others_uT` is multiplied by a factor.
    """
    rays = others_uT / np.linalg.norm(others_uT, axis=1, keepdims=True)
    rows_n = max(1, CHUNK_PAIRS_N // len(rays))
    chunks = [db_uT[i : i + rows_n] for i in range(0, len(db_uT), rows_n)]
    nearest = np.concatenate([(chunk @ rays.T).argmax(axis=1) for chunk in chunks])
    ray = rays[nearest].astype(np.float64)
    along_uT = (db_uT * ray).sum(axis=1, keepdims=True)
    return nearest, np.linalg.norm(db_uT - along_uT * ray, axis=1)


# --- Networks ---

# Largest relative difference between scalers that were fitted to the same rows: 4 float32 roundings, or 5e-7. Sums in
# another order change a result by at most one rounding. For comparison, one additional row among 100,000 rows changes a
# column's mean by about 1e-5 of the column's standard deviation.
SCALER_TOLERANCE = 4 * float(np.finfo(np.float32).eps)


def check_networks(data: SceneData, models: Path) -> Iterator[Check]:
    """Check to which rows the scaler of every network was fitted, and from what each adapted network was made."""
    folds = {(fold.experiment, fold.name): fold for fold in data.folds}
    files = [file for stage in data.settings.models for file in sorted((models / stage).glob("*.json"))]
    cards = {file: io.read_json(file) for file in files}
    bases = {(card["fold"], card["seed_i"], card["key"]) for card in cards.values() if card["question"] == "triplet"}
    fits: dict[tuple[str, ...], Mapping[str, np.ndarray]] = {}  # equal fits are computed only once
    for file, card in cards.items():
        experiment = "lobo" if card["question"] in ("triplet", "adapt") else card["question"]
        fold, recipe = folds[experiment, card["fold"]], card["recipe"]
        key = (experiment, fold.name, recipe["inputs"], recipe["scaling"])
        if key not in fits:
            view_uT = VIEW[recipe["inputs"]](data.rows.db_uT[fold.train])
            fits[key] = FIT[recipe["scaling"]](view_uT, data.rows.target[fold.train]).arrays()
        yield check_scaler(file.stem, io.read_tensors(file.with_suffix(".safetensors"))[0], fits[key])
        if "tuning" in card:
            known = (card["fold"], card["seed_i"], card["tuning"]["from"]) in bases
            found, remedy = f"it {'was' if known else 'was not'}", "Adapt this network again."
            yield Check("base", file.stem, found, known, remedy=remedy)
            pokes = np.array(card["tuning"]["indentations"], np.int64)
            tested = np.intersect1d(pokes, data.rows.indentation[fold.test])
            foreign = np.setdiff1d(pokes, data.rows.indentation[fold.pool])
            found = f"of {len(pokes)} indentations, {len(tested)} are tested, and {len(foreign)} are not in the pool"
            yield Check("pokes", file.stem, found, not len(tested) and not len(foreign), remedy=remedy)


def check_scaler(where: str, arrays: Mapping[str, np.ndarray], fitted: Mapping[str, np.ndarray]) -> Check:
    """Compare a network's scaler with one that was fitted to the training rows; a missing array is a difference."""
    gaps = [
        np.max(np.abs(arrays.get(name, np.nan) - value.astype(float)) / np.where(value == 0, 1.0, np.abs(value)))
        for name, value in fitted.items()
    ]
    gap = float(np.max(gaps))  # NaN if any is NaN
    found = f"relative difference of {gap:.2g} from a scaler fitted to them (allowed: {SCALER_TOLERANCE:.2g})"
    return Check("scaler", where, found, gap <= SCALER_TOLERANCE, remedy="Train this network again.")


# --- Settings ---

NOT_CHOSEN = "not chosen by the study"  # beginning of `Check.found` for a setting that the study did not choose
SAME_AS = {"train_single": "train_multi"}  # stages that use the recipe that the study chose for another stage


class Choice(Strict, extra="allow"):
    """The record of the study that chose the training settings: its boards and skins, and a recipe for each stage."""

    scene: str
    source: str
    seed: int
    boards: tuple[str, ...]
    skins: tuple[str, ...]
    chosen: dict[str, dict[str, Any]]


def check_settings(data: SceneData, choice: Path, models: Path) -> Iterator[Check]:
    """Check that settings were not chosen on tested boards or skins, and list recipes that differ from the chosen ones.

    Recorded skins are the same if their names are equal. Simulated skins are different if their seeds differ, even if
    their names are equal.
    """
    record = parse(Choice, io.read_json(choice), "record of the study of settings")
    source = data.settings["source"]
    same_draw = record.source == source and (source == "recorded" or record.seed == data.settings.seed)
    test = np.unique(np.concatenate([fold.test for fold in data.folds]))
    remedy = "Choose the settings in a scene with other boards and skins."
    for what, studied, label in (("boards", record.boards, data.rows.board), ("skins", record.skins, data.rows.skin)):
        tested = np.unique(label[test])
        shared = np.intersect1d(tested, studied) if same_draw else tested[:0]
        found = f"{len(shared)} of {len(tested)} tested {what} are {what} of scene {record.scene}{names(shared)}"
        yield Check(f"settings: {what}", "all folds", found, not len(shared), remedy=remedy)
    for stage in data.settings.models:
        cards = (io.read_json(file) for file in sorted((models / stage).glob("*.json")))
        used = without_budget(settings_of(next(card for card in cards if card["recipe_name"] == HEADLINE)))
        chosen = record.chosen.get(SAME_AS.get(stage, stage), {})
        differing = [
            f"{key} {used.get(key, 'absent')} (study: {chosen.get(key, 'absent')})"
            for key in sorted({*used, *chosen})
            if (key in used, used.get(key)) != (key in chosen, chosen.get(key))
        ]
        found = f"{NOT_CHOSEN}: {', '.join(differing)}" if differing else "equal"
        yield Check("settings: recipe", stage, found if chosen else NOT_CHOSEN, holds=True)
