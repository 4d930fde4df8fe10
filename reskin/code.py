"""Compute digests of code, to detect that code has changed.

A digest is computed either from one module, ignoring comments and docstrings (`digest`), or from all files of packages
(`package_digest`). `imported` finds the modules on which a module depends.
"""

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
    """Return a digest of the syntax of a module. If `data` is True, the data files of the module are included.

    Formatting, comments, docstrings and the version of Python do not affect the digest. The data files of a module have
    the same name and are in the same folder: `page.yaml` belongs to `page.py`.
    """
    hasher = hashlib.sha256()
    for file in files_of(name) if data else [file_of(name)]:
        hasher.update(normalised(file.name, file.read_bytes()))
    return hasher.hexdigest()[:32]


def files_of(name: str) -> list[Path]:
    """Return the Python file of a module or package, followed by data files of the same name in the same folder."""
    file, path = file_of(name), ROOT / name.replace(".", "/")
    return [file, *sorted(data for data in path.parent.glob(f"{path.name}.*") if data.suffix in DATA)]


def normalised(file: str, content: bytes) -> bytes:
    """Return the content of a file in the form from which digests are computed.

    For a Python file, this is its syntax without comments and docstrings. The content of other files is unchanged.
    """
    return json.dumps(_syntax(ast.parse(content))).encode() if file.endswith(".py") else content


def package_digest(*packages: Path, suffixes: Sequence[str] = (".py",)) -> str:
    """Return a digest of the bytes of all files in these folders that have one of the suffixes."""
    hasher = hashlib.sha256()
    for package in packages:
        for file in sorted(file for file in package.rglob("*") if file.suffix in suffixes):
            hasher.update(f"{file.relative_to(package)} {hashlib.sha256(file.read_bytes()).hexdigest()}\n".encode())
    return hasher.hexdigest()[:32]


def imported(*names: str) -> list[str]:
    """Return the modules of `PACKAGES` that the named modules import, directly or indirectly.

    The result includes the named modules themselves, and the packages in which the modules are. Imports under
    `if TYPE_CHECKING:` are ignored.
    """
    modules = set(names).union(*map(_graph().find_upstream_modules, names))
    return sorted({name.rsplit(".", i)[0] for name in modules for i in range(name.count(".") + 1)})


@cache
def _graph() -> Any:
    import grimp  # imported here, because only few commands need to know which modules import others

    return grimp.build_graph(*PACKAGES, exclude_type_checking_imports=True, cache_dir=None)


def file_of(name: str) -> Path:
    """Return the file of a module such as `reskin.io`, or the `__init__.py` of a package."""
    path = ROOT / name.replace(".", "/")
    module = path.with_suffix(".py")
    return module if module.is_file() else path / "__init__.py"


def _syntax(node: ast.AST) -> list[Any]:
    """Convert a syntax tree to nested lists, and remove docstrings.

    Empty fields of a node are left out, because the version of Python determines which empty fields a node has.

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
