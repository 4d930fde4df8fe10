"""Experiments, each with one module (settings, computation, tables, figures) and one YAML file of the same name.

For example, `shear.py` defines the function `shear`, which runs as stage `shear`, and the functions `tables` and
`figures`, which the report calls. `shear.yaml` states what a scene needs to run the experiment (`experiment`, see
`pipeline.catalogue`). It also contains the experiment's section of the report page, and its rows of the checklist that
compares our results with the paper's.
"""
