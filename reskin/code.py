"""The code behind a result: which modules a stage imports, and a digest of each without comments and docstrings.

In: the package's files. Refuses to know stages by name, settings and data.
"""

import ast
import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Any

PACKAGES = ("pipeline", "reskin")
DATA = (".yaml", ".html")  # files that belong to the module of their name
ROOT = Path(__file__).parents[1]
_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef)


@cache
def digest(name: str, *, data: bool = True) -> str:
    """Give the digest of what a module does: of its syntax without docstrings, and of data files of the same name.

    Formatting, comments and the version of Python change nothing. `page.yaml` belongs to `page.py` beside it; without
    `data`, files like it do not count.
    """
    found = hashlib.sha256()
    for file in files_of(name) if data else [file_of(name)]:
        found.update(meaning(file.name, file.read_bytes()))
    return found.hexdigest()[:32]


def files_of(name: str) -> list[Path]:
    """Give the files of a module: its own, and data files of the same name beside it."""
    file = file_of(name)
    return [file, *sorted(one for one in file.parent.glob(f"{file.stem}.*") if one.suffix in DATA)]


def meaning(file: str, content: bytes) -> bytes:
    """Give what a file does: of Python its syntax without comments and docstrings, else all of it."""
    return json.dumps(_syntax(ast.parse(content))).encode() if file.endswith(".py") else content


def imported(*names: str) -> list[str]:
    """Name the modules of this package that some modules import, directly or not, these themselves and their packages.

    Imports under `if TYPE_CHECKING:` run nothing and do not count.
    """
    found = set(names).union(*map(_graph().find_upstream_modules, names))
    return sorted({name.rsplit(".", i)[0] for name in found for i in range(name.count(".") + 1)})


@cache
def _graph() -> Any:
    import grimp  # late: only the stage that follows imports needs it

    return grimp.build_graph(*PACKAGES, exclude_type_checking_imports=True, cache_dir=None)


def file_of(name: str) -> Path:
    """Give the file of a module, `reskin.io`."""
    path = ROOT / name.replace(".", "/")
    module = path.with_suffix(".py")
    return module if module.is_file() else path / "__init__.py"


def _syntax(node: ast.AST) -> list[Any]:
    """Turn a syntax tree into lists; empty fields are left out, as which there are differs between Python versions.

    >>> same = ["x = 1", "'Say.'\\nx = (1)  # metres"]
    >>> len({json.dumps(_syntax(ast.parse(source))) for source in [*same, "x = 2"]})
    2
    """
    found: list[Any] = [type(node).__name__]
    for key in node._fields:
        part: Any = getattr(node, key, None)
        if key == "body" and isinstance(node, _DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            part = part[1:]
        if isinstance(part, list):
            if part:
                found.append([key, [_part(one) for one in part]])
        elif part is not None:
            found.append([key, _part(part)])
    return found


def _part(of: Any) -> Any:
    return _syntax(of) if isinstance(of, ast.AST) else repr(of)
