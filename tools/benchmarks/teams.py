"""Run a team's workflow on this machine: PostgreSQL, MLflow, DVC remotes, merging the recordings of two people.

The program starts servers on the loopback address and always stops them, even after a failure; all files are in one
temporary folder. It prints the steps and their seconds. It needs `pip install -e '.[team]'
'moto[server]'`.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import boto3
import mlflow
import numpy as np
import pandas as pd
import psycopg2
from ruamel.yaml import YAML

import reskin
from deploy import servers
from tools.benchmarks.common import ROOT, Steps, end_on_signals

SCENE = "team"
SETTINGS = {
    "source": "recorded", "seed": 1, "experiments": ["lobo"], "selection": {"force_min_N": 0.0}, "split": {},
    "train_multi": {"recipe": "paper", "steps_n": 100, "seeds_n": 1, "variants": {}},
}  # fmt: skip
BUCKET, REMOTE = "reskin-team", "store"
ACCESS_KEYS = {"AWS_ACCESS_KEY_ID": "team", "AWS_SECRET_ACCESS_KEY": "on loopback", "AWS_DEFAULT_REGION": "us-east-1"}
GIT_IDENTITY = {
    "GIT_AUTHOR_NAME": "Tester", "GIT_AUTHOR_EMAIL": "tester@example.org", "GIT_CONFIG_GLOBAL": os.devnull,
    "GIT_COMMITTER_NAME": "Tester", "GIT_COMMITTER_EMAIL": "tester@example.org",
}  # fmt: skip
ENVIRONMENT = {
    "DVC_NO_ANALYTICS": "1",
    "OMP_NUM_THREADS": "1",
    "RESKIN_EXECUTOR": "here",
    "PYTHONDONTWRITEBYTECODE": "",
}
RAN_STAGE, UNCHANGED_STAGE = re.compile(r"^Running stage '(.*?)(?:@.*)?'", re.M), re.compile(r"didn't change, skipping")


class Clone:
    """One person's clone of the team's repository; its commands use the virtual environment of this process."""

    def __init__(self, folder: Path, origin: Path, variables: Mapping[str, str]) -> None:
        self.folder = folder
        self._variables = {
            **os.environ,
            **ENVIRONMENT,
            **ACCESS_KEYS,
            **GIT_IDENTITY,
            **variables,
            "PYTHONPATH": str(folder),
        }
        run(["git", "clone", "--quiet", str(origin), str(folder)], folder.parent, self._variables)
        (folder / ".venv").symlink_to(sys.prefix)

    def git(self, *words: str, check: bool = True) -> str:
        return run(["git", *words], self.folder, self._variables, check=check)

    def dvc(self, *words: str) -> str:
        return run([sys.executable, "-m", "dvc", *words], self.folder, self._variables)

    def reskin(self, *words: str) -> str:
        return run([sys.executable, "-m", "pipeline", *words], self.folder, self._variables)

    def add(self, skin_i: int) -> None:
        """Add the recording of a simulated skin on a new board, in layout `table`."""
        file = self.folder.parent / f"skin{skin_i}.csv"
        recording(skin_i).to_csv(file, index=False)
        labels = ["--board", f"board{skin_i}", "--skin", f"skin{skin_i}", "--scene", SCENE]
        self.reskin("add", str(file), "--layout", "table", *labels)

    def repro(self) -> Counter[str]:
        """Run `dvc repro`; return how many times each stage ran."""
        return Counter(RAN_STAGE.findall(self.dvc("repro")))

    def commit(self, sentence: str) -> None:
        self.git("add", "--all")
        self.git("commit", "--quiet", "-m", sentence)


def require(condition: bool, what: str) -> None:
    if not condition:
        raise RuntimeError(what)


def run(words: list[str], folder: Path, variables: Mapping[str, str], *, check: bool = True) -> str:
    done = subprocess.run(words, cwd=folder, env=variables, capture_output=True, text=True, check=False)
    if check and done.returncode:
        raise RuntimeError(f"{' '.join(words[-6:])}: {(done.stdout + done.stderr)[-800:]}")
    return done.stdout + done.stderr


def recording(skin_i: int) -> pd.DataFrame:
    """Return a simulated recording as CSV: presses at 81 places and two depths, each preceded by a no-load row."""
    grid = np.stack(np.meshgrid(np.arange(0, 18, 2.0), np.arange(0, 18, 2.0), [0.6, 1.2]), -1).reshape(-1, 3)
    skin = reskin.draw_skin(f"b{skin_i}_s0", seed=skin_i)
    noload_uT, b_uT, force_N = reskin.simulate_pokes(skin, grid, board=reskin.draw_board(f"b{skin_i}", seed=skin_i))
    fields = [f"{axis}{chip}" for chip in range(5) for axis in ("Bx", "By", "Bz")]
    parts = []
    for phase, field_uT in (("noload", noload_uT), ("contact", b_uT)):
        part = pd.DataFrame(field_uT, columns=fields).assign(x_mm=grid[:, 0], y_mm=grid[:, 1], phase=phase)
        parts.append(part.assign(depth_mm=grid[:, 2], Fz_N=force_N if phase == "contact" else 0.0))
    return pd.concat(parts).sort_index(kind="stable")


def make_origin(folder: Path, address: str) -> Path:
    """Create the team's bare repository: the code of this commit, one small scene and two DVC remotes."""
    seed = Clone(folder / "seed", ROOT, {})
    seed.git("checkout", "--quiet", "-B", "main")
    with (seed.folder / f"pipeline/scenes/{SCENE}.yaml").open("w") as stream:
        YAML().dump(SETTINGS, stream)
    run([sys.executable, "-c", "from pathlib import Path; from pipeline import plan; plan.use(Path(), [])"],
        seed.folder, {**os.environ, "PYTHONPATH": str(seed.folder)})  # fmt: skip
    seed.dvc("remote", "add", "folder", str(folder / "remote"))
    seed.dvc("remote", "add", "--default", REMOTE, f"s3://{BUCKET}/dvc")
    seed.dvc("remote", "modify", REMOTE, "endpointurl", address)
    seed.commit("Begin a team")
    origin = folder / "origin.git"
    seed.git("clone", "--quiet", "--bare", str(seed.folder), str(origin))
    return origin


def transfer_summary(output: str) -> str:
    """Return the summary line in the output of `dvc push` or `dvc pull`."""
    found = re.search(r"(\d+ files? (?:pushed|fetched)[^\n]*)|Everything is up to date", output)
    return found[0] if found else "no message from DVC"


def list_stages(ran: Counter[str]) -> str:
    return ", ".join(f"{n} {name}" if n > 1 else name for name, n in ran.items()) or "0 stages"


def share_by_remotes(steps: Steps, folder: Path, origin: Path, tracking: str) -> tuple[Clone, Clone]:
    """Push the data to both DVC remotes and pull them into new clones; check that no stage needs to run there."""
    variables = {"MLFLOW_TRACKING_URI": tracking}
    with steps.step("Ana: clone, `reskin add` two skins, `dvc repro`") as note:
        ana = Clone(folder / "ana", origin, variables)
        for skin_i in (1, 2):
            ana.add(skin_i)
        ran = ana.repro()
        require(ran["train_multi"] == ran["report"] == 1, f"ran {ran}")
        note(f"{sum(ran.values())} stages ran")
        ana.commit("Add two skins")
    for remote in (REMOTE, "folder"):
        with steps.step(f"Ana: `dvc push -r {remote}`") as note:
            note(transfer_summary(ana.dvc("push", "-r", remote)))
    ana.git("push", "--quiet", "origin", "main")
    fresh = []
    for remote in (REMOTE, "folder"):
        with steps.step(f"fresh clone, `dvc pull -r {remote}`") as note:
            fresh.append(Clone(folder / f"fresh-{remote}", origin, variables))
            note(transfer_summary(fresh[-1].dvc("pull", "-r", remote)))
        with steps.step("`dvc repro` in this clone") as note:
            before = fresh[-1].git("status", "--porcelain")
            ran = fresh[-1].repro()
            note(f"{sum(ran.values())} stages ran")
            require(not ran, f"ran {ran}")
            require(before == fresh[-1].git("status", "--porcelain") == "", "files changed")
    return ana, fresh[0]


def merge_two(steps: Steps, ana: Clone, ben: Clone) -> None:
    """Let two people each add a skin, run the pipeline and push. The second one merges; the first pulls the merge."""
    for name, clone, skin_i in (("Ana", ana, 3), ("Ben", ben, 4)):
        with steps.step(f"{name}: `reskin add` skin {skin_i}, `dvc repro`, commit, `dvc push`") as note:
            clone.add(skin_i)
            ran = clone.repro()
            require(ran["ingest"] == 1, f"ran {ran}")
            note(list_stages(ran))
            clone.commit(f"Add skin {skin_i}")
            clone.dvc("push")
    ana.git("push", "--quiet", "origin", "main")
    with steps.step("Ben: `git pull`, `git checkout --theirs`, `reskin scenes use`, `git commit`") as note:
        ben.git("pull", "--quiet", "--no-rebase", "origin", "main", check=False)
        conflicts = ben.git("diff", "--name-only", "--diff-filter=U").split()
        require({"dvc.lock", "pipeline/plan.yaml"} <= {*conflicts}, f"in conflict: {conflicts}")
        note(f"{len(conflicts)} files in conflict")
        ben.git("checkout", "--theirs", "dvc.lock", "pipeline/plan.yaml", "reports")
        ben.reskin("scenes", "use", SCENE)
        ben.commit("Merge both skins")
    with steps.step("Ben: `dvc pull`, `dvc repro`, commit, push") as note:
        pulled = transfer_summary(ben.dvc("pull"))
        ran = ben.repro()
        require(ran["ingest"] == 0, f"ran {ran}")
        require(ran["train_multi"] == 1, f"ran {ran}")
        note(f"{pulled}; {list_stages(ran)}; no recording is read again")
        ben.commit("Results of four skins")
        ben.dvc("push")
        ben.git("push", "--quiet", "origin", "main")
    pull_merge(steps, ana)


def pull_merge(steps: Steps, ana: Clone) -> None:
    """Pull a merge that somebody else made and ran; check that no stage needs to run."""
    with steps.step("Ana: `git pull`, `dvc pull`, `dvc repro`") as note:
        ana.git("pull", "--quiet", "origin", "main")
        ana.dvc("pull")
        ran = ana.repro()
        require(not ran, f"ran {ran}")
        note("0 stages ran; 4 captures")


def search_runs(tracking: str) -> pd.DataFrame:
    mlflow.set_tracking_uri(tracking)
    return mlflow.search_runs(search_all_experiments=True)


def share_by_mlflow(steps: Steps, ana: Clone, ben: Clone, tracking: str, database: str) -> int:
    """Check that PostgreSQL has each MLflow run once and that the server returns a model; return the run count."""
    with steps.step("publish again from both clones at once") as note:
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(lambda clone: clone.reskin("publish"), (ana, ben)))
        runs = search_runs(tracking)
        require(runs["tags.key"].is_unique, "a result was published twice")
        note(f"{len(runs)} MLflow runs, no duplicates")
    with steps.step("query PostgreSQL") as note:
        rows_n = count_rows(database)
        require(rows_n == len(runs), f"{rows_n} rows, {len(runs)} runs")
        note(f"{rows_n} rows in table runs")
    with steps.step("load a model from the server and from its file") as note:
        pokes = np.random.default_rng(0).normal(0, 50, (5, 15)).astype(np.float32)
        model = mlflow.pyfunc.load_model(f"models:/reskin-{SCENE}@champion")
        named = pd.DataFrame(pokes, columns=model.metadata.get_input_schema().input_names())
        theirs = model.predict(named).to_numpy()
        ours = reskin.load_model(ben.folder / f"data/models/{SCENE}/final/final.safetensors")
        require(np.array_equal(theirs, ours.zero(np.zeros(15)).predict(pokes)), "predictions differ")
        note("same predictions")
    return rows_n


def count_rows(database: str) -> int:
    connection = psycopg2.connect(database.replace("+psycopg2", ""))
    try:
        with connection.cursor() as cursor:
            cursor.execute("select count(*) from runs where lifecycle_stage = 'active'")
            return int(cursor.fetchone()[0])
    finally:
        connection.close()


def run_steps(steps: Steps, folder: Path) -> None:
    """Run all steps of the workflow in a folder."""
    os.environ.update(ACCESS_KEYS, MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR="false")
    addresses, ports = [], [servers.free_port() for _ in range(3)]
    try:
        with ExitStack() as up:
            with steps.step("start PostgreSQL (new database), MLflow and an S3-compatible server"):
                database = up.enter_context(servers.postgres(folder / "postgres", ports[0]))
                addresses.append(database)
                down = up.enter_context(ExitStack())
                tracking = down.enter_context(servers.mlflow(folder / "mlflow", database, ports[1]))
                store = up.enter_context(servers.s3(folder / "s3", ports[2]))
                addresses += [tracking, store]
                boto3.client("s3", endpoint_url=store).create_bucket(Bucket=BUCKET)
            ana, ben = share_by_remotes(steps, folder, make_origin(folder, store), tracking)
            merge_two(steps, ana, ben)
            rows_n = share_by_mlflow(steps, ana, ben, tracking, database)
            with steps.step("restart MLflow on the same database") as note:
                down.close()
                up.enter_context(servers.mlflow(folder / "mlflow", database, ports[1]))
                require(len(search_runs(tracking)) == rows_n, "runs are lost")
                note(f"{rows_n} runs, as before")
    finally:
        with steps.step("stop all servers") as note:
            left = [address.split("@")[-1] for address in addresses if servers.listens(address)]
            require(not left, f"still listening: {left}")
            note(f"{len(addresses)} ports are closed")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keep", type=Path, help="folder for all files of the workflow; it is kept")
    given = parser.parse_args()
    end_on_signals()
    steps = Steps()
    with ExitStack() as kept:
        folder = given.keep or Path(kept.enter_context(tempfile.TemporaryDirectory()))
        folder.chmod(0o755)  # PostgreSQL runs as another user
        run_steps(steps, folder.resolve())


if __name__ == "__main__":
    main()
