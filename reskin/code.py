"""Digests of code: of single modules, ignoring comments and docstrings, and of whole packages."""

import ast
import hashlib
import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

PACKAGES = ("pipeline", "reskin")
DATA = (".yaml", ".html")  # data files that belong to the module of the same name
ROOT = Path(__file__).parents[1]
_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef)


@cache
def digest(name: str, *, data: bool = True) -> str:
    """Return a digest of a module: its syntax without docstrings, and data files of the same name.

    Formatting, comments and the version of Python do not change it. `page.yaml` belongs to `page.py` beside it; with
    `data=False`, such files do not count.
    """
    hasher = hashlib.sha256()
    for file in files_of(name) if data else [file_of(name)]:
        hasher.update(normalised(file.name, file.read_bytes()))
    return hasher.hexdigest()[:32]


def files_of(name: str) -> list[Path]:
    """Return the files of a module or package: its Python file, and data files of the same name beside it."""
    file, path = file_of(name), ROOT / name.replace(".", "/")
    return [file, *sorted(data for data in path.parent.glob(f"{path.name}.*") if data.suffix in DATA)]


def normalised(file: str, content: bytes) -> bytes:
    """Return the syntax of a Python file without comments and docstrings, and any other file as it is."""
    return json.dumps(_syntax(ast.parse(content))).encode() if file.endswith(".py") else content


def package_digest(*packages: Path, suffixes: Sequence[str] = (".py",)) -> str:
    """Return a digest of all files of packages with these suffixes, byte by byte."""
    hasher = hashlib.sha256()
    for package in packages:
        for file in sorted(file for file in package.rglob("*") if file.suffix in suffixes):
            hasher.update(f"{file.relative_to(package)} {hashlib.sha256(file.read_bytes()).hexdigest()}\n".encode())
    return hasher.hexdigest()[:32]


def imported(*names: str) -> list[str]:
    """Return the modules of `PACKAGES` that the named modules import, directly or indirectly.

    The result includes the named modules themselves and the packages that contain any of these modules.

    Imports under `if TYPE_CHECKING:` do not count.
    """
    modules = set(names).union(*map(_graph().find_upstream_modules, names))
    return sorted({name.rsplit(".", i)[0] for name in modules for i in range(name.count(".") + 1)})


@cache
def _graph() -> Any:
    import grimp  # imported late: only stages that trace imports need it

    return grimp.build_graph(*PACKAGES, exclude_type_checking_imports=True, cache_dir=None)


def file_of(name: str) -> Path:
    """Return the file of a module, such as `reskin.io`."""
    path = ROOT / name.replace(".", "/")
    module = path.with_suffix(".py")
    return module if module.is_file() else path / "__init__.py"


def _syntax(node: ast.AST) -> list[Any]:
    """Convert a syntax tree to lists; empty fields are dropped, as they differ between Python versions.

    >>> same = ["x = 1", "'Say.'\\nx = (1)  # metres"]
    >>> len({json.dumps(_syntax(ast.parse(source))) for source in [*same, "x = 2"]})
    2
    """
    items: list[Any] = [type(node).__name__]
    for key in node._fields:
        part: Any = getattr(node, key, None)
        if key == "body" and isinstance(node, _DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            part = part[1:]
        if isinstance(part, list):
            if part:
                items.append([key, [_part(item) for item in part]])
        elif part is not None:
            items.append([key, _part(part)])
    return items


def _part(value: Any) -> Any:
    return _syntax(value) if isinstance(value, ast.AST) else repr(value)
