"""The order of a report page: questions of a scene -> sections, each with what it answers and shows. Words only.

A section stands on a page if one of its tables or figures does. Refuses to know numbers and HTML.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Section:
    """A part of the page: its heading, one sentence on what it answers, and the names of what it shows, in order."""

    key: str
    title: str
    sentence: str
    tables: tuple[str, ...] = ()
    figures: tuple[str, ...] = ()
    folded: tuple[str, ...] = ()  # tables so long that they open on demand


HEADLINE = Section(
    "headline",
    "Headline",
    "What networks make of skins and boards that they never saw, beside the paper's table 2.",
    ("table2", "order"),
)
QUESTIONS = (
    Section("table1", "Tactile sensors (table 1)", "How ReSkin stands beside other tactile sensors.", ("table1",)),
    Section(
        "single",
        "One skin (section 4)",
        "How well a network knows the skin that it learnt, by how the test readings were held out.",
        ("single_sensor",),
        (
            "error_grid_single_random.svg",
            "error_grid_single_indentation.svg",
            "error_grid_single_pass.svg",
            "error_grid_single_temporal.svg",
        ),
    ),
    Section(
        "shear", "Shear (section 4)", "Whether dragged contacts give away all three forces.", ("shear",), ("shear.svg",)
    ),
    Section(
        "variation",
        "Variation over time and skins (figure 4)",
        "How the field of the same poke changes as a skin ages, and from skin to skin.",
        ("variation",),
        ("variation_time.svg", "variation_skins.svg"),
    ),
    Section(
        "drift",
        "Drift (figure 5)",
        "How long a network stays good as its skin wears, and what no-load readings regain.",
        ("drift_findings", "drift"),
        ("drift.svg", "drift_force.svg"),
    ),
    Section(
        "skins",
        "New skins and boards (section 5, table 2)",
        "How networks answer for boards and skins that they never saw, and how much methods differ there.",
        ("paired", "paired_boards", "lobo_boards"),
        ("error_grid_transfer.svg", "error_grid_lobo.svg", "error_grid_triplet.svg", "error_grid_adapt.svg"),
    ),
    Section(
        "pokes",
        "Unlabelled pokes (figure 6a)",
        "How many pokes of the new skin adaptation needs.",
        ("sweep_pokes",),
        ("sweep_pokes.svg",),
    ),
    Section(
        "sensors",
        "Training skins (figure 6b)",
        "How many skins training needs, with and without adaptation.",
        ("sweep_sensors",),
        ("sweep_sensors.svg",),
    ),
    Section("manual", "Hand pokes (section 5)", "Whether adaptation works with pokes by hand.", ("manual",)),
    Section(
        "flexible",
        "Flexible boards (section 5)",
        "What a network of rigid boards makes of flexible ones.",
        ("flexible",),
        ("flexible.svg",),
    ),
    Section(
        "sensitivity",
        "Force sensitivity (section 6)",
        "The smallest step of force that readings tell apart.",
        ("sensitivity",),
        ("sensitivity.svg",),
    ),
    Section(
        "logs",
        "On-board logs (section 6)",
        "Force and place over time from a log of dog shoe or glove.",
        ("logs", "logs_turning"),
        ("logs.svg",),
    ),
    Section(
        "sleeve",
        "Sleeve (section 6)",
        "Whether many boards under one skin find a contact over its whole area.",
        ("sleeve", "sleeve_set_up"),
        ("sleeve.svg",),
    ),
    Section(
        "contacts",
        "Two contacts (section 7)",
        "What a network of single contacts makes of two, and whether two can be told from one.",
        ("contacts", "superposition"),
        ("contacts.svg",),
    ),
    Section(
        "ambient",
        "Fields and iron nearby (section 7)",
        "What a field from outside costs, and what subtracting it regains.",
        ("ambient",),
        ("ambient.svg",),
    ),
    Section(
        "dynamics",
        "Dynamic presses (section 7)",
        "What the whole stream of a press tells beyond the mean of five readings.",
        ("dynamics",),
        ("dynamics.svg",),
    ),
    Section(
        "baselines",
        "Classical methods (ours)",
        "How far methods without networks come on the same folds.",
        ("baselines",),
    ),
    Section("labels", "A few labels (ours)", "What a few labelled indentations of a new board are worth.", ("labels",)),
    Section("choice", "Choice of settings (ours)", "Which settings were chosen, on boards of their own.", ("chosen",)),
    Section(
        "described",
        "Skins (section 2)",
        "What the skins of this scene look like: fields, noise, forces.",
        ("skins",),
    ),
    Section(
        "checks",
        "Verification, stability and leaks",
        "Whether the physics follows its laws, stiff and extreme cases end well, and no result rests on its test rows.",
        folded=("verification", "stability", "audit", "trainings"),
    ),
    Section(
        "checklist",
        "Checklist of the paper",
        "Each figure, table and numbered result of the paper beside ours, and where it is shown here.",
        ("checklist",),
    ),
)
FURTHER = Section("further", "Further", "What no section above names.", folded=("variants",))
LEFT_OUT = Section(
    "left-out",
    "What was left out, and what that costs",
    "The terms of physics that protocols of this scene do without, and the error that each makes.",
    ("left_out",),
)
COSTS = Section(
    "costs",
    "Error against run time",
    "What accuracy costs: measured on the machine named under provenance, so these change from run to run.",
    ("learning", "adaptation", "stages"),
    ("training.svg", "inference.svg", "adaptation.svg", "quadratures.svg", "integrators.svg"),
    ("quadratures", "integrators"),
)
CAPTURES = Section(
    "captures", "Captures, and what was dropped", "What was read, and what of it was lost.", ("captures",)
)

# What stands above a table and below a figure; others are called by their names.
CAPTIONS = {
    "table2": "Table 2: scores on skins and boards never seen",
    "order": "Does the order of the paper's rows hold?",
    "checklist": "Each result of the paper, and ours",
    "table1": "Table 1: tactile sensors",
    "single_sensor": "One skin, by what is held out",
    "paired": "Paired differences between methods, over held-out boards",
    "paired_boards": "Paired differences between methods, board by board",
    "lobo_boards": "Each board held out in turn",
    "sweep_pokes": "Scores by unlabelled pokes",
    "sweep_sensors": "Scores by training skins",
    "baselines": "Classical methods and networks on the same folds",
    "labels": "Scores by labelled indentations of the new board",
    "chosen": "Candidates, and which was chosen",
    "audit": "Search for leaks",
    "trainings": "Trainings that collapsed",
    "left_out": "Terms of physics: left out by which protocols, computed for which",
    "captures": "What was read, and what was lost",
    "stages": "What each stage cost",
    "learning": "Methods: error beside time",
    "adaptation": "Adaptation: error beside time",
    "quadratures": "Quadratures of the field: error beside time",
    "integrators": "Integrators of relaxation: error beside time",
    "variants": "Every recipe that was trained",
    "drift_findings": "What the paper found about drift, and whether it is so here",
    "variation": "How far the field of equal pokes moves",
    "drift": "Scores by contacts that the skin has felt",
    "shear": "Place and all three forces of dragged lines",
    "manual": "Scores before and after adaptation by hand pokes",
    "flexible": "Networks of rigid boards on flexible boards",
    "sensitivity": "Weights told apart, as a glass fills",
    "logs": "Contacts of a log, found and made",
    "logs_turning": "The same log on a board that turns in the earth's field",
    "sleeve": "Places found on a sleeve of eight boards",
    "sleeve_set_up": "The sleeve beside the paper's",
    "contacts": "One network's answer to two contacts, and whether two are told",
    "superposition": "How far the fields of two contacts add up",
    "ambient": "Scores in fields from outside",
    "dynamics": "Scores of presses that never rest",
    "skins": "What skins look like",
    "verification": "The physics against independent references",
    "stability": "Stiff, extreme and broken cases",
    "error_grid_single_random.svg": "Place error on one skin, random readings held out",
    "error_grid_single_indentation.svg": "Place error on one skin, indentations held out",
    "error_grid_single_pass.svg": "Place error on one skin, passes held out",
    "error_grid_single_temporal.svg": "Place error on one skin, last passes held out",
    "error_grid_transfer.svg": "Place error, trained on one skin and tested on others",
    "error_grid_lobo.svg": "Place error, board held out",
    "error_grid_triplet.svg": "Place error, board held out, with the triplet loss",
    "error_grid_adapt.svg": "Place error, board held out, after adaptation",
    "sweep_pokes.svg": "Scores against unlabelled pokes",
    "sweep_sensors.svg": "Scores against training skins",
    "drift.svg": "Accuracy and MSE of the force against interactions, by no-load policy",
    "drift_force.svg": "Predicted against true force, late",
    "variation_time.svg": "Change of the field over time at two places",
    "variation_skins.svg": "Field of equal pokes, a line a skin",
    "shear.svg": "Predicted against true forces, whole lines held out",
    "flexible.svg": "Predicted against true force on flexible boards, before and after adaptation",
    "sensitivity.svg": "Response to weight, and weights told apart",
    "logs.svg": "Force and place over the time of a log",
    "sleeve.svg": "Place error over the whole sleeve",
    "contacts.svg": "Where one answer falls between two contacts, and how often two are told",
    "ambient.svg": "Accuracy against a uniform field, and against iron nearby",
    "dynamics.svg": "Errors against the duration of a press",
    "training.svg": "Error against training time",
    "inference.svg": "Error against the time of one reading",
    "adaptation.svg": "Error against adaptation time",
    "quadratures.svg": "Error of the field against run time",
    "integrators.svg": "Error of the relaxed force against run time",
}
