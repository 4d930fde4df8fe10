"""Validate scenes (`pipeline/scenes/*.yaml`), `params.yaml` and the plan; list the experiments that a scene runs."""

from collections.abc import Iterable, Mapping, Set
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from pipeline import PARAMS
from pipeline.catalogue import EXPERIMENTS, Experiment, Kind, module_of
from pipeline.settings import Seed, Settings, read_settings, section_of
from reskin.config import Strict, parse, read_yaml
from reskin.data.rows import Selection
from reskin.data.splits import Split
from reskin.errors import ParamsError, did_you_mean
from reskin.models.recipe import AdaptationRecipe, Name, Recipe, Schedule
from reskin.recordings.fault_policy import FaultPolicy

MAIN_PROTOCOL = "grid"  # protocol whose captures are split into folds
# The rows of table 2, each with the experiment that provides its scores. If a scene runs all four experiments, stage
# table2 writes this table as soon as they are done, before the report.
TABLE_2 = {"single": "transfer", "multi": "lobo", "triplet": "triplet", "adapted": "adapt"}

WHOLE = "the scene"  # in messages about unused settings: the place of settings that are whole sections of the scene
# Experiments and sections that no longer exist, by the experiment that replaces them.
REPLACED = {
    "new_board": ("labels", "few_labels", "calibrated", "random_presses", "reference_methods", "recorded_limits"),
    "rig": ("universal",),
    "interference": ("ambient", "moving_hand"),
    "extremes": ("verification", "stability"),
    "accuracy_and_cost": ("runtime", "neglected_effects"),
}
KEPT = {"pool_passes_n"}  # settings that have an effect even if the scene does not run the experiment that needs them

SECTIONS = {experiment.stage for experiment in EXPERIMENTS.values() if experiment.settings}


def stages(names: Iterable[str], *kinds: Kind) -> list[str]:
    """Return the stages that run the named experiments of the given kinds, in the order of the catalogue."""
    chosen = set(names)
    return list(
        dict.fromkeys(
            experiment.stage
            for experiment in EXPERIMENTS.values()
            if experiment.name in chosen and experiment.kind in kinds
        )
    )


SharedRow = dict[str, Any]  # a row without `steps_n`, which each scene sets
SHARED_ROWS: dict[str, type[Schedule]] = {
    "recipes": Recipe,
    "adaptations": AdaptationRecipe,
}
Source = Literal["simulated", "recorded"]


class ProtocolSummary(Strict, extra="allow"):
    """The settings of a protocol that the plan needs: its kind, its boards, and its physics terms."""

    kind: str
    boards: str
    terms: tuple[str, ...]


class Simulation(Strict):
    """The part of section `simulate` that the plan needs; `pipeline.simulation` checks the whole section."""

    boards: dict[str, dict[str, Any]]
    protocols: Annotated[dict[str, ProtocolSummary], Field(min_length=1)]


class Scene(Strict, extra="allow"):
    """A scene: captures (recorded or simulated readings), experiments on them, and the settings of the experiments.

    The captures of a simulated scene are simulated according to section `simulate`. A simulated scene without this
    section consists of recordings of emulated boards, which were added to the scene.
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
        return tuple(experiment.name for experiment in self.entries if experiment.kind == "analysis")

    @property
    def with_folds(self) -> tuple[str, ...]:
        """The experiments for which folds are drawn."""
        return tuple(experiment.name for experiment in self.entries if experiment.folds is not None)

    @property
    def model_stages(self) -> list[str]:
        """The stages that write models, with cards and predictions."""
        return stages(self.experiments, "models")

    @property
    def scored_stages(self) -> list[str]:
        """The stages that write rows of the table of scores."""
        return list(dict.fromkeys(experiment.stage for experiment in self.entries if experiment.scores))

    @property
    def curves(self) -> dict[str, str]:
        """The stage of each experiment of kind `curve`, by experiment."""
        of_curves = (experiment for experiment in EXPERIMENTS.values() if experiment.kind == "curve")
        return {experiment.name: experiment.stage for experiment in of_curves if experiment.name in self.experiments}

    @property
    def protocols(self) -> set[str]:
        """The protocols that a simulated scene needs for its experiments."""
        return {MAIN_PROTOCOL} | {experiment.protocol for experiment in self.entries if experiment.protocol is not None}

    def named_file(self, experiment: str) -> str:
        """Return the path of the file that is given in the settings of an experiment, relative to the checkout.

        If none is given, this is `params.yaml`, on which the experiment depends in any case.
        """
        entry = EXPERIMENTS[experiment]
        return str((self.model_extra or {})[entry.stage].get(entry.file) or PARAMS)

    @property
    def unused(self) -> list[str]:
        """The settings that no experiment of the scene reads, by their place in the scene's file, such as `drift`.

        Unused settings change nothing, so an experiment can be removed from a scene without removing its settings.
        One setting is never listed: `split.pool_passes_n`, the number of passes from which pokes for adaptation are
        drawn. It has an effect even without adaptation, because these passes are not in the test rows of other
        experiments.
        """
        unread = {place: sorted(have - want - KEPT) for place, (have, want) in self._settings_by_place.items()}
        return [name if place == WHOLE else f"{place}.{name}" for place, names in unread.items() for name in names]

    @property
    def _settings_by_place(self) -> dict[str, tuple[Set[str], Set[str]]]:
        """The settings that the scene has, and the settings that its experiments need, by place in the scene's file."""
        split_keys = {key for experiment in self.entries for key in experiment.folds or ()}
        # Adaptation draws its pokes from the first `pool_passes_n` passes.
        split_keys |= {"pool_passes_n"} if "adapt" in self.experiments else set()
        sections = {experiment.stage for experiment in self.entries if experiment.settings}
        sections |= {section for experiment in self.entries for section in experiment.reads}
        places: dict[str, tuple[Set[str], Set[str]]]
        places = {WHOLE: ({*(self.model_extra or ())}, sections), "split": (self.split.model_fields_set, split_keys)}
        if self.simulate is not None:
            places["simulate.protocols"] = ({*self.simulate.protocols}, self.protocols)
        return places

    @property
    def described(self) -> str:
        """The key of the scene's main captures in section `described` of numbers.json."""
        return "recorded" if self.source == "recorded" else MAIN_PROTOCOL

    def runs(self, unit: str) -> bool:
        """Return whether the scene runs a stage (`drift`), or a stage for one protocol (`simulate-wear`)."""
        stage, _, part = unit.partition("-")
        if stage in {experiment.stage for experiment in EXPERIMENTS.values() if experiment.kind != "report"}:
            return stage in {experiment.stage for experiment in self.entries}
        return not part or self.simulate is None or part in self.protocols

    @model_validator(mode="after")
    def _check_sections(self) -> "Scene":
        if self.simulate is not None and self.source == "recorded":
            raise ValueError("a recorded scene must not have a section simulate")
        if self.simulate is None and self.source == "simulated" and self.boards is None:
            raise ValueError("a simulated scene must have a section simulate, or key boards with the emulated boards")
        for experiment in self.entries:
            if missing := set(experiment.needs) - set(self.experiments):
                raise ValueError(f"experiment {experiment.name} needs {', '.join(sorted(missing))} in the same scene")
        lacking = [
            f"{place} lacks {', '.join(sorted(absent))}"
            for place, (have, want) in self._settings_by_place.items()
            if (absent := want - have)
        ]
        if lacking:
            raise ValueError(f"a scene must have the settings that its experiments need; {'; '.join(lacking)}")
        return self

    @model_validator(mode="after")
    def _check_source(self) -> "Scene":
        if not self.with_folds and not any(experiment.alone for experiment in self.entries):
            sufficient = sorted(
                experiment.name
                for experiment in EXPERIMENTS.values()
                if experiment.folds is not None or experiment.alone
            )
            raise ValueError(f"experiments must include at least one of {', '.join(sufficient)}")
        only_simulated = sorted(experiment.name for experiment in self.entries if not experiment.recorded)
        if self.simulate is None and only_simulated:
            raise ValueError(f"only a simulated scene can run experiments {', '.join(only_simulated)}")
        return self


class Shared(Strict):
    """Content of `params.yaml`: settings that scenes share, in named rows."""

    lost_fraction_max: Annotated[float, Field(ge=0, le=1)]
    faults: FaultPolicy
    recipes: dict[Name, SharedRow]
    adaptations: dict[Name, SharedRow]


class Plan(Strict):
    """Content of `pipeline/plan.yaml`, which states what `dvc repro` runs.

    - scenes: the experiments of each planned scene.
    - captures: the recorded captures of each scene.
    - held_out: the experiments of each scene for which folds are drawn.
    - models: the stages of each scene that write models.
    - stages: the items (scenes, captures or folders) for which each stage runs.
    """

    scenes: dict[str, tuple[str, ...]]
    captures: dict[str, tuple[str, ...]]
    held_out: dict[str, tuple[str, ...]]
    models: dict[str, tuple[str, ...]]
    stages: dict[str, Any]


def read_scene(root: Path, name: str) -> Scene:
    """Read and check `pipeline/scenes/<name>.yaml` and `params.yaml`."""
    read_shared(root / PARAMS)
    return check_scene(read_settings(name, root))


def check_scene(settings: Settings) -> Scene:
    """Check a scene and its sections; each section is parsed by the settings model of the stage that uses it."""
    scene = parse_scene(settings.of_scene, settings.where)
    for stage in dict.fromkeys(
        ["split", *(experiment.stage for experiment in scene.entries if experiment.kind != "report")]
    ):
        if model := section_of(getattr(module_of(stage), stage)):
            settings.section(model, stage)
    if scene.simulate is not None:
        from pipeline.simulation import simulation_settings  # imports the physics, which recorded scenes do not need

        simulation_settings(settings)
    return scene


def parse_scene(content: Mapping[str, Any], where: str) -> Scene:
    """Check a scene's experiments, and whether the scene has the sections of settings that they need.

    The sections are not parsed.
    """
    named = content.get("experiments")
    for new, olds in REPLACED.items():
        if old := [name for name in olds if name in content or (isinstance(named, list) and name in named)]:
            remedy = f"Use {new}; the scene that `reskin new` writes, or pipeline/scenes/ci.yaml, shows its settings."
            raise ParamsError(f"{where}: {', '.join(old)} was replaced by {new}. {remedy}")
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
                raise ParamsError(
                    f"{where}: remove steps_n from this row. Each scene sets steps_n in the section that names the row."
                )
            parse(model, row | {"steps_n": 1}, where)
    return shared


def read_plan(path: Path) -> Plan:
    return parse(Plan, read_yaml(path), str(path))
