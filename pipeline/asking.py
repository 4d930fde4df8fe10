"""What a scene asks: its source and its questions -> the stages that answer, the protocols that they need. Words only.

Refuses to know settings, files and results.
"""

from collections.abc import Iterable
from typing import Annotated, Literal

from pydantic import Field

from pipeline.dataset.splits import Question
from pipeline.questions import (
    ANSWERED_BY,
    ARMS,
    EXPERIMENTS,
    MAIN_PROTOCOL,
    MODELLED,
    STAGE_OF,
    STUDIED_BY,
    STUDIES,
    SWEPT,
    Experiment,
    Further,
    Study,
)
from pipeline.strict import Strict

Source = Literal["simulated", "recorded"]
Questions = Annotated[tuple[Literal[Question, Further, Study, Experiment], ...], Field(min_length=1)]


class Asking(Strict):
    """The two settings of a scene that say which stages it has."""

    source: Source
    questions: Questions

    @property
    def experiments(self) -> tuple[str, ...]:
        """The paper's further experiments among the questions."""
        return tuple(question for question in self.questions if question in EXPERIMENTS)

    @property
    def trained(self) -> tuple[str, ...]:
        """The questions that have folds of their own."""
        return folds_of(self.questions)

    @property
    def studied(self) -> tuple[str, ...]:
        """The questions about the physics."""
        return tuple(question for question in self.questions if question in STUDIED_BY)

    @property
    def protocols(self) -> set[str]:
        """The protocols that a simulated scene needs for its questions."""
        return {MAIN_PROTOCOL} | {own for question in self.experiments if (own := EXPERIMENTS[question]) is not None}


def folds_of(questions: Iterable[str]) -> tuple[str, ...]:
    """Keep the questions that have folds of their own."""
    return tuple(question for question in questions if question in ANSWERED_BY)


def arms_of(asking: Asking) -> list[str]:
    """Name the stages that answer a scene's questions about learning."""
    asked = {STAGE_OF[question] for question in asking.questions if question in STAGE_OF}
    return [arm for arm in ARMS if arm in asked]


def runs(asking: Asking, unit: str) -> bool:
    """Tell whether a stage still runs for a scene, named as its cost is: `drift`, `simulate-wear`."""
    stage, _, part = unit.partition("-")
    if stage in {*ARMS, *EXPERIMENTS, *STUDIES}:
        return stage in {*arms_of(asking), *asking.experiments, *(STUDIED_BY[one] for one in asking.studied)}
    return not part or asking.source == "recorded" or part in asking.protocols


def modelled(asking: Asking) -> list[str]:
    """Name the stages that leave models, with cards and predictions."""
    return [arm for arm in arms_of(asking) if arm in MODELLED]


def swept(asking: Asking) -> dict[str, str]:
    """Name the questions whose answers are points of a curve, and the stage that finds them."""
    return {question: stage for question, stage in SWEPT.items() if question in asking.questions}


def described_in(asking: Asking) -> list[str]:
    """Name the descriptions of a scene's captures: that of its main protocol, or of the recorded ones."""
    return ["recorded"] if asking.source == "recorded" else [MAIN_PROTOCOL]
