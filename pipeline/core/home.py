"""The checkout that this process works for. In: the working directory. Out: where its caches and its diary lie.

`dvc exp run --temp` and queued experiments run in a copy below `.dvc/tmp/exps` that is deleted afterwards: finished
trainings are shared with the checkout around it. Refuses to know what is kept there.
"""

from pathlib import Path

COPIES = (".dvc", "tmp", "exps")  # where DVC makes such copies


def home() -> Path:
    """Give the checkout: the working directory, or the one around a copy that DVC made for an experiment."""
    here = Path.cwd()
    around = [parent for parent in here.parents if here.relative_to(parent).parts[:3] == COPIES]
    return around[-1] if around else Path()


def is_experiment() -> bool:
    """Tell whether this runs in such a copy."""
    return home() != Path()
