"""The stages of the pipeline: thin functions that read inputs, call the library, and write outputs.

`python -m pipeline STAGE --scene NAME ...` runs one; dvc.yaml says with which inputs and outputs.
"""

from importlib import import_module
from pathlib import Path
from types import ModuleType

MODULES = {
    "simulate": ("simulate",),
    "ingest": ("ingest", "ingest_many", "ingest_simulated", "describe", "split"),
    "train": ("train_single", "train_multi", "train_triplet", "adapt", "train_classical"),
    "sweeps": ("sweep_pokes", "sweep_sensors"),
    "universal": ("few_labels", "universal"),
    "report": ("table2", "report", "publish"),
}
EXPERIMENTS = "pipeline.experiments"
FOLDER = Path(__file__).parents[1] / "experiments"
STAGES = {stage: f"pipeline.stages.{module}" for module, names in MODULES.items() for stage in names}


def is_stage(name: str) -> bool:
    """Tell whether a stage or an experiment has this name."""
    return name in STAGES or (FOLDER / f"{name}.py").is_file() or (FOLDER / name / "__init__.py").is_file()


def module_name(stage: str) -> str:
    """Name the module that holds a stage's function: one of `pipeline.stages`, or that of an experiment."""
    return STAGES.get(stage, f"{EXPERIMENTS}.{stage}")


def module_of(stage: str) -> ModuleType:
    """Import the module that holds a stage's function."""
    return import_module(module_name(stage))
