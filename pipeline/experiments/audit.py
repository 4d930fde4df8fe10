"""Audit: check that no information about test rows leaked into training.

The audit checks the division of rows into training and test rows (folds), the scaling of inputs, the data for
adaptation and the choice of settings. It also checks whether a capture (a recorded file) is a copy of another capture.
If a leak is found, the stage fails. Two findings are only reported in the results: leaks that the paper's own protocol
implies, and collapsed networks, whose predictions are nearly constant.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32, Int

from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.training.choice import fingerprint, settings_of, without_budget
from pipeline.training.jobs import SceneData, read_data
from reskin import io
from reskin.config import Strict, parse
from reskin.errors import LeakError, ParamsError, SchemaError
from reskin.models.inputs import FIT, VIEW
from reskin.models.recipe import HEADLINE
from reskin.seeds import rng_for

NOT_CHOSEN = "not chosen by the study"  # beginning of `Check.found` for a setting that the study did not choose
COLLAPSE = "collapse"
COPIES = "copies"


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


NOTHING_ACCEPTED = AuditSettings(settings="for speed")


@dataclass(frozen=True)
class Check:
    """The result of one check of the audit.

    - what: short name of the rule.
    - where: name of the fold or the network that was checked.
    - rule: the rule in words.
    - found: what the check found.
    - holds: whether the rule holds.
    - known: if true, a violation of the rule is reported in the results, but does not fail the stage.
    - remedy: what to do about a violation; used only in the error message.
    """

    what: str
    where: str
    rule: str
    found: str
    holds: bool
    known: bool = False
    remedy: str = "Check section split of the scene, and run stage split again."


def audit(
    settings: Settings,
    section: AuditSettings,
    indentations: Path,
    folds: Path,
    models: Path,
    choice: Path,
    results: Path,
) -> None:
    """Check every fold, the scaler of every network and the settings; raise `LeakError` for a leak."""
    data = read_data(settings, indentations, folds)
    labels = Labels(data.rows.board, data.rows.skin, data.rows.indentation, data.rows.capture)
    sides = [Sides(fold.experiment, fold.name, fold.train, fold.pool, fold.test) for fold in data.folds]
    checks = [
        check
        for side in sides
        for check in audit_fold(
            side,
            labels,
            db_uT=data.rows.db_uT,
            rng=rng_for(data.settings.seed, "audit", side.experiment, side.name),
            accepted=section,
            scene=settings.scene,
        )
    ]
    checks += list(model_checks(data, {(side.experiment, side.name): side for side in sides}, models))
    if section.settings == "chosen":
        checks += settings_checks(data, choice, models)
    leak = next((check for check in checks if not (check.holds or check.known)), None)
    if leak is not None:
        where = f"audit of {settings.scene}, {leak.where}, {leak.what}"
        raise LeakError(f"{where}: {leak.found}. Rule: {leak.rule}. {leak.remedy}")
    io.write_json(
        results, [{key: value for key, value in asdict(check).items() if key != "remedy"} for check in checks]
    )
    unchosen_n = sum(check.found.startswith(NOT_CHOSEN) for check in checks)
    collapsed_n = sum(check.known and check.what == COLLAPSE for check in checks)
    accepted_n = sum(check.known and check.what == COPIES for check in checks)
    known_leaks_n = sum(check.known for check in checks) - collapsed_n - accepted_n
    say(
        f"{settings.scene}: {len(checks)} checks found no leak. In addition, {known_leaks_n} known leaks are part of "
        f"the paper's own protocol, {accepted_n} folds have skins that the scene accepts as similar or weak, "
        f"{collapsed_n} variants have collapsed networks, and {unchosen_n} settings were not chosen by the study"
    )


# --- Folds ---

SKINS_UNSEEN = ("lobo", "sensors", "labels", "transfer")  # experiments that test on skins without training rows
SKIN_SHARED = ("single_temporal", "single_indentation", "single_pass")  # experiments that train and test on one skin
# The experiment that splits the readings of an indentation between training and test, as the paper does in section 4.
PAPERS_SPLIT = "single_random"


@dataclass(frozen=True)
class Sides:
    """A fold, which is a division of the scene's rows.

    - experiment, name: the experiment to which the fold belongs, and the name of the fold.
    - train: numbers of the training rows.
    - pool: numbers of the unlabelled rows to which networks may be adapted.
    - test: numbers of the test rows.
    """

    experiment: str
    name: str
    train: Int[np.ndarray, " a"]
    pool: Int[np.ndarray, " c"]
    test: Int[np.ndarray, " b"]

    @property
    def where(self) -> str:
        """Name of the fold in messages."""
        return f"{self.experiment}/{self.name}"


@dataclass(frozen=True)
class Labels:
    """Board, skin, indentation and capture of each row of the scene; `indentation` is unique over the scene."""

    board: np.ndarray
    skin: np.ndarray
    indentation: Int[np.ndarray, " f"]
    capture: np.ndarray


def audit_fold(
    sides: Sides,
    labels: Labels,
    *,
    db_uT: Float[np.ndarray, "f ch"],
    rng: np.random.Generator,
    accepted: AuditSettings = NOTHING_ACCEPTED,
    scene: str = "SCENE",
) -> list[Check]:
    """Check that neither the test rows of a fold nor copies of them were used for training or adaptation.

    accepted: skins that the scene accepts as similar or weak. scene: name of the scene, for remedies.

    >>> skin = np.array(["s1", "s1", "s2"])
    >>> labels = Labels(np.array(["b1", "b1", "b2"]), skin, np.array([0, 0, 1]), capture=skin)
    >>> db_uT = np.array([[200.0, 0, 0], [200, 0, 0], [0, 200, 0]], np.float32)
    >>> fold = Sides("lobo", "b2", np.array([0, 1]), np.array([], int), np.array([2]))
    >>> for check in audit_fold(fold, labels, db_uT=db_uT, rng=rng):
    ...     print(f"{check.what}: {check.found}: {check.holds}")
    readings: 0 of 1 test readings are also used for training or adaptation: True
    boards: 0 of 1 test boards are also in training: True
    skins: 0 of 1 test skins are also in training: True
    indentations: 0 of 1 test indentations are also in training: True
    copies: 1 of 1 test captures compared. At most 0.0 % of the indentations of a capture match one training skin: True
    """
    _check_experiment(sides)
    checks = [_check_readings(sides)]
    if sides.experiment in SKINS_UNSEEN:
        checks += [_check_disjoint("boards", labels.board, sides), _check_disjoint("skins", labels.skin, sides)]
        checks.append(_check_disjoint("indentations", labels.indentation, sides))
        checks.append(_check_copies(sides, labels, db_uT, rng, accepted, scene))
    elif sides.experiment in SKIN_SHARED:
        rule = "no test indentation is in training (the skin is in training and test by design)"
        checks.append(_check_disjoint("indentations", labels.indentation, sides, rule=rule))
    else:
        rule = (
            "no test indentation is in training (the skin is in training and test by design); the paper's own protocol "
            "breaks this rule"
        )
        checks.append(_check_disjoint("indentations", labels.indentation, sides, rule=rule, known=True))
    return checks + (_check_pool(sides, labels) if len(sides.pool) else [])


def _check_experiment(sides: Sides) -> None:
    known = (*SKINS_UNSEEN, *SKIN_SHARED, PAPERS_SPLIT)
    if sides.experiment not in known:
        raise ParamsError(
                f"fold {sides.where}", "the experiment", f"one of {', '.join(known)}", sides.experiment,
                "Add the experiment to SKINS_UNSEEN or SKIN_SHARED in pipeline/experiments/audit.py.",
            )  # fmt: skip
    if not (len(sides.train) and len(sides.test)):
        got = f"{len(sides.train)} to train on, {len(sides.test)} to test on"
        remedy = "Change section split of the scene, and run stage split again."
        raise ParamsError(f"fold {sides.where}: one side of the fold has no rows: {got}. {remedy}")


def _check_readings(sides: Sides) -> Check:
    used = np.isin(sides.test, np.concatenate([sides.train, sides.pool]))
    found = f"{int(used.sum())} of {len(sides.test)} test readings are also used for training or adaptation"
    rule = "no test reading is used for training or adaptation"
    return Check("readings", sides.where, rule, found, holds=not used.any())


def _check_disjoint(what: str, label: np.ndarray, sides: Sides, *, rule: str = "", known: bool = False) -> Check:
    """Check that training rows and test rows have no value of `label` in common.

    With `known`, common values are reported as a known leak.
    """
    rule = rule or f"no test {what.removesuffix('s')} is in training"
    tested = np.unique(label[sides.test])
    shared = tested[np.isin(tested, np.unique(label[sides.train]))]
    found = f"{len(shared)} of {len(tested)} test {what} are also in training{_first_names(shared)}"
    return Check(what, sides.where, rule, found, holds=len(shared) == 0, known=known and len(shared) > 0)


def _check_copies(
    sides: Sides, labels: Labels, db_uT: np.ndarray, rng: np.random.Generator, accepted: AuditSettings, scene: str
) -> Check:
    """Check that no test capture is a copy of a training skin's captures under another name."""
    test, train = (
        strong_indentations(name[side], labels.indentation[side], db_uT[side])
        for name, side in ((labels.capture, sides.test), (labels.skin, sides.train))
    )
    rule = f"less than {100 * COPIED_SHARE_MAX:g} % of the indentations of a test capture match one training skin"
    captures, skins = labels.capture[sides.test], labels.skin[sides.test]
    weak_skins = np.setdiff1d(skins, skins[np.isin(captures, test.name)])
    if not len(train.name):
        weak_skins = np.union1d(weak_skins, labels.skin[sides.train])
    unaccepted = np.setdiff1d(weak_skins, accepted.weak_skins)
    section = f"section audit of pipeline/scenes/{scene}.yaml"
    if len(unaccepted) or not (len(train.name) and len(test.name)):
        least_uT = STRONG_NOISES * noise_uT(db_uT.shape[1])
        found = f"not checked, because no field change exceeds {least_uT:.0f} µT{_first_names(weak_skins)}"
        remedy = f"To accept these weak skins, write in {section}: weak_skins: [{', '.join(map(str, unaccepted))}]"
        return Check(COPIES, sides.where, rule, found, holds=False, known=not len(unaccepted), remedy=remedy)
    likenesses = all_likenesses(test, train, rng=rng)
    captures_n = len({likeness.capture for likeness in likenesses})
    found = f"{captures_n} of {len(np.unique(captures))} test captures compared. "
    pairs = {frozenset(pair) for pair in accepted.similar_skins}
    skin_of = dict(zip(captures.tolist(), skins.tolist(), strict=True))
    too_similar = [likeness for likeness in likenesses if likeness.share >= COPIED_SHARE_MAX]
    not_accepted = [one for one in too_similar if frozenset((skin_of[one.capture], one.train_skin)) not in pairs]
    closest = max(not_accepted or likenesses, key=lambda likeness: likeness.share)
    if not too_similar:
        found += f"At most {100 * closest.share:.1f} % of the indentations of a capture match one training skin"
        return Check(COPIES, sides.where, rule, found, holds=True)
    capture, other = closest.capture, closest.train_skin
    found += (
        f"{100 * closest.share:.1f} % of the {closest.compared_n} compared indentations of capture {capture} match "
        f"skin {other}"
    )
    remedy = (
        f"If both are the same recording, remove one of them: reskin remove {scene} {capture}. If they are different "
        f"recordings, write in {section}: similar_skins: [[{skin_of[capture]}, {other}]]"
    )
    return Check(COPIES, sides.where, rule, found, holds=False, known=not not_accepted, remedy=remedy)


def _check_pool(sides: Sides, labels: Labels) -> list[Check]:
    """Check that the unlabelled pokes for adaptation are of held-out skins, and that none is a test indentation."""
    pokes, tested = (np.unique(labels.indentation[side]) for side in (sides.pool, sides.test))
    shared = pokes[np.isin(pokes, tested)]
    skins = np.unique(labels.skin[sides.pool])
    foreign = np.setdiff1d(skins, labels.skin[sides.test])
    overlap = f"{len(shared)} of {len(pokes)} indentations for adaptation are also tested{_first_names(shared)}"
    not_held_out = f"{len(foreign)} of {len(skins)} skins for adaptation are not held out{_first_names(foreign)}"
    rules = "no indentation for adaptation is tested", "all skins for adaptation are held out"
    return [
        Check("pool indentations", sides.where, rules[0], overlap, holds=len(shared) == 0),
        Check("pool skins", sides.where, rules[1], not_held_out, holds=len(foreign) == 0),
    ]


def _first_names(names: np.ndarray) -> str:
    """Format the first three names for the end of a message; return an empty string if there are no names."""
    if len(names) == 0:
        return ""
    return f": {', '.join(map(str, names[:3]))}{', ...' if len(names) > 3 else ''}"


# --- Copies ---

# Standard deviation of the noise of one reading, on the x, y and z axes of a chip. In the lab's recordings, it is 3.0
# to 3.3 uT on x and y, and 4.4 to 5.0 uT on z.
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


@dataclass(frozen=True)
class MeanFields:
    """Mean dB of the indentations whose |dB| is well above the noise, each with the name of its capture or skin."""

    name: np.ndarray
    db_uT: Float32[np.ndarray, "n ch"]


@dataclass(frozen=True)
class Likeness:
    """The fraction of a test capture's indentations that look copied from a training skin."""

    capture: str
    train_skin: str
    share: float
    compared_n: int


def strong_indentations(
    name: np.ndarray, indentation: Int[np.ndarray, " f"], db_uT: Float[np.ndarray, "f ch"]
) -> MeanFields:
    """Average the readings of each indentation; return the means whose |dB| exceeds ten times a reading's noise."""
    _, first, group = np.unique(indentation, return_index=True, return_inverse=True)
    sums = np.stack([np.bincount(group, weights=channel) for channel in db_uT.T], axis=1)
    mean_uT = (sums / np.bincount(group)[:, None]).astype(np.float32)
    strong = np.linalg.norm(mean_uT, axis=1) > STRONG_NOISES * noise_uT(db_uT.shape[1])
    return MeanFields(name[first][strong], mean_uT[strong])


def noise_uT(ch_n: int) -> float:
    """Return the norm, over `ch_n` channels, of the noise of one reading."""
    return float(np.sqrt(ch_n / len(NOISE_uT) * (NOISE_uT**2).sum()))


def all_likenesses(test: MeanFields, train: MeanFields, *, rng: np.random.Generator) -> list[Likeness]:
    """Compare each test capture with each training skin.

    A random sample of the capture's indentations is compared with all indentations of every training skin.
    """
    captures = np.unique(test.name)
    sample_n = max(SAMPLE_MIN_N, PAIRS_MAX_N // len(train.name) // len(captures))
    likenesses = []
    for capture in captures:
        db_uT = test.db_uT[test.name == capture]
        sample_uT = db_uT[rng.permutation(len(db_uT))[:sample_n]]
        shares = _copied_shares(sample_uT, train)
        likenesses += [Likeness(str(capture), skin, share, len(sample_uT)) for skin, share in shares.items()]
    return likenesses


def nearest_rays(
    db_uT: Float32[np.ndarray, "n ch"], others_uT: Float32[np.ndarray, "m ch"]
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Find, for each row of `db_uT`, the row of `others_uT` whose direction is nearest.

    Returns two arrays. The first contains the index of the nearest row of `others_uT`. The second contains the distance
    in uT between the row of `db_uT` and the line through the origin and this nearest row. The distance does not change
    if `others_uT` is multiplied by a factor.
    """
    rays = others_uT / np.linalg.norm(others_uT, axis=1, keepdims=True)
    rows_n = max(1, CHUNK_PAIRS_N // len(rays))
    chunks = [db_uT[i : i + rows_n] for i in range(0, len(db_uT), rows_n)]
    nearest = np.concatenate([(chunk @ rays.T).argmax(axis=1) for chunk in chunks])
    ray = rays[nearest].astype(np.float64)
    along_uT = (db_uT * ray).sum(axis=1, keepdims=True)
    return nearest, np.linalg.norm(db_uT - along_uT * ray, axis=1)


def _copied_shares(sample_uT: Float32[np.ndarray, "n ch"], train: MeanFields) -> dict[str, float]:
    """Return, for each training skin, the fraction of a capture's indentations that look copied from this skin."""
    nearest, off_uT = nearest_rays(sample_uT, train.db_uT)
    similar = off_uT < COPY_DISTANCE_NOISES * noise_uT(sample_uT.shape[1])
    factor = np.linalg.norm(sample_uT, axis=1) / np.linalg.norm(train.db_uT[nearest], axis=1)
    shares = {}
    for skin in np.unique(train.name):
        factors = factor[similar & (train.name[nearest] == skin)]
        copied = np.abs(factors / np.median(factors) - 1) < FACTOR_TOLERANCE if len(factors) else factors
        shares[str(skin)] = float(copied.sum() / len(sample_uT))
    return shares


# --- Networks ---

# Two scalers count as fitted to the same rows if their relative difference is at most 4 float32 roundings, or 5e-7. The
# scalers of the same rows may differ because float64 sums were computed in another order, which changes a float32
# result by at most one rounding. For comparison, one additional row among 100,000 rows changes a column's mean by about
# 1e-5 of the column's standard deviation.
SCALER_TOLERANCE = 4 * float(np.finfo(np.float32).eps)

Arrays = Mapping[str, np.ndarray]
Fits = dict[tuple[str, str, str, str, int], Arrays]  # scaler arrays by experiment, fold, view, scaling and row count


def model_checks(data: SceneData, sides: dict[tuple[str, str], Sides], models: Path) -> Iterator[Check]:
    """Check, for every network, which rows its scaler was fitted to, whether it collapsed, and how it was adapted."""
    views = {name: view(data.rows.db_uT) for name, view in VIEW.items()}
    fits: Fits = {}
    keys: dict[tuple[str, int], set[str]] = {}  # by fold and seed: keys of the pretrained networks that may be adapted
    for variant in data.settings.models:
        cards = {file: io.read_json(file) for file in sorted((models / variant).glob("*.json"))}
        yield audit_collapse(variant, list(cards.values()))
        for file, card in cards.items():
            experiment = "lobo" if card["question"] in ("triplet", "adapt") else card["question"]
            inputs, scaling = card["recipe"]["inputs"], card["recipe"]["scaling"]
            yield audit_scaler(
                file.stem, io.read_tensors(file.with_suffix(".safetensors"))[0], db_uT=views[inputs],
                target=data.rows.target, sides=sides[experiment, card["fold"]],
                fit=partial(_fit_once, fits, (experiment, card["fold"], inputs, scaling)),
            )  # fmt: skip
            bases = keys.setdefault((card["fold"], card["seed_i"]), set())
            if "tuning" in card:
                side = sides[experiment, card["fold"]]
                yield from audit_tuning(
                    file.stem, card["tuning"], bases=bases, sides=side, indentation=data.rows.indentation
                )
            elif card["question"] == "triplet":
                bases.add(card["key"])


def _fit_once(fits: Fits, key: tuple[str, str, str, str], db_uT: np.ndarray, target: np.ndarray) -> Arrays:
    """Return the arrays of a scaler that is fitted to these rows; equal fits are computed only once."""
    # The number of rows distinguishes a fit to the training rows from a fit to training and test rows.
    fit_key = (*key, len(db_uT))
    if fit_key not in fits:
        fits[fit_key] = FIT[key[-1]](db_uT, target).arrays()
    return fits[fit_key]


def audit_scaler(
    where: str,
    arrays: Arrays,
    *,
    db_uT: Float[np.ndarray, "f ch"],
    target: Float[np.ndarray, "f 3"],
    sides: Sides,
    fit: Callable[[np.ndarray, np.ndarray], Arrays],
) -> Check:
    """Check that a network's scaler was fitted to the training rows alone, rather than to training and test rows."""
    both_sides = np.concatenate([sides.train, sides.test])
    train_gap, both_gap = (
        _relative_gap(where, arrays, fit(db_uT[side], target[side])) for side in (sides.train, both_sides)
    )
    found = (
        f"relative difference {train_gap:.2g} from a scaler fitted to the training rows, and {both_gap:.2g} from a "
        "scaler fitted to training and test rows"
    )
    rule = f"the scaler was fitted to the training rows alone (tolerance: relative difference {SCALER_TOLERANCE:.2g})"
    holds = train_gap <= SCALER_TOLERANCE and train_gap <= both_gap
    return Check("scaler", where, rule, found, holds=holds, remedy="Train this network again.")


def _relative_gap(where: str, arrays: Arrays, fitted: Arrays) -> float:
    """Return the largest relative difference between a network's scaler arrays and the fitted ones; NaN if any is NaN.

    The difference is absolute where the fitted value is 0.
    """
    gaps = []
    for name, value in fitted.items():
        if name not in arrays or arrays[name].shape != value.shape:
            raise SchemaError(f"{where}: scaler array {name} of shape {value.shape} is missing. Train it again.")
        size = np.where(value == 0, 1.0, np.abs(value))
        gaps.append(np.max(np.abs(arrays[name].astype(np.float64) - value) / size))
    return float(np.max(gaps))


def audit_tuning(
    where: str, tuning: Mapping[str, Any], *, bases: set[str], sides: Sides, indentation: Int[np.ndarray, " f"]
) -> list[Check]:
    """Check which pretrained network was adapted, and to which pokes, according to section `tuning` of a model card.

    `bases` are the keys of the pretrained networks that have the fold and seed of the adapted network.
    """
    adapted_to = np.array(tuning["indentations"], np.int64)
    tested = np.intersect1d(adapted_to, indentation[sides.test])
    foreign = np.setdiff1d(adapted_to, indentation[sides.pool])
    base_known = tuning["from"] in bases
    remedy = "Adapt this network again."
    base = f"the pretrained network is {'' if base_known else 'not '}of the same fold and seed"
    pokes = (
        f"of {len(adapted_to)} indentations for adaptation, {len(tested)} are tested, and {len(foreign)} are not in "
        "the fold's pool"
    )
    rules = (
        "the pretrained network has the same fold and seed as the adapted network",
        "all indentations for adaptation are in the fold's pool, and none of them is tested",
    )
    return [
        Check("base", where, rules[0], base, holds=base_known, remedy=remedy),
        Check("pokes", where, rules[1], pokes, holds=not len(tested) and not len(foreign), remedy=remedy),
    ]


def audit_collapse(variant: str, cards: Sequence[Mapping[str, Any]]) -> Check:
    """Count a variant's collapsed networks, whose predictions are nearly constant, and its repeated training runs."""
    collapsed = [
        f"{card['question']}.{card['recipe_name']}.{card['fold']}.seed{card['seed_i']}"
        for card in cards
        if card["collapsed"]
    ]
    again_n = sum(card["collapsed_before_n"] for card in cards)
    found = (
        f"{len(collapsed)} of {len(cards)} networks collapsed{': ' if collapsed else ''}{', '.join(collapsed)}; "
        f"{again_n} training runs were repeated"
    )
    rule = "no network predicts nearly the same values for all inputs"
    return Check(COLLAPSE, variant, rule, found, holds=not collapsed, known=bool(collapsed))


# --- Settings ---

# The study chooses no recipe for the variants on the left. Each of them uses the recipe that the study chose for the
# variant on the right.
SAME_AS = {"train_single": "train_multi"}


class Choice(Strict, extra="allow"):
    """The record of the study that chose the training settings.

    The record contains the boards and skins of the study, and the recipe chosen for each variant of the networks.
    """

    scene: str
    source: str
    seed: int
    boards: tuple[str, ...]
    skins: tuple[str, ...]
    physics: str = "not recorded"
    chosen: dict[str, dict[str, Any]]


def settings_checks(data: SceneData, choice: Path, models: Path) -> list[Check]:
    """Compare the headline recipes of the trained networks with the recipes that the study of settings chose."""
    recipes = {variant: without_budget(_headline(models / variant)) for variant in data.settings.models}
    held_out = np.unique(np.concatenate([fold.test for fold in data.folds]))
    return audit_choice(
        io.read_json(choice), recipes, source=data.settings["source"], seed=data.settings.seed,
        test_boards=np.unique(data.rows.board[held_out]).tolist(),
        test_skins=np.unique(data.rows.skin[held_out]).tolist(),
        physics=fingerprint(data.settings.shared),
    )  # fmt: skip


def _headline(models: Path) -> dict[str, Any]:
    """Return the settings of the headline recipe, from the model cards in folder `models`."""
    cards = (io.read_json(file) for file in sorted(models.glob("*.json")))
    return settings_of(next(card for card in cards if card["recipe_name"] == HEADLINE))


def audit_choice(
    choice: Mapping[str, Any],
    recipes: Mapping[str, Mapping[str, Any]],
    *,
    source: str,
    seed: int,
    test_boards: Sequence[str],
    test_skins: Sequence[str],
    physics: str,
) -> list[Check]:
    """Check that the settings were chosen on boards and skins that this scene does not test.

    Headline recipes that differ from the chosen recipes are also reported. Recorded skins are the same if their names
    are equal. Simulated skins are different if their seeds differ, even if their names are equal.
    """
    record = parse(Choice, dict(choice), "record of the study of settings")
    same_draw = record.source == source and (source == "recorded" or record.seed == seed)
    checks = []
    for what, studied, tested in (("boards", record.boards, test_boards), ("skins", record.skins, test_skins)):
        shared = sorted(set(studied) & set(tested)) if same_draw else []
        names = f": {', '.join(shared)}" if shared else ""
        found = f"{len(shared)} of {len(set(tested))} tested {what} were used to choose the settings{names}"
        rule = f"no tested {what.removesuffix('s')} was used in scene {record.scene} to choose the settings"
        remedy = "Choose the settings in a scene with other boards and skins."
        checks.append(Check(f"settings: {what}", "all folds", rule, found, holds=not shared, remedy=remedy))
    changed = f"{NOT_CHOSEN}: fingerprint {record.physics}, now {physics}; run the study of settings again"
    found = "equal" if record.physics == physics else changed
    rule = f"the settings of the simulated skin are those with which scene {record.scene} chose the training settings"
    checks.append(Check("settings: physics", "all variants", rule, found, holds=True))
    return checks + [audit_recipe(variant, recipe, record) for variant, recipe in recipes.items()]


def audit_recipe(variant: str, recipe: Mapping[str, Any], record: Choice) -> Check:
    """Report how a recipe differs from the recipe that the study chose; a difference is not a leak."""
    rule = f"the recipe equals the recipe that scene {record.scene} chose; differences are only listed"
    studied = SAME_AS.get(variant, variant)
    chosen = record.chosen.get(studied)
    if chosen is None:
        return Check(
            "settings: recipe", variant, rule, f"{NOT_CHOSEN}: the study chose no recipe for this stage", holds=True
        )
    used, best = ({key: repr(value) for key, value in settings.items()} for settings in (recipe, chosen))
    differing = [
        f"{key} {used.get(key, 'absent')} (study: {best.get(key, 'absent')})"
        for key in sorted({*used, *best})
        if used.get(key) != best.get(key)
    ]
    found = f"{NOT_CHOSEN}: {', '.join(differing)}" if differing else "equal"
    return Check("settings: recipe", variant, rule, found, holds=True)
