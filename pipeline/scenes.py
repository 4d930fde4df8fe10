"""Validate scenes (`pipeline/scenes/*.yaml`) and `params.yaml`; list the experiments that a scene runs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from pipeline import PARAMS, SCENES
from pipeline.catalogue import EXPERIMENTS, Experiment, module_of, stages
from pipeline.settings import Seed, Settings, read_settings, section_of
from reskin.config import Strict, parse, read_yaml
from reskin.data.rows import Selection
from reskin.data.splits import Split
from reskin.errors import ParamsError, did_you_mean
from reskin.models.recipe import AdaptationRecipe, Name, Recipe, Schedule
from reskin.recordings.fault_policy import FaultPolicy

MAIN_PROTOCOL = "grid"  # protocol whose captures are split into folds
# The rows of table 2, each with the experiment that provides its scores.
TABLE_2 = {"single": "transfer", "multi": "lobo", "triplet": "triplet", "adapted": "adapt"}
SECTIONS = {experiment.stage for experiment in EXPERIMENTS.values() if experiment.settings}
Source = Literal["simulated", "recorded"]


class Protocol(Strict, extra="allow"):
    """The setting of a protocol that the plan needs; `pipeline.simulation` checks the others."""

    kind: str


class Simulation(Strict, extra="allow"):
    """The part of section `simulate` that the plan needs."""

    protocols: Annotated[dict[str, Protocol], Field(min_length=1)]


class Scene(Strict, extra="allow"):
    """A scene: captures (recorded or simulated readings), experiments on them, and the settings of the experiments.

    The captures of a simulated scene are simulated according to section `simulate`. A simulated scene without this
    section consists of recordings of emulated boards, which were added to the scene. Settings that no experiment of the
    scene reads are allowed, so that an experiment can be removed from the scene without its settings.
    """

    source: Source
    seed: Seed
    experiments: Annotated[tuple[Literal[tuple(EXPERIMENTS)], ...], Field(min_length=1)]  # type: ignore[valid-type]
    selection: Selection
    split: Split
    simulate: Simulation | None = None
    boards: Annotated[tuple[Name, ...], Field(min_length=1)] | None = None  # names of the boards of added recordings

    @property
    def entries(self) -> list[Experiment]:
        """The catalogue entries of the scene's experiments, in the order of its file."""
        return [EXPERIMENTS[name] for name in self.experiments]

    @property
    def analyses(self) -> tuple[str, ...]:
        return tuple(one.name for one in self.entries if one.kind == "analysis")

    @property
    def with_folds(self) -> tuple[str, ...]:
        """The experiments for which folds are drawn."""
        return tuple(one.name for one in self.entries if one.folds is not None)

    @property
    def model_stages(self) -> list[str]:
        """The stages that write models, with cards and predictions."""
        return stages(self.experiments, "models")

    @property
    def scored_stages(self) -> list[str]:
        """The stages that write rows of the table of scores."""
        return list(dict.fromkeys(one.stage for one in self.entries if one.scores))

    @property
    def curves(self) -> dict[str, str]:
        """The stage of each experiment of kind `curve`, by experiment."""
        return {one.name: one.stage for one in EXPERIMENTS.values() if one.kind == "curve" and one in self.entries}

    @property
    def protocols(self) -> set[str]:
        """The protocols that a simulated scene needs for its experiments."""
        return {MAIN_PROTOCOL} | {one.protocol for one in self.entries if one.protocol is not None}

    def named_file(self, experiment: Experiment) -> str:
        """Return the file that the experiment's section names, or `params.yaml`, on which its stage depends anyway."""
        return str((self.model_extra or {})[experiment.stage].get(experiment.file) or PARAMS)

    @property
    def described(self) -> str:
        """The key of the scene's main captures in section `described` of numbers.json."""
        return "recorded" if self.source == "recorded" else MAIN_PROTOCOL

    def runs(self, unit: str) -> bool:
        """Return whether the scene runs a stage (`drift`), or a stage for one protocol (`simulate-wear`)."""
        stage, _, part = unit.partition("-")
        if stage in {one.stage for one in EXPERIMENTS.values() if one.kind != "report"}:
            return stage in {one.stage for one in self.entries}
        return not part or self.simulate is None or part in self.protocols

    @model_validator(mode="after")
    def _check_source(self) -> "Scene":
        if self.simulate is not None and self.source == "recorded":
            raise ValueError("a recorded scene must not have a section simulate")
        if self.simulate is None and self.source == "simulated" and self.boards is None:
            raise ValueError("a simulated scene must have a section simulate, or key boards with the emulated boards")
        if self.simulate is None and (refused := sorted(one.name for one in self.entries if not one.recorded)):
            raise ValueError(f"only a simulated scene can run experiments {', '.join(refused)}")
        return self

    @model_validator(mode="after")
    def _check_experiments(self) -> "Scene":
        for one in self.entries:
            if missing := set(one.needs) - set(self.experiments):
                raise ValueError(f"experiment {one.name} needs {', '.join(sorted(missing))} in the same scene")
        if not any(_suffices(one) for one in self.entries):
            sufficient = sorted(one.name for one in EXPERIMENTS.values() if _suffices(one))
            raise ValueError(f"experiments must include at least one of {', '.join(sufficient)}")
        return self

    @model_validator(mode="after")
    def _check_sections(self) -> "Scene":
        split = {key for one in self.entries for key in one.folds or ()}
        # Adaptation draws its pokes from the first `pool_passes_n` passes.
        split |= {"pool_passes_n"} if "adapt" in self.experiments else set()
        sections = {one.stage for one in self.entries if one.settings}
        sections |= {name for one in self.entries for name in one.reads}
        lacking = {"the scene": sections - {*(self.model_extra or ())}, "split": split - self.split.model_fields_set}
        if self.simulate is not None:
            lacking["simulate.protocols"] = self.protocols - {*self.simulate.protocols}
        if named := [f"{place} lacks {', '.join(sorted(names))}" for place, names in lacking.items() if names]:
            raise ValueError(f"a scene must have the settings that its experiments need; {'; '.join(named)}")
        return self


def _suffices(experiment: Experiment) -> bool:
    """Return whether a scene may consist of this experiment alone."""
    return experiment.folds is not None or experiment.without_contact


SHARED_ROWS: dict[str, type[Schedule]] = {"recipes": Recipe, "adaptations": AdaptationRecipe}


class Shared(Strict):
    """Content of `params.yaml`: settings that scenes share; recipes are rows without `steps_n`, which scenes set."""

    lost_fraction_max: Annotated[float, Field(ge=0, le=1)]
    faults: FaultPolicy
    recipes: dict[Name, dict[str, Any]]
    adaptations: dict[Name, dict[str, Any]]


def read_scene(root: Path, name: str) -> Scene:
    """Read and check `pipeline/scenes/<name>.yaml` and `params.yaml`."""
    read_shared(root / PARAMS)
    return check_scene(read_settings(name, root))


def check_scene(settings: Settings) -> Scene:
    """Check a scene and its sections; each section is parsed by the settings model of the stage that uses it."""
    scene = parse_scene(settings.of_scene, settings.where)
    for stage in dict.fromkeys(["split", *(one.stage for one in scene.entries if one.kind != "report")]):
        if model := section_of(getattr(module_of(stage), stage)):
            settings.section(model, stage)
    if scene.simulate is not None:
        from pipeline.simulation import simulation_settings  # imports the physics, which recorded scenes do not need

        simulation_settings(settings)
    return scene


def parse_scene(content: Mapping[str, Any], where: str) -> Scene:
    """Check a scene's experiments, and that the scene has the sections that they need, which are not parsed."""
    for name, value in content.items():
        if name not in (known := {*Scene.model_fields, *SECTIONS}):
            got, guess = repr(value)[:80], did_you_mean(name, sorted(known))
            raise ParamsError(
                f"{where}: {name} is not a known parameter (its value: {got}). Correct its name or remove it.{guess}"
            )
        if name in SECTIONS and not isinstance(value, dict):
            remedy = f"Write {name} as a section with keys and values."
            raise ParamsError(where, name, "a valid dictionary", repr(value)[:80], remedy)
    return parse(Scene, content, where)


def read_shared(path: Path) -> Shared:
    """Read and check `params.yaml`."""
    shared = parse(Shared, read_yaml(path), str(path))
    for section, model in SHARED_ROWS.items():
        for name, row in getattr(shared, section).items():
            where = f"{path}: {section}.{name}"
            if "steps_n" in row:
                remedy = "Each scene sets steps_n in the section that names the row."
                raise ParamsError(f"{where}: remove steps_n from this row. {remedy}")
            parse(model, row | {"steps_n": 1}, where)
    return shared


def scene_names(root: Path) -> list[str]:
    if not (root / SCENES).is_dir():
        raise ParamsError(f"{root / SCENES}: folder not found. Run the command in the folder of the checkout.")
    return sorted(file.stem for file in (root / SCENES).glob("*.yaml"))


def scene_file(root: Path, name: str, *, remedy: str = "To create one, see docs/extend.md.") -> Path:
    """Return the file of a scene; raise `ParamsError` if there is none."""
    known = scene_names(root)
    if name not in known:
        guess = did_you_mean(name, known)
        raise ParamsError(f"no scene {name}.{guess} The scenes are: {', '.join(known)}. {remedy}")
    return root / SCENES / f"{name}.yaml"
