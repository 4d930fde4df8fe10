"""The questions that a scene may ask, in one table: who answers each, what it needs, on which captures. Words only.

A new experiment is a row here, a folder in `experiments`, a stage in dvc.yaml, and its name in a scene. Refuses to know
files, settings and results.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

MAIN_PROTOCOL = "grid"  # folds are drawn on its captures
NOT_INGESTED = {"walk"}  # kinds of protocols whose captures are read as they are: an SD card knows no probe
POOLED_BY = "adapt"  # takes pokes of the held-out skins, so a part of these is kept from every test
# The rows of table 2 and who answers them; a scene that asks all of these questions has the table early.
TABLE_2 = {"single": "transfer", "multi": "lobo", "triplet": "triplet", "adapted": "adapt"}
RANDOM = ("random_test_fraction", "random_repeats_n")

Kind = Literal["models", "curve", "other", "experiment", "study", "report"]


@dataclass(frozen=True)
class Question:
    """One row: a question, the stage that answers it and the questions it goes on from.

    `kind` tells what the answer is: models with cards, points of a curve, another file about learning, an experiment
    with a folder of its own, a study of the physics, or words of the report. `protocol` is that of the captures it is
    asked of; None: the main ones. `folds` are the keys of `split` that its folds are drawn with; None: it has no folds
    of its own. `section`: the scene's file holds settings for it, named as the stage.
    """

    name: str
    kind: Kind
    stage: str = ""
    needs: tuple[str, ...] = ()
    protocol: str | None = None
    folds: tuple[str, ...] | None = None
    section: bool = False
    recorded: bool = True  # a scene of recordings may ask it too
    alone: bool = False  # a scene may ask it and nothing else: it needs no folds, and no places in mm

    def __post_init__(self) -> None:
        object.__setattr__(self, "stage", self.stage or self.name)


def _experiment(
    name: str, protocol: str | None, *needs: str, section: bool = False, recorded: bool = False, alone: bool = False
) -> Question:
    return Question(name, "experiment", "", needs, protocol, section=section, recorded=recorded, alone=alone)


def _study(name: str, *, section: bool = False) -> Question:
    return Question(name, "study", section=section, recorded=False)


ROWS = (
    Question("single_random", "models", "train_single", folds=RANDOM, section=True),
    Question("single_indentation", "models", "train_single", folds=RANDOM, section=True),
    Question("single_pass", "models", "train_single", folds=RANDOM, section=True),
    Question("single_temporal", "models", "train_single", folds=("temporal_test_fraction",), section=True),
    Question("transfer", "models", "train_single", folds=("transfer_skins_n",), section=True),
    Question("lobo", "models", "train_multi", folds=(), section=True),
    Question("triplet", "models", "train_triplet", needs=("lobo",), section=True),
    Question("adapt", "models", needs=("triplet",), section=True),
    Question("pokes", "curve", "sweep_pokes", needs=("adapt",), section=True),
    Question("sensors", "curve", "sweep_sensors", needs=("adapt",), folds=("sensors_skins_n", "sensors_draws_n")),
    Question("baselines", "curve", "train_classical", needs=("lobo",), section=True),
    Question("labels", "curve", "few_labels", needs=("lobo",), folds=("labels_pool_n", "labels_draws_n"), section=True),
    Question("universal", "curve", needs=("labels", "compare"), section=True),
    Question("audit", "other", needs=("lobo",), section=True),
    Question("choice", "report", "report", needs=("lobo", "triplet", "adapt")),
    _experiment("bound", None, "single_pass"),
    _experiment("population", None, "adapt", section=True),
    _experiment("drift", "wear", section=True, recorded=True),
    _experiment("variation", "wear", section=True),
    _experiment("shear", "drag", section=True),
    _experiment("manual", "hand", "adapt"),
    _experiment("flexible", "flexible", "adapt"),
    _experiment("sleeve", "sleeve", section=True),
    _experiment("sensitivity", "glass"),
    _experiment("logs", "log", "lobo"),
    _experiment("compare", None, section=True, recorded=True),
    _experiment("rivals", None, "universal", section=True, recorded=True),
    _experiment("contacts", None, "lobo", section=True, recorded=True),
    _experiment("touches", None, section=True, recorded=True, alone=True),
    _experiment("ambient", None, "lobo", section=True),
    _experiment("dynamics", "press", "lobo"),
    _experiment("worlds", None, "transfer", "adapt", section=True),
    _experiment("gripper", "grip", "lobo", section=True),
    _study("verification"),
    _study("stability"),
    _study("runtime", section=True),
    _study("left_out"),
)
QUESTIONS: Mapping[str, Question] = {row.name: row for row in ROWS}


def stages(names: Iterable[str], *kinds: Kind) -> list[str]:
    """Name the stages that answer questions of some kinds, in the order of the table; each once."""
    chosen = set(names)
    return list(dict.fromkeys(row.stage for row in ROWS if row.name in chosen and row.kind in kinds))


LEARNING: tuple[Kind, ...] = ("models", "curve", "other")
EXPERIMENTS = tuple(row.name for row in ROWS if row.kind == "experiment")
SECTIONS = tuple(dict.fromkeys(row.stage for row in ROWS if row.section))
