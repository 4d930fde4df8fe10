"""Stage sweep_pokes: adaptation with few and many unlabelled pokes (paper figure 6a).

Refuses to know how networks are adapted (`trials.adapting`).
"""

from pathlib import Path
from typing import Any

from pipeline.stage import run
from pipeline.training.trainings import (
    adaptations,
    note_seconds,
    point_of,
    prepare_training,
    read_data,
    read_starts,
    train_all,
)
from reskin import io
from reskin.config import Files, Settings, read_settings
from reskin.errors import ParamsError
from reskin.models.recipe import HEADLINE, PokesSweep
from reskin.models.recipe import adaptations as adaptations_of


def read(settings: Settings) -> PokesSweep:
    """Read section sweep_pokes."""
    return settings.section(PokesSweep, "sweep_pokes")


def sweep_pokes(scene: str, files: Files, indentations: Path, folds: Path, started: Path, scores: Path) -> None:
    """Score every number of pokes; none at all is the network as it was trained."""
    prepare_training()
    data, starts = read_data(read_settings("sweep_pokes", scene, files), indentations, folds), read_starts(started)
    sweep, recipe = read(data.settings), adaptations_of(data.settings).recipes[HEADLINE]
    held_out = data.folds_of("lobo")[-sweep.boards_n :]
    if sweep.boards_n > len(held_out):
        rule = f"at most the {len(held_out)} boards of the scene"
        raise ParamsError(data.settings.where, "sweep_pokes.boards_n", rule, sweep.boards_n, "Ask for fewer.")
    pairs = [
        (trial, pokes_n)
        for fold in held_out
        for pokes_n in sweep.pokes_n
        if pokes_n
        for trial in adaptations(data, fold, (HEADLINE, recipe), starts, question="pokes", pokes_n=pokes_n)
    ]
    trials = [trial for trial, _ in pairs]
    trained = train_all(data, trials, "sweep_pokes")
    points = [
        point_of(data, trial, result, "adapted") | {"pokes_n": pokes_n}
        for (trial, pokes_n), result in zip(pairs, trained, strict=True)
    ]
    io.write_json(scores, points + _unadapted(started, recipe.base, {fold.name for fold in held_out}))
    note_seconds(scene, "sweep_pokes", trials, trained)


def _unadapted(started: Path, base: str, held_out: set[str]) -> list[dict[str, Any]]:
    cards = [io.read_json(file) for file in sorted(started.glob("*.json"))]
    kept = ("key", "question", "fold", "seed_i", "stopped_step", "scores")
    return [
        {name: card[name] for name in kept} | {"method": "triplet", "pokes_n": 0}
        for card in cards
        if card["recipe_name"] == base and card["fold"] in held_out
    ]


if __name__ == "__main__":
    run(sweep_pokes)
