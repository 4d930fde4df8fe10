"""Stage logs: an SD card's log -> contacts, places and forces over time (section 6, dog shoe and glove)."""

from pathlib import Path

import numpy as np

from pipeline.capture import probe, sd_card
from pipeline.capture.header import LOG_FILE, PROBE_FILE
from pipeline.core.config import Files, read_settings
from pipeline.core.stage import run, say
from pipeline.dataset.captures import read_header
from pipeline.experiments.answer import write_answer
from pipeline.experiments.logs.boards import turned
from pipeline.experiments.logs.estimates import describe, estimate, score_contacts, thin, truth_at
from pipeline.experiments.logs.turning import Log
from pipeline.experiments.only import only
from pipeline.trials.networks import networks_without


def logs(scene: str, files: Files, raw: Path, models: Path, answer: Path) -> None:
    """Read a folder's walk with networks that never saw its board; score it where its truth is kept, and turn it."""
    settings = read_settings("logs", scene, files)
    folder = only(sorted(child for child in raw.iterdir() if child.is_dir()), raw)
    t_s, b_uT, _, account = sd_card.read_log(folder / LOG_FILE)
    board = read_header(folder).board
    networks = networks_without(models, board)
    found = estimate(t_s, b_uT, networks, where=str(folder / LOG_FILE))
    numbers, true = describe(found) | {"networks_n": len(networks), "account": account}, None
    if (folder / PROBE_FILE).is_file():
        log = probe.parse(folder / PROBE_FILE, str(folder / PROBE_FILE))
        known = np.stack([log.x_mm, log.y_mm, log.Fz_N], axis=1)
        known[~log.contact] = np.nan
        true = truth_at(t_s, log.t_start_s, log.t_end_s, known)
        numbers |= score_contacts(found, true) | turned(Log(t_s, b_uT, true, found.quiet_n), board, settings, networks)
    losses = {"accounts": [numbers["account"]], "left_out": {}}
    write_answer(answer, numbers, thin(found, true), losses)
    say(f"{scene}: {numbers['contacts_n']} contacts in {numbers['duration_s']:.1f} s of log")


if __name__ == "__main__":
    run(logs)
