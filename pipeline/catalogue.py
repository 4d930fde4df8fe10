"""Catalogue of stages and experiments: the module of each stage, and what a scene needs to run an experiment.

The file dvc.yaml runs a stage with the command `python -m pipeline STAGE --scene SCENE ...`. `STAGES` lists the stages
of package `pipeline.stages` by module. In addition, each experiment in `ANALYSED` is a stage of its own: a function
with the name of the experiment, in the module of the same name in `pipeline.experiments`.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import Any, Literal

STAGES = {
    "simulate": ("physics", "simulate"),
    "ingest": ("ingest", "ingest_many", "ingest_simulated", "describe", "split"),
    "train": ("train_single", "train_multi", "train_triplet", "adapt"),
    "sweeps": ("sweep_pokes", "sweep_sensors"),
    "rig": ("rig",),
    "report": ("report",),
}
MODULES = {stage: f"pipeline.stages.{module}" for module, stages in STAGES.items() for stage in stages}
EXPERIMENTS_PACKAGE = "pipeline.experiments"
Kind = Literal["models", "files", "curve", "analysis", "report"]


@dataclass(frozen=True)
class Experiment:
    """An experiment that scenes can run, and its requirements for a scene.

    stage: the DVC stage that runs the experiment.
    kind: what the stage writes. `models`: networks with JSON cards. `files`: model files that other experiments score.
        `curve`: points of a curve. `analysis`: numbers, figure data and capture losses. `report`: nothing, because the
        report stage computes it.
    needs: other experiments that the scene must also run.
    protocol: the simulated protocol whose captures the experiment reads; None for the main protocol.
    folds: the keys of the scene's section `split` that set how the experiment's folds are drawn; None if no folds are
        drawn for the experiment.
    settings: whether the scene's file must have a section of settings for the experiment, named after the stage.
    reads: sections of the scene that the experiment reads besides its own.
    file: the key of the experiment's section that names a file on which the stage depends; None if there is none.
    recorded: whether scenes with recorded captures may run the experiment.
    without_contact: whether the experiment reads recordings in which nothing touches the skin. It needs neither folds
        nor places in mm, so that a scene may run it without any other experiment.
    scores: whether the stage writes rows of the table of scores.
    """

    name: str
    stage: str
    kind: Kind
    needs: tuple[str, ...] = ()
    protocol: str | None = None
    folds: tuple[str, ...] | None = None
    settings: bool = True
    reads: tuple[str, ...] = ()
    file: str | None = None
    recorded: bool = False
    without_contact: bool = False
    scores: bool = False


def _learning(name: str, kind: Kind, stage: str, **more: Any) -> Experiment:
    return Experiment(name, stage, kind, recorded=True, scores=kind in ("models", "curve"), **more)


def _analysis(name: str, **more: Any) -> Experiment:
    return Experiment(name, name, "analysis", **more)


RANDOM = ("random_test_fraction", "random_repeats_n")
ADAPTED = ("lobo", "triplet", "adapt")
LEARNING = (
    _learning("single_random", "models", "train_single", folds=RANDOM),
    _learning("single_indentation", "models", "train_single", folds=RANDOM),
    _learning("single_pass", "models", "train_single", folds=RANDOM),
    _learning("single_temporal", "models", "train_single", folds=("temporal_test_fraction",)),
    _learning("transfer", "models", "train_single", folds=("transfer_skins_n",)),
    _learning("lobo", "models", "train_multi", folds=()),
    _learning("triplet", "models", "train_triplet", needs=("lobo",)),
    _learning("adapt", "models", "adapt", needs=("triplet",)),
    _learning("pokes", "curve", "sweep_pokes", needs=("adapt",)),
    _learning(
        "sensors", "curve", "sweep_sensors", needs=("adapt",), folds=("sensors_skins_n", "sensors_draws_n"),
        settings=False,
    ),
    _learning("rig", "files", "rig", reads=("compare",)),
    _learning("choice", "report", "report", needs=ADAPTED, settings=False),
)  # fmt: skip
ANALYSED = (
    _analysis("accuracy_and_cost", needs=("adapt",)),
    _analysis("audit", needs=("lobo",), recorded=True),
    _analysis("compare", recorded=True),
    _analysis("drift", protocol="wear", recorded=True, scores=True),
    _analysis("extremes"),
    _analysis("flexible", needs=("adapt",), protocol="flexible", settings=False, scores=True),
    _analysis("gripper", needs=("lobo",), protocol="grip"),
    _analysis("interference", recorded=True, scores=True, without_contact=True),
    _analysis("logs", needs=("lobo",), protocol="log", settings=False),
    _analysis("manual", needs=("adapt",), protocol="hand", settings=False, scores=True),
    _analysis(
        "new_board", needs=("lobo", "triplet"), reads=("compare", "adapt"), file="model", recorded=True, scores=True
    ),
    _analysis("sensitivity", protocol="glass", settings=False),
    _analysis("shear", protocol="drag", scores=True),
    _analysis("sleeve", protocol="sleeve", scores=True),
    _analysis("variation", protocol="wear"),
)
EXPERIMENTS = {experiment.name: experiment for experiment in (*LEARNING, *ANALYSED)}
ANALYSES = tuple(experiment.name for experiment in ANALYSED)


def stages(names: Iterable[str], *kinds: Kind) -> list[str]:
    """Return the stages that run the named experiments of the given kinds, in the order of the catalogue."""
    chosen = set(names)
    found = (one.stage for one in EXPERIMENTS.values() if one.name in chosen and one.kind in kinds)
    return list(dict.fromkeys(found))


def is_stage(name: str) -> bool:
    """Return whether a stage or an experiment has this name."""
    return name in MODULES or name in ANALYSES


def module_name(stage: str) -> str:
    """Return the name of the module that contains a stage's function."""
    return MODULES.get(stage, f"{EXPERIMENTS_PACKAGE}.{stage}")


def module_of(stage: str) -> ModuleType:
    """Import the module that contains a stage's function."""
    return import_module(module_name(stage))
