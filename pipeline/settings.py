"""The settings that one stage reads, checked: YAML of a scene, of params.yaml and of the plan -> `Settings`.

Of each file only the keys that `pipeline.reads` lists for the stage are taken, so that what it does not declare it
cannot read. Refuses to know what is done with a value.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import Field

from pipeline.asking import Asking, Source
from pipeline.dataset.rows import Selection
from pipeline.dataset.splits import Split
from pipeline.errors import ParamsError, complain
from pipeline.learning.recipe import (
    Adaptations,
    AdaptationsRow,
    AuditSettings,
    PokesSweep,
    Training,
    TrainingRow,
    resolve_adaptations,
    resolve_training,
)
from pipeline.reads import READS
from pipeline.sections import Ambient, Contacts, Drift, Shear, Sleeve, Variation
from pipeline.strict import Strict, parse, parse_parts, read_yaml

Words = Mapping[str, Any]
Model = TypeVar("Model", bound=Strict)
NOTHING = object()
EAGER = (
    "seed", "source", "questions", "selection", "split", "train_single", "train_multi", "train_triplet", "adapt",
    "sweep_pokes", "audit", "drift", "variation", "shear", "sleeve", "contacts", "ambient",
)  # fmt: skip


@dataclass(frozen=True)
class Files:
    """Where settings are written: the scene's file, params.yaml, and the plan."""

    settings: Path
    params: Path
    plan: Path


class Basics(Asking):
    """What stands at the top of a scene's file."""

    seed: Annotated[int, Field(ge=0)]


@dataclass(frozen=True)
class Settings:
    """A scene's settings as far as a stage declares them; what it does not declare is an error."""

    scene: str
    where: str  # the scene's file
    own: Words  # of the scene's file
    shared: Words  # of params.yaml
    planned: Words  # of the plan

    def words(self, key: str) -> Any:
        """Take what the scene's file says under a key, `simulate.boards.rigid`; the caller checks it."""
        return self._declared(self.own, key, self.where)

    def named(self, section: str, name: str) -> Any:
        """Take a row of params.yaml by its name, as it is written: the caller checks it."""
        return self._declared(self.shared, f"{section}.{name}", "params.yaml")

    @cached_property
    def seed(self) -> int:
        """The scene's seed."""
        return parse_parts(Basics, {"seed": self.words("seed")}, self.where).seed

    @cached_property
    def source(self) -> Source:
        """Whether its captures are simulated or recorded."""
        return parse_parts(Basics, {"source": self.words("source")}, self.where).source

    @cached_property
    def questions(self) -> tuple[str, ...]:
        """What the scene asks."""
        return parse_parts(Basics, {"questions": self.words("questions")}, self.where).questions

    @cached_property
    def asking(self) -> Asking:
        """What the scene asks, with what follows from it."""
        return parse(Asking, {name: self.words(name) for name in ("source", "questions")}, self.where)

    @cached_property
    def selection(self) -> Selection:
        """Which readings count."""
        return parse(Selection, self.words("selection"), f"{self.where}: selection")

    @cached_property
    def split(self) -> Split:
        """How folds are drawn."""
        return parse_parts(Split, self.words("split"), f"{self.where}: split")

    @cached_property
    def train_single(self) -> Training:
        """Section train_single."""
        return self._training("train_single")

    @cached_property
    def train_multi(self) -> Training:
        """Section train_multi."""
        return self._training("train_multi")

    @cached_property
    def train_triplet(self) -> Training:
        """Section train_triplet."""
        return self._training("train_triplet")

    @cached_property
    def adapt(self) -> Adaptations:
        """Section adapt; every base is a recipe of train_triplet."""
        where, words = f"{self.where}: adapt", self.words("adapt")
        parse_parts(AdaptationsRow, words, where)
        rows = resolve_adaptations(words, self._row("adaptations", words["adaptation"]), where)
        adapt = parse_parts(Adaptations, rows, where)
        for name, row in adapt.recipes.items():
            if row.base not in self.train_triplet.recipes:
                known = sorted(self.train_triplet.recipes)
                raise ParamsError(
                    complain(where, f"base of {name}", f"one of {known}", repr(row.base), "Mend it there.")
                )
        return adapt

    @cached_property
    def sweep_pokes(self) -> PokesSweep:
        """Section sweep_pokes."""
        return self._section(PokesSweep, "sweep_pokes")

    @cached_property
    def audit(self) -> AuditSettings:
        """Section audit."""
        return self._section(AuditSettings, "audit")

    @cached_property
    def drift(self) -> Drift:
        """Section drift."""
        return self._with_training(Drift, "drift")

    @cached_property
    def variation(self) -> Variation:
        """Section variation."""
        return self._section(Variation, "variation")

    @cached_property
    def shear(self) -> Shear:
        """Section shear."""
        return self._with_training(Shear, "shear")

    @cached_property
    def sleeve(self) -> Sleeve:
        """Section sleeve."""
        return self._with_training(Sleeve, "sleeve")

    @cached_property
    def contacts(self) -> Contacts:
        """Section contacts."""
        return self._section(Contacts, "contacts")

    @cached_property
    def ambient(self) -> Ambient:
        """Section ambient."""
        return self._section(Ambient, "ambient")

    @cached_property
    def captures(self) -> tuple[str, ...]:
        """The scene's recorded captures, as planned; none for a simulated one."""
        return tuple(self._declared(self.planned, f"stages.split.{self.scene}.captures", "the plan"))

    def captures_in(self, indentations: Path) -> list[str]:
        """Name the captures of the scene, sorted.

        Recorded ones stand in the plan: a stale file of a removed capture must not come back. Simulated ones are what
        their one stage has just written.
        """
        return sorted(self.captures) or sorted(file.stem for file in indentations.glob("*.parquet"))

    def check_questions(self) -> None:
        """Raise if the plan was made for other questions: the scene was edited since."""
        planned = self._declared(self.planned, f"scenes.{self.scene}", "the plan")
        if list(planned) != list(self.words("questions")):
            differing = sorted(set(planned) ^ set(self.words("questions")))
            remedy = f"Try: reskin scenes use {self.scene}, beside the others that run."
            got = f"{', '.join(differing) or 'another order'} only in one"
            raise ParamsError(complain(self.where, "questions", "those of pipeline/plan.yaml", got, remedy))

    def check_all(self) -> None:
        """Check every section that is there."""
        for name in EAGER:
            if name in self.own:
                getattr(self, name)

    def _declared(self, words: Words, key: str, where: str) -> Any:
        value = _at(words, key)
        if value is NOTHING:
            remedy = f"Write it there; if it is, the plan is older: reskin scenes use {self.scene}, beside the others."
            raise ParamsError(complain(where, key, "given, and declared by its stage", "nothing", remedy))
        return value

    def _row(self, section: str, name: str) -> Words:
        return {name: self.named(section, name)}

    def _section(self, model: type[Model], section: str) -> Model:
        return parse(model, self.words(section), f"{self.where}: {section}")

    def _training(self, section: str) -> Training:
        words, where = self.words(section), f"{self.where}: {section}"
        parse_parts(TrainingRow, words, where)
        rows = resolve_training(words, self._row("recipes", words["recipe"]), where)
        return parse_parts(Training, rows, where)

    def _with_training(self, model: type[Model], section: str) -> Model:
        words, where = dict(self.words(section)), f"{self.where}: {section}"
        training = words.get("training", {})
        parse(TrainingRow, training, f"{where}.training")
        rows = resolve_training(training, self._row("recipes", training["recipe"]), f"{where}.training")
        return parse(model, words | {"training": rows}, where)


def read_settings(stage: str, key: str, files: Files) -> Settings:
    """Read what one stage declares of each file; `key` names its item in the plan."""
    plan = read_yaml(files.plan)
    item = _at(plan, f"stages.{stage}.{key}")
    if item is NOTHING:
        raise ParamsError(
            complain(files.plan, f"stages.{stage}", "planned for it", key, f"Try: reskin scenes use {key}")
        )
    own, shared, planned = keys_of(stage, item)
    scene = read_yaml(files.settings)
    _check_names(stage, key, item, scene, files)
    settings = Settings(
        item["scene"], str(files.settings), take(scene, own), take(read_yaml(files.params), shared), take(plan, planned)
    )
    settings.check_all()
    return settings


def keys_of(stage: str, item: Words) -> tuple[list[str], list[str], list[str]]:
    """List the keys that a stage reads: of the scene's file, of params.yaml, of the plan."""
    reads = READS[stage]
    own, shared, plan = ([key.format(**item) for key in keys] for keys in (reads.own, reads.shared, reads.plan))
    own += [key for _, key in _named(stage, item) if not any(_covers(one, key) for one in own)]
    return [*own, *item.get("own", [])], [*shared, *item.get("shared", [])], plan


def take(words: Words, keys: Iterable[str]) -> dict[str, Any]:
    """Keep of nested words what stands under some keys; a key that is not there is left out."""
    kept: dict[str, Any] = {}
    for key in sorted(keys, key=len):  # a whole section before its parts, which it holds
        value, (*path, name) = _at(words, key), key.split(".")
        if value is NOTHING or _at(kept, key) is not NOTHING:
            continue
        inner = kept
        for part in path:
            inner = inner.setdefault(part, {})
        inner[name] = value
    return kept


def _named(stage: str, item: Words) -> list[tuple[str, str]]:
    """List the words of an item that the scene's file must say too, and where it says them."""
    return [(word, key.format(**item)) for word, key in READS[stage].named if word in item]


def _check_names(stage: str, key: str, item: Words, scene: Words, files: Files) -> None:
    """Raise if the scene's file names another row than the plan, which DVC goes by: its keys would not be tracked."""
    for word, at in _named(stage, item):
        said = _at(scene, at)
        if said != item[word]:
            remedy = (
                f"Try: reskin scenes use {item['scene']}, beside the others that run; or, for an experiment, also "
                f"-S {files.plan}:stages.{stage}.{key}.{word}={said}"
            )
            got = "nothing" if said is NOTHING else said
            raise ParamsError(complain(files.settings, at, f"{item[word]}, as planned", got, remedy))


def _covers(key: str, inner: str) -> bool:
    return key == inner or inner.startswith(f"{key}.")


def _at(words: Any, key: str) -> Any:
    """Follow a key into nested words."""
    for part in key.split("."):
        if not isinstance(words, Mapping) or part not in words:
            return NOTHING
        words = words[part]
    return words
