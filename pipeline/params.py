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
from pipeline.learning.recipe import Training
from pipeline.strict import Strict, parse, read_yaml

# question -> the section (and stage) that answers it, and the keys of `split` that draw its folds
ANSWERED_BY: dict[str, str] = {
    "lobo": "train_multi",
    "transfer": "train_single",
    "single_random": "train_single",
    "single_temporal": "train_single",
}
DRAWN_WITH: dict[str, set[str]] = {
    "lobo": set(),
    "transfer": {"transfer_skins_n"},
    "single_random": {"random_test_fraction", "random_repeats_n"},
    "single_temporal": {"temporal_test_fraction"},
}
ARMS = ("train_single", "train_multi")


class Scene(Strict):
    """One named set-up: its captures (or how to simulate them), its protocol, and the questions it asks."""

    source: Literal["simulated", "recorded"]
    seed: Annotated[int, Field(ge=0)]
    questions: Annotated[tuple[Question, ...], Field(min_length=1)]
    selection: Selection
    split: Split
    simulate: dict[str, Any] | None = None  # checked by dataset.synthetic, so that only its stage depends on physics
    train_single: Training | None = None
    train_multi: Training | None = None

    @model_validator(mode="after")
    def _sections_follow_questions(self) -> "Scene":
        if (self.simulate is not None) != (self.source == "simulated"):
            raise ValueError("section simulate stands in a scene if and only if its source is simulated")
        asked = {ANSWERED_BY[question] for question in self.questions}
        for arm in ARMS:
            if (getattr(self, arm) is not None) != (arm in asked):
                asking = [question for question, stage in ANSWERED_BY.items() if stage == arm]
                raise ValueError(f"section {arm} stands in a scene if and only if it asks one of {asking}")
        needed = set().union(*(DRAWN_WITH[question] for question in self.questions))
        if needed != self.split.model_fields_set:
            raise ValueError(f"split holds exactly what the questions need, {sorted(needed)}")
        return self


class IngestItem(Strict):
    """One recorded capture that has a stage of its own."""

    scene: str
    capture: str


class Stages(Strict):
    """Which scenes each stage of dvc.yaml runs for; made from the scenes by `reskin scenes use`, never by hand."""

    simulate: tuple[str, ...]
    ingest_simulated: tuple[str, ...]
    ingest: dict[str, IngestItem]
    split: dict[str, tuple[str, ...]]  # scene -> its recorded captures; none for a simulated one
    train_single: tuple[str, ...]
    train_multi: tuple[str, ...]
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
    """Raise if `params.yaml` has no stage for a question that the scene asks: it was added by hand since."""
    unplanned = [arm for arm in arms_of(scene) if name not in getattr(params.stages, arm)]
    if unplanned:
        raise ParamsError(
            complain(
                where, "questions", "planned in params.yaml", f"{', '.join(unplanned)} without a stage",
                f"Try: reskin scenes use {' '.join(params.scenes)}",
            )
        )  # fmt: skip


def arms_of(scene: Scene) -> list[str]:
    """Name the training stages that answer a scene's questions."""
    return [arm for arm in ARMS if arm in {ANSWERED_BY[question] for question in scene.questions}]


def captures_of(scene: str, params: Params, indentations: Path) -> list[str]:
    """Name the captures of a scene, sorted.

    Recorded ones stand in `params.yaml`: a stale file of a removed capture must not come back. Simulated ones are what
    their one stage has just written.
    """
    recorded = params.stages.split[scene]
    return sorted(recorded) or sorted(file.stem for file in indentations.glob("*.parquet"))
