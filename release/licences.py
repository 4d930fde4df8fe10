"""The licences of what is installed. In: metadata of installed packages. Out: by package, its licence; what may not be.

python -m release.licences prints them, and fails on one that is not compatible with MIT. A package tells its licence by
an SPDX expression, a classifier or free words; whoever tells nothing that is known here is refused. No legal advice.
"""

import re
import sys
import tomllib
from collections.abc import Iterable
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
# Words of licences that a program under MIT may import: they ask for notices, MPL for changes of its own files.
COMPATIBLE = re.compile(
    r"\b(MIT|BSD|0BSD|Apache|PSF|Python Software Foundation|ISC|MPL|Mozilla Public|Zlib|CC0|BSL-1\.0|ZPL|Zope|HPND)",
    re.I,
)
WITHHELD = re.compile(r"\b(A?GPL|LGPL|GNU|EPL|SSPL|BUSL|Commercial|Proprietary)", re.I)
GROUP = re.compile(r"(?:^|(?<=AND )|(?<=OR )|(?<=\())\(([^()]*)\)")  # elsewhere brackets are words: BSD (3-clause)
# Of extra `pipeline`, never of the core: DVC imports them, we start DVC; none of them is part of our wheel.
TOLERATED = {
    "asyncssh": "EPL-2.0 or GPL-2.0+: remotes of DVC over SSH",
    "grandalf": "GPL-2.0 or EPL-1.0: `dvc dag` draws with it",
    "pygit2": "GPL-2.0 with an exception for what links it: DVC reads git",
}
SILENT = {"huey": "MIT", "skops": "MIT"}  # licence files of these say what their metadata does not


def wanted(extra: str | None = None) -> list[str]:
    """Give what pyproject.toml asks for: the core, or an extra."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return project["dependencies"] if extra is None else project["optional-dependencies"][extra]


def closure(requirements: Iterable[str]) -> dict[str, Distribution]:
    """Follow requirements to all that they install here, by canonical name; our own extras count as what they name."""
    found: dict[str, Distribution] = {}
    todo = [(Requirement(text), "") for text in requirements]
    seen = set()
    while todo:
        requirement, extra = todo.pop()
        name = canonicalize_name(requirement.name)
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": extra}):
            continue
        if name == "reskin":
            todo += [(Requirement(text), "") for part in requirement.extras for text in wanted(part)]
            continue
        package = distribution(name)
        found[name] = package
        for part in {"", *requirement.extras}:
            if (name, part) not in seen:
                seen.add((name, part))
                todo += [(Requirement(text), part) for text in package.requires or ()]
    return found


def licence_of(package: Distribution) -> str:
    """Give what a package says of its licence: the expression, else classifiers, else the first line of words."""
    words, name = package.metadata, canonicalize_name(package.metadata["Name"])
    kinds = [line.split(" :: ")[-1] for line in words.get_all("Classifier") or () if line.startswith("License ::")]
    told = [kind for kind in kinds if kind not in ("OSI Approved", "DFSG approved")]
    free = (words.get("License") or "").strip().partition("\n")[0]
    return words.get("License-Expression") or "; ".join(told) or free or SILENT.get(name, "")


def is_compatible(licence: str) -> bool:
    """Tell whether every part of an expression, or of one of its alternatives, is a known licence that MIT may import.

    >>> is_compatible("Apache-2.0 OR GPL-2.0-or-later"), is_compatible("MIT AND unheard-of"), is_compatible("")
    (True, False, False)
    """
    while group := GROUP.search(licence):  # a group is as good as a licence, or as none
        verdict = "MIT" if is_compatible(group[1]) else "Proprietary"
        licence = licence[: group.start()] + verdict + licence[group.end() :]
    alternatives = [re.split(r"\s+AND\s+|;", text, flags=re.I) for text in re.split(r"\s+OR\s+", licence)]
    return any(all(COMPATIBLE.search(part) and not WITHHELD.search(part) for part in parts) for parts in alternatives)


def incompatible(packages: dict[str, Distribution]) -> dict[str, str]:
    """Give packages whose licence is unknown or not compatible, and what it is."""
    licences = {name: licence_of(package) for name, package in packages.items()}
    return {name: licence or "nothing" for name, licence in licences.items() if not is_compatible(licence)}


def main() -> None:
    try:
        core, full = closure(wanted()), closure(wanted("dev"))
    except PackageNotFoundError as error:
        sys.exit(f"licences: all packages must be installed; got none of the name {error.name}. Try: make lint")
    for name, package in sorted((core | full).items()):
        print(f"{name:28} {'core' if name in core else 'dev':5} {licence_of(package)} {TOLERATED.get(name, '')}")
    refused = {name: text for name, text in incompatible(core | full).items() if name in core or name not in TOLERATED}
    if refused:
        sys.exit(
            f"licences: each must be compatible with MIT; got {refused}. Drop the package, or state why it may stay."
        )
    print(f"{len(core)} packages of the core, {len(full)} with all extras of development: compatible with MIT")


if __name__ == "__main__":
    main()
