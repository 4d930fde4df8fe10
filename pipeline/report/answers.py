"""Answer, from the numbers of a scene, whether its models work on a skin that was not in training.

Place and force of a contact have separate answers. Each answer states what a user has to do with the new skin.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import sqrt
from statistics import fmean
from typing import Any

from pipeline.formatting import Statistic, show, show_with_unit, three_digits, two_digits
from pipeline.paper import ADAPTED_POKES_N, PLACE_ACCURACY_MIN_PCT
from pipeline.report.figures import IN_CONTEXT, constant_force, unseen_rows
from pipeline.report.table_2 import Results, models
from pipeline.statistics import Stat

PLACE, FORCE = "place", "force"
YES, PARTLY, NO, UNTESTED = "yes", "partly", "no", "not tested"
PLACE_PARTLY_PCT = (
    50.0  # assumed limit for "partly"; the limit for "yes" is the paper's requirement `PLACE_ACCURACY_MIN_PCT`
)
FORCE_YES_R2, FORCE_PARTLY_R2 = 0.9, 0.5  # assumed; the paper states no requirement for the force on a new skin
LEVELS = (
    f"For places, the answer is yes if at least {PLACE_ACCURACY_MIN_PCT:g} % of the readings are within 1 mm in x and "
    'in y (the paper\'s requirement "1mm with 90% accuracy"), and partly if at least '
    f"{PLACE_PARTLY_PCT:g} % are. For forces, the answer is yes if R² is at least {FORCE_YES_R2:g}, and partly if R² "
    f"is at least {FORCE_PARTLY_R2:g}. The first of these limits is the paper's, and we chose the others. For a yes, "
    "the whole interval has to be above the limit. With fewer than four boards there is no interval; then the value "
    "of every board has to be above the limit."
)
IN_BRACKETS = (
    "[low, high] is the 95 % interval over the held-out boards (Student's t). With fewer than four boards there is no "
    "interval, and (a; b) are the values of the boards. ± is the standard deviation over pairs of a training skin and "
    "a tested skin."
)
SQUARED = {"mse_xy_mm2": "mm", "mse_f_N2": "N"}  # unit of the square root of each mean squared error
NOTHING, UNLABELLED = "none", "presses without labels"
NONE_HELD_OUT = "no board held out"
ANSWER, SECOND, COMPARED = "answer", "second", "compared"
RIG, SHIPPED = IN_CONTEXT  # methods of experiment new_board
ADAPTED = "Multi-sensor with triplet loss, adapted"
CHOSEN_ON = "lab"  # the scene on whose boards details of the universal model were chosen (docs/learning.md)
USABLE = {YES: " (usable)", PARTLY: " (partly usable)", NO: " (not usable)"}
WITHIN_SKIN = ("single_temporal", "single_pass", "single_indentation")  # the first of these that the scene ran is shown


@dataclass(frozen=True)
class Effort:
    """Scores of a model on new skins, and the data that it needs of a new skin; `paper` has the paper's means.

    `role` is `answer` if the answer of the scene is about this model, `second` if the short form of the answer also
    states the score of this model, and `compared` if another sentence compares this model with the answer's model.
    """

    model: str
    needs: str
    scores: Mapping[str, Stat]
    paper: Mapping[str, float]
    labels_n: int = 0
    role: str = ""

    @property
    def cells(self) -> dict[str, str]:
        """The scores as text, by column."""
        paper = [
            f"{three_digits(self.paper['accuracy_pct'])} %" if "accuracy_pct" in self.paper else "",
            *(f"{sqrt(self.paper[name]):.2f} {unit}" for name, unit in SQUARED.items() if name in self.paper),
        ]
        return {
            "model": self.model,
            "data needed from the new skin": self.needs,
            "place: within 1 mm": show_with_unit(self.scores.get("accuracy_pct"), "%"),
            "place: rms error": show_with_unit(rms(self.scores.get("mse_xy_mm2")), "mm"),
            "force: rms error": show_with_unit(rms(self.scores.get("mse_f_N2")), "N"),
            "force: R²": show(self.scores.get("r2_f")),
            "paper": ", ".join(filter(None, paper)) or "–",
        }


@dataclass(frozen=True)
class Answer:
    """The answer for the place or the force of a contact: a level, a short form, and sentences with numbers.

    `second` is a sentence about the second model, which is shown together with the short form of the answer.
    """

    quantity: str
    level: str
    short: str
    sentences: tuple[str, ...] = ()
    second: str = ""


@dataclass(frozen=True)
class Answers:
    """The answers of a scene for place and force, what was tested, and the scores behind the answers."""

    tested: str
    place: Answer
    force: Answer
    efforts: tuple[Effort, ...] = ()


def answers(numbers: Results) -> Answers:
    """Answer whether the models of a scene work on skins that were not in training."""
    efforts = tuple(_efforts(numbers))
    if not efforts:
        return _within_skin(numbers)
    best = next(effort for effort in efforts if effort.role == ANSWER)
    others = [effort for effort in efforts if effort.role in (SECOND, COMPARED)]
    return Answers(_tested(numbers, best), _place(best, others), _force(numbers, best, others), efforts)


def rms(mse: Statistic | None) -> Stat | None:
    """Return the root mean squared error for a mean squared error, with an interval or with one value per board.

    If the values of boards are known, the square root of each value is computed, and the mean is the mean of these
    roots. The result has no standard deviation, because the standard deviation of the square roots cannot be computed
    from the standard deviation of the squared errors.

    >>> rms({"mean": 0.25, "n": 6, "ci95": [0.16, 0.36]}).to_json()
    {'mean': 0.5, 'n': 6, 'ci95': [0.4, 0.6]}
    """
    if mse is None:
        return None
    stat = Stat.of(mse)
    if stat.values:
        roots = tuple(sqrt(value) for value in stat.values)
        return Stat(fmean(roots), stat.n, values=roots)
    ci95 = None if stat.ci95 is None else (sqrt(stat.ci95[0]), sqrt(stat.ci95[1]))
    return Stat(sqrt(stat.mean), stat.n, ci95=ci95)


def level(score: Statistic, yes: float, partly: float) -> str:
    """Return the level of a score; for a yes, the whole interval, or all boards, must be at `yes` or above."""
    stat = Stat.of(score)
    if min(stat.ends or (stat.mean,)) >= yes:
        return YES
    return PARTLY if stat.mean >= partly else NO


def _efforts(numbers: Results) -> Iterator[Effort]:
    """Yield the models to show; the model that needs the most data from the new skin comes last."""
    if unseen_rows(numbers):
        yield from _efforts_on_new_boards(numbers)
        return
    known, table2 = models(numbers), numbers.get("table2", {})
    adapting = f"{numbers.get('adapt', {}).get('pokes_n', ADAPTED_POKES_N)} presses without labels"
    rows = [row for row in ("single", "multi", "triplet", "adapted") if row in table2]
    for row in rows:
        title = ADAPTED if row == "adapted" else known[row].title
        paper = {metric: mean for metric, (mean, _) in known[row].paper.items()}
        needs = adapting if row == "adapted" else NOTHING
        yield Effort(title, needs, table2[row], paper, role=ANSWER if row == rows[-1] else "")


def _efforts_on_new_boards(numbers: Results) -> Iterator[Effort]:
    """Yield the in-context models by number of labels, scored as in the figure of boards never seen in training."""
    rows = sorted((row for row in unseen_rows(numbers) if row["labels_n"] != 1), key=lambda row: row["labels_n"])
    first = RIG if any(row["method"] == RIG for row in rows) else SHIPPED
    for method in dict.fromkeys((SHIPPED, first)):  # the model that gives the answer comes last
        swept = [row for row in rows if row["method"] == method]
        for row in swept:
            unlabelled, labels_n = f"{row['pokes_n']} presses without labels", row["labels_n"]
            needs = f"{unlabelled}, and {labels_n} with known place and force" if labels_n else unlabelled
            role = ""
            if row is swept[0]:
                role = ANSWER if method == first else SECOND
            elif row is swept[-1] and method == first:
                role = COMPARED
            yield Effort(f"In-context model (ours), {IN_CONTEXT[method]}", needs, row, {}, labels_n, role)


def _tested(numbers: Results, best: Effort) -> str:
    source = numbers["provenance"]["source"]
    boards_n, skins_n = _held_out_n(numbers)
    boards = f"{boards_n} {source} boards with {skins_n} skins" if boards_n and skins_n else f"{source} boards"
    held_out = f"Tested on {boards}; no tested board or skin was in training."
    if source == "simulated":
        held_out += " All readings were simulated, so these results are no evidence about real skins."
    if unseen_rows(numbers) and numbers["provenance"]["scene"] == CHOSEN_ON:
        held_out += " However, details of the model were chosen with these boards, so the scores are optimistic."
    return f"{held_out} Model: {best.model}. Data that this model needs from the new skin: {best.needs}."


def _held_out_n(numbers: Results) -> tuple[int, int]:
    """Return the numbers of held-out boards and skins; 0 if unknown. Not all scenes have the protocol of their run."""
    if lobo := numbers.get("protocol", {}).get("lobo"):
        return lobo["boards_n"], lobo["skins_n"]
    described: Mapping[str, Any] = next(iter(numbers.get("described", {}).values()), {})
    over_skins = [stat["n"] for stat in described.get("over_skins", {}).values()]
    return len(numbers.get("lobo", {}).get("by_board", ())), max(over_skins, default=0)


def _place(best: Effort, others: Sequence[Effort]) -> Answer:
    accuracy = best.scores.get("accuracy_pct")
    if accuracy is None:
        return Answer(PLACE, UNTESTED, "the recordings have no places")
    error = show_with_unit(rms(best.scores.get("mse_xy_mm2")), "mm")
    second = ""
    sentences = [
        f"Rms error of one coordinate (x or y): {error}.",
        f'The paper\'s requirement, "1mm with 90% accuracy": {_requirement(accuracy)}.',
    ]
    if best.paper:
        paper_mm = sqrt(best.paper["mse_xy_mm2"])
        sentences.append(
            f"Paper: {three_digits(best.paper['accuracy_pct'])} % within 1 mm; rms error of one coordinate "
            f"{paper_mm:.2f} mm."
        )
    for other in others:
        sentences.append(f"{_named(other)}: {show_with_unit(other.scores['accuracy_pct'], '%')} within 1 mm.")
        second = sentences[-1] if other.role == SECOND else second
    reached = level(accuracy, PLACE_ACCURACY_MIN_PCT, PLACE_PARTLY_PCT)
    short = f"{show_with_unit(accuracy, '%')} of readings are within 1 mm in x and in y"
    return Answer(PLACE, reached, short, tuple(sentences), second)


def _requirement(accuracy: Statistic) -> str:
    """Say whether an accuracy reaches the paper's requirement, from its interval or the values of a few boards."""
    stat = Stat.of(accuracy)
    ends, few = stat.ends or (stat.mean,), stat.ci95 is None
    if min(ends) >= PLACE_ACCURACY_MIN_PCT:
        return "reached on all boards" if few else "reached"
    if max(ends) < PLACE_ACCURACY_MIN_PCT:
        return "reached on no board" if few else "not reached"
    return "reached on some boards" if few else f"inconclusive (the interval includes {PLACE_ACCURACY_MIN_PCT:g} %)"


def _force(numbers: Results, best: Effort, others: Sequence[Effort]) -> Answer:
    explained, error = best.scores.get("r2_f"), rms(best.scores.get("mse_f_N2"))
    if explained is None or error is None:
        return Answer(FORCE, UNTESTED, "the recordings have no forces")
    second = ""
    sentences = [f"Rms error: {show_with_unit(error, 'N')}; R²: {show(explained)}.", *_forces(numbers)]
    table_2 = numbers.get("constant_force", {}).get("table2")
    constant = constant_force(numbers) or (rms(table_2["mse_f_N2"]) if table_2 else None)
    if best.paper:
        sentences.append(
            f"Paper: rms error {sqrt(best.paper['mse_f_N2']):.2f} N. The paper does not state how large its forces are."
        )
    for other in others:
        r2 = other.scores["r2_f"]
        shown = show_with_unit(rms(other.scores["mse_f_N2"]), "N")
        sentences.append(f"{_named(other)}: rms error {shown}; R² {show(r2)}{USABLE[force_level(r2)]}.")
        second = sentences[-1] if other.role == SECOND else second
    short = f"rms error {two_digits(error.mean)} N"
    if constant:
        short += f" (always predicting the mean force: {two_digits(Stat.of(constant).mean)} N)"
    if force_level(explained) == NO:
        short = f"not usable; {short}"
    return Answer(FORCE, force_level(explained), short, tuple(sentences), second)


def force_level(explained: Statistic) -> str:
    """Return the level that R² of the force reaches."""
    return level(explained, FORCE_YES_R2, FORCE_PARTLY_R2)


def _named(effort: Effort) -> str:
    return f"With {effort.labels_n} labelled presses" if effort.labels_n else effort.model


def _forces(numbers: Results) -> list[str]:
    described: Mapping[str, Any] = next(iter(numbers.get("described", {}).values()), {"over_skins": {}})
    over_skins = described["over_skins"]
    if not {"force_median_N", "force_max_N"} <= over_skins.keys():
        return []
    median_N, max_N = over_skins["force_median_N"]["mean"], over_skins["force_max_N"]["most"]
    return [f"Tested forces: median {two_digits(median_N)} N, up to {two_digits(max_N)} N."]


def _within_skin(numbers: Results) -> Answers:
    """Answer `not tested` for a scene that holds out no board, and state the scores on skins that were in training."""
    split = next((name for name in WITHIN_SKIN if name in numbers), None)
    tested = "This scene holds out no board, so it does not test new skins."
    if split is None:
        return Answers(tested, Answer(PLACE, UNTESTED, NONE_HELD_OUT), Answer(FORCE, UNTESTED, NONE_HELD_OUT))
    own = "Scores on skins that were in training, for held-out readings"
    skins = numbers.get("single_skins", {"": {name: stat["mean"] for name, stat in numbers[split].items()}})
    places, forces = [], []
    for skin, scores in skins.items():
        seen = numbers.get("hover", {}).get(skin, {}).get("seen", False)
        named = f"{skin}: " if skin else ""
        magnetic = ", but the chips also sense the tip without touch" if seen else ""
        places.append(f"{named}{three_digits(scores['accuracy_pct'])} % within 1 mm{magnetic}")
        if "mse_f_N2" in scores:
            forces.append(f"{named}rms error {two_digits(sqrt(scores['mse_f_N2']))} N, R² {scores['r2_f']:.3f}")
    return Answers(
        tested,
        Answer(PLACE, UNTESTED, NONE_HELD_OUT, (f"{own}: {'; '.join(places)}.",)),
        Answer(FORCE, UNTESTED, NONE_HELD_OUT, (f"{own}: {'; '.join(forces)}.",))
        if forces
        else Answer(FORCE, UNTESTED, "the recordings have no forces"),
    )
