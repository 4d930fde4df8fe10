"""Compare the results of a scene under different numbers of threads, processor instructions and Python versions.

Under each setting, a reduced scene quick (one skin per board, all passes and steps, experiments single_random, lobo and
triplet) runs in a new clone of the last commit, without cached results. Its numbers are compared with those under the
first setting. The program adds to docs/measured/repeat.json and writes docs/repeat.md.
"""

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.manage.verify import flatten
from pipeline.provenance import code_version, machine
from reskin import io
from reskin.config import read_yaml
from tools.benchmarks.common import MEASURED, ROOT, table, write_block

SCENE = "repeat"
SKINS_N = 6  # one skin on each board
EXPERIMENTS = ("single_random", "lobo", "triplet")
TRAINING_SECTIONS = ("train_single", "train_multi", "train_triplet")
RERUN_CODE = f"from pathlib import Path; from pipeline.manage.verify import rerun; rerun(Path(), ['{SCENE}'])"
# reskin/numerics.py sets variables so that libraries use the same instructions on all processors. These values undo
# this: each library then uses the newest instructions that the processor has.
UNPINNED = {
    "MKL_CBWR": "AUTO", "ATEN_CPU_CAPABILITY": "avx512", "ONEDNN_MAX_CPU_ISA": "DEFAULT",
    "OPENBLAS_CORETYPE": "SkylakeX", "OPENBLAS_NUM_THREADS": "2",
    "NPY_DISABLE_CPU_FEATURES": "", "NUMBA_CPU_NAME": "host",
}  # fmt: skip
SETTINGS: dict[str, dict[str, str]] = {
    "two processes": {},
    "one process": {"RESKIN_EXECUTOR": "here"},
    "two threads of OpenMP and MKL": dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), "2"),
    "nothing pinned": UNPINNED,
    "ATEN_CPU_CAPABILITY=default": {"ATEN_CPU_CAPABILITY": "default"},
    "MKL and oneDNN as on an unknown processor": {"MKL_CBWR": "COMPATIBLE", "ONEDNN_MAX_CPU_ISA": "SSE41"},
}
FIRST = "two processes"


def scene_settings() -> dict[str, Any]:
    """Return the settings of scene quick that the three experiments need, with SKINS_N skins."""
    quick = read_yaml(ROOT / "pipeline/scenes/quick.yaml")
    kept = {key: quick[key] for key in ("source", "seed", "selection", *TRAINING_SECTIONS)}
    split = {key: quick["split"][key] for key in ("random_test_fraction", "random_repeats_n")}
    simulate = quick["simulate"]
    boards, grid = {"rigid": simulate["boards"]["rigid"]}, simulate["protocols"]["grid"] | {"skins_n": SKINS_N}
    return kept | {
        "experiments": list(EXPERIMENTS), "split": split, "simulate": {"boards": boards, "protocols": {"grid": grid}},
    }  # fmt: skip


def make_checkout(folder: Path) -> None:
    """Clone the last commit and commit the scene to the clone."""
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(folder)], check=True)
    (folder / f"pipeline/scenes/{SCENE}.yaml").write_text(json.dumps(scene_settings(), indent=1))  # JSON is valid YAML
    author = ("-c", "user.name=a", "-c", "user.email=a@b")
    for words in (["add", "."], [*author, "commit", "--quiet", "--message", SCENE]):
        subprocess.run(["git", *words], cwd=folder, check=True)


def run(folder: Path, python: Path, setting: Mapping[str, str]) -> dict[str, Any]:
    """Run the scene without cached results; return the numbers of its report."""
    environment = {**os.environ, **setting, "PYTHONPATH": str(folder)}
    subprocess.run([str(python), "-c", RERUN_CODE], cwd=folder, env=environment, check=True, stderr=subprocess.DEVNULL)
    numbers: dict[str, Any] = io.read_json(folder / f".reskin/verified/{SCENE}/numbers.json")
    return numbers


def differences(first: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Return the counts of equal and differing values, the largest relative difference, and the name of its value."""
    one, two = flatten(first), flatten(other)
    common = one.keys() & two.keys()
    differing = {name: (json.loads(one[name]), json.loads(two[name])) for name in common if one[name] != two[name]}
    relative = {
        name: abs(old - new) / max(abs(old), abs(new))
        for name, (old, new) in differing.items()
        if isinstance(old, float) and isinstance(new, float)
    }
    found = {
        "equal_n": len(common) - len(differing), "values_n": len(common), "absent_n": len(one.keys() ^ two.keys()),
    }  # fmt: skip
    largest = max(relative, key=lambda name: relative[name], default=None)
    return found | ({"largest_relative": relative[largest], "of": largest} if largest else {})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--python", type=Path, nargs="*", default=[], help="interpreters of other versions, with the project's packages"
    )
    parser.add_argument("--out", type=Path, default=MEASURED / "repeat.json")
    parser.add_argument(
        "--settings",
        nargs="*",
        choices=SETTINGS,
        default=list(SETTINGS),
        help=f"settings to run in addition to '{FIRST}'",
    )
    arguments = parser.parse_args()
    named = {name: setting for name, setting in SETTINGS.items() if name in (FIRST, *arguments.settings)}
    runs = {name: (Path(sys.executable), setting) for name, setting in named.items()}
    runs |= {python_version(python): (python.absolute(), {}) for python in arguments.python}
    found: dict[str, Any] = json.loads(arguments.out.read_text())["runs"] if arguments.out.exists() else {}
    with tempfile.TemporaryDirectory() as temporary:
        first: dict[str, Any] = {}
        for name, (python, setting) in runs.items():
            folder = Path(temporary) / name.replace(" ", "_").replace("=", "_")
            make_checkout(folder)
            try:
                numbers = run(folder, python, setting)
            except subprocess.CalledProcessError as error:
                print(f"{name}: failed ({error})", flush=True)
                continue
            finally:
                shutil.rmtree(folder)
            first = first or numbers
            found[name] = {"settings": setting, **differences(first, numbers)}
            print(f"{name}: {json.dumps(found[name])}", flush=True)
            measurements = {"git": code_version(), "machine": machine(), "experiments": EXPERIMENTS, "runs": found}
            arguments.out.write_text(json.dumps(measurements, indent=1) + "\n")
    show(json.loads(arguments.out.read_text()))


def show(found: Mapping[str, Any]) -> None:
    """Write the table of docs/repeat.md: one row per setting."""
    rows = [
        {
            "setting": name,
            "equal values": run["equal_n"],
            "compared values": run["values_n"],
            "largest relative difference": f"{100 * run.get('largest_relative', 0.0):.3g} %",
            "value with this difference": run.get("of", "–"),
        }
        for name, run in found["runs"].items()
    ]
    heading = f"Code {found['git']}, {found['machine']}; the other rows are compared with the first row."
    write_block("repeat.md", "repeat", [heading, table(rows)])


def python_version(python: Path) -> str:
    words = "import platform; print(platform.python_version())"
    done = subprocess.run([str(python), "-c", words], capture_output=True, text=True, check=True)
    return f"Python {done.stdout.strip()}" if done.stdout.strip() != platform.python_version() else "the same Python"


if __name__ == "__main__":
    main()
