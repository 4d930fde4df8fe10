"""Reproduction of the ReSkin paper: DVC stages, experiments, scenes, reports and MLflow, on the library `reskin`."""

import reskin  # noqa: F401  (first: it sets the variables that NumPy reads when it loads)

FLOW, PARAMS, PLAN, SCENES = "dvc.yaml", "params.yaml", "pipeline/plan.yaml", "pipeline/scenes"  # in a checkout
