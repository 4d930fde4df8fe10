"""Stage publish: models, points of sweeps and the report -> the MLflow diary. No output: nothing reads it back.

Refuses to compute a result.
"""

from pathlib import Path

from pipeline.provenance import home, is_experiment
from pipeline.report.numbers import curves_of
from pipeline.scenes import Asking
from pipeline.stage import run, say
from pipeline.stages._report import asking
from pipeline.tracking import Curves, TrackingAway, metrics_of
from pipeline.tracking import publish as write
from reskin import io
from reskin.config import Files, read_settings


def publish(scene: str, files: Files, models: Path, answers: Path, reports: Path) -> None:
    """Write every training of a scene and its report to MLflow once; if the server is away, say so and go on."""
    asked = asking(read_settings("publish", scene, files))
    arms = {arm: models / arm for arm in asked.modelled}
    name = (
        f"{scene} (dvc exp)" if is_experiment() else scene
    )  # beside the checkout's own results, and not in their place
    try:
        say(f"{name}: MLflow runs {write(arms, read_curves(asked, answers), reports, scene=name, root=home())}")
    except TrackingAway as away:
        say(f"warning: {scene} is not in MLflow: {away}")


def read_curves(asked: Asking, answers: Path) -> Curves:
    """Read the points of every sweep and the numbers of every experiment, as curves by stage."""
    stages = asked.curves
    points = {question: io.read_json(answers / f"{stage}.json") for question, stage in stages.items()}
    curves: dict[str, list[tuple[str, int, dict[str, float]]]]
    curves = {stages[question]: rows for question, rows in curves_of(points).items()}
    for question in asked.experiments:
        numbers = io.read_json(answers / f"{question}.json")["numbers"]
        named = [(name.rpartition("."), value, step) for name, value, step in metrics_of({question: numbers})]
        curves[question] = [(head, step, {tail: value}) for (head, _, tail), value, step in named]
    return curves


if __name__ == "__main__":
    run(publish)
