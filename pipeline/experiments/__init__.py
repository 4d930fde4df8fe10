"""Experiments: one module each (settings, computation, tables, figures), and a YAML file of the same name.

For example, `shear.py` defines the function `shear`, which stage `shear` calls, and optionally `read` (parses its
settings), `tables` and `figures`. `shear.yaml` states what a scene needs to run the experiment (`experiment`, see
`pipeline.catalogue`), and contains its section of the report page and its rows of the checklist against the paper.
"""
