"""Reproduction of the ReSkin paper: DVC stages, experiments, scenes, reports and MLflow, on the library `reskin`."""

import reskin  # noqa: F401  (first: it selects the arithmetic that NumPy loads with)
