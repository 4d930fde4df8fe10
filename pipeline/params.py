"""The legal values of `params.yaml`, of every scene and of the plan. In: YAML. Out: frozen, checked models.

Whole files are checked here, for the command line; a stage reads only what it declares (`pipeline.settings`).
A section stands in a scene's file if, and only if, a question of the scene needs it: what a scene does not ask costs
nothing. Refuses to know what is done with a value.
"""

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from pipeline.asking import Asking, arms_of
from pipeline.dataset.rows import Selection
from pipeline.dataset.splits import Split
from pipeline.errors import ParamsError, complain
from pipeline.learning.recipe import (
    AdaptationsRow,
    AuditSettings,
    FineTuning,
    Labelling,
    Name,
    PokesSweep,
    Recipe,
    Schedule,
    TrainingRow,
)
from pipeline.questions import (
    ANSWERED_BY,
    ARMS,
    DRAWN_WITH,
    NEEDS,
    OF_RECORDED,
    POOLED_BY,
    STAGE_OF,
    WITH_SECTION,
    WITHOUT_SECTION,
)
from pipeline.settings import Settings
from pipeline.strict import Strict, parse, read_yaml

ROWS: dict[str, type[Schedule]] = {"recipes": Recipe, "adaptations": FineTuning, "labellings": Labelling}
STEPS = "How many steps is a scene's budget: write them in its sections."
Section = dict[str, Any]  # checked where it is read: by `Settings`, or by a stage that knows physics or scikit-learn


class OnBoards(Strict, extra="allow"):
    """A protocol, as far as the plan must know it: its kind, on which kind of boards it runs, its terms."""

    kind: str
    boards: str
    terms: tuple[str, ...]


class Simulation(Strict):
    """Section `simulate`; the rest is checked by `synthesis`, so that only its stages depend on physics."""

    boards: dict[str, Section]
    protocols: Annotated[dict[str, OnBoards], Field(min_length=1)]


class Scene(Asking):
    """One named set-up: its captures (or how to simulate them), its protocol, and the questions it asks."""

    seed: Annotated[int, Field(ge=0)]
    selection: Selection
    split: Split
    simulate: Simulation | None = None
    runtime: Section | None = None
    train_single: TrainingRow | None = None
    train_multi: TrainingRow | None = None
    train_triplet: TrainingRow | None = None
    adapt: AdaptationsRow | None = None
    sweep_pokes: PokesSweep | None = None
    train_classical: Section | None = None
    few_labels: Section | None = None
    audit: AuditSettings | None = None
    drift: Section | None = None
    variation: Section | None = None
    shear: Section | None = None
    sleeve: Section | None = None
    contacts: Section | None = None
    ambient: Section | None = None

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
        if self.protocols != set(self.simulate.protocols):
            have, want = set(self.simulate.protocols), self.protocols
            wrong = [f"lacks {sorted(want - have)}"] * bool(want - have)
            wrong += [f"holds {sorted(have - want)}, of which nothing is asked"] * bool(have - want)
            raise ValueError(f"simulate.protocols holds exactly what the questions need; it {' and '.join(wrong)}")
        return self


class Shared(Strict):
    """`params.yaml`: what scenes share, by name."""

    lost_fraction_max: Annotated[float, Field(ge=0, le=1)]
    recipes: dict[Name, Section]
    adaptations: dict[Name, Section]
    labellings: dict[Name, Section]
    methods: dict[Name, dict[Name, Section]]
    skin: Section
    rig: Section
    chip: Section
    spreads: Section
    terms: dict[str, Section]


class Plan(Strict):
    """`pipeline/plan.yaml`: what each scene that runs asks, and by stage and key what each stage of dvc.yaml takes."""

    scenes: dict[str, tuple[str, ...]]
    stages: dict[str, dict[str, dict[str, Any]]]


def read_scene(path: Path, params: Path) -> Scene:
    """Read and check `pipeline/scenes/<name>.yaml`, with the rows of `params.yaml` that it names."""
    words = read_yaml(path)
    scene = parse(Scene, words, str(path))
    Settings(path.stem, str(path), words, read_shared(params), {}).check_all()
    return scene


def read_shared(path: Path) -> dict[str, Any]:
    """Read and check `params.yaml`, as it is written."""
    words: dict[str, Any] = read_yaml(path)
    shared = parse(Shared, words, str(path))
    rows = {"recipes": shared.recipes, "adaptations": shared.adaptations, "labellings": shared.labellings}
    for section, own in rows.items():
        for name, row in own.items():
            if "steps_n" in row:
                raise ParamsError(complain(f"{path}: {section}", name, "without steps_n", "one", STEPS))
            parse(ROWS[section], row | {"steps_n": 1}, f"{path}: {section}.{name}")
    return words


def read_plan(path: Path) -> Plan:
    """Read and check `pipeline/plan.yaml`."""
    return parse(Plan, read_yaml(path), str(path))
