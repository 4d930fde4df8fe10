"""What the stages about physics share: settings that a stage declares -> how skins are made. Knows no stage."""

from collections.abc import Mapping
from typing import Any

from pipeline.core.config import Settings, Strict, parse, parse_parts
from pipeline.physics.board import Spreads
from pipeline.physics.sensor import ChipDesign
from pipeline.physics.skin import SkinDesign
from pipeline.synthesis.capture import BoardKind, Synthesis
from pipeline.synthesis.protocols import Grid
from pipeline.synthesis.rig import Rig

MODELS: dict[str, type[Strict]] = {"skin": SkinDesign, "rig": Rig, "chip": ChipDesign, "spreads": Spreads}


def synthesis_of(settings: Settings) -> Synthesis:
    """Put together what the stage declares of section `simulate` and of what scenes share; the rest is not there."""
    words: Mapping[str, Any] = settings.words("simulate")
    parts: dict[str, Any] = {
        name: parse_parts(model, settings.shared[name], f"params.yaml: {name}")
        for name, model in MODELS.items() if name in settings.shared
    }  # fmt: skip
    where = f"{settings.where}: simulate"
    kinds = words.get("boards", {}).items()
    parts["boards"] = {name: parse_parts(BoardKind, kind, f"{where}.boards.{name}") for name, kind in kinds}
    protocols = words.get("protocols", {})
    whole = {name: own for name, own in protocols.items() if "kind" in own}
    parts["protocols"] = dict(parse_parts(Synthesis, {"protocols": whole}, where).protocols) if whole else {}
    for name, own in protocols.items():
        if name not in whole:  # a few numbers of the main protocol
            parts["protocols"][name] = parse_parts(Grid, own, f"{where}.protocols.{name}")
    named = {term for protocol in whole.values() for term in protocol["terms"]}
    if "rig" in settings.shared and whole:  # what is recorded, and not only looked at, has terms
        terms = {term: settings.row("terms", term) for term in sorted(named)}
        parts |= parse_parts(Synthesis, {"terms": terms}, "params.yaml").__dict__
    return Synthesis.model_construct(**parts)


def check_synthesis(settings: Settings) -> Synthesis:
    """Check section `simulate` of a whole scene with all that scenes share of it."""
    words = settings.words("simulate")
    terms = {term for protocol in words["protocols"].values() for term in protocol["terms"]}
    shared = {name: settings.shared[name] for name in MODELS}
    named = {term: settings.row("terms", term) for term in sorted(terms)}
    return parse(Synthesis, words | shared | {"terms": named}, f"{settings.where}: simulate")
