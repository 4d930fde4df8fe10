"""Run benchmarks: `python -m tools.benchmarks [NAME [ARGUMENT ...]]`.

Without a name, the short ones run, one after another, each in a process of its own (about ten minutes):

    decode     decoding of frames, compared with loops over single frames
    physics    field change by an indentation, compared with magpylib
    training   grid of trainings, compared with a DataLoader loop
    model      readings and presses of the shipped model, compared with PyTorch
    live       delay from the last byte of a frame to its estimate and to the screen

The others take longer, and have arguments of their own (`python -m tools.benchmarks NAME --help`):

    repro      `make repro` in a fresh clone -> reports/time.json
    own_boards the commands of docs/add-your-data.md, on simulated recordings
    teams      a team's workflow with PostgreSQL, MLflow and S3 on this machine
"""

import runpy
import subprocess
import sys

SHORT = ("decode", "physics", "training", "model", "live")
LONG = ("repro", "own_boards", "teams")


def main() -> None:
    name, *arguments = sys.argv[1:] or [""]
    if not name:
        for short in SHORT:
            print(f"\n## {short}", flush=True)
            subprocess.run([sys.executable, "-m", "tools.benchmarks", short], check=True)
    elif name in SHORT + LONG:
        sys.argv = [f"python -m tools.benchmarks {name}", *arguments]
        runpy.run_module(f"tools.benchmarks.{name}", run_name="__main__")
    else:
        sys.exit(__doc__)


if __name__ == "__main__":
    main()
