"""Settings: YAML files, and strict pydantic models that validate them.

A settings model is frozen, rejects unknown keys and has few default values. It is defined in the module that uses it.
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
    """Base class of all settings models: missing keys and unknown keys are errors."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


Model = TypeVar("Model", bound=Strict)


def read_yaml(path: Path) -> Any:
    """Read a file as YAML 1.2, as DVC does; in YAML 1.1, `1e-3` would be text."""
    try:
        return YAML(typ="safe").load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ParamsError(f"{path}: file not found. Check the name.") from None
    except (YAMLError, UnicodeDecodeError) as error:
        problem = " ".join(str(error).split())
        raise ParamsError(f"{path}: the file is not YAML: {problem}. Correct the line that is named here.") from None


def parse(model: type[Model], value: Any, where: str) -> Model:
    """Create a settings model from plain values; raise a `ParamsError` that names the wrong key and its rule."""
    try:
        # If values are validated as Python values, pydantic's strict mode rejects a list where a tuple is expected. If
        # they are validated as JSON, it accepts such a list, but still rejects the text "3" where a number is expected.
        return model.model_validate_json(json.dumps(value, default=str))
    except ValidationError as error:
        # A misspelt key causes two errors, one for an unknown key and one for a missing key. Report the unknown key.
        details = error.errors(include_url=False)
        first = min(details, key=lambda detail: detail["type"] != "extra_forbidden")
        missing = [item for item in details if item["type"] == "missing" and item["loc"][:-1] == first["loc"][:-1]]
        reported = missing if first in missing else [first]
        names = [".".join(_path_in_file(detail["loc"], value)) for detail in reported]
        name = ", ".join(names) or "the file"
        got = repr(first.get("input"))[:80]
        if first["type"] == "missing":
            raise ParamsError(f"{where}: {name} {'are' if ', ' in name else 'is'} missing. Add it there.") from None
        if first["type"] == "extra_forbidden":
            raise ParamsError(
                f"{where}: {name} is not a known parameter (its value: {got}). Correct or remove it there."
            ) from None
        rule = first["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
        # the error of a validator, whose message names the parameters and their values
        if first["type"] == "value_error":
            place = f"{where}: {name}" if first["loc"] else where
            end = "" if rule.endswith("?") else "."
            raise ParamsError(f"{place}: {rule}{end} Correct it there.") from None
        choices = re.findall("'([^']*)'", rule) if first["type"] == "literal_error" else []
        guess = did_you_mean(first.get("input"), choices)
        raise ParamsError(where, name, rule, got, f"Correct it there.{guess}") from None


def _path_in_file(loc: Sequence[int | str], value: Any) -> list[str]:
    """Return the keys and indices that locate an error, without the names of types that pydantic adds to `loc`."""
    kept = []
    for i, part in enumerate(loc):
        if isinstance(value, list | tuple):
            known = isinstance(part, int) and part < len(value)
        else:
            known = isinstance(value, dict) and part in value
        if known or i == len(loc) - 1:
            kept.append(str(part))
        value = value[part] if known else value
    return kept
