"""Settings of a scene: they come from the scene's file, from `params.yaml`, and from the library's nominal skin.

In `dvc.yaml`, the `params` of a stage contain the settings on which its results depend, except for the boards, skins
and physics of section `simulate`: stage `physics` writes these to a file, on which the stages depend that use them.
"""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

from pydantic import Field

from pipeline import PARAMS, PLAN, SCENES
from reskin.config import Strict, parse, read_yaml
from reskin.errors import ParamsError, did_you_mean
from reskin.models.recipe import HEADLINE, AdaptationWithBase, AugmentedRecipe, Name, Recipe
from reskin.simulation.defaults import SHARED, nominal

Section = TypeVar("Section", bound=Strict)
Row = dict[str, Any]
Seed = Annotated[int, Field(ge=0)]
Count = Annotated[int, Field(ge=1)]


class Seeded(Strict):
    """Model of the key `seed` of a scene."""

    seed: Seed


class SectionWithRows(Strict):
    """Base class of sections that refer to rows of `params.yaml` by name, such as training recipes."""

    @classmethod
    def expand(cls, section: Row, settings: "Settings", where: str) -> Row:
        """Replace the names of rows by their content, before the section is parsed."""
        raise NotImplementedError


class Training(SectionWithRows):
    """Training recipes by name; for each recipe, one network is trained on every fold with each of `seeds_n` seeds.

    In the scene's file, the section states `recipe` (a recipe, or the name of one in `params.yaml`), `steps_n` and
    `variants`, which list only the values that differ from this recipe.
    """

    recipes: dict[Name, Recipe | AugmentedRecipe]
    seeds_n: Count

    @classmethod
    def expand(cls, section: Row, settings: "Settings", where: str) -> Row:
        return expand_variants(section, settings.row("recipes", section, "recipe", where), where)


class SectionWithTraining(SectionWithRows):
    """Base class of sections that contain a subsection `training`."""

    @classmethod
    def expand(cls, section: Row, settings: "Settings", where: str) -> Row:
        training = dict(take(section, "training", where))
        return section | {"training": Training.expand(training, settings, f"{where}.training")}


class Adaptations(SectionWithRows):
    """Adaptations by name, which continue the training with `pokes_n` unlabelled indentations of a held-out skin.

    In the scene's file, the section states `adaptation` (the name of a row in `params.yaml`), `base` (the recipe of
    section train_triplet whose networks are adapted), `steps_n` and `variants`.
    """

    pokes_n: Count
    recipes: dict[Name, AdaptationWithBase]

    @classmethod
    def expand(cls, section: Row, settings: "Settings", where: str) -> Row:
        adaptation = settings.row("adaptations", section, "adaptation", where)
        section = expand_variants(section, adaptation | {"base": take(section, "base", where)}, where)
        known = sorted(settings.section(Training, "train_triplet").recipes)
        for name, recipe in section["recipes"].items():
            if recipe["base"] not in known:
                remedy = "Name one of these recipes."
                raise ParamsError(where, f"base of {name}", f"one of {known}", repr(recipe["base"]), remedy)
        return section


@dataclass(frozen=True)
class Settings:
    """The settings of a scene; each section is parsed into a typed model when it is first read.

    - scene: name of the scene.
    - where: path of the scene's file, for error messages.
    - of_scene: content of the scene's file.
    - shared: content of `params.yaml` and of the library's nominal skin.
    - captures: names of the scene's recorded captures; empty for a simulated scene.
    - held_out: experiments of the scene for which folds (divisions into training and test rows) are drawn.
    - models: stages of the scene that write models.
    - parsed: sections that have been parsed, by settings model and name.
    """

    scene: str
    where: str
    of_scene: Mapping[str, Any]
    shared: Mapping[str, Any]
    captures: tuple[str, ...] = ()
    held_out: tuple[str, ...] = ()
    models: tuple[str, ...] = ()
    parsed: dict[tuple[type[Strict], str], Strict] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __getitem__(self, section: str) -> Any:
        """Return a section of the scene's file without parsing it; raise `ParamsError` if the section is missing."""
        if section not in self.of_scene:
            raise ParamsError(f"{self.where}: section {section} is missing. Add the section to this file.")
        return self.of_scene[section]

    def section(self, model: type[Section], name: str) -> Section:
        """Parse a section of the scene's file, after the content of the rows of `params.yaml` that it names."""
        if (model, name) not in self.parsed:
            content, where = self[name], f"{self.where}: {name}"
            if issubclass(model, SectionWithRows):
                content = model.expand(dict(content), self, where)
            self.parsed[model, name] = parse(model, content, where)
        return cast(Section, self.parsed[model, name])

    def shared_section(self, model: type[Section], name: str) -> Section:
        """Parse a section that all scenes share, such as `skin`."""
        if (model, name) not in self.parsed:
            self.parsed[model, name] = parse(model, self.shared[name], name)
        return cast(Section, self.parsed[model, name])

    def row(self, shared: str, section: dict[str, Any], key: str, where: str) -> dict[str, Any]:
        """Remove `key` from a section, and return the row of `params.yaml` that its value names, or is.

        `shared` is the section of `params.yaml` that contains the row.
        """
        name, rows = take(section, key, where), self.shared[shared]
        if isinstance(name, dict):
            return dict(name)
        if not isinstance(name, str) or name not in rows:
            rule = f"one of {', '.join(sorted(rows))} (section {shared} of {PARAMS})"
            raise ParamsError(
                f"{where}.{key} must be {rule}; got {name!r}. Name one of these rows.{did_you_mean(name, rows)}"
            )
        return dict(rows[name])

    @property
    def seed(self) -> int:
        """Seed of the scene, from which every random generator is derived by name (`reskin.seeds`)."""
        return parse(Seeded, {"seed": self["seed"]}, self.where).seed

    def captures_in(self, indentations: Path) -> list[str]:
        """Return the names of the captures in a folder of readings; files of removed captures are left out."""
        return sorted(self.captures) or sorted(file.stem for file in indentations.glob("*.parquet"))


def section_of(stage: Callable[..., None]) -> type[Strict] | None:
    """Return the settings model of a stage function's parameter `section`; None if it has no such parameter."""
    parameter = inspect.signature(stage).parameters.get("section")
    return None if parameter is None else parameter.annotation


def read_settings(scene: str, root: Path = Path()) -> Settings:
    """Read the settings of a scene from a checkout."""
    file, plan = root / SCENES / f"{scene}.yaml", root / PLAN
    planned = read_yaml(plan) if plan.is_file() else {}
    lists = {key: tuple(planned.get(key, {}).get(scene, ())) for key in ("captures", "held_out", "models")}
    return Settings(scene, str(file), read_yaml(file), read_shared_files(root), **lists)


def read_shared_files(root: Path = Path()) -> dict[str, Any]:
    """Read the settings that all scenes share: `params.yaml` and the nominal skin."""
    return {**read_yaml(root / PARAMS), **{name: nominal(name) for name in SHARED}}


def take(section: dict[str, Any], key: str, where: str) -> Any:
    """Remove a key from a section and return its value; raise `ParamsError` if it is missing."""
    if key not in section:
        known = ", ".join(sorted(section)) or "nothing"
        raise ParamsError(f"{where}: {key} is missing (given: {known}). Add key {key} to this section.")
    return section.pop(key)


def expand_variants(section: Mapping[str, Any], shared: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Replace the keys `steps_n` and `variants` of a section by `recipes`: the headline recipe and each variant of it.

    The headline recipe is the row `shared` with `steps_n`.
    """
    section = dict(section)
    headline = dict(shared) | {"steps_n": take(section, "steps_n", where)}
    variants = take(section, "variants", where)
    if "recipes" in section:
        raise ParamsError(
            f"{where}: unknown key recipes. Remove this key: keys recipe, steps_n and variants determine the recipes."
        )
    if not isinstance(variants, dict) or not all(isinstance(changes, dict) for changes in variants.values()):
        rule = "a mapping from the name of each variant to the settings that it changes, or {} for no variants"
        raise ParamsError(f"{where}.variants", "the variants", rule, variants, "Write variants as such a mapping.")
    if HEADLINE in variants:
        rule = f"other than {HEADLINE}, which is the name of the recipe without changes"
        raise ParamsError(f"{where}.variants", "a variant's name", rule, HEADLINE, "Choose another name.")
    recipes = {HEADLINE: headline} | {name: headline | changes for name, changes in variants.items()}
    return section | {"recipes": recipes}
