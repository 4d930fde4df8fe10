"""One folder an experiment: `run.py` computes its answer, `show.py` makes tables and figures of it.

Knows no experiment by name: `questions` lists them, and the package of each holds a sentence only.
"""
