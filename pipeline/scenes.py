"""Scenes: the experiments that exist, and the legal values of `params.yaml` and of every scene."""

from collections.abc import Iterable, Mapping, Set
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from pipeline import PARAMS
from pipeline.catalogue import LEARNING_ROWS, Experiment, Kind, experiment_rows
from pipeline.settings import Seeded, Settings, read_settings
from pipeline.stages import module_of
from reskin.config import Strict, parse, read_yaml
from reskin.data.rows import Selection
from reskin.data.splits import Split
from reskin.errors import ParamsError
from reskin.models.recipe import AdaptationRecipe, FineTuningRecipe, Name, Recipe, Schedule
from reskin.recordings.fault_policy import FaultPolicy

MAIN_PROTOCOL = "grid"  # folds are drawn on its captures
NOT_INGESTED = {"walk"}  # kinds of protocols whose captures are read as they are: an SD card knows no probe
POOLED_BY = "adapt"  # takes pokes of the held-out skins, so a part of these is kept from every test
# The rows of table 2 and who answers them; a scene that asks all of these experiments has the table early.
TABLE_2 = {"single": "transfer", "multi": "lobo", "triplet": "triplet", "adapted": "adapt"}


ROWS = (*LEARNING_ROWS, *experiment_rows())
EXPERIMENTS: Mapping[str, Experiment] = {row.name: row for row in ROWS}


def stages(names: Iterable[str], *kinds: Kind) -> list[str]:
    """Name the stages that answer experiments of some kinds, in the order of the table; each once."""
    chosen = set(names)
    return list(dict.fromkeys(row.stage for row in ROWS if row.name in chosen and row.kind in kinds))


LEARNING: tuple[Kind, ...] = ("models", "curve", "other")
ANALYSES = tuple(row.name for row in ROWS if row.kind == "analysis")
SECTIONS = tuple(dict.fromkeys(row.stage for row in ROWS if row.section))


SHARED_ROWS: dict[str, type[Schedule]] = {
    "recipes": Recipe,
    "adaptations": AdaptationRecipe,
    "labellings": FineTuningRecipe,
}
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


class SceneExperiments(Strict, extra="ignore"):
    """The two settings of a scene that say which stages it has."""

    source: Source
    experiments: Annotated[tuple[Literal[tuple(EXPERIMENTS)], ...], Field(min_length=1)]  # type: ignore[valid-type]

    @property
    def rows(self) -> list[Experiment]:
        """The rows of the table of experiments that the scene asks, in the order that it asks them."""
        return [EXPERIMENTS[name] for name in self.experiments]

    @property
    def analyses(self) -> tuple[str, ...]:
        return tuple(row.name for row in self.rows if row.kind == "analysis")

    @property
    def studies(self) -> tuple[str, ...]:
        return tuple(row.name for row in self.rows if row.kind == "study")

    @property
    def with_folds(self) -> tuple[str, ...]:
        return tuple(row.name for row in self.rows if row.folds is not None)

    @property
    def modelled(self) -> list[str]:
        """The stages that leave models, with cards and predictions."""
        return stages(self.experiments, "models")

    @property
    def curves(self) -> dict[str, str]:
        """The experiments whose answers are points of a curve, and the stage that finds them."""
        return {row.name: row.stage for row in ROWS if row.kind == "curve" and row.name in self.experiments}

    @property
    def protocols(self) -> set[str]:
        """The protocols that a simulated scene needs for its experiments."""
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


class Scene(SceneExperiments, Seeded, extra="allow"):
    """One named set-up: its captures (or how to simulate them), the experiments it asks, and a section for each."""

    selection: Selection
    split: Split
    simulate: Simulation | None = None

    @model_validator(mode="after")
    def _sections_follow_experiments(self) -> "Scene":
        if (self.simulate is not None) != (self.source == "simulated"):
            raise ValueError("section simulate stands in a scene if and only if its source is simulated")
        for row in self.rows:
            if lacking := set(row.needs) - set(self.experiments):
                raise ValueError(f"a scene that asks {row.name} also asks {sorted(lacking)}, on which it goes on")
        keys = {key for row in self.rows for key in row.folds or ()}
        keys |= {"pool_passes_n"} if POOLED_BY in self.experiments else set()
        sections = {row.stage for row in self.rows if row.section}
        wrong = [
            *_differ("the scene", set(self.model_extra or ()), sections),
            *_differ("split", self.split.model_fields_set, keys),
            *(_differ("simulate.protocols", set(self.simulate.protocols), self.protocols) if self.simulate else ()),
        ]
        if wrong:
            raise ValueError(f"a scene holds exactly what its experiments need; {'; '.join(wrong)}")
        return self

    @model_validator(mode="after")
    def _experiments_fit_the_source(self) -> "Scene":
        if not self.with_folds and not any(row.alone for row in self.rows):
            with_folds = sorted(row.name for row in ROWS if row.folds is not None or row.alone)
            raise ValueError(f"experiments holds at least one of {with_folds}")
        if self.simulate is None:
            if self.studies:
                raise ValueError(
                    f"experiments {list(self.studies)} are about physics: only a simulated scene asks them"
                )
            if beyond := sorted(row.name for row in self.rows if not row.recorded):
                raise ValueError(f"experiments {beyond} are asked of simulated scenes only, so far")
        return self


def _differ(place: str, have: Set[str], want: Set[str]) -> list[str]:
    lacks = [f"{place} lacks {', '.join(sorted(want - have))}"] if want - have else []
    extra = [f"of {place} nothing asks {', '.join(sorted(have - want))}"] if have - want else []
    return lacks + extra


class Shared(Strict):
    """`params.yaml`: what scenes share, by name."""

    lost_fraction_max: Annotated[float, Field(ge=0, le=1)]
    faults: FaultPolicy
    recipes: dict[Name, Section]
    adaptations: dict[Name, Section]
    labellings: dict[Name, Section]
    methods: dict[Name, dict[Name, Section]]


class Plan(Strict):
    """`pipeline/plan.yaml`: experiments of the scenes that run, their recorded captures, the items of each stage."""

    scenes: dict[str, tuple[str, ...]]
    captures: dict[str, tuple[str, ...]]
    held_out: dict[str, tuple[str, ...]]
    models: dict[str, tuple[str, ...]]
    stages: dict[str, Any]


def read_scene(root: Path, name: str) -> Scene:
    """Read and check `pipeline/scenes/<name>.yaml`, with the shared rows that it names."""
    read_shared(root / PARAMS)
    return check_scene(read_settings(name, root))


def check_scene(settings: Settings) -> Scene:
    """Check a scene, and every section as the stage that reads it does."""
    scene = parse_scene(settings.of_scene, settings.where)
    for stage in dict.fromkeys(["split", *(row.stage for row in scene.rows if row.kind != "report")]):
        module = module_of(stage)
        if read := getattr(module, f"read_{stage}", getattr(module, "read", None)):
            read(settings)
    if scene.simulate is not None:
        from pipeline.synthesis import synthesis_of  # the physics, for a simulated scene only

        synthesis_of(settings)
    return scene


def experiments_of(settings: Settings) -> SceneExperiments:
    """Parse which experiments a scene runs, and on which kind of data."""
    return parse(SceneExperiments, {name: settings[name] for name in ("source", "experiments")}, settings.where)


def parse_scene(words: Mapping[str, Any], where: str) -> Scene:
    """Check a scene's experiments, and that it has the sections for them; their stages check what stands in these."""
    for name, value in words.items():
        if name not in {*Scene.model_fields, *SECTIONS}:
            raise ParamsError(where, name, "a known parameter", repr(value)[:80], "Mend it there.")
        if name in SECTIONS and not isinstance(value, dict):
            raise ParamsError(where, name, "a valid dictionary", repr(value)[:80], "Mend it there.")
    return parse(Scene, words, where)


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
