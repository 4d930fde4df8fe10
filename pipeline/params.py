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
from pipeline.strict import Strict, parse, read_yaml

Study = Literal["verification", "stability", "runtime", "left_out"]
Further = Literal["triplet", "adapt", "pokes", "baselines", "audit", "choice"]

# question -> the stage that answers it, and the keys of `split` that draw its folds
ANSWERED_BY: dict[str, str] = {
    "lobo": "train_multi",
    "transfer": "train_single",
    "single_random": "train_single",
    "single_temporal": "train_single",
    "sensors": "sweep_sensors",
    "labels": "few_labels",
}
DRAWN_WITH: dict[str, set[str]] = {
    "lobo": set(),
    "transfer": {"transfer_skins_n"},
    "single_random": {"random_test_fraction", "random_repeats_n"},
    "single_temporal": {"temporal_test_fraction"},
    "sensors": {"sensors_skins_n", "sensors_draws_n"},
    "labels": {"labels_pool_n", "labels_draws_n"},
}
# questions about the folds of others -> the stage that answers it, and the questions that it goes on from
CONTINUED_BY: dict[str, str] = {
    "triplet": "train_triplet",
    "adapt": "adapt",
    "pokes": "sweep_pokes",
    "baselines": "train_classical",
    "audit": "audit",
}
NEEDS: dict[str, set[str]] = {
    "triplet": {"lobo"},
    "adapt": {"triplet"},
    "pokes": {"adapt"},
    "sensors": {"adapt"},
    "baselines": {"lobo"},
    "labels": {"lobo"},
    "audit": {"lobo"},
    "choice": {"lobo", "triplet", "adapt"},  # answered by the report: it only reads scores
}
POOLED_BY = "adapt"  # takes pokes of the held-out skins, so a part of these is kept from every test
ARMS = (
    "train_single", "train_multi", "train_triplet", "adapt", "sweep_pokes", "sweep_sensors", "train_classical",
    "few_labels", "audit",
)  # fmt: skip
WITHOUT_SECTION = {"sweep_sensors"}  # settings of others are all they need
# questions about the physics of a simulated scene -> the stage that answers it
STUDIED_BY: dict[str, str] = {
    "verification": "verify",
    "stability": "stability",
    "runtime": "runtime",
    "left_out": "leave_out",
}
STUDIES = tuple(STUDIED_BY.values())
MODELLED = {"train_single", "train_multi", "train_triplet", "adapt"}
SWEPT = {"pokes": "sweep_pokes", "sensors": "sweep_sensors", "baselines": "train_classical", "labels": "few_labels"}
_STAGES = ANSWERED_BY | CONTINUED_BY
MAIN_PROTOCOL = "grid"  # folds are drawn on its captures


class OnBoards(Strict, extra="allow"):
    """A protocol, as far as the plan must know it: on which kind of boards it runs."""

    boards: str


class Simulation(Strict, extra="allow"):
    """Section `simulate`; the rest is checked by `synthesis`, so that only its stages depend on physics."""

    protocols: Annotated[dict[str, OnBoards], Field(min_length=1)]


class Scene(Strict):
    """One named set-up: its captures (or how to simulate them), its protocol, and the questions it asks."""

    source: Literal["simulated", "recorded"]
    seed: Annotated[int, Field(ge=0)]
    questions: Annotated[tuple[Literal[Question, Further, Study], ...], Field(min_length=1)]
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
                asking = [question for question, stage in _STAGES.items() if stage == arm]
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
        if self.simulate is not None and self.trained and MAIN_PROTOCOL not in self.simulate.protocols:
            raise ValueError(f"a scene that asks {list(self.trained)} has a protocol named {MAIN_PROTOCOL}")
        if (self.runtime is not None) != ("runtime" in self.questions):
            raise ValueError("section runtime stands in a scene if and only if it asks runtime")
        return self

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
    asked = {_STAGES[question] for question in scene.questions if question in _STAGES}
    return [arm for arm in ARMS if arm in asked]


def modelled(scene: Scene) -> list[str]:
    """Name the stages that leave models, with cards and predictions."""
    return [arm for arm in arms_of(scene) if arm in MODELLED]


def swept(scene: Scene) -> dict[str, str]:
    """Name the questions whose answers are points of a curve, and the stage that finds them."""
    return {question: stage for question, stage in SWEPT.items() if question in scene.questions}


def described_in(scene: Scene) -> list[str]:
    """Name the descriptions of a scene's captures: one a protocol, or that of the recorded ones."""
    return ["recorded"] if scene.simulate is None else list(scene.simulate.protocols)


def captures_of(scene: str, params: Params, indentations: Path) -> list[str]:
    """Name the captures of a scene, sorted.

    Recorded ones stand in `params.yaml`: a stale file of a removed capture must not come back. Simulated ones are what
    their one stage has just written.
    """
    recorded = params.stages.split[scene]
    return sorted(recorded) or sorted(file.stem for file in indentations.glob("*.parquet"))
