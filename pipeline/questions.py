"""Which questions a scene may ask: who answers each, what it goes on from, what it needs. Words only.

A new question is a row here, a section in `sections`, a stage and a part of the report. Refuses to know files.
"""

from typing import Literal

Study = Literal["verification", "stability", "runtime", "left_out"]
Further = Literal["triplet", "adapt", "pokes", "baselines", "audit", "choice"]
Experiment = Literal[
    "drift",
    "variation",
    "shear",
    "manual",
    "flexible",
    "sleeve",
    "sensitivity",
    "logs",
    "contacts",
    "ambient",
    "dynamics",
]

# question -> the stage that answers it, and the keys of `split` that draw its folds
ANSWERED_BY: dict[str, str] = {
    "lobo": "train_multi",
    "transfer": "train_single",
    "single_random": "train_single",
    "single_indentation": "train_single",
    "single_pass": "train_single",
    "single_temporal": "train_single",
    "sensors": "sweep_sensors",
    "labels": "few_labels",
}
DRAWN_WITH: dict[str, set[str]] = {
    "lobo": set(),
    "transfer": {"transfer_skins_n"},
    "single_random": {"random_test_fraction", "random_repeats_n"},
    "single_indentation": {"random_test_fraction", "random_repeats_n"},
    "single_pass": {"random_test_fraction", "random_repeats_n"},
    "single_temporal": {"temporal_test_fraction"},
    "sensors": {"sensors_skins_n", "sensors_draws_n"},
    "labels": {"labels_pool_n", "labels_draws_n"},
}
# questions about the folds of others -> the stage that answers it, and the questions that it goes on from
CONTINUED_BY: dict[str, str] = {
    "triplet": "train_triplet",
    "adapt": "adapt",
    "pokes": "sweep_pokes",
    "baselines": "train_classical",
    "audit": "audit",
}
NEEDS: dict[str, set[str]] = {
    "triplet": {"lobo"},
    "adapt": {"triplet"},
    "pokes": {"adapt"},
    "sensors": {"adapt"},
    "baselines": {"lobo"},
    "labels": {"lobo"},
    "audit": {"lobo"},
    "choice": {"lobo", "triplet", "adapt"},  # answered by the report: it only reads scores
    "manual": {"adapt"},
    "flexible": {"adapt"},
    "logs": {"lobo"},
    "contacts": {"lobo"},
    "ambient": {"lobo"},
    "dynamics": {"lobo"},
}
POOLED_BY = "adapt"  # takes pokes of the held-out skins, so a part of these is kept from every test
ARMS = (
    "train_single", "train_multi", "train_triplet", "adapt", "sweep_pokes", "sweep_sensors", "train_classical",
    "few_labels", "audit",
)  # fmt: skip
WITHOUT_SECTION = {"sweep_sensors"}  # settings of others are all they need
# questions about the physics of a simulated scene -> the stage that answers it
STUDIED_BY: dict[str, str] = {
    "verification": "verify",
    "stability": "stability",
    "runtime": "runtime",
    "left_out": "leave_out",
}
STUDIES = tuple(STUDIED_BY.values())
MODELLED = {"train_single", "train_multi", "train_triplet", "adapt"}
SWEPT = {"pokes": "sweep_pokes", "sensors": "sweep_sensors", "baselines": "train_classical", "labels": "few_labels"}
STAGE_OF = ANSWERED_BY | CONTINUED_BY  # of the questions about learning
MAIN_PROTOCOL = "grid"  # folds are drawn on its captures

# The paper's further experiments, each answered by the stage of its name -> the protocol that it is asked of. None: the
# main captures. A recorded scene has all its captures in one folder.
EXPERIMENTS: dict[str, str | None] = {
    "drift": "wear",
    "variation": "wear",
    "shear": "drag",
    "manual": "hand",
    "flexible": "flexible",
    "sleeve": "sleeve",
    "sensitivity": "glass",
    "logs": "log",
    "contacts": None,
    "ambient": None,
    "dynamics": "press",
}
NOT_INGESTED = {"walk"}  # kinds of protocols whose captures are read as they are: an SD card knows no probe
OF_RECORDED = {"drift", "contacts"}  # the experiments that recorded captures can answer too
WITH_SECTION = {"drift", "variation", "shear", "sleeve", "contacts", "ambient"}
