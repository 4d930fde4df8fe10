"""The largest accepted error of each law in experiment extremes, for tests that measure the law with other inputs."""

from pipeline.experiments.extremes import CASES

LIMITS = {case.name: case.limit for case in CASES}
