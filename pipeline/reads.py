"""Which settings each stage reads: keys of its scene's file, of `params.yaml` and of the plan. Words only.

`{recipe}` in a key stands for a word of the stage's item in the plan, and `named` tells which key of the scene's file
that word was taken from. dvc.yaml lists the same keys (tests/test_settings.py compares them), so that an override
re-runs exactly the stages that read it. Refuses to know files and values.
"""

from dataclasses import dataclass

from pipeline.questions import MAIN_PROTOCOL

TERMS_N = 4  # terms of physics that a protocol may name
IDLE = "lost_fraction_max"  # a key of params.yaml that re-runs what a stage rests on anyhow


@dataclass(frozen=True)
class Reads:
    """Keys that one stage reads; `named` maps a word of the plan to the key of the scene's file that says it.

    `terms` is set for a stage that reads the terms of its protocol, `physics` for one that looks at the physics of
    simulated scenes only: the plan then lists such keys one by one.
    """

    own: tuple[str, ...] = ()
    shared: tuple[str, ...] = ()
    plan: tuple[str, ...] = ()
    named: tuple[tuple[str, str], ...] = ()
    terms: bool = False
    physics: bool = False


_RECIPE, _TRIPLET, _ADAPTATION = "recipes.{recipe}", "recipes.{triplet}", "adaptations.{adaptation}"
_BASES = ("train_triplet.recipe", "train_triplet.steps_n", "train_triplet.variants")
_HEADLINE = ("adapt.adaptation", "adapt.base", "adapt.steps_n")
_OF_BASES = (("triplet", "train_triplet.recipe"), ("adaptation", "adapt.adaptation"))
_BOARDS = (("boards", f"simulate.protocols.{MAIN_PROTOCOL}.boards"),)
_MAIN = f"simulate.protocols.{MAIN_PROTOCOL}"
_NOISE = ("rig.readings_n", "rig.noload_frames_n")
_CAPTURES = ("stages.split.{scene}.captures",)
_ASKED = ("scenes.{scene}",)


def _trains(section: str, *more: str) -> Reads:
    own = ("seed", "selection", section, *more)
    return Reads(own, (_RECIPE,), named=(("recipe", f"{section}.recipe"),))


def _trains_inside(section: str, plan: tuple[str, ...] = ()) -> Reads:
    named = (("recipe", f"{section}.training.recipe"),)
    return Reads(("seed", "selection", section), (_RECIPE,), plan, named)


# What `contacts` reads of a simulated scene, and a recorded one does not have.
PHYSICS_OWN = (f"{_MAIN}.boards", f"{_MAIN}.depths_mm", f"{_MAIN}.skins_n", "simulate.boards.{boards}")
PHYSICS_SHARED = ("skin", "spreads")

READS: dict[str, Reads] = {
    "simulate": Reads(
        ("seed", "simulate.boards.{boards}", "simulate.protocols.{protocol}"), ("skin", "rig", "chip", "spreads"),
        named=(("boards", "simulate.protocols.{protocol}.boards"),), terms=True,
    ),
    "describe": Reads(plan=_CAPTURES),
    "split": Reads(("seed", "questions", "selection", "split"), plan=(*_CAPTURES, *_ASKED)),
    "train_single": _trains("train_single"),
    "train_multi": _trains("train_multi"),
    "train_triplet": _trains("train_triplet"),
    "adapt": Reads(("seed", "selection", *_BASES, "adapt"), (_TRIPLET, _ADAPTATION), named=_OF_BASES),
    "sweep_pokes": Reads(
        ("seed", "selection", *_BASES, *_HEADLINE, "sweep_pokes"), (_TRIPLET, _ADAPTATION), named=_OF_BASES
    ),
    "sweep_sensors": Reads(
        ("seed", "selection", "train_multi.recipe", "train_multi.steps_n", *_BASES, *_HEADLINE, "adapt.pokes_n"),
        (_RECIPE, _TRIPLET, _ADAPTATION), named=(("recipe", "train_multi.recipe"), *_OF_BASES),
    ),
    "train_classical": Reads(
        ("seed", "selection", "train_classical"), ("methods.{methods}",),
        named=(("methods", "train_classical.methods"),),
    ),
    "few_labels": Reads(
        ("seed", "selection", "few_labels"), (_RECIPE, _ADAPTATION, "labellings.{labelling}", "methods.{methods}"),
        named=(
            ("recipe", "few_labels.recipe"), ("adaptation", "few_labels.adapting.adaptation"),
            ("labelling", "few_labels.labelling.labelling"), ("methods", "few_labels.methods"),
        ),
    ),
    "variation": Reads(("variation",), plan=_CAPTURES),
    "drift": _trains_inside("drift", _CAPTURES),
    "shear": _trains_inside("shear"),
    "manual": Reads(
        ("seed", "selection", *_BASES, *_HEADLINE, "adapt.variants"), (_TRIPLET, _ADAPTATION), named=_OF_BASES
    ),
    "flexible": Reads(
        (
            "seed", "selection", "split.pool_passes_n", *_BASES, "adapt", f"{_MAIN}.boards",
            "simulate.protocols.flexible.boards", "simulate.boards.{boards}.design.gap_mm",
            "simulate.boards.{flexible}.design.gap_mm",
        ),
        (_TRIPLET, _ADAPTATION),
        named=(*_OF_BASES, *_BOARDS, ("flexible", "simulate.protocols.flexible.boards")),
    ),
    "sensitivity": Reads(("simulate.protocols.glass.force_max_N", "simulate.protocols.glass.step_N")),
    "logs": Reads(
        ("seed", f"{_MAIN}.boards", "simulate.boards.{boards}.design"), ("chip", "spreads", *_NOISE), named=_BOARDS
    ),
    "sleeve": Reads(
        (
            "seed", "selection", "sleeve", "simulate.protocols.sleeve.boards", "simulate.boards.{boards}.design",
            "simulate.boards.{boards}.skin_mm",
        ),
        (_RECIPE,),
        named=(("recipe", "sleeve.training.recipe"), ("boards", "simulate.protocols.sleeve.boards")),
    ),
    "contacts": Reads(("seed", "selection", "contacts"), physics=True),
    "ambient": Reads(
        (
            "seed", "selection", "train_multi.recipe", "train_multi.steps_n", "train_multi.seeds_n", "ambient",
            f"{_MAIN}.boards", "simulate.boards.{boards}.design", "simulate.boards.{boards}.quadrature",
        ),
        (_RECIPE, "skin", "chip", "spreads", *_NOISE),
        named=(("recipe", "train_multi.recipe"), *_BOARDS),
    ),
    "audit": Reads(("source", "seed", "questions", "selection", "audit")),
    "verify": Reads(
        (
            "seed", f"{_MAIN}.boards", f"{_MAIN}.depths_mm", "simulate.boards.{boards}.design",
            "simulate.boards.{boards}.quadrature",
        ),
        ("skin", "chip", "spreads"),
        named=_BOARDS,
    ),
    "stability": Reads(
        ("seed", f"{_MAIN}.boards", "simulate.boards.{boards}.design"), ("skin", "chip", "spreads"), named=_BOARDS
    ),
    "leave_out": Reads(
        ("seed", "simulate.protocols", "simulate.boards.{boards}"), ("skin", "chip.gain_sel", "spreads"), named=_BOARDS
    ),
    "runtime": Reads(
        ("seed", "runtime", f"{_MAIN}.boards", f"{_MAIN}.skins_n", "simulate.boards.{boards}"), ("skin", "spreads"),
        named=_BOARDS,
    ),
    "report": Reads(("source", "seed", "questions"), plan=_ASKED),
    "publish": Reads(("source", "questions")),
}  # fmt: skip
