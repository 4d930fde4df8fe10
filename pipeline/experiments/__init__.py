"""Experiments, one module each: settings, the function of the stage, the summary of its numbers, and its figures.

For example, `shear.py` defines the function `shear`, which runs as stage `shear`, and `figures`, which the report
calls. `pipeline.catalogue` states what a scene needs to run an experiment. Tables are in `pipeline/report/tables.py`,
and the claims of the paper that the numbers decide are in `pipeline/report/claims.yaml`.
"""
