"""The base of every parameter model: frozen, strict, nothing extra, no defaults. Knows no knob.

Sections live beside what they steer (`Split` in dataset.splits, `Recipe` in learning.recipe, ...) and are
put together to a scene in `pipeline.params`.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

from pydantic import BaseModel, ConfigDict, ValidationError, create_model
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from pipeline.errors import ParamsError, complain


class Strict(BaseModel):
    """A parameter model: what is not written is an error, and so is what is not known."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


Model = TypeVar("Model", bound=Strict)


def read_yaml(path: Path) -> Any:
    """Read YAML 1.2 as DVC does (`1e-3` is a number)."""
    try:
        return YAML(typ="safe").load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ParamsError(complain(path, "the file", "there", "nothing", "Check the name.")) from None
    except (YAMLError, UnicodeDecodeError) as error:
        problem = " ".join(str(error).split())
        raise ParamsError(complain(path, "the file", "YAML", problem, "Mend the line it names.")) from None


def parse(model: type[Model], value: Any, where: str) -> Model:
    """Check plain values against a model; name the first parameter that is wrong, and what is allowed."""
    try:
        # Through JSON, so that a YAML list may fill a tuple while "3" still does not become 3.
        return model.model_validate_json(json.dumps(value, default=str))
    except ValidationError as error:
        # A misspelt name is also a missing one: name what was written first.
        first = min(error.errors(include_url=False), key=lambda one: one["type"] != "extra_forbidden")
        name = ".".join(_written(first["loc"], value)) or "the file"
        got = "nothing" if first["type"] == "missing" else repr(first.get("input"))[:80]
        rule = {"missing": "given", "extra_forbidden": "a known parameter"}.get(first["type"])
        rule = rule or first["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
        if (
            first["type"] == "value_error"
        ):  # parameters that contradict each other: the rule names them and their values
            place = f"{where}: {name}" if first["loc"] else where
            raise ParamsError(f"{place}: {rule}. Mend it there.") from None
        raise ParamsError(complain(where, name, rule, got, "Mend it there.")) from None


def parse_parts(model: type[Model], value: Any, where: str) -> Model:
    """Check what is there of a model; for a stage that reads a part of a section. What is absent is no attribute."""
    fields = {name: field for name, field in model.model_fields.items() if name in value}
    if all(name in value or not field.is_required() for name, field in model.model_fields.items()):
        return parse(model, value, where)
    asked: dict[str, Any] = {name: (field.annotation, field) for name, field in fields.items()}
    part: Strict = parse(create_model(model.__name__, __base__=Strict, **asked), value, where)
    return cast(Model, model.model_construct(**{name: getattr(part, name) for name in fields}))


def _written(loc: Sequence[int | str], value: Any) -> list[str]:
    """Keep of a place what a file can say: pydantic also names the kind of section that it tried."""
    kept = []
    for i, part in enumerate(loc):
        known = part in value if isinstance(value, dict) else isinstance(value, list | tuple) and isinstance(part, int)
        if known or i == len(loc) - 1:
            kept.append(str(part))
        value = value[part] if known else value
    return kept
