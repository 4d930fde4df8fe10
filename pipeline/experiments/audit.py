"""Whether test rows leaked into training: folds, copies, scalers, settings."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32, Int

from pipeline.report.choice import settings_of, trimmed
from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.training.jobs import SceneData, read_data
from reskin import io
from reskin.config import Strict, parse
from reskin.errors import LeakError, ParamsError, SchemaError
from reskin.models.inputs import FIT, VIEW
from reskin.models.recipe import HEADLINE
from reskin.seeds import rng_for
from reskin.simulation.fingerprint import fingerprint


@dataclass(frozen=True)
class Check:
    """A rule that keeps training apart from testing, and what was found of it."""

    what: str
    where: str
    rule: str
    found: str
    holds: bool
    known: bool


@dataclass(frozen=True)
class Sides:
    """Row numbers of a fold: trained on, poked without labels to adapt to, tested on."""

    experiment: str
    name: str
    train: Int[np.ndarray, " a"]
    pool: Int[np.ndarray, " c"]
    test: Int[np.ndarray, " b"]

    @property
    def where(self) -> str:
        """A name for people."""
        return f"{self.experiment}/{self.name}"


# The same rows give the same scaler but for the order of float64 sums, and that turns the last bit of a float32 at
# most; 4 of them are 5e-7. One foreign row in 100,000 moves a mean by some 1e-5 of its deviation.
SCALER_TOLERANCE = 4 * float(np.finfo(np.float32).eps)

NOT_CHOSEN = "not chosen by the study"  # begins what is stated of such a setting

Arrays = Mapping[str, np.ndarray]
Words = Mapping[str, Any]


SAME_AS = {"train_single": "train_multi"}  # one recipe for networks of one skin and of many


class Choice(Strict, extra="allow"):
    """The record of a study of settings: on whose readings, and the recipe chosen for each arm."""

    scene: str
    source: str
    seed: int
    boards: tuple[str, ...]
    skins: tuple[str, ...]
    physics: str = "not recorded"
    chosen: dict[str, dict[str, Any]]


def audit_scaler(
    where: str,
    arrays: Arrays,
    *,
    db_uT: Float[np.ndarray, "f ch"],
    target: Float[np.ndarray, "f 3"],
    sides: Sides,
    fit: Callable[[np.ndarray, np.ndarray], Arrays],
) -> Check:
    """Fit the scaler again on the training rows, and on those of the test too: the model's must be the former."""
    both = np.concatenate([sides.train, sides.test])
    honest, leaky = (_gap(where, arrays, fit(db_uT[side], target[side])) for side in (sides.train, both))
    found = f"off by {honest:.2g} from training rows alone, by {leaky:.2g} from both sides"
    rule = f"that of the training rows, to {SCALER_TOLERANCE:.2g}"
    return Check("scaler", where, rule, found, holds=honest <= SCALER_TOLERANCE and honest <= leaky, known=False)


def audit_choice(
    choice: Words,
    recipes: Mapping[str, Words],
    *,
    source: str,
    seed: int,
    test_boards: Sequence[str],
    test_skins: Sequence[str],
    physics: str,
) -> list[Check]:
    """Check that settings were chosen on other boards and skins, and state which headlines are not the chosen ones.

    Simulated skins of another seed are others, whatever their names; recorded ones are known by name.
    """
    record = parse(Choice, dict(choice), "record of the study of settings")
    same_draw = record.source == source and (source == "recorded" or record.seed == seed)
    checks = []
    for what, studied, tested in (("boards", record.boards, test_boards), ("skins", record.skins, test_skins)):
        shared = sorted(set(studied) & set(tested)) if same_draw else []
        found = f"{len(shared)} of {len(set(tested))} tested were chosen on{': ' if shared else ''}{', '.join(shared)}"
        rule = f"none of those that scene {record.scene} chose on (of its source and seed)"
        checks.append(Check(f"settings: {what}", "all folds", rule, found, holds=not shared, known=False))
    found = "equal" if record.physics == physics else f"{NOT_CHOSEN}: {record.physics}, now {physics}; run it again"
    rule = f"the simulated skin that scene {record.scene} chose on has the fingerprint of today's"
    checks.append(Check("settings: physics", "all arms", rule, found, holds=True, known=False))
    return checks + [_as_chosen(arm, recipe, record) for arm, recipe in recipes.items()]


def _as_chosen(arm: str, recipe: Words, record: Choice) -> Check:
    """State how a recipe differs from the chosen one: that is no leak, whoever set it."""
    rule = f"the recipe chosen on scene {record.scene}, or one that is stated here"
    studied = SAME_AS.get(arm, arm)
    chosen = record.chosen.get(studied, {})
    pairs = {key: (_said(recipe, key), _said(chosen, key)) for key in sorted({*recipe, *chosen})}
    differing = [f"{key} {used} (study: {best})" for key, (used, best) in pairs.items() if used != best]
    found = f"{NOT_CHOSEN}: {', '.join(differing)}" if differing else "equal"
    found = found if studied in record.chosen else f"{NOT_CHOSEN}: it chose none for this"
    return Check("settings: recipe", arm, rule, found, holds=True, known=False)


def _said(words: Words, key: str) -> str:
    return repr(words[key]) if key in words else "absent"


def _gap(where: str, arrays: Arrays, fitted: Arrays) -> float:
    """Give the largest difference, as a part of the value fitted (or bare, where that is 0); NaN if any is."""
    gaps = []
    for name, value in fitted.items():
        if name not in arrays or arrays[name].shape != value.shape:
            raise SchemaError(
                where, f"scaler array {name}", f"there, of shape {value.shape}", "none", "Train it again."
            )
        size = np.where(value == 0, 1.0, np.abs(value))
        gaps.append(np.max(np.abs(arrays[name].astype(np.float64) - value) / size))
    return float(np.max(gaps))


def audit_tuning(
    where: str, tuning: Mapping[str, Any], *, bases: set[str], sides: Sides, indentation: Int[np.ndarray, " f"]
) -> list[Check]:
    """Check a card's `tuning`; `bases` are the keys of the networks of its fold and seed."""
    own = np.array(tuning["indentations"], np.int64)
    tested = np.intersect1d(own, indentation[sides.test])
    strange = np.setdiff1d(own, indentation[sides.pool])
    base = "one of this fold and seed" if tuning["from"] in bases else "another"
    pokes = f"{len(tested)} of {len(own)} are tested, {len(strange)} are not of the pool"
    return [
        Check("base", where, "a network of its fold and seed", base, holds=tuning["from"] in bases, known=False),
        Check(
            "pokes",
            where,
            "of the pool, and none tested",
            pokes,
            holds=not len(tested) and not len(strange),
            known=False,
        ),
    ]


COLLAPSE = "collapse"


def audit_collapse(arm: str, cards: Sequence[Mapping[str, Any]]) -> Check:
    """Count the networks of an arm that answer nearly the same to any input, and trainings that were done again."""
    kept = [
        f"{one['question']}.{one['recipe_name']}.{one['fold']}.seed{one['seed_i']}" for one in cards if one["collapsed"]
    ]
    again_n = sum(one["collapsed_before_n"] for one in cards)
    found = f"{len(kept)} of {len(cards)} collapsed{': ' if kept else ''}{', '.join(kept)}; {again_n} trained again"
    rule = "no network answers nearly the same to any input"
    return Check(COLLAPSE, arm, rule, found, holds=not kept, known=bool(kept))


Fits = dict[tuple[str, str, str, str, int], dict[str, np.ndarray]]  # by fold, view, scaling and rows


def model_checks(data: SceneData, sides: dict[tuple[str, str], Sides], models: Path) -> Iterator[Check]:
    """Fit the scaler of every network again, from its fold's training rows, and look at what it was adapted with."""
    views = {name: view(data.rows.db_uT) for name, view in VIEW.items()}
    fits: Fits = {}
    keys: dict[tuple[str, int], set[str]] = {}  # of the networks that may be adapted, by fold and seed
    for arm in data.settings.models:
        cards = {file: io.read_json(file) for file in sorted((models / arm).glob("*.json"))}
        yield audit_collapse(arm, list(cards.values()))
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


def _fit_once(
    fits: Fits, key: tuple[str, str, str, str], db_uT: np.ndarray, target: np.ndarray
) -> dict[str, np.ndarray]:
    of = (*key, len(db_uT))  # a fold's training rows are fewer than those of both sides
    if of not in fits:
        fits[of] = FIT[key[-1]](db_uT, target).arrays()
    return fits[of]


def settings_checks(data: SceneData, choice: Path, models: Path) -> list[Check]:
    """Compare the headline recipes that were trained with the record of what was chosen, and where."""
    recipes = {arm: trimmed(_headline(models / arm)) for arm in data.settings.models}
    held_out = np.unique(np.concatenate([fold.test for fold in data.folds]))
    return audit_choice(
        io.read_json(choice), recipes, source=data.settings["source"], seed=data.settings.seed,
        test_boards=np.unique(data.rows.board[held_out]).tolist(),
        test_skins=np.unique(data.rows.skin[held_out]).tolist(),
        physics=fingerprint(data.settings.shared),
    )  # fmt: skip


def _headline(models: Path) -> dict[str, Any]:
    """Read the settings of a stage's headline: its networks' cards say what they were trained with."""
    cards = (io.read_json(file) for file in sorted(models.glob("*.json")))
    return settings_of(next(card for card in cards if card["recipe_name"] == HEADLINE))


class AuditSettings(Strict):
    """Section audit: were the scene's settings chosen, so that a study must vouch for them, or are they for speed?"""

    settings: Literal["chosen", "for speed"]


def read(settings: Settings) -> AuditSettings:
    """Read section audit."""
    return settings.section(AuditSettings, "audit")


def audit(settings: Settings, indentations: Path, folds: Path, models: Path, choice: Path, results: Path) -> None:
    """Check every fold, the scaler of every network and the settings; a leak fails the stage and names itself."""
    data = read_data(settings, indentations, folds)
    labels = Labels(data.rows.board, data.rows.skin, data.rows.indentation, data.rows.capture)
    sides = [Sides(fold.experiment, fold.name, fold.train, fold.pool, fold.test) for fold in data.folds]
    checks = [
        check
        for side in sides
        for check in audit_fold(
            side, labels, db_uT=data.rows.db_uT, rng=rng_for(data.settings.seed, "audit", side.experiment, side.name)
        )
    ]
    checks += list(model_checks(data, {(side.experiment, side.name): side for side in sides}, models))
    checks += settings_checks(data, choice, models) if read(data.settings).settings == "chosen" else []
    if not holds(checks):
        first = next(check for check in checks if not (check.holds or check.known))
        raise LeakError(
            f"audit of {settings.scene}, {first.where}", first.what, first.rule, first.found, "Look at who is held out."
        )
    io.write_json(results, to_words(checks))
    unchosen_n = sum(check.found.startswith(NOT_CHOSEN) for check in checks)
    dead_n = sum(check.known and check.what == COLLAPSE for check in checks)
    papers_n = sum(check.known for check in checks) - dead_n
    say(
        f"{settings.scene}: {len(checks)} checks, no leak; {papers_n} known, the paper's own; "
        f"{dead_n} arms with collapsed networks; {unchosen_n} settings that the study did not choose"
    )


# One reading's noise by axis of a chip (x, y, z), measured on the lab's recordings: 3.0-3.3 and 4.4-5.0 uT.
NOISE_uT = np.array([3.3, 3.3, 5.0])
STRONG_NOISES = 10.0  # below, the direction of dB is more noise than skin
# Two readings of one state are 1.4 noises apart (22 uT over 15 channels), a copy with 5 uT added to each channel 1.3.
ALIKE_NOISES = 2.0
FACTOR_TOLERANCE = 0.1  # a copy was multiplied by one factor, while honest look-alikes differ in depth
# Alike are, measured: between four recorded skins 0 %, between honest simulated ones at most 11 % (60 skins, 4 draws);
# in a copy with up to 8 uT added to single readings 55 % or more, and with 5 % of random gain a channel 42 %.
COPIED_SHARE_MAX = 0.3
PAIRS_MAX_N = 100_000_000  # indentations compared in a fold: a second at most, unless samples became too small to judge
SAMPLE_MIN_N = 100  # of a capture
CHUNK_PAIRS_N = 4_000_000  # of these at once: 16 MB


@dataclass(frozen=True)
class Indented:
    """The mean dB of each indentation whose field is well above the noise, and the name of its capture or skin."""

    name: np.ndarray
    db_uT: Float32[np.ndarray, "n ch"]


@dataclass(frozen=True)
class Likeness:
    """The training skin most like a test capture, and the share of the capture's indentations that look copied."""

    capture: str
    train_skin: str
    share: float
    compared_n: int


def strong_indentations(
    name: np.ndarray, indentation: Int[np.ndarray, " f"], db_uT: Float[np.ndarray, "f ch"]
) -> Indented:
    """Average the readings of each indentation, and keep those with |dB| above ten noises of a reading."""
    _, first, group = np.unique(indentation, return_index=True, return_inverse=True)
    sums = np.stack([np.bincount(group, weights=channel) for channel in db_uT.T], axis=1)
    mean_uT = (sums / np.bincount(group)[:, None]).astype(np.float32)
    strong = np.linalg.norm(mean_uT, axis=1) > STRONG_NOISES * noise_uT(db_uT.shape[1])
    return Indented(name[first][strong], mean_uT[strong])


def noise_uT(ch_n: int) -> float:
    """Give the norm of one reading's noise over all channels."""
    return float(np.sqrt(ch_n / len(NOISE_uT) * (NOISE_uT**2).sum()))


def liken(test: Indented, train: Indented, *, rng: np.random.Generator) -> list[Likeness]:
    """Compare each test capture with all training skins: all of their indentations, and a sample of its own."""
    captures = np.unique(test.name)
    sample_n = max(SAMPLE_MIN_N, PAIRS_MAX_N // len(train.name) // len(captures))
    likest = []
    for capture in captures:
        own_uT = test.db_uT[test.name == capture]
        own_uT = own_uT[rng.permutation(len(own_uT))[:sample_n]]
        shares = _copied_shares(own_uT, train)
        most = max(shares, key=lambda skin: shares[skin])
        likest.append(Likeness(str(capture), most, shares[most], len(own_uT)))
    return likest


def nearest_rays(
    db_uT: Float32[np.ndarray, "n ch"], others_uT: Float32[np.ndarray, "m ch"]
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Find for each row the one of `others_uT` nearest in direction, and how far off that one's ray (uT) it lies."""
    rays = others_uT / np.linalg.norm(others_uT, axis=1, keepdims=True)
    rows_n = max(1, CHUNK_PAIRS_N // len(rays))
    chunks = [db_uT[i : i + rows_n] for i in range(0, len(db_uT), rows_n)]
    nearest = np.concatenate([(chunk @ rays.T).argmax(axis=1) for chunk in chunks])
    ray = rays[nearest].astype(np.float64)
    along_uT = (db_uT * ray).sum(axis=1, keepdims=True)
    return nearest, np.linalg.norm(db_uT - along_uT * ray, axis=1)


def _copied_shares(own_uT: Float32[np.ndarray, "n ch"], train: Indented) -> dict[str, float]:
    nearest, off_uT = nearest_rays(own_uT, train.db_uT)
    alike = off_uT < ALIKE_NOISES * noise_uT(own_uT.shape[1])
    factor = np.linalg.norm(own_uT, axis=1) / np.linalg.norm(train.db_uT[nearest], axis=1)
    shares = {}
    for skin in np.unique(train.name):
        hit = factor[alike & (train.name[nearest] == skin)]
        steady = np.abs(hit / np.median(hit) - 1) < FACTOR_TOLERANCE if len(hit) else hit
        shares[str(skin)] = float(steady.sum() / len(own_uT))
    return shares


def holds(checks: Iterable[Check]) -> bool:
    """Tell whether every rule holds, but for the leaks that are known."""
    return all(check.holds or check.known for check in checks)


def to_words(checks: Iterable[Check]) -> list[dict[str, str | bool]]:
    """Write checks as JSON words."""
    return [asdict(check) for check in checks]


SKINS_UNSEEN = ("lobo", "sensors", "labels", "transfer")
SKIN_SHARED = ("single_temporal", "single_indentation", "single_pass")
PAPERS_WAY = "single_random"  # readings of one indentation on both sides, as in the paper's section 4


@dataclass(frozen=True)
class Labels:
    """What each row of the scene belongs to; `indentation` is unique over the scene."""

    board: np.ndarray
    skin: np.ndarray
    indentation: Int[np.ndarray, " f"]
    capture: np.ndarray


def audit_fold(
    sides: Sides, labels: Labels, *, db_uT: Float[np.ndarray, "f ch"], rng: np.random.Generator
) -> list[Check]:
    """Check that nothing of the test side was trained on, by row, label and likeness, nor adapted to.

    >>> skin = np.array(["s1", "s1", "s2"])
    >>> labels = Labels(np.array(["b1", "b1", "b2"]), skin, np.array([0, 0, 1]), capture=skin)
    >>> db_uT = np.array([[200.0, 0, 0], [200, 0, 0], [0, 200, 0]], np.float32)
    >>> fold = Sides("lobo", "b2", np.array([0, 1]), np.array([], int), np.array([2]))
    >>> for check in audit_fold(fold, labels, db_uT=db_uT, rng=rng):
    ...     print(f"{check.what}: {check.found}: {check.holds}")
    readings: 0 of 1 test readings trained on or adapted to: True
    boards: 0 of 1 on both sides: True
    skins: 0 of 1 on both sides: True
    indentations: 0 of 1 on both sides: True
    copies: 1 of 1 captures compared; s2 like s1: 0.0 % of 1 indentations: True
    """
    _check_experiment(sides)
    checks = [_readings(sides)]
    if sides.experiment in SKINS_UNSEEN:
        checks += [_apart("boards", labels.board, sides), _apart("skins", labels.skin, sides)]
        checks += [_apart("indentations", labels.indentation, sides), _copies(sides, labels, db_uT, rng)]
    elif sides.experiment in SKIN_SHARED:
        rule = "apart; the skin is shared by design"
        checks.append(_apart("indentations", labels.indentation, sides, rule=rule))
    else:
        rule = "apart, but for the paper's own protocol; the skin is shared by design"
        checks.append(_apart("indentations", labels.indentation, sides, rule=rule, known=True))
    return checks + (_pool(sides, labels) if len(sides.pool) else [])


def _check_experiment(sides: Sides) -> None:
    known = (*SKINS_UNSEEN, *SKIN_SHARED, PAPERS_WAY)
    if sides.experiment not in known:
        raise ParamsError(
                f"fold {sides.where}", "the experiment", f"one of {', '.join(known)}", sides.experiment,
                "Say in the audit what its two sides may share.",
            )  # fmt: skip
    if not (len(sides.train) and len(sides.test)):
        got = f"{len(sides.train)} to train on, {len(sides.test)} to test on"
        raise ParamsError(f"fold {sides.where}", "rows", "on both sides", got, "Split again.")


def _readings(sides: Sides) -> Check:
    seen = np.isin(sides.test, np.concatenate([sides.train, sides.pool]))
    found = f"{int(seen.sum())} of {len(sides.test)} test readings trained on or adapted to"
    return Check("readings", sides.where, "on one side only", found, holds=not seen.any(), known=False)


def _apart(what: str, label: np.ndarray, sides: Sides, *, rule: str = "apart", known: bool = False) -> Check:
    """Look for labels on both sides; `known` excuses them."""
    own = np.unique(label[sides.test])
    shared = own[np.isin(own, np.unique(label[sides.train]))]
    found = f"{len(shared)} of {len(own)} on both sides{_some(shared)}"
    return Check(what, sides.where, rule, found, holds=len(shared) == 0, known=known and len(shared) > 0)


def _copies(sides: Sides, labels: Labels, db_uT: np.ndarray, rng: np.random.Generator) -> Check:
    """Look for recordings of a training skin under a test skin's name."""
    test, train = (
        strong_indentations(name[side], labels.indentation[side], db_uT[side])
        for name, side in ((labels.capture, sides.test), (labels.skin, sides.train))
    )
    rule = f"in no capture {100 * COPIED_SHARE_MAX:g} % like one training skin"
    captures, skins = labels.capture[sides.test], labels.skin[sides.test]
    untold = np.setdiff1d(skins, skins[np.isin(captures, test.name)])
    if len(untold) or not len(train.name):
        found = f"cannot be told: fields within the noise{_some(untold)}"
        return Check("copies", sides.where, rule, found, holds=False, known=False)
    likest = liken(test, train, rng=rng)
    most = max(likest, key=lambda one: one.share)
    found = (
        f"{len(likest)} of {len(np.unique(captures))} captures compared; "
        f"{most.capture} like {most.train_skin}: {100 * most.share:.1f} % of {most.compared_n} indentations"
    )
    return Check("copies", sides.where, rule, found, holds=most.share < COPIED_SHARE_MAX, known=False)


def _pool(sides: Sides, labels: Labels) -> list[Check]:
    """Check the unlabelled pokes: of the skins held out, and none of those tested on."""
    pokes, tested = (np.unique(labels.indentation[side]) for side in (sides.pool, sides.test))
    shared = pokes[np.isin(pokes, tested)]
    skins = np.unique(labels.skin[sides.pool])
    foreign = np.setdiff1d(skins, labels.skin[sides.test])
    apart = f"{len(shared)} of {len(pokes)} unlabelled also tested{_some(shared)}"
    strangers = f"{len(foreign)} of {len(skins)} are not held out{_some(foreign)}"
    return [
        Check("pool indentations", sides.where, "apart from the test", apart, holds=len(shared) == 0, known=False),
        Check("pool skins", sides.where, "skins of the test", strangers, holds=len(foreign) == 0, known=False),
    ]


def _some(names: np.ndarray) -> str:
    """Name the first few, for a sentence."""
    if len(names) == 0:
        return ""
    return f": {', '.join(map(str, names[:3]))}{', ...' if len(names) > 3 else ''}"
