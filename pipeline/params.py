"""The legal values of `params.yaml` and of every scene. In: YAML. Out: frozen, checked models without defaults.

A section stands in a scene's file if, and only if, a question of the scene needs it: what a scene does not ask costs
nothing. Refuses to know what is done with a value.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from pipeline.dataset.rows import Selection
from pipeline.dataset.splits import Question, Split
from pipeline.errors import ParamsError, complain
from pipeline.learning.recipe import Adaptations, AuditSettings, PokesSweep, Training
from pipeline.questions import (
    ANSWERED_BY,
    ARMS,
    DRAWN_WITH,
    EXPERIMENTS,
    MAIN_PROTOCOL,
    MODELLED,
    NEEDS,
    OF_RECORDED,
    POOLED_BY,
    STAGE_OF,
    STUDIED_BY,
    STUDIES,
    SWEPT,
    WITH_SECTION,
    WITHOUT_SECTION,
    Experiment,
    Further,
    Study,
)
from pipeline.sections import Ambient, Contacts, Drift, Shear, Sleeve, Variation
from pipeline.strict import Strict, parse, read_yaml


class OnBoards(Strict, extra="allow"):
    """A protocol, as far as the plan must know it: its kind, and on which kind of boards it runs."""

    kind: str
    boards: str


class Simulation(Strict, extra="allow"):
    """Section `simulate`; the rest is checked by `synthesis`, so that only its stages depend on physics."""

    protocols: Annotated[dict[str, OnBoards], Field(min_length=1)]


class Scene(Strict):
    """One named set-up: its captures (or how to simulate them), its protocol, and the questions it asks."""

    source: Literal["simulated", "recorded"]
    seed: Annotated[int, Field(ge=0)]
    questions: Annotated[tuple[Literal[Question, Further, Study, Experiment], ...], Field(min_length=1)]
    selection: Selection
    split: Split
    simulate: Simulation | None = None
    runtime: dict[str, Any] | None = None  # checked by the stage, as `simulate` is
    train_single: Training | None = None
    train_multi: Training | None = None
    train_triplet: Training | None = None
    adapt: Adaptations | None = None
    sweep_pokes: PokesSweep | None = None
    train_classical: dict[str, Any] | None = None  # checked by the stage, as `simulate` is
    few_labels: dict[str, Any] | None = None
    audit: AuditSettings | None = None
    drift: Drift | None = None
    variation: Variation | None = None
    shear: Shear | None = None
    sleeve: Sleeve | None = None
    contacts: Contacts | None = None
    ambient: Ambient | None = None

    @model_validator(mode="after")
    def _sections_follow_questions(self) -> "Scene":
        if (self.simulate is not None) != (self.source == "simulated"):
            raise ValueError("section simulate stands in a scene if and only if its source is simulated")
        for question in self.questions:
            if lacking := NEEDS.get(question, set()) - set(self.questions):
                raise ValueError(f"a scene that asks {question} also asks {sorted(lacking)}, on which it goes on")
        asked = set(arms_of(self))
        for arm in ARMS:
            if arm not in WITHOUT_SECTION and (getattr(self, arm) is not None) != (arm in asked):
                asking = [question for question, stage in STAGE_OF.items() if stage == arm]
                raise ValueError(f"section {arm} stands in a scene if and only if it asks one of {asking}")
        needed = set().union(*(DRAWN_WITH[question] for question in self.trained))
        needed |= {"pool_passes_n"} if POOLED_BY in self.questions else set()
        if needed != self.split.model_fields_set:
            raise ValueError(f"split holds exactly what the questions need, {sorted(needed)}")
        return self

    @model_validator(mode="after")
    def _adaptation_has_its_bases(self) -> "Scene":
        bases = self.train_triplet.recipes if self.train_triplet else {}
        for name, one in self.adapt.recipes.items() if self.adapt else ():
            if one.base not in bases:
                raise ValueError(f"adapt.recipes.{name}.base is one of {sorted(bases)}, not {one.base!r}")
        return self

    @model_validator(mode="after")
    def _questions_fit_the_source(self) -> "Scene":
        if not self.trained:
            raise ValueError(f"questions holds at least one of {sorted(ANSWERED_BY)}")
        if self.simulate is None and self.studied:
            raise ValueError(f"questions {list(self.studied)} are about physics: only a simulated scene asks them")
        if (self.runtime is not None) != ("runtime" in self.questions):
            raise ValueError("section runtime stands in a scene if and only if it asks runtime")
        return self

    @model_validator(mode="after")
    def _experiments_have_what_they_need(self) -> "Scene":
        there = {question for question in WITH_SECTION if getattr(self, question) is not None}
        if surplus := sorted(there - set(self.questions)):
            raise ValueError(f"sections {surplus} stand there, but questions does not hold them: take them out")
        if lacking := sorted(WITH_SECTION & set(self.questions) - there):
            raise ValueError(f"questions {lacking} need sections of their names: write them, or do not ask")
        if self.simulate is None:
            if beyond := sorted(set(self.experiments) - OF_RECORDED):
                raise ValueError(f"questions {beyond} are asked of simulated scenes only, so far")
            return self
        needed = {MAIN_PROTOCOL} | {EXPERIMENTS[question] for question in self.experiments} - {None}
        if needed != set(self.simulate.protocols):
            have, want = set(self.simulate.protocols), set(map(str, needed))
            wrong = [f"lacks {sorted(want - have)}"] * bool(want - have)
            wrong += [f"holds {sorted(have - want)}, of which nothing is asked"] * bool(have - want)
            raise ValueError(f"simulate.protocols holds exactly what the questions need; it {' and '.join(wrong)}")
        return self

    @property
    def experiments(self) -> tuple[str, ...]:
        """The paper's further experiments among the questions."""
        return tuple(question for question in self.questions if question in EXPERIMENTS)

    @property
    def trained(self) -> tuple[str, ...]:
        """The questions that have folds of their own."""
        return tuple(question for question in self.questions if question in ANSWERED_BY)

    @property
    def studied(self) -> tuple[str, ...]:
        """The questions about the physics."""
        return tuple(question for question in self.questions if question in STUDIED_BY)


class IngestItem(Strict):
    """One recorded capture that has a stage of its own."""

    scene: str
    capture: str


class ProtocolItem(Strict):
    """One protocol of a simulated scene, and the boards it needs; its key names the folder of its captures."""

    scene: str
    protocol: str
    boards: str


class DescribeItem(Strict):
    """One folder of captures, and the name of its description."""

    scene: str
    protocol: str


class ExperimentItem(Strict):
    """One scene that asks for an experiment, and the folder of the captures that it is asked of."""

    scene: str
    folder: str


class Stages(Strict):
    """Which scenes each stage of dvc.yaml runs for; made from the scenes by `reskin scenes use`, never by hand."""

    simulate: dict[str, ProtocolItem]
    ingest_simulated: dict[str, ProtocolItem]
    ingest: dict[str, IngestItem]
    describe: dict[str, DescribeItem]
    split: dict[str, tuple[str, ...]]  # scene -> its recorded captures; none for a simulated one
    train_single: tuple[str, ...]
    train_multi: tuple[str, ...]
    train_triplet: tuple[str, ...]
    adapt: tuple[str, ...]
    sweep_pokes: tuple[str, ...]
    sweep_sensors: tuple[str, ...]
    train_classical: tuple[str, ...]
    few_labels: tuple[str, ...]
    audit: tuple[str, ...]
    drift: dict[str, ExperimentItem]
    variation: dict[str, ExperimentItem]
    shear: dict[str, ExperimentItem]
    manual: dict[str, ExperimentItem]
    flexible: dict[str, ExperimentItem]
    sleeve: dict[str, ExperimentItem]
    sensitivity: dict[str, ExperimentItem]
    logs: dict[str, ExperimentItem]
    contacts: dict[str, ExperimentItem]
    ambient: dict[str, ExperimentItem]
    dynamics: dict[str, ExperimentItem]
    verify: tuple[str, ...]
    stability: tuple[str, ...]
    runtime: tuple[str, ...]
    leave_out: tuple[str, ...]
    publish: tuple[str, ...]
    report: tuple[str, ...]


class Params(Strict):
    """`params.yaml`: which scenes run, and what they share."""

    scenes: tuple[str, ...]
    lost_fraction_max: Annotated[float, Field(ge=0, le=1)]
    stages: Stages


def read_scene(path: Path) -> Scene:
    """Read and check `pipeline/scenes/<name>.yaml`."""
    return parse(Scene, read_yaml(path), str(path))


def read_params(path: Path) -> Params:
    """Read and check `params.yaml`."""
    return parse(Params, read_yaml(path), str(path))


def check_planned(name: str, scene: Scene, params: Params, where: str) -> None:
    """Raise if `params.yaml` has other stages than the scene's questions and protocols ask for: it was edited since."""
    wanted = arms_of(scene) + [STUDIED_BY[question] for question in scene.studied]
    unplanned = [stage for stage in wanted if name not in getattr(params.stages, stage)]
    unplanned += [stage for stage in scene.experiments if name not in getattr(params.stages, stage)]
    if scene.simulate is not None:
        planned = {item.protocol for item in params.stages.simulate.values() if item.scene == name}
        unplanned += [f"protocol {one}" for one in sorted(planned ^ set(scene.simulate.protocols))]
    if unplanned:
        raise ParamsError(
            complain(
                where, "questions and protocols", "those planned in params.yaml", f"{', '.join(unplanned)} only in one",
                f"Try: reskin scenes use {' '.join(params.scenes)}",
            )
        )  # fmt: skip


def arms_of(scene: Scene) -> list[str]:
    """Name the stages that answer a scene's questions about learning."""
    asked = {STAGE_OF[question] for question in scene.questions if question in STAGE_OF}
    return [arm for arm in ARMS if arm in asked]


def runs(scene: Scene, unit: str) -> bool:
    """Tell whether a stage still runs for a scene, named as its cost is: `drift`, `simulate-wear`."""
    stage, _, part = unit.partition("-")
    if stage in {*ARMS, *EXPERIMENTS, *STUDIES}:
        return stage in {*arms_of(scene), *scene.experiments, *(STUDIED_BY[question] for question in scene.studied)}
    return not part or scene.simulate is None or part in scene.simulate.protocols


def modelled(scene: Scene) -> list[str]:
    """Name the stages that leave models, with cards and predictions."""
    return [arm for arm in arms_of(scene) if arm in MODELLED]


def swept(scene: Scene) -> dict[str, str]:
    """Name the questions whose answers are points of a curve, and the stage that finds them."""
    return {question: stage for question, stage in SWEPT.items() if question in scene.questions}


def described_in(scene: Scene) -> list[str]:
    """Name the descriptions of a scene's captures: that of its main protocol, or of the recorded ones."""
    return ["recorded"] if scene.simulate is None else [MAIN_PROTOCOL]


def captures_of(scene: str, params: Params, indentations: Path) -> list[str]:
    """Name the captures of a scene, sorted.

    Recorded ones stand in `params.yaml`: a stale file of a removed capture must not come back. Simulated ones are what
    their one stage has just written.
    """
    recorded = params.stages.split[scene]
    return sorted(recorded) or sorted(file.stem for file in indentations.glob("*.parquet"))
