"""One folder an experiment: `run.py` computes its answer, `show.py` makes tables and figures of it."""
