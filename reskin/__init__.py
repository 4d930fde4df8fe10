"""The Python interface of the pipeline, for notebooks and controllers: `import reskin`, and see `help(reskin)`.

Knows nothing of its own: `pipeline.api` holds it.
"""

from pipeline.api import (
    Model,
    Pokes,
    draw_board,
    draw_skin,
    lifted,
    load_model,
    load_rows,
    load_universal,
    open,
    record,
    simulate_pokes,
    touch,
)

__all__ = [
    "Model",
    "Pokes",
    "draw_board",
    "draw_skin",
    "lifted",
    "load_model",
    "load_rows",
    "load_universal",
    "open",
    "record",
    "simulate_pokes",
    "touch",
]
