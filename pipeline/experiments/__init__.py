"""Experiments, each with one module (settings, computation, tables, figures) and one YAML file of the same name.

For example, `shear.py` defines the function `shear`, which runs as stage `shear`, and the functions `tables` and
`figures`, which the report calls. `shear.yaml` states what a scene needs to run the experiment (`experiment`, see
`pipeline.catalogue`). The claims of the paper that its numbers decide are in `pipeline/report/claims.yaml`.
"""
