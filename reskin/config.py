"""Settings: YAML of a scene, of params.yaml and of the plan -> checked values. Knows no setting by name.

A model of settings is frozen, strict, knows nothing extra and has no defaults; it stands beside what it steers
(`Split` in dataset.splits, `Recipe` in learning.recipe, ...). A stage is given the keys that dvc.yaml declares for it,
and no other: what it does not declare, it cannot read. Refuses to know what is done with a value.
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from reskin.errors import ParamsError


class Strict(BaseModel):
    """A parameter model: what is not written is an error, and so is what is not known."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


Model = TypeVar("Model", bound=Strict)


def read_yaml(path: Path) -> Any:
    """Read YAML 1.2 as DVC does (`1e-3` is a number)."""
    try:
        return YAML(typ="safe").load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ParamsError(path, "the file", "there", "nothing", "Check the name.") from None
    except (YAMLError, UnicodeDecodeError) as error:
        problem = " ".join(str(error).split())
        raise ParamsError(path, "the file", "YAML", problem, "Mend the line it names.") from None


def root_of_scenes() -> Path:
    """Give where scenes are read: the working directory if it is a checkout, otherwise what the code lies in."""
    is_checkout = Path(FLOW).is_file() and Path(SCENES).is_dir()  # other projects have a dvc.yaml too
    return Path() if is_checkout else ROOT


def params_of(root: Path) -> Path:
    """Give the shared params.yaml of a checkout, or the copy that a wheel keeps within the package."""
    packed = root / "pipeline" / PARAMS
    return packed if packed.is_file() else root / PARAMS


def parse(model: type[Model], value: Any, where: str) -> Model:
    """Check plain values against a model; name the first that is wrong, and what is allowed, or all that lack there."""
    try:
        # Through JSON, so that a YAML list may fill a tuple while "3" still does not become 3.
        return model.model_validate_json(json.dumps(value, default=str))
    except ValidationError as error:
        # A misspelt name is also a missing one: name what was written first.
        faults = error.errors(include_url=False)
        first = min(faults, key=lambda found: found["type"] != "extra_forbidden")
        beside = [found for found in faults if found["type"] == "missing" and found["loc"][:-1] == first["loc"][:-1]]
        names = [".".join(_written(found["loc"], value)) for found in (beside if first in beside else [first])]
        name = ", ".join(names) or "the file"
        got = "nothing" if first["type"] == "missing" else repr(first.get("input"))[:80]
        rule = {"missing": "given", "extra_forbidden": "a known parameter"}.get(first["type"])
        rule = rule or first["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
        if first["type"] == "value_error":  # parameters contradict each other: the rule names them and their values
            place = f"{where}: {name}" if first["loc"] else where
            raise ParamsError(f"{place}: {rule}. Mend it there.") from None
        raise ParamsError(where, name, rule, got, "Mend it there.") from None


def parse_parts(model: type[Model], value: Any, where: str) -> Model:
    """Check what is there of a model; for a stage that reads a part of a section. What is absent is no attribute."""
    fields = {name: field for name, field in model.model_fields.items() if name in value}
    if all(name in value or not field.is_required() for name, field in model.model_fields.items()):
        return parse(model, value, where)
    declared: dict[str, Any] = {name: (field.annotation, field) for name, field in fields.items()}
    part: Strict = parse(create_model(model.__name__, __base__=Strict, **declared), value, where)
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


Words = Mapping[str, Any]
NOTHING = object()
FLOW, PARAMS, PLAN, SCENES = "dvc.yaml", "params.yaml", "pipeline/plan.yaml", "pipeline/scenes"
ROOT = Path(__file__).resolve().parents[1]  # what the code lies in: a checkout, or the packages of an environment
# In dvc.yaml: ${key}, ${item.train_multi.recipe}, ${item.terms[0]}.
PLACE = re.compile(r"\$\{(item\.)?([^}\[]+)(?:\[(\d+)\])?\}")


class Seeded(Strict):
    """The seed of a scene."""

    seed: Annotated[int, Field(ge=0)]


@dataclass(frozen=True)
class Files:
    """Where settings are written: the scene's file, params.yaml, and the plan. dvc.yaml stands beside params.yaml."""

    settings: Path
    params: Path
    plan: Path

    @classmethod
    def of(cls, scene: str) -> "Files":
        """Give those of a scene of this checkout."""
        return cls(Path(SCENES) / f"{scene}.yaml", Path(PARAMS), Path(PLAN))


@dataclass(frozen=True)
class Settings:
    """The settings of a scene that one stage declares in dvc.yaml; what it does not declare is an error."""

    scene: str
    where: str  # the scene's file
    of_scene: Words
    shared: Words  # of params.yaml
    planned: Words  # of the stage's item in the plan

    def words(self, key: str) -> Any:
        """Take the value under a key of the scene's file, `simulate.boards.rigid`; the caller checks it."""
        return self._declared(self.of_scene, key, self.where)

    def row(self, section: str, name: str) -> Any:
        """Take a row of params.yaml by its name, as it is written; the caller checks it."""
        return self._declared(self.shared, f"{section}.{name}", "params.yaml")

    def plan(self, key: str) -> Any:
        """Take a word of the stage's item in the plan."""
        return self._declared(self.planned, key, "the plan")

    def section(self, model: type[Model], name: str) -> Model:
        return parse(model, self.words(name), f"{self.where}: {name}")

    @property
    def seed(self) -> int:
        return parse(Seeded, {"seed": self.words("seed")}, self.where).seed

    def captures_in(self, indentations: Path) -> list[str]:
        """Name the captures of the scene, sorted.

        Recorded ones stand in the plan: a stale file of a removed capture must not come back. Simulated ones are what
        their one stage has just written.
        """
        return sorted(self.plan("captures")) or sorted(file.stem for file in indentations.glob("*.parquet"))

    def _declared(self, words: Words, key: str, where: str) -> Any:
        value = find(words, key)
        if value is NOTHING:
            remedy = f"Write it there; if it is, the plan is older: reskin scenes use {self.scene}, beside the others."
            raise ParamsError(where, key, "given, and declared by its stage", "nothing", remedy)
        return value


def read_settings(stage: str, key: str, files: Files) -> Settings:
    """Read of each file the keys that dvc.yaml declares for a stage; `key` names the stage's item in the plan."""
    plan, scene = read_yaml(files.plan), read_yaml(files.settings)
    item = find(plan, f"stages.{stage}.{key}")
    if item is NOTHING:
        remedy = f"Try: reskin scenes use {key}"
        raise ParamsError(files.plan, f"stages.{stage}", "planned for it", key, remedy)
    templates = declared(read_yaml(files.params.with_name(FLOW)), stage)
    _check_names(f"stages.{stage}.{key}", item, scene, files)
    keys = {kind: [fill(template, key, item) for template in rows] for kind, rows in templates.items()}
    planned = find(take(plan, keys["plan"]), f"stages.{stage}.{key}")
    return Settings(
        scene=item["scene"], where=str(files.settings), of_scene=take(scene, keys["scene"]),
        shared=take(read_yaml(files.params), keys["shared"]), planned={} if planned is NOTHING else planned,
    )  # fmt: skip


def declared(flow: Words, stage: str) -> dict[str, list[str]]:
    """List the keys that dvc.yaml declares for a stage: of the scene's file, of params.yaml (`shared`), of the plan."""
    keys: dict[str, list[str]] = {"scene": [], "shared": [], "plan": []}
    for entry in flow["stages"][stage]["do"].get("params", []):
        for file, of_file in entry.items():
            kind = {PARAMS: "shared", PLAN: "plan"}.get(file, "scene")
            keys[kind] += of_file
    return keys


def fill(template: str, key: str, item: Words) -> str:
    """Put a key of the plan and words of its item into a template, as DVC does.

    >>> fill("recipes.${item.train_multi.recipe}", "quick", {"train_multi": {"recipe": "paper"}})
    'recipes.paper'
    """

    return PLACE.sub(lambda place: _word(place, key, item), template)


def _word(place: re.Match[str], key: str, item: Words) -> str:
    value = find(item, place[2]) if place[1] else key
    return str(value if place[3] is None else value[int(place[3])])


def take(words: Words, keys: Iterable[str]) -> dict[str, Any]:
    """Keep of nested words what stands under some keys; a key that is not there is left out."""
    kept: dict[str, Any] = {}
    for key in sorted(keys, key=len):  # a whole section before its parts, which it holds
        value = find(words, key)
        if value is not NOTHING and find(kept, key) is NOTHING:
            put(kept, key, value)
    return kept


def find(words: Any, key: str) -> Any:
    """Follow a key, `train_multi.recipe`, into nested words; `NOTHING` if it leads nowhere."""
    for part in key.split("."):
        if not isinstance(words, Mapping) or part not in words:
            return NOTHING
        words = words[part]
    return words


def put(words: dict[str, Any], key: str, value: Any) -> None:
    *path, name = key.split(".")
    for part in path:
        words = words.setdefault(part, {})
    words[name] = value


def _check_names(place: str, item: Words, scene: Words, files: Files) -> None:
    """Raise if the scene's file names another row than the plan, which DVC goes by: its keys would not be tracked."""
    for key, planned in _leaves(item):
        named = find(scene, key)
        if "." in key and named != planned:
            remedy = (
                f"Try: reskin scenes use {item['scene']}, beside the others that run; or, for an experiment, also "
                f"-S {files.plan}:{place}.{key}={named}"
            )
            got = "nothing" if named is NOTHING else named
            raise ParamsError(files.settings, key, f"{planned}, as planned", got, remedy)


def _leaves(words: Words, prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in words.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
