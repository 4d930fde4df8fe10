"""Write docs/costs.md: the cost of each stage of a scene, and lower bounds for the three most expensive stages.

Run `python -m tests.benchmarks.time_costs [quick paper]`. The costs are those of each stage's last run, from
reports/<scene>/provenance.json and dvc.lock. The lower bounds follow from rates of this machine, which the program
measures: matrix products per CPU second (with the instructions that training uses), and bytes per second of memory and
disk. Run nothing else on the machine meanwhile.
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from pipeline.provenance import machine
from reskin.config import read_yaml
from reskin.models.network import FEATURE_LAYERS_N, paper_layers
from tests.benchmarks.pages import MEASURED, ROOT, short, table, write_block

HEAVIEST_N, BEST_OF_N = 3, 5
LAYERS = paper_layers(15)
WEIGHTS_N = sum(layer.in_n * layer.out_n + layer.out_n for layer in LAYERS)
UNITS_N = sum(layer.out_n for layer in LAYERS)
# Memory accesses per weight and step: AdamW reads the weight, its gradient and two moments, and writes the same four.
MOVES_N = 8
# Memory accesses per activation: it is written and read once in the forward pass, and once in the backward pass.
ACTIVATION_MOVES_N = 4
# In each step, these numbers of batches pass through the first layers in addition to the labelled batch: positives
# and negatives of triplets, and the anchors, positives and negatives of triplets of unlabelled pokes.
EXTRA_PASSES_N = {"train_multi": 0, "train_single": 0, "train_triplet": 2, "adapt": 5}
# For each sweep, the numbers of networks that it trains for each held-out board at each of its points. The keys are
# the stages that train networks of the same kind.
NETWORKS_BY_SWEEP: dict[str, Mapping[str, int]] = {
    "sweep_sensors": {"train_multi": 1, "train_triplet": 1, "adapt": 3},
    "sweep_pokes": {"adapt": 1},
}


def products_flop(kind: str, batch_n: int) -> float:
    """Count the floating-point operations of one step of one network (see `flop` in test_training_benchmark.py)."""

    def passes(layers: Any) -> float:
        return 2.0 * batch_n * (3 * sum(one.in_n * one.out_n for one in layers) - layers[0].in_n * layers[0].out_n)

    return passes(LAYERS) + EXTRA_PASSES_N[kind] * passes(LAYERS[:FEATURE_LAYERS_N])


def moved_bytes(kind: str, batch_n: int) -> float:
    """Count the bytes that one step of one network reads and writes if the processor's cache is never hit."""
    activations_n = batch_n * (UNITS_N + EXTRA_PASSES_N[kind] * sum(one.out_n for one in LAYERS[:FEATURE_LAYERS_N]))
    return 4.0 * (MOVES_N * WEIGHTS_N + ACTIVATION_MOVES_N * activations_n)


def best(call: Callable[[], object], clock: Callable[[], float]) -> float:
    call()
    took_s = []
    for _ in range(BEST_OF_N):
        start_s = clock()
        call()
        took_s.append(clock() - start_s)
    return min(took_s)


def measure_rates() -> dict[str, float]:
    """Measure products and copied bytes per CPU second of one thread, and bytes written to disk per second."""
    torch.set_num_threads(1)
    one, other = torch.rand(2, 1024, 1024)
    many, block = np.ones(2**26, np.float32), os.urandom(2**26)
    target = np.empty_like(many)
    with tempfile.NamedTemporaryFile(dir=ROOT) as file:

        def write() -> None:
            file.seek(0)
            file.write(block)
            file.flush()
            os.fsync(file.fileno())

        return {
            "sgemm_flop_per_s": 2 * 1024**3 / best(lambda: one @ other, time.process_time),
            "memory_bytes_per_s": 2 * many.nbytes / best(lambda: np.copyto(target, many), time.process_time),
            "disk_bytes_per_s": len(block) / best(write, time.monotonic),
        }


def stages_of(scene: str) -> list[dict[str, Any]]:
    """Return each stage's cost and, if dvc.lock has it, the size of its outputs; most expensive stage first."""
    costs = json.loads((ROOT / f"reports/{scene}/provenance.json").read_text())["runtime"]["stages"]
    lock = read_yaml(ROOT / "dvc.lock")["stages"]
    rows = []
    for unit, cost in costs.items():
        stage, _, part = unit.partition("-")
        locked = lock.get(f"{stage}@{scene}{'-' * bool(part)}{part}", {})
        sizes = [out["size"] for out in locked.get("outs", [])]
        rows.append({"stage": unit, "bytes_n": sum(sizes) if sizes else None, **cost})
    return sorted(rows, key=lambda row: -row.get("computed_s", row["seconds"]))


def limits_of(scene: str, row: Mapping[str, Any], rates: Mapping[str, float]) -> dict[str, float] | None:
    """Return a stage's lower bounds in s for products, memory and disk; None for stages that do not train."""
    settings, stage = read_yaml(ROOT / f"pipeline/scenes/{scene}.yaml"), str(row["stage"])
    shared = read_yaml(ROOT / "params.yaml")
    group = NETWORKS_BY_SWEEP.get(stage, {stage: 1} if stage in EXTRA_PASSES_N else None)
    if group is None:
        return None
    flop = moved = 0.0
    for kind, n in group.items():
        section = settings[kind]
        rule = shared["adaptations"][section["adaptation"]] if kind == "adapt" else shared["recipes"][section["recipe"]]
        steps_n = row["trainings_n"] * n / sum(group.values()) * section["steps_n"]
        flop += steps_n * products_flop(kind, rule["batch_n"])
        moved += steps_n * moved_bytes(kind, rule["batch_n"])
    disk_s = (row["bytes_n"] or 0) / rates["disk_bytes_per_s"]
    return {
        "products": flop / rates["sgemm_flop_per_s"], "memory": moved / rates["memory_bytes_per_s"], "disk": disk_s,
    }  # fmt: skip


def format_row(row: Mapping[str, Any]) -> dict[str, str]:
    return {
        "stage": row["stage"],
        "computed, s": f"{row.get('computed_s', row['seconds']):,.1f}",
        "last run, CPU s": f"{row['cpu_s']:,.1f}" if "cpu_s" in row else "–",
        "peak memory of a process, MB": f"{row['peak_process_memory_MB']:,.0f}",
        "on disk, MB": "–" if row["bytes_n"] is None else f"{row['bytes_n'] / 1e6:,.1f}",
    }


def compare_heaviest(scene: str, rows: list[dict[str, Any]], rates: Mapping[str, float]) -> list[dict[str, str]]:
    """Return one row per stage for the three most expensive stages: the cost and the lower bounds."""
    found = []
    for row in rows[:HEAVIEST_N]:
        limits, took_s = limits_of(scene, row, rates), row.get("computed_s", row["seconds"])
        if limits is None:
            found.append({"stage": row["stage"], "computed, s": short(took_s)})
            continue
        named = {f"lower bound ({name}), s": short(seconds) for name, seconds in limits.items()}
        ratio = {"computed / largest lower bound": f"{took_s / max(limits.values()):.2f}"}
        found.append({"stage": row["stage"], "computed, s": short(took_s)} | named | ratio)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=["quick", "paper"])
    scenes, rates = parser.parse_args().scenes, measure_rates()
    MEASURED.mkdir(exist_ok=True)
    (MEASURED / "rates.json").write_text(json.dumps({"machine": machine(), **rates}, indent=1) + "\n")
    parts = [
        f"Rates of {machine()}: {rates['sgemm_flop_per_s'] / 1e9:.0f} GFLOP of matrix products (single precision) and "
        f"{rates['memory_bytes_per_s'] / 1e9:.1f} GB copied per CPU second of one thread; "
        f"{rates['disk_bytes_per_s'] / 1e6:.0f} MB written to disk per second."
    ]
    for scene in scenes:
        rows = stages_of(scene)
        code = json.loads((ROOT / f"reports/{scene}/provenance.json").read_text())["git"]
        parts += [
            f"## Scene `{scene}`, code {code}",
            table(compare_heaviest(scene, rows, rates)),
            table(list(map(format_row, rows))),
        ]
    write_block("costs.md", "stages-costs", parts)


if __name__ == "__main__":
    main()
