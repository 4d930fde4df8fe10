"""What a scene can run: trainings on its folds, experiments, and studies of the physics."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

from reskin.config import Strict, parse, read_yaml

RANDOM = ("random_test_fraction", "random_repeats_n")

Kind = Literal["models", "curve", "other", "analysis", "study", "report"]


@dataclass(frozen=True)
class Experiment:
    """One experiment: the stage that runs it, and what it needs of a scene.

    kind: the kind of its results: models with cards, points of a curve, another file about learning, an analysis of
    `pipeline.experiments`, a study of the physics, or a part of the report. needs: experiments that a scene runs
    besides. protocol: the simulated protocol whose captures it reads; None: those of the main protocol. folds: the keys
    of section `split` that its folds are drawn with; None: it has no folds of its own. section: the scene's file holds
    a section of settings, named as the stage. key: its name in numbers.json, its own name unless given.
    """

    name: str
    kind: Kind
    stage: str = ""
    needs: tuple[str, ...] = ()
    protocol: str | None = None
    folds: tuple[str, ...] | None = None
    section: bool = False
    recorded: bool = True  # a scene of recordings may run it too
    alone: bool = False  # a scene may run it and nothing else: it needs no folds, and no places in mm
    key: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "stage", self.stage or self.name)
        object.__setattr__(self, "key", self.key or self.name)


class Requirements(Strict):
    """Section `experiment` of an experiment's YAML file: what a scene needs to run it.

    kind: an analysis has results of its own; a study is about the physics, and the same for all simulated scenes.
    protocol: the simulated protocol whose captures it reads; None: those of the main protocol. needs: what the scene
    runs besides. settings: the scene holds a section of settings of its name. recorded: a scene of recordings may run
    it. alone: a scene may run nothing else. key: the name of its results in numbers.json, if not the experiment's: an
    experiment that is renamed keeps it.
    """

    kind: Literal["analysis", "study"] = "analysis"
    protocol: str | None = None
    needs: tuple[str, ...] = ()
    settings: bool = False
    recorded: bool = False
    alone: bool = False
    key: str = ""


class ExperimentFile(Strict):
    """`pipeline/experiments/<name>.yaml`: its needs, its section of the report page, its rows of the checklist."""

    experiment: Requirements
    section: dict[str, Any] | None = None
    checklist: tuple[dict[str, Any], ...] = ()


FOLDER = Path(__file__).parent / "experiments"


@cache
def experiment_files() -> Mapping[str, ExperimentFile]:
    """Read the YAML files of all experiments, by name."""
    return {file.stem: parse(ExperimentFile, read_yaml(file), str(file)) for file in sorted(FOLDER.glob("*.yaml"))}


def experiment_rows() -> Iterator[Experiment]:
    """Give the rows of all experiments and studies, by name."""
    for name, file in experiment_files().items():
        own = file.experiment
        yield Experiment(
            name,
            own.kind,
            "",
            own.needs,
            own.protocol,
            section=own.settings,
            recorded=own.recorded,
            alone=own.alone,
            key=own.key,
        )


LEARNING_ROWS = (
    Experiment("single_random", "models", "train_single", folds=RANDOM, section=True),
    Experiment("single_indentation", "models", "train_single", folds=RANDOM, section=True),
    Experiment("single_pass", "models", "train_single", folds=RANDOM, section=True),
    Experiment("single_temporal", "models", "train_single", folds=("temporal_test_fraction",), section=True),
    Experiment("transfer", "models", "train_single", folds=("transfer_skins_n",), section=True),
    Experiment("lobo", "models", "train_multi", folds=(), section=True),
    Experiment("triplet", "models", "train_triplet", needs=("lobo",), section=True),
    Experiment("adapt", "models", needs=("triplet",), section=True),
    Experiment("pokes", "curve", "sweep_pokes", needs=("adapt",), section=True),
    Experiment("sensors", "curve", "sweep_sensors", needs=("adapt",), folds=("sensors_skins_n", "sensors_draws_n")),
    Experiment("baselines", "curve", "train_classical", needs=("lobo",), section=True),
    Experiment(
        "labels", "curve", "few_labels", needs=("lobo",), folds=("labels_pool_n", "labels_draws_n"), section=True
    ),
    Experiment("universal", "curve", needs=("labels", "compare"), section=True),
    Experiment("audit", "other", needs=("lobo",), section=True),
    Experiment("choice", "report", "report", needs=("lobo", "triplet", "adapt")),
)
