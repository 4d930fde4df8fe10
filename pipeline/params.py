"""The legal values of `params.yaml`, of every scene and of the plan. In: YAML. Out: frozen, checked models.

Whole files are checked here, for the command line; a stage reads only what dvc.yaml declares for it. A section stands
in a scene's file if, and only if, a question of the scene needs it: what a scene does not ask costs nothing. Refuses to
know what is done with a value.
"""

from collections.abc import Set
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from pipeline.capture.decisions import Decisions
from pipeline.core.config import Seeded, Settings, Strict, parse, read_yaml
from pipeline.core.errors import ParamsError
from pipeline.dataset.rows import Selection
from pipeline.dataset.splits import Split
from pipeline.learning.recipe import FineTuning, Labelling, Name, Recipe, Schedule
from pipeline.questions import MAIN_PROTOCOL, POOLED_BY, QUESTIONS, ROWS, SECTIONS, Question, stages

SHARED_ROWS: dict[str, type[Schedule]] = {"recipes": Recipe, "adaptations": FineTuning, "labellings": Labelling}
STEPS = "How many steps is a scene's budget: write them in its sections."
Section = dict[str, Any]  # checked by the stage that reads it
Source = Literal["simulated", "recorded"]


class OnBoards(Strict, extra="allow"):
    """A protocol, as far as the plan needs it: its kind, its kind of boards, its terms of physics."""

    kind: str
    boards: str
    terms: tuple[str, ...]


class Simulation(Strict):
    """Section `simulate`; the rest is checked by `synthesis`, so that only its stages depend on physics."""

    boards: dict[str, Section]
    protocols: Annotated[dict[str, OnBoards], Field(min_length=1)]


class Asking(Strict, extra="ignore"):
    """The two settings of a scene that say which stages it has."""

    source: Source
    questions: Annotated[tuple[Literal[tuple(QUESTIONS)], ...], Field(min_length=1)]  # type: ignore[valid-type]

    @property
    def rows(self) -> list[Question]:
        """The rows of the table of questions that the scene asks, in the order that it asks them."""
        return [QUESTIONS[name] for name in self.questions]

    @property
    def experiments(self) -> tuple[str, ...]:
        return tuple(row.name for row in self.rows if row.kind == "experiment")

    @property
    def studied(self) -> tuple[str, ...]:
        return tuple(row.name for row in self.rows if row.kind == "study")

    @property
    def with_folds(self) -> tuple[str, ...]:
        return tuple(row.name for row in self.rows if row.folds is not None)

    @property
    def modelled(self) -> list[str]:
        """The stages that leave models, with cards and predictions."""
        return stages(self.questions, "models")

    @property
    def curves(self) -> dict[str, str]:
        """The questions whose answers are points of a curve, and the stage that finds them."""
        return {row.name: row.stage for row in ROWS if row.kind == "curve" and row.name in self.questions}

    @property
    def protocols(self) -> set[str]:
        """The protocols that a simulated scene needs for its questions."""
        return {MAIN_PROTOCOL} | {row.protocol for row in self.rows if row.protocol is not None}

    @property
    def described(self) -> str:
        """The name of the description of a scene's captures."""
        return "recorded" if self.source == "recorded" else MAIN_PROTOCOL

    def runs(self, unit: str) -> bool:
        """Tell whether a stage still runs for the scene, named as its cost is: `drift`, `simulate-wear`."""
        stage, _, part = unit.partition("-")
        if stage in {row.stage for row in ROWS if row.kind != "report"}:
            return stage in {row.stage for row in self.rows}
        return not part or self.source == "recorded" or part in self.protocols


class Scene(Asking, Seeded, extra="allow"):
    """One named set-up: its captures (or how to simulate them), the questions it asks, and a section for each."""

    selection: Selection
    split: Split
    simulate: Simulation | None = None

    @model_validator(mode="after")
    def _sections_follow_questions(self) -> "Scene":
        if (self.simulate is not None) != (self.source == "simulated"):
            raise ValueError("section simulate stands in a scene if and only if its source is simulated")
        for row in self.rows:
            if lacking := set(row.needs) - set(self.questions):
                raise ValueError(f"a scene that asks {row.name} also asks {sorted(lacking)}, on which it goes on")
        keys = {key for row in self.rows for key in row.folds or ()}
        keys |= {"pool_passes_n"} if POOLED_BY in self.questions else set()
        sections = {row.stage for row in self.rows if row.section}
        wrong = [
            *_differ("the scene", set(self.model_extra or ()), sections),
            *_differ("split", self.split.model_fields_set, keys),
            *(_differ("simulate.protocols", set(self.simulate.protocols), self.protocols) if self.simulate else ()),
        ]
        if wrong:
            raise ValueError(f"a scene holds exactly what its questions need; {'; '.join(wrong)}")
        return self

    @model_validator(mode="after")
    def _questions_fit_the_source(self) -> "Scene":
        if not self.with_folds and not any(row.alone for row in self.rows):
            with_folds = sorted(row.name for row in ROWS if row.folds is not None or row.alone)
            raise ValueError(f"questions holds at least one of {with_folds}")
        if self.simulate is None:
            if self.studied:
                raise ValueError(f"questions {list(self.studied)} are about physics: only a simulated scene asks them")
            if beyond := sorted(row.name for row in self.rows if not row.recorded):
                raise ValueError(f"questions {beyond} are asked of simulated scenes only, so far")
        return self


def _differ(place: str, have: Set[str], want: Set[str]) -> list[str]:
    lacks = [f"{place} lacks {', '.join(sorted(want - have))}"] if want - have else []
    extra = [f"of {place} nothing asks {', '.join(sorted(have - want))}"] if have - want else []
    return lacks + extra


class Shared(Strict):
    """`params.yaml`: what scenes share, by name."""

    lost_fraction_max: Annotated[float, Field(ge=0, le=1)]
    faults: Decisions
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
    return check_scene(path.stem, str(path), read_yaml(path), read_shared(params))


def check_scene(name: str, where: str, words: dict[str, Any], shared: dict[str, Any]) -> Scene:
    """Check a scene, and every section as the stage that reads it does."""
    scene, settings = parse_scene(words, where), Settings(name, where, words, shared, {})
    for stage in dict.fromkeys(["split", *(row.stage for row in scene.rows if row.kind != "report")]):
        if read := getattr(module_of(stage), "read", None):
            read(settings)
    if scene.simulate is not None:
        from pipeline.synthesis.settings import check_synthesis  # the physics, for a simulated scene only

        check_synthesis(settings)
    return scene


def parse_scene(words: dict[str, Any], where: str) -> Scene:
    """Check a scene's questions, and that it has the sections for them; their stages check what stands in these."""
    for name, value in words.items():
        if name not in {*Scene.model_fields, *SECTIONS}:
            raise ParamsError(where, name, "a known parameter", repr(value)[:80], "Mend it there.")
        if name in SECTIONS and not isinstance(value, dict):
            raise ParamsError(where, name, "a valid dictionary", repr(value)[:80], "Mend it there.")
    return parse(Scene, words, where)


def module_of(stage: str) -> ModuleType:
    """Import the module of a stage: `experiments.<stage>.run`, or `stages.<stage>`."""
    experiment = f"pipeline.experiments.{stage}"
    return import_module(f"{experiment}.run" if find_spec(experiment) else f"pipeline.stages.{stage}")


def read_shared(path: Path) -> dict[str, Any]:
    """Read and check `params.yaml`, as it is written."""
    words: dict[str, Any] = read_yaml(path)
    shared = parse(Shared, words, str(path))
    for section, model in SHARED_ROWS.items():
        for name, row in getattr(shared, section).items():
            if "steps_n" in row:
                raise ParamsError(f"{path}: {section}", name, "without steps_n", "one", STEPS)
            parse(model, row | {"steps_n": 1}, f"{path}: {section}.{name}")
    return words


def read_plan(path: Path) -> Plan:
    return parse(Plan, read_yaml(path), str(path))
