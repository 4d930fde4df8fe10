"""Read settings from YAML files, and validate them with pydantic models.

A settings model is a class that declares the keys of a section of settings and the types of their values. It is defined
in the module that uses the settings. All settings models are subclasses of `Strict`.
"""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent

from reskin.errors import ParamsError, did_you_mean


class Strict(BaseModel):
    """Base class of all settings models. Unknown keys are errors, and so are missing keys that have no default value.

    The settings cannot be changed after they were read.
    """

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


Model = TypeVar("Model", bound=Strict)
YAML_BYTES_MAX = 2**22
YAML_DEPTH_MAX = 50  # the files of this project have at most 10 levels


def read_yaml(path: Path) -> Any:
    """Read a file as YAML 1.2, which is the version that DVC reads too. In YAML 1.1, `1e-3` would be text.

    Aliases are refused, because a few lines of them can expand to gigabytes, and so are large or deep files.
    """
    try:
        if path.stat().st_size > YAML_BYTES_MAX:
            raise YAMLError(f"it has more than {YAML_BYTES_MAX} bytes")
        text = path.read_text(encoding="utf-8")
        _check_events(text)
        return YAML(typ="safe").load(text)
    except FileNotFoundError:
        raise ParamsError(f"{path}: file not found. Check the path.") from None
    except (YAMLError, ValueError) as error:
        problem = " ".join(str(error).split())
        raise ParamsError(
            f"{path}: the file is not valid YAML: {problem}. Correct the line of the file that this message names."
        ) from None


def _check_events(text: str) -> None:
    """Raise if YAML text has aliases, or is nested so deeply that the loader would run out of stack."""
    depth = 0
    for event in YAML(typ="safe").parse(text):
        depth += isinstance(event, CollectionStartEvent) - isinstance(event, CollectionEndEvent)
        if isinstance(event, AliasEvent) or depth > YAML_DEPTH_MAX:
            fault = "an alias (*name)" if isinstance(event, AliasEvent) else f"more than {YAML_DEPTH_MAX} levels"
            raise YAMLError(f"line {event.start_mark.line + 1} has {fault}")


def parse(model: type[Model], value: Any, where: str) -> Model:
    """Create a settings model from plain values, such as those of a YAML file.

    If a value is invalid, a `ParamsError` is raised. Its message names `where`, the key, the rule for the value, and
    what the user can do.
    """
    try:
        # The values are converted to JSON before they are validated. If Python values were validated, pydantic's strict
        # mode would reject a list where a tuple is expected. In JSON, it accepts such a list, but still rejects the
        # text "3" where a number is expected.
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
            are, remedy = "is", "Add this key, and give it a value."
            if len(names) > 1:
                are, remedy = "are", "Add these keys, and give each of them a value."
            raise ParamsError(f"{where}: {name} {are} missing. {remedy}") from None
        if first["type"] == "extra_forbidden":
            raise ParamsError(
                f"{where}: {name} is not a known parameter (its value: {got}). Correct the name of this key, or remove "
                "the key."
            ) from None
        rule = first["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
        # This is the error of a validator that the model defines. Its message already names the keys and their values.
        if first["type"] == "value_error":
            place = f"{where}: {name}" if first["loc"] else where
            end = "" if rule.endswith("?") else "."
            remedy = "Correct this value." if first["loc"] else "Correct these settings."
            raise ParamsError(f"{place}: {rule}{end} {remedy}") from None
        choices = re.findall("'([^']*)'", rule) if first["type"] == "literal_error" else []
        guess = did_you_mean(first.get("input"), choices)
        raise ParamsError(where, name, rule, got, f"Correct this value.{guess}") from None


def _path_in_file(loc: Sequence[int | str], value: Any) -> list[str]:
    """Return the keys and list indices at which the wrong value is in the file.

    `loc` is the location that pydantic reports. It also contains the names of types, which are not in the file.
    """
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
