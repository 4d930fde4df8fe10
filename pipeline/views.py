"""Views of MLflow's table of runs, each with columns and a filter, and links to these views.

Without a view, the table shows no metrics, and MLflow 3.17 offers no other way to choose the columns that everybody
sees first. A view is a tag of an experiment. It can be opened with the button *Views* on the experiment's page, or by a
link.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

# The metrics of each training run. In MLflow, each stage also has a run of its own. Its metrics are the means over the
# training runs of the stage.
SCORES = ("accuracy_pct", "mse_xy_mm2", "mse_f_N2", "r2_f")
TRAIN_S = "train_s"
TAG, NOTE = "mlflow.sharedViewState.", "mlflow.note.content"
UI = "http://127.0.0.1:5000"  # where `mlflow ui` listens by default
WIDTHS = {"name": 170, "metric": 100, "other": 130}  # px; all scores fit on a page of 1400 px beside MLflow's panels


@dataclass(frozen=True)
class View:
    """A saved view of the table of runs.

    `key` identifies the view in links. `filter` is the condition that runs must meet to be listed; runs of
    older results are never listed. `columns` are shown in addition to the columns of scores.
    """

    key: str
    title: str
    filter: str
    columns: tuple[str, ...]

    def state(self) -> str:
        """Return the view in the form in which MLflow's page saves it."""
        metrics = [_column("metrics", name) for name in (*SCORES, TRAIN_S)]
        columns = [*metrics, *self.columns]
        widths = dict.fromkeys(metrics, WIDTHS["metric"]) | dict.fromkeys(self.columns, WIDTHS["other"])
        name = _column("attributes", "Run Name")
        state = {
            "searchFilter": f"{self.filter} and tags.current = 'true'",
            # Sorted by `attributes.start_time`, MLflow groups training runs under the runs of their stages and hides
            # them until a user opens each group.
            "orderByKey": _column("attributes", "Created"),
            "orderByAsc": False,
            "selectedColumns": columns,
            "columnOrder": [name, *columns],
            "columnWidths": {name: WIDTHS["name"]} | widths,
        }
        return json.dumps(state)


def _column(kind: str, name: str) -> str:
    """Return MLflow's name of a column.

    >>> _column("metrics", "r2_f")
    'metrics.`r2_f`'
    """
    return f"{kind}.`{name}`"


TRAININGS = View(
    "scores",
    "Scores of each training run",
    "tags.kind != 'stage'",  # trainings, the final model, and the universal model
    (_column("params", "method"), _column("tags", "board")),
)
STAGES = View("stages", "Mean scores of each stage", "tags.kind = 'stage' and metrics.accuracy_pct >= 0", ())
VIEWS = (TRAININGS, STAGES)


def experiment_tags(experiment_id: str, created_ms: int) -> Iterator[tuple[str, str]]:
    """Yield name and value of the tags of an MLflow experiment.

    There is one tag for each view, and one tag with the description of the experiment, which contains links to all
    views.
    """
    for i, view in enumerate(reversed(VIEWS)):  # the latest view is listed first
        made_ms = created_ms + i
        saved = {"name": view.title, "createdAt": made_ms, "updatedAt": made_ms, "state": view.state()}
        yield f"{TAG}{view.key}", json.dumps(saved)
    links = ", ".join(f"[{view.title.lower()}]({link(experiment_id, view, host='')})" for view in VIEWS)
    yield NOTE, f"Open {links}."


def link(experiment_id: str, view: View = TRAININGS, *, host: str = UI) -> str:
    """Return the address of a view on an MLflow server."""
    # Without a workflow, MLflow's page shows the menus for language models.
    query = f"workflowType=machine_learning&viewStateShareKey={view.key}"
    return f"{host.rstrip('/')}/#/experiments/{experiment_id}/runs?{query}"


def missing_tags(existing: Mapping[str, str], experiment_id: str, created_ms: int) -> Iterator[tuple[str, str]]:
    """Yield the tags that an experiment lacks; a description that somebody has edited is kept."""
    for name, value in experiment_tags(experiment_id, created_ms):
        if existing.get(name) != value and not (name == NOTE and existing.get(name)):
            yield name, value
