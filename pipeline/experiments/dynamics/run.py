"""Stage dynamics: presses that never rest -> errors of single readings and of the last five's mean (section 7)."""

from pathlib import Path

import numpy as np

from pipeline.core.stage import run, say
from pipeline.dataset.baseline import subtract
from pipeline.dataset.rows import TARGETS
from pipeline.experiments.answer import read_folder, read_losses, write_answer
from pipeline.experiments.dynamics.presses import compare, presses_of
from pipeline.experiments.only import only
from pipeline.trials.networks import networks_without


def dynamics(scene: str, indentations: Path, models: Path, answer: Path) -> None:
    """Ask the networks of train_multi that never saw the pressed skin's board."""
    one = only(read_folder(indentations), indentations)
    true = np.stack([getattr(one, name) for name in TARGETS], axis=1)
    presses = presses_of(subtract(one.b_uT, one.noload_uT), true, one.t_s, one.indentation)
    numbers = compare(presses, networks_without(models, one.board), board=one.board)
    write_answer(answer, numbers, {}, read_losses(indentations, {}))
    say(f"{scene}: {numbers['readings_n']} readings of {numbers['presses_n']} presses at {numbers['rate_hz']:.0f} Hz")


if __name__ == "__main__":
    run(dynamics)
