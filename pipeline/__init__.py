"""Reproduction of the ReSkin paper: DVC stages, experiments, scenes, reports and MLflow, based on library `reskin`."""

import reskin  # noqa: F401  (imported first: it sets variables that NumPy reads on import)

# Paths relative to a checkout.
FLOW, PARAMS, PLAN, SCENES = "dvc.yaml", "params.yaml", "pipeline/plan.yaml", "pipeline/scenes"
