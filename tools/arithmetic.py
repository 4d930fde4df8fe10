"""Print a digest of the weights after a tiny training run, on this processor or on emulated processors.

The run trains the paper's networks (several at once, as a stack, with all terms of the loss). The training of the
universal model is not exact to the bit: its file is an input. `python -m tools.arithmetic` prints the digest;
test_numerics.py calls this command with several environment variables. `python -m tools.arithmetic Haswell-v2 EPYC-v1`
also runs on these two processors, emulated by QEMU (package qemu-user; about two minutes per processor; `qemu-x86_64
-cpu help` lists the processors), and fails if the digests differ. MKL and PyTorch select code by the maker and the
instruction sets of the processor, so emulation finds differences that environment variables alone cannot cause.
"""

import pipeline  # isort: skip  # noqa: F401  (must be first: `pipeline` sets variables that NumPy reads when imported)

import hashlib
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence

import numpy as np

from reskin.models.job import LossWeights
from reskin.models.recipe import Schedule
from reskin.models.train import train
from tests.models.example_jobs import some_job

STEPS_N = 10
SCHEDULE = Schedule(steps_n=STEPS_N, batch_n=128, rate_max=3e-3, gradient_norm_max=1.0, weight_decay=0.01)


def digest(arrays: Iterable[np.ndarray]) -> str:
    sha256 = hashlib.sha256()
    for array in arrays:
        sha256.update(array.tobytes())
    return sha256.hexdigest()[:16]


def paper_networks() -> str:
    jobs = [some_job(name, n=300, terms=True) for name in range(3)]
    outcomes = train(jobs, "paper", SCHEDULE, LossWeights(0.1, 0.1, 0.1), "cpu")
    return digest(outcome.weights[name] for outcome in outcomes for name in sorted(outcome.weights))


def digests_on(name: str) -> str:
    """Return the digests computed on the emulated processor with this QEMU name."""
    command = ["qemu-x86_64", "-cpu", name, sys.executable, "-m", "tools.arithmetic"]
    # Under QEMU, NumPy reads the real /proc/cpuinfo and warns about instruction sets that the emulated processor lacks.
    environment = {**os.environ, "NPY_DISABLE_CPU_FEATURES": ""}
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, check=True)
    return done.stdout.decode().strip()


def main(processors: Sequence[str]) -> None:
    here = paper_networks()
    print(here, flush=True)
    different = []
    for name in processors:
        emulated = digests_on(name)
        print(f"{emulated}  {name}", flush=True)
        different += [name] * (emulated != here)
    if different:
        sys.exit(f"the weights differ from those of this processor on: {', '.join(different)}")


if __name__ == "__main__":
    main(sys.argv[1:])
