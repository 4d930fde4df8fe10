"""CPU seconds and memory of each stage and of DVC for growing numbers of skins or recorded captures.

`skins 18 60 180 600 1800` runs the whole pipeline on scenes with these numbers of simulated skins and 65 pokes per
skin. Only 18 skins are simulated; the others are copies under other labels, which cost the same in all later stages.
`captures 10 30 100` creates these numbers of recorded captures and times four commands: `reskin add` of one more
capture, the first `dvc repro`, a `dvc repro` that has nothing to do, and the `dvc repro` after another `reskin add`.
The results are added to docs/measured/growth.json and printed as tables. CPU seconds are given because other work on
the machine changes them least.
"""

import argparse
import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import log
from pathlib import Path
from typing import Any

import numpy as np

from pipeline import SCENES, plan
from pipeline.manage.registry import Entry, Registry, write_registry
from pipeline.provenance import code_version, machine
from reskin import io
from reskin.config import read_yaml
from reskin.recordings.header import HEADER_FILE, make_header, write_capture
from tests.stages.checkout import PROGRAMS, copy_checkout, variables
from tools.benchmarks.common import MEASURED, ROOT, run, table

SCENE, BOARDS_N, SIMULATED_N = "grow", 6, 18
STEPS_N = 100  # Steps per training run. They are few, because the cost of a step does not depend on the number of rows.
READINGS_N = 40  # Readings per recorded capture. They are few, so that the overhead per capture dominates.


def time_command(folder: Path, *words: str) -> dict[str, float]:
    """Run a program of the environment in the copy; return its cost."""
    return run([str(PROGRAMS / words[0]), *words[1:]], folder, **variables(folder))


@contextmanager
def checkout(scene: Mapping[str, Any]) -> Iterator[Path]:
    """Yield a temporary copy of this checkout that has only the given scene."""
    with tempfile.TemporaryDirectory() as temporary:
        root = copy_checkout(Path(temporary))
        (root / SCENES / f"{SCENE}.yaml").write_text(json.dumps(scene))  # JSON is valid YAML
        yield root


def skins_scene(skins_n: int) -> dict[str, Any]:
    """Return a scene with the boards of scene quick and one light press per place."""
    quick = read_yaml(ROOT / "pipeline/scenes/quick.yaml")
    rigid = quick["simulate"]["boards"]["rigid"] | {"boards_n": BOARDS_N, "skins_per_board_n": skins_n // BOARDS_N}
    grid = quick["simulate"]["protocols"]["grid"] | {"skins_n": skins_n, "passes_n": 1, "depths_mm": [0.8]}
    return {
        "source": "simulated", "seed": 2021, "experiments": ["lobo"], "selection": {"force_min_N": 0.0}, "split": {},
        "simulate": {"boards": {"rigid": rigid}, "protocols": {"grid": grid}},
        "train_multi": quick["train_multi"] | {"steps_n": STEPS_N},
    }  # fmt: skip


def copy_captures(raw: Path, skins_n: int) -> None:
    """Copy the simulated captures under new names until there are `skins_n` captures."""
    sources = sorted(child for child in raw.iterdir() if child.is_dir())
    for i in range(len(sources), skins_n):
        source, name = sources[i % len(sources)], f"b{i % BOARDS_N}_s{i // BOARDS_N}"
        target = raw / name
        target.mkdir()
        for file in source.iterdir():
            if file.name != HEADER_FILE:
                os.link(file, target / file.name)
        header = io.read_json(source / HEADER_FILE)
        io.write_json(target / HEADER_FILE, header | {"capture": name, "board": name.split("_")[0], "skin": name})


def stages_of(root: Path, whole_run: Mapping[str, float]) -> dict[str, Any]:
    """Return the cost of each stage; the cost of DVC is that of the whole run minus the sum over stages."""
    files = sorted((root / ".reskin/costs" / SCENE).glob("*.json"))
    # Stage simulate is excluded: it ran before `whole_run`.
    costs = {file.stem: io.read_json(file) for file in files if file.stem != "simulate"}
    found = {
        stage: {"cpu_s": cost["cpu_s"], "peak_MB": round(cost["peak_process_memory_MB"])}
        for stage, cost in costs.items()
    }
    return found | {"dvc": {"cpu_s": round(whole_run["cpu_s"] - sum(cost["cpu_s"] for cost in found.values()), 2)}}


def grow_skins(skins_n: int, simulated_raw: Path) -> dict[str, Any]:
    """Run the pipeline on this number of skins, from raw captures to the report page; return the cost of each stage."""
    with checkout(skins_scene(skins_n)) as root:
        time_command(root, "reskin", "scenes", "use", SCENE)
        raw = root / "data/raw" / SCENE
        if not simulated_raw.exists():
            simulated = time_command(root, "dvc", "repro", "--quiet", f"simulate@{SCENE}")
            shutil.copytree(raw, simulated_raw)
            io.write_json(simulated_raw.with_suffix(".json"), simulated)
        if not raw.exists():
            shutil.copytree(simulated_raw, raw)
        copy_captures(raw, skins_n)
        time_command(root, "dvc", "repro", "--quiet", "code")
        committed = time_command(root, "dvc", "commit", "--quiet", "--force", f"simulate@{SCENE}")
        whole = time_command(root, "dvc", "repro", "--quiet", f"report@{SCENE}")
        stages = stages_of(root, whole)
        stages["dvc, raw captures"] = committed
        stages["dvc, nothing to do"] = time_command(root, "dvc", "repro", "--quiet", f"report@{SCENE}")
        stages["whole"] = whole
        folders = {name: sum(1 for _ in (root / name).rglob("*")) for name in ("data/raw", "data/indentations")}
        rows_n = io.read_json(root / f"data/models/{SCENE}/folds.json")["rows_n"]
        return {"skins_n": skins_n, "rows_n": rows_n, "files_n": folders, "stages": stages}


def recording(rng: np.random.Generator) -> bytes:
    """Return a random recording in layout `table`."""
    fields = [f"B{axis}{chip}" for chip in range(5) for axis in "xyz"]
    lines = [",".join(["phase", "x_mm", "y_mm", "Fz_N", *fields])]
    for i in range(READINGS_N):
        phase = ("noload", "contact")[i % 2]
        values = [4.0 + i // 2 % 9, 4.0 + i // 18, 0.5 * (i % 2), *(1000 + 50 * rng.standard_normal(15)).round(2)]
        lines.append(",".join([phase, *map(str, values)]))
    return ("\n".join(lines) + "\n").encode()


def create_captures(root: Path, captures_n: int, rng: np.random.Generator) -> None:
    """Create captures as repeated calls of `reskin add` would: folders, .dvc files, the registry and the plan."""
    from dvc.repo import Repo

    entries, targets = {}, []
    for i in range(captures_n):
        labels = {"board": f"b{i % BOARDS_N}", "skin": f"b{i % BOARDS_N}_s{i // BOARDS_N}"}
        name, target = f"c{i}", root / "data/raw" / SCENE / f"c{i}"
        header = make_header("growth", capture=name, layout="table", chips_n=5, protocol="", note="", **labels)
        write_capture(target, header, {"readings.csv": recording(rng)})
        entries[name] = Entry(layout="table", chips_n=5, fingerprints=(f"{i:064x}",), copy_of=None, **labels)
        targets.append(str(target))
    with Repo(str(root)) as repo:
        repo.add(targets)
    write_registry(root, Registry(captures={SCENE: entries}))
    plan.use(root, [SCENE])


def grow_captures(captures_n: int) -> dict[str, Any]:
    """Time four commands on this number of recorded captures; return the times and the size of dvc.lock."""
    rng = np.random.default_rng(captures_n)
    training = {"recipe": "paper", "steps_n": 1, "seeds_n": 1, "variants": {}}
    scene = {
        "source": "recorded", "seed": 1, "experiments": ["lobo"], "selection": {"force_min_N": 0.0}, "split": {},
        "train_multi": training,
    }  # fmt: skip
    with checkout(scene) as root:
        create_captures(root, captures_n, rng)
        (root / "one.csv").write_bytes(recording(rng))
        words = ("--layout", "table", "--board", "b0", "--skin", "b0_s0", "--scene", SCENE, "--name", "last")
        found = {"add one": time_command(root, "reskin", "add", "one.csv", *words)}
        found["ingest and split all"] = time_command(root, "dvc", "repro", "--quiet", f"split@{SCENE}")
        found["nothing to do"] = time_command(root, "dvc", "repro", "--quiet", f"split@{SCENE}")
        (root / "two.csv").write_bytes(recording(rng))
        time_command(root, "reskin", "add", "two.csv", *words[:-1], "more")
        found["ingest one more, split"] = time_command(root, "dvc", "repro", "--quiet", f"split@{SCENE}")
        lock_bytes_n = (root / "dvc.lock").stat().st_size
        return {"captures_n": captures_n, "lock_bytes_n": lock_bytes_n, "steps": found}


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=("skins", "captures"))
    parser.add_argument("counts", type=int, nargs="+")
    parser.add_argument("--out", type=Path, default=MEASURED / "growth.json")
    given = parser.parse_args(words)
    found: dict[str, Any] = json.loads(given.out.read_text()) if given.out.exists() else {}
    points = {point[f"{given.part}_n"]: point for point in found.get(given.part, [])}
    with tempfile.TemporaryDirectory() as folder:
        for count in given.counts:
            skins = given.part == "skins"
            points[count] = grow_skins(count, Path(folder) / "raw") if skins else grow_captures(count)
            found |= {"git": code_version(), "machine": machine(), given.part: [points[n] for n in sorted(points)]}
            given.out.write_text(json.dumps(found, indent=1) + "\n")
    print(table_of(found[given.part], given.part))


def table_of(points: Sequence[Mapping[str, Any]], part: str) -> str:
    """Return a row of CPU seconds for each stage or command, and the slope between the last two counts (log-log)."""
    counts, costs = (
        [point[f"{part}_n"] for point in points],
        [point.get("stages") or point["steps"] for point in points],
    )
    rows = []
    for name in costs[-1]:
        cpu_s = [cost[name]["cpu_s"] for cost in costs]
        rows.append({"CPU s": name} | dict(zip(counts, cpu_s, strict=True)))
        if len(counts) > 1 and min(cpu_s[-2:]) > 0:
            rows[-1]["slope"] = f"{log(cpu_s[-1] / cpu_s[-2]) / log(counts[-1] / counts[-2]):.2f}"
    return table(rows)


if __name__ == "__main__":
    main()
