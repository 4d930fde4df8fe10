"""Experiments: one module each (settings, computation, tables, figures), and a YAML file of the same name.

`manual.py` holds the function `manual`, which stage `manual` calls, and optionally `read_manual` (checks its settings),
`tables` and `figures`. `manual.yaml` says what a scene needs to run it (`experiment`, see `pipeline.catalogue`), and
holds its section of the report page and its rows of the checklist against the paper.
"""
