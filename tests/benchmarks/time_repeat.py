"""How far do the same settings' numbers lie apart under other threads, instructions, precisions and Pythons?

python tests/benchmarks/time_repeat.py [--python .../python3.12 ...]: a part of scene quick (one skin a board, all its
passes and steps; one skin alone, boards held out without and with triplets) runs from nothing in a clean copy of the
last commit under each setting; every number of its report is held against the first run's. Adds to
docs/measured/repeat.json and writes docs/repeat.md.
"""

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pipeline.core import io
from pipeline.core.config import read_yaml
from pipeline.core.provenance import code_version, device
from pipeline.evaluation.reproduced import TOLERANCES, leaves, tolerance_of
from tests.benchmarks.pages import MEASURED, ROOT, short, table, write_block

SCENE = "repeat"
SKINS_N = 6  # one a board
QUESTIONS = ("single_random", "lobo", "triplet")
TRAINED = ("train_single", "train_multi", "train_triplet")
AGAIN = f"from pathlib import Path; from pipeline.verifying import rerun; rerun(Path(), ['{SCENE}'])"
# Whatever this processor has, and its libraries choose: nothing that pipeline/core/numerics.py pins holds.
UNPINNED = {
    "MKL_CBWR": "AUTO", "ATEN_CPU_CAPABILITY": "avx512", "ONEDNN_MAX_CPU_ISA": "DEFAULT",
    "OPENBLAS_CORETYPE": "SkylakeX", "NPY_DISABLE_CPU_FEATURES": "", "NUMBA_CPU_NAME": "host",
}  # fmt: skip
SETTINGS: dict[str, dict[str, str]] = {
    "two processes": {},
    "one process": {"RESKIN_EXECUTOR": "here"},
    "two threads of BLAS": dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "2"),
    "nothing pinned": UNPINNED,
    "ATEN_CPU_CAPABILITY=default": {"ATEN_CPU_CAPABILITY": "default"},
    "MKL_CBWR=COMPATIBLE": {"MKL_CBWR": "COMPATIBLE"},
    "networks in float64": {},
}
FIRST = "two processes"
DOUBLE = "networks in float64"  # the product has no such setting: its tensors are cast, in a copy
CASTS = {
    "pipeline/learning/train.py": ("for job in jobs]).to(device)", ".double()"),
    "pipeline/learning/job.py": ("np.concatenate(rows)).to(device)", ".double()"),
    "pipeline/learning/model.py": ("Stack(layers, [weights]).to(device)", ".double()"),
}
FED = ("pipeline/learning/model.py", "torch.from_numpy(inputs)", "torch.from_numpy(inputs).double()")


def scene_words() -> dict[str, Any]:
    """Take of scene quick what these questions need."""
    words = read_yaml(ROOT / "pipeline/scenes/quick.yaml")
    kept = {key: words[key] for key in ("source", "seed", "selection", *TRAINED)}
    split = {key: words["split"][key] for key in ("random_test_fraction", "random_repeats_n")}
    simulate = words["simulate"]
    boards, grid = {"rigid": simulate["boards"]["rigid"]}, simulate["protocols"]["grid"] | {"skins_n": SKINS_N}
    return kept | {
        "questions": list(QUESTIONS), "split": split, "simulate": {"boards": boards, "protocols": {"grid": grid}},
    }  # fmt: skip


def make_checkout(folder: Path, *, double: bool) -> None:
    """Clone the last commit, with the scene in it."""
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(folder)], check=True)
    (folder / f"pipeline/scenes/{SCENE}.yaml").write_text(json.dumps(scene_words(), indent=1))  # JSON is YAML
    if double:
        for name, (after, cast) in CASTS.items():
            replace(folder / name, after, after + cast)
        replace(folder / FED[0], *FED[1:])
    author = ("-c", "user.name=a", "-c", "user.email=a@b")
    for words in (["add", "."], [*author, "commit", "--quiet", "--message", SCENE]):
        subprocess.run(["git", *words], cwd=folder, check=True)


def replace(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert text.count(old) == 1, f"{file}: {old}"
    file.write_text(text.replace(old, new))


def run(folder: Path, python: Path, setting: Mapping[str, str]) -> dict[str, Any]:
    """Run the scene from nothing, and read its numbers."""
    environment = {**os.environ, **setting, "PYTHONPATH": str(folder)}
    subprocess.run([str(python), "-c", AGAIN], cwd=folder, env=environment, check=True, stderr=subprocess.DEVNULL)
    return dict(leaves(io.read_json(folder / f".reskin/verified/{SCENE}/numbers.json")))


def differences(first: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Count what is equal; give by kind of number (its tolerance's place) the largest difference, and what it is of."""
    kinds: dict[str, dict[str, Any]] = {}
    texts_n = 0
    for name, value in first.items():
        fresh = other[name]
        if not isinstance(value, int | float) or isinstance(value, bool):
            texts_n += value != fresh
            continue
        tolerance = tolerance_of(name)
        kind = kinds.setdefault(
            str(TOLERANCES.index(tolerance)),
            {"values_n": 0, "equal_n": 0, "beyond_n": 0, "absolute": 0.0, "relative": 0.0},
        )
        off = abs(fresh - value)
        kind["values_n"] += 1
        kind["equal_n"] += off == 0
        kind["beyond_n"] += not tolerance.allows(value, fresh)
        if off > kind["absolute"]:
            kind |= {"absolute": off, "of": name}
        if value:
            kind["relative"] = max(kind["relative"], off / abs(value))
    return {"texts_differ_n": texts_n, "absent_n": len(first.keys() ^ other.keys()), "kinds": kinds}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--python", type=Path, nargs="*", default=[], help="of other versions, with the project's packages"
    )
    parser.add_argument("--out", type=Path, default=MEASURED / "repeat.json")
    parser.add_argument("--settings", nargs="*", choices=SETTINGS, default=list(SETTINGS), help="beside the first")
    asked = parser.parse_args()
    named = {name: setting for name, setting in SETTINGS.items() if name in (FIRST, *asked.settings)}
    runs = {name: (Path(sys.executable), setting) for name, setting in named.items()}
    runs |= {version_of(python): (python.absolute(), {}) for python in asked.python}
    found: dict[str, Any] = json.loads(asked.out.read_text())["runs"] if asked.out.exists() else {}
    with tempfile.TemporaryDirectory() as temporary:
        first: dict[str, Any] = {}
        for name, (python, setting) in runs.items():
            folder = Path(temporary) / name.replace(" ", "_").replace("=", "_")
            make_checkout(folder, double=name == DOUBLE)
            try:
                numbers = run(folder, python, setting)
            except subprocess.CalledProcessError as error:
                print(f"{name}: did not end ({error})", flush=True)
                continue
            finally:
                shutil.rmtree(folder)
            first = first or numbers
            found[name] = {"settings": setting, **differences(first, numbers)}
            print(f"{name}: {json.dumps(found[name])}", flush=True)
            of = {"git": code_version(), "machine": device(), "questions": QUESTIONS, "runs": found}
            asked.out.write_text(json.dumps(of, indent=1) + "\n")
    show(json.loads(asked.out.read_text()))


def show(found: Mapping[str, Any]) -> None:
    """Write what was measured into docs/repeat.md: a row a setting, and a row a kind of number."""
    settings = [
        {
            "setting": name,
            "numbers equal": sum(kind["equal_n"] for kind in run["kinds"].values()),
            "of": sum(kind["values_n"] for kind in run["kinds"].values()),
            "beyond tolerance": sum(kind["beyond_n"] for kind in run["kinds"].values()),
            "other words": run["texts_differ_n"],
        }
        for name, run in found["runs"].items()
    ]
    parts = [
        f"Code {found['git']}, {found['machine']}; the first row is what the others are held against.",
        table(settings),
    ]
    write_block("repeat.md", "repeat", [*parts, table([*_kinds(found["runs"])])])


def _kinds(runs: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for i, tolerance in enumerate(TOLERANCES):
        of_kind = {name: run["kinds"][str(i)] for name, run in runs.items() if str(i) in run["kinds"]}
        if of_kind:
            worst = max(of_kind, key=lambda name: of_kind[name]["absolute"])
            yield {
                "kind of number": f"`{tolerance.pattern.replace('|', chr(92) + '|')}`"
                if tolerance.pattern
                else "all others",
                "numbers": of_kind[worst]["values_n"],
                "largest difference": short(of_kind[worst]["absolute"]),
                "of which": of_kind[worst].get("of", "–"),
                "under": worst if of_kind[worst]["absolute"] else "–",
                "largest relative": f"{100 * max(kind['relative'] for kind in of_kind.values()):.2g} %",
                "tolerance": str(tolerance),
            }


def version_of(python: Path) -> str:
    words = "import platform; print(platform.python_version())"
    said = subprocess.run([str(python), "-c", words], capture_output=True, text=True, check=True)
    return f"Python {said.stdout.strip()}" if said.stdout.strip() != platform.python_version() else "the same Python"


if __name__ == "__main__":
    main()
