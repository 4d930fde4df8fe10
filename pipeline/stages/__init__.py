"""The stages of the pipeline. Each stage is a function that reads inputs, calls the library, and writes outputs.

The file dvc.yaml runs a stage with the command `python -m pipeline STAGE --scene SCENE ...`. `STAGES` lists the stages
in this package by module. In addition, each experiment is a stage of its own: a function with the name of the
experiment, in the module of the same name in `pipeline.experiments`.
"""

from importlib import import_module
from types import ModuleType

from pipeline.catalogue import experiment_files

STAGES = {
    "simulate": ("simulate",),
    "ingest": ("ingest", "ingest_many", "ingest_simulated", "describe", "split"),
    "train": ("train_single", "train_multi", "train_triplet", "adapt", "train_classical"),
    "sweeps": ("sweep_pokes", "sweep_sensors"),
    "universal": ("few_labels", "universal", "calibrated"),
    "report": ("table2", "report", "publish"),
}
MODULES = {stage: f"pipeline.stages.{module}" for module, stages in STAGES.items() for stage in stages}
EXPERIMENTS = "pipeline.experiments"


def is_stage(name: str) -> bool:
    """Return whether a stage or an experiment has this name."""
    return name in MODULES or name in experiment_files()


def module_name(stage: str) -> str:
    """Return the name of the module that contains a stage's function."""
    return MODULES.get(stage, f"{EXPERIMENTS}.{stage}")


def module_of(stage: str) -> ModuleType:
    """Import the module that contains a stage's function."""
    return import_module(module_name(stage))
