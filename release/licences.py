"""Check the licences of all installed packages: python -m release.licences.

Prints them, and fails if one is not compatible with MIT, unless TOLERATED says why it may stay. A package states its
licence by an SPDX expression, a classifier or free text; an unknown statement counts as incompatible. This is not legal
advice.
"""

import re
import sys
import tomllib
from collections.abc import Iterable, Mapping
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from release.constraints import OF_CUDA

ROOT = Path(__file__).resolve().parents[1]
# Licences that a program under MIT may import. They require notices; MPL also requires changes of its files.
COMPATIBLE = re.compile(
    r"\b(MIT|BSD|0BSD|Apache|PSF|Python Software Foundation|ISC|MPL|Mozilla Public|Zlib|CC0|BSL-1\.0|ZPL|Zope|HPND)",
    re.I,
)
WITHHELD = re.compile(r"\b(A?GPL|LGPL|GNU|EPL|SSPL|BUSL|Commercial|Proprietary)", re.I)
GROUP = re.compile(r"(?:^|(?<=AND )|(?<=OR )|(?<=\())\(([^()]*)\)")  # other brackets belong to a name: BSD (3-clause)
# Packages of extra `pipeline`, never of the core. DVC imports them, and we only run DVC; none of them is in our wheel.
TOLERATED = {
    "asyncssh": "EPL-2.0 or GPL-2.0+: remotes of DVC over SSH",
    "grandalf": "GPL-2.0 or EPL-1.0: `dvc dag` draws with it",
    "pygit2": "GPL-2.0 with an exception for programs that link it: DVC reads git",
}
SILENT = {"huey": "MIT", "skops": "MIT"}  # packages that state it in licence files only, not in the metadata


def wanted(extra: str | None = None) -> list[str]:
    """Return the requirements of pyproject.toml: of the core, or of an extra."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return project["dependencies"] if extra is None else project["optional-dependencies"][extra]


def closure(requirements: Iterable[str]) -> dict[str, Distribution]:
    """Return all packages that the requirements install here, by canonical name."""
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
    """Return the licence that a package states: its expression, else classifiers, else the first line of its text."""
    metadata, name = package.metadata, canonicalize_name(package.metadata["Name"])
    kinds = [line.split(" :: ")[-1] for line in metadata.get_all("Classifier") or () if line.startswith("License ::")]
    stated = [kind for kind in kinds if kind not in ("OSI Approved", "DFSG approved")]
    free = (metadata.get("License") or "").strip().partition("\n")[0]
    return metadata.get("License-Expression") or "; ".join(stated) or free or SILENT.get(name, "")


def is_compatible(licence: str) -> bool:
    """Return whether every part of an expression, or of one of its alternatives, is a licence compatible with MIT.

    >>> is_compatible("Apache-2.0 OR GPL-2.0-or-later"), is_compatible("MIT AND unheard-of"), is_compatible("")
    (True, False, False)
    """
    while group := GROUP.search(licence):  # replace a group by its verdict
        verdict = "MIT" if is_compatible(group[1]) else "Proprietary"
        licence = licence[: group.start()] + verdict + licence[group.end() :]
    alternatives = [re.split(r"\s+AND\s+|;", text, flags=re.I) for text in re.split(r"\s+OR\s+", licence)]
    return any(all(COMPATIBLE.search(part) and not WITHHELD.search(part) for part in parts) for parts in alternatives)


def incompatible(packages: Mapping[str, Distribution]) -> dict[str, str]:
    """Return the packages with an unknown or incompatible licence, with that licence.

    NVIDIA's packages are left out: pip installs them with a torch for GPUs, and the project does not need them.
    """
    licences = {name: licence_of(package) for name, package in packages.items() if not name.startswith(OF_CUDA)}
    return {name: licence or "nothing" for name, licence in licences.items() if not is_compatible(licence)}


def main() -> None:
    try:
        core, full = closure(wanted()), closure(wanted("dev"))
    except PackageNotFoundError as error:
        sys.exit(f"licences: package {error.name} is not installed. Try: make lint")
    for name, package in sorted((core | full).items()):
        print(f"{name:28} {'core' if name in core else 'dev':5} {licence_of(package)} {TOLERATED.get(name, '')}")
    refused = {name: text for name, text in incompatible(core | full).items() if name in core or name not in TOLERATED}
    if refused:
        sys.exit(
            f"licences not compatible with MIT: {refused}. Drop the package, or state in TOLERATED why it may stay."
        )
    print(
        f"compatible with MIT: all {len(core)} packages of the core, and of {len(full)} with all development extras "
        f"all but {', '.join(TOLERATED)}, which are tolerated: DVC needs them, and the project contains none."
    )


if __name__ == "__main__":
    main()
