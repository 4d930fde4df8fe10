"""Settings: YAML files, and strict pydantic models that validate them.

A model of settings is frozen, allows no unknown keys and has few defaults; it is defined beside the code that uses it.
"""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from reskin.errors import ParamsError, did_you_mean


class Strict(BaseModel):
    """Base of all models of settings: missing keys and unknown keys are errors."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


Model = TypeVar("Model", bound=Strict)


def read_yaml(path: Path) -> Any:
    """Read YAML 1.2 as DVC does (`1e-3` is a number)."""
    try:
        return YAML(typ="safe").load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ParamsError(f"{path}: file not found. Check the name.") from None
    except (YAMLError, UnicodeDecodeError) as error:
        problem = " ".join(str(error).split())
        raise ParamsError(f"{path}: the file is not YAML: {problem}. Correct the line it names.") from None


def parse(model: type[Model], value: Any, where: str) -> Model:
    """Validate plain values against a model; raise a `ParamsError` that names the wrong key and what is allowed."""
    try:
        # Through JSON, so that a YAML list may fill a tuple while "3" still does not become 3.
        return model.model_validate_json(json.dumps(value, default=str))
    except ValidationError as error:
        # A misspelt key makes another key missing: report the unknown key first.
        faults = error.errors(include_url=False)
        first = min(faults, key=lambda found: found["type"] != "extra_forbidden")
        beside = [found for found in faults if found["type"] == "missing" and found["loc"][:-1] == first["loc"][:-1]]
        names = [".".join(_path_in_file(found["loc"], value)) for found in (beside if first in beside else [first])]
        name = ", ".join(names) or "the file"
        got = repr(first.get("input"))[:80]
        if first["type"] == "missing":
            raise ParamsError(f"{where}: {name} {'are' if ', ' in name else 'is'} missing. Add it there.") from None
        if first["type"] == "extra_forbidden":
            raise ParamsError(
                f"{where}: {name} is not a known parameter (its value: {got}). Correct or remove it there."
            ) from None
        rule = first["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
        if first["type"] == "value_error":  # parameters contradict each other: the rule names them and their values
            place = f"{where}: {name}" if first["loc"] else where
            raise ParamsError(f"{place}: {rule}. Correct it there.") from None
        choices = re.findall("'([^']*)'", rule) if first["type"] == "literal_error" else []
        guess = did_you_mean(first.get("input"), choices)
        raise ParamsError(where, name, rule, got, f"Correct it there.{guess}") from None


def _path_in_file(loc: Sequence[int | str], value: Any) -> list[str]:
    """Return the keys of a location that are in the file: pydantic also names the types that it tried."""
    kept = []
    for i, part in enumerate(loc):
        known = part in value if isinstance(value, dict) else isinstance(value, list | tuple) and isinstance(part, int)
        if known or i == len(loc) - 1:
            kept.append(str(part))
        value = value[part] if known else value
    return kept
