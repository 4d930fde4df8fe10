"""Plant small faults in the code, one at a time, and tell which of them the tests find.

    python -m tools.mutate reskin/physics/layer.py [--n 20] [--seed 1]

A fault is a small change of one expression in a function: another operator, comparison or constant, a dropped `not` or
keyword, the other branch of a condition, two adjacent arguments exchanged. Texts and error messages are not changed.
Each fault is in another function, as long as there are functions left. It is planted in a temporary copy of the
checkout, in which the tests of the same tree run (tests/physics for reskin/physics), those that import the changed
module first. A fault that survives is either harmless, or shows a law that no test states.

mutmut and cosmic-ray are bigger tools for the same purpose.
"""

import argparse
import ast
import copy
import difflib
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
NOT_COPIED = (".git", ".venv*", ".reskin", ".mypy_cache", ".ruff_cache", ".hypothesis", "mlruns")
IMPORTING_N = 12  # how many of the test files that import a module are run, besides those of the same folder
OTHER: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
SAID = re.compile(r"(\w*[Ee]rror|print|log|warn|add_argument|echo|Option|Argument)$")  # calls whose arguments are texts
UNCHANGED = ("axis", "encoding", "zorder")  # keywords whose change crashes always, or never matters


class Mutant(NamedTuple):
    """A changed module: its path in the checkout, the function and line of the change, its kind, and the new source."""

    path: Path
    function: str
    line: int
    kind: str
    source: str


def changes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield changed copies of an expression. Changes that only make the code crash are left out where this is known."""
    if isinstance(node, ast.BinOp | ast.BoolOp) and type(node.op) in OTHER:
        yield changed(node, op=OTHER[type(node.op)]())
    if isinstance(node, ast.Compare) and type(node.ops[0]) in OTHER:
        yield changed(node, ops=[OTHER[type(node.ops[0])](), *node.ops[1:]])
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield node.operand
    if isinstance(node, ast.IfExp):
        yield changed(node, body=node.orelse, orelse=node.body)
    if isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield ast.Constant(not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        yield ast.Constant(node.value + 1 if isinstance(node.value, int) else 1.5 * node.value + (node.value == 0.0))
    if isinstance(node, ast.Call):
        for i in range(len(node.args) - 1):
            one, two = node.args[i : i + 2]
            if type(one) is type(two) and not isinstance(two, ast.Constant) and ast.dump(one) != ast.dump(two):
                yield changed(node, args=[*node.args[:i], two, one, *node.args[i + 2 :]])
        for keyword in [keyword for keyword in node.keywords if keyword.arg not in UNCHANGED]:
            yield changed(node, keywords=[other for other in node.keywords if other is not keyword])


def changed(node: ast.AST, **fields: object) -> ast.AST:
    new = copy.copy(node)
    for name, value in fields.items():
        setattr(new, name, value)
    return new


def expressions(node: ast.AST) -> Iterator[ast.expr]:
    """Yield the expressions below a node, without texts, messages, annotations and nested functions."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.Raise | ast.JoinedStr | ast.FunctionDef | ast.ClassDef | ast.Assert):
                continue
            if isinstance(child, ast.keyword) and child.arg in UNCHANGED:
                continue
            if isinstance(child, ast.Call) and SAID.search(ast.unparse(child.func)):
                continue
            if isinstance(child, ast.expr):
                yield child
            if isinstance(child, ast.AST):
                yield from expressions(child)


def mutants_of(path: Path) -> dict[str, list[Mutant]]:
    """Return all mutants of a module by the function that they change."""
    source = (ROOT / path).read_text(encoding="utf-8")
    begin_at = [0]  # byte offsets of the lines, because the columns of `ast` count bytes
    for line in source.encode().splitlines(keepends=True):
        begin_at.append(begin_at[-1] + len(line))
    found = {}
    for function in ast.walk(ast.parse(source)):
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            name = f"{path}:{function.name}:{function.lineno}"
            found[name] = [
                Mutant(path, function.name, node.lineno, type(node).__name__, replaced(source, begin_at, node, new))
                for node in expressions(function)
                for new in changes(node)
            ]
    return {name: mutants for name, mutants in found.items() if mutants}


def replaced(source: str, begin_at: list[int], node: ast.expr, new: ast.AST) -> str:
    data = source.encode()
    first = begin_at[node.lineno - 1] + node.col_offset
    last = begin_at[(node.end_lineno or node.lineno) - 1] + (node.end_col_offset or 0)
    text = ast.unparse(new)
    if not isinstance(new, ast.Constant | ast.Call | ast.Name):
        text = f"({text})"
    return (data[:first] + text.encode() + data[last:]).decode()


def draw(paths: Iterable[Path], n: int, seed: int) -> list[Mutant]:
    """Draw mutants, each in another function as long as there are functions left."""
    rng = random.Random(seed)
    by_function = {name: mutants for path in paths for name, mutants in mutants_of(path).items()}
    drawn: list[Mutant] = []
    while by_function and len(drawn) < n:
        for name in rng.sample(sorted(by_function), len(by_function)):
            kind = rng.choice(sorted({mutant.kind for mutant in by_function[name]}))
            drawn.append(rng.choice([mutant for mutant in by_function[name] if mutant.kind == kind]))
            by_function[name].remove(drawn[-1])
        by_function = {name: mutants for name, mutants in by_function.items() if mutants}
    return drawn[:n]


def tests_of(path: Path) -> list[str]:
    """Return the test files of a module: those that import it, then the others of the same folder."""
    module = path.parent if path.stem == "__init__" else path.with_suffix("")
    words = rf"\b(from {'.'.join(module.parent.parts)} import .*\b{module.name}\b|{'.'.join(module.parts)}\b)"
    files = sorted((ROOT / "tests").rglob("test_*.py"))
    folder = Path("tests", *path.parent.parts[1:2])
    near = [file for file in files if file.relative_to(ROOT).parent.is_relative_to(folder)]
    importing = [file for file in files if re.search(words, file.read_text(encoding="utf-8"))]
    importing.sort(key=lambda file: (file.stem.removeprefix("test_") != path.stem, file not in near))
    others = near if folder != Path("tests") else []
    return [str(file.relative_to(ROOT)) for file in dict.fromkeys(importing[:IMPORTING_N] + others)]


def outcome(mutant: Mutant, checkout: Path, limit_s: float) -> str:
    """Plant the mutant in the copy and run its tests; return `killed by TEST`, `SURVIVED` or `out of time`."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1", "RESKIN_EXECUTOR": "here"}
    command = [sys.executable, "-m", "pytest", "-qx", "-p", "no:cacheprovider", "-p", "no:xdist", "--tb=no"]
    source = (checkout / mutant.path).read_text(encoding="utf-8")
    for kept in checkout.rglob("*.nb[ic]"):  # compiled kernels may contain functions of the changed module
        if "njit" in source or "numba" in source:
            kept.unlink()
    try:
        (checkout / mutant.path).write_text(mutant.source, encoding="utf-8")
        tests = subprocess.run(
            [*command, *tests_of(mutant.path)], cwd=checkout, env=environment, capture_output=True, text=True,
            timeout=limit_s, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return "out of time"
    finally:
        (checkout / mutant.path).write_text(source, encoding="utf-8")
    failed = re.findall(r"^(?:FAILED|ERROR) (\S+)", tests.stdout, re.M)
    return "SURVIVED" if tests.returncode == 0 else f"killed by {(failed or ['all'])[0]}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+", type=Path, help="modules or folders below reskin/ and pipeline/")
    parser.add_argument("--n", type=int, default=20, help="number of mutants")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--without", default="(?!)", help="pattern of paths to leave out")
    parser.add_argument("--limit-s", type=float, default=300.0, help="time for the tests of one mutant")
    given = parser.parse_args()
    modules = [file for path in given.paths for file in ([path] if path.suffix else sorted(path.rglob("*.py")))]
    mutants = draw([file for file in modules if not re.search(given.without, str(file))], given.n, given.seed)
    found: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        checkout = Path(folder) / "checkout"
        shutil.copytree(ROOT, checkout, ignore=shutil.ignore_patterns(*NOT_COPIED))
        for mutant in mutants:
            start_s = time.monotonic()
            said = outcome(mutant, checkout, given.limit_s)
            found[said.partition(" by ")[0]] += 1
            print(f"{mutant.path}:{mutant.line} {mutant.function}: {said} ({time.monotonic() - start_s:.0f} s)")
            before = (ROOT / mutant.path).read_text(encoding="utf-8").splitlines()
            diff = list(difflib.unified_diff(before, mutant.source.splitlines(), n=0, lineterm=""))
            print("\n".join(f"    {line}" for line in diff[3:]), flush=True)
    ended_n = found["killed"] + found["SURVIVED"]
    print(f"{found['killed']} of {ended_n} mutants killed ({found['killed'] / max(1, ended_n):.0%}); {dict(found)}")


if __name__ == "__main__":
    main()
