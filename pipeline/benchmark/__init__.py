"""A benchmark that anybody can enter, with frozen folds, a file format for predictions, scores and tables of entries.

docs/benchmark.md describes the task, how to enter a method, and the rules.

    >>> from pipeline import benchmark
    >>> task = benchmark.tasks("simulated")[0]
    >>> task.fold, task.labels_n, task.tests_uT.shape
    ('v1.simulated.test0.draw0.labels0', 0, (90, 15))
    >>> rows = task.predictions(place_mm=[[8.0, 8.0]] * 90, force_N=[1.0] * 90)
    >>> benchmark.write([rows], "predictions.csv")  # doctest: +SKIP
"""

from pipeline.benchmark.folds import Presses, Task, tasks
from pipeline.benchmark.predictions import write

__all__ = ["Presses", "Task", "tasks", "write"]
