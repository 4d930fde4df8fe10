"""What a team does, for real, on loopback: PostgreSQL, MLflow, DVC remotes, two people's recordings merged.

make teams, or python -m tests.benchmarks.teams. Starts its servers and ends them, after a failure too; all files lie
in a folder of their own, which goes at the end. A table of what was done, with seconds -> docs/measured/teams.md.
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
from tests.benchmarks.steps import ROOT, Steps, end_on_signals, require

SCENE = "team"
SETTINGS = {
    "source": "recorded", "seed": 1, "experiments": ["lobo"], "selection": {"force_min_N": 0.0}, "split": {},
    "train_multi": {"recipe": "paper", "steps_n": 100, "seeds_n": 1, "variants": {}},
}  # fmt: skip
BUCKET, REMOTE = "reskin-team", "store"
KEYS = {"AWS_ACCESS_KEY_ID": "team", "AWS_SECRET_ACCESS_KEY": "on loopback", "AWS_DEFAULT_REGION": "us-east-1"}
PERSON = {"GIT_AUTHOR_NAME": "Tester", "GIT_AUTHOR_EMAIL": "tester@example.org", "GIT_CONFIG_GLOBAL": os.devnull} | {
    "GIT_COMMITTER_NAME": "Tester", "GIT_COMMITTER_EMAIL": "tester@example.org",
}  # fmt: skip
ALWAYS = {"DVC_NO_ANALYTICS": "1", "OMP_NUM_THREADS": "1", "RESKIN_EXECUTOR": "here", "PYTHONDONTWRITEBYTECODE": ""}
RAN, KEPT = re.compile(r"^Running stage '(.*?)(?:@.*)?'", re.M), re.compile(r"didn't change, skipping")


class Clone:
    """One person's clone of the team's repository, with this environment."""

    def __init__(self, folder: Path, origin: Path, variables: Mapping[str, str]) -> None:
        self.folder = folder
        self._variables = {**os.environ, **ALWAYS, **KEYS, **PERSON, **variables, "PYTHONPATH": str(folder)}
        run(["git", "clone", "--quiet", str(origin), str(folder)], folder.parent, self._variables)
        (folder / ".venv").symlink_to(sys.prefix)

    def git(self, *words: str, check: bool = True) -> str:
        return run(["git", *words], self.folder, self._variables, check=check)

    def dvc(self, *words: str) -> str:
        return run([sys.executable, "-m", "dvc", *words], self.folder, self._variables)

    def reskin(self, *words: str) -> str:
        return run([sys.executable, "-m", "pipeline", *words], self.folder, self._variables)

    def add(self, skin_i: int) -> None:
        """Add one skin on a board of its own: a simulated one, as a plain table of readings."""
        file = self.folder.parent / f"skin{skin_i}.csv"
        recording(skin_i).to_csv(file, index=False)
        labels = ["--board", f"board{skin_i}", "--skin", f"skin{skin_i}", "--scene", SCENE]
        self.reskin("add", str(file), "--layout", "table", *labels)

    def repro(self) -> Counter[str]:
        """Run what is to be run; give the stages that ran, by name."""
        return Counter(RAN.findall(self.dvc("repro")))

    def commit(self, sentence: str) -> None:
        self.git("add", "--all")
        self.git("commit", "--quiet", "-m", sentence)


def run(words: list[str], folder: Path, variables: Mapping[str, str], *, check: bool = True) -> str:
    done = subprocess.run(words, cwd=folder, env=variables, capture_output=True, text=True, check=False)
    if check and done.returncode:
        raise RuntimeError(f"{' '.join(words[-6:])}: {(done.stdout + done.stderr)[-800:]}")
    return done.stdout + done.stderr


def recording(skin_i: int) -> pd.DataFrame:
    """81 places, two depths: a row at rest before each touch."""
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
    """Make the team's bare repository: this commit, one small scene, both remotes."""
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


def transferred(said: str) -> str:
    """What DVC says of a push or a pull, in a few words."""
    found = re.search(r"(\d+ files? (?:pushed|fetched)[^\n]*)|Everything is up to date", said)
    return found[0] if found else "no message of DVC"


def words(ran: Counter[str]) -> str:
    return ", ".join(f"{n} {name}" if n > 1 else name for name, n in ran.items()) or "0 stages"


def with_remotes(steps: Steps, folder: Path, origin: Path, tracking: str) -> tuple[Clone, Clone]:
    """Push, fresh clone, pull, nothing to run; from the S3-compatible server and from the folder."""
    at = {"MLFLOW_TRACKING_URI": tracking}
    with steps.step("Ana: clone, `reskin add` two skins, `dvc repro`") as see:
        ana = Clone(folder / "ana", origin, at)
        for skin_i in (1, 2):
            ana.add(skin_i)
        ran = ana.repro()
        require(ran["train_multi"] == ran["publish"] == 1, f"ran {ran}")
        see(f"{sum(ran.values())} stages ran")
        ana.commit("Add two skins")
    for remote in (REMOTE, "folder"):
        with steps.step(f"Ana: `dvc push -r {remote}`") as see:
            see(transferred(ana.dvc("push", "-r", remote)))
    ana.git("push", "--quiet", "origin", "main")
    fresh = []
    for remote in (REMOTE, "folder"):
        with steps.step(f"fresh clone, `dvc pull -r {remote}`") as see:
            fresh.append(Clone(folder / f"fresh-{remote}", origin, at))
            see(transferred(fresh[-1].dvc("pull", "-r", remote)))
        with steps.step("`dvc repro` in this clone") as see:
            before = fresh[-1].git("status", "--porcelain")
            ran = fresh[-1].repro()
            see(f"{sum(ran.values())} stages ran")
            require(not ran, f"ran {ran}")
            require(before == fresh[-1].git("status", "--porcelain") == "", "files changed")
    return ana, fresh[0]


def merge_two(steps: Steps, ana: Clone, ben: Clone) -> None:
    """Two people add a skin each, run, push; the second merges, and the first takes it over."""
    for name, clone, skin_i in (("Ana", ana, 3), ("Ben", ben, 4)):
        with steps.step(f"{name}: `reskin add` skin {skin_i}, `dvc repro`, commit, `dvc push`") as see:
            clone.add(skin_i)
            ran = clone.repro()
            require(ran["ingest"] == 1, f"ran {ran}")
            see(words(ran))
            clone.commit(f"Add skin {skin_i}")
            clone.dvc("push")
    ana.git("push", "--quiet", "origin", "main")
    with steps.step("Ben: `git pull`, `reskin merge`, `git commit`") as see:
        ben.git("pull", "--quiet", "--no-rebase", "origin", "main", check=False)
        conflicts = ben.git("diff", "--name-only", "--diff-filter=U").split()
        require({"dvc.lock", "data/captures.yaml", "pipeline/plan.yaml"} <= {*conflicts}, f"in conflict: {conflicts}")
        see(f"{len(conflicts)} files in conflict, none after")
        ben.reskin("merge")
        ben.git("commit", "--quiet", "-m", "Merge both skins")
    with steps.step("Ben: `dvc pull`, `dvc repro`, commit, push") as see:
        pulled = transferred(ben.dvc("pull"))
        ran = ben.repro()
        require(ran["ingest"] == 0, f"ran {ran}")
        require(ran["train_multi"] == 1, f"ran {ran}")
        see(f"{pulled}; {words(ran)}; no recording is read again")
        ben.commit("Results of four skins")
        ben.dvc("push")
        ben.git("push", "--quiet", "origin", "main")
    take_over(steps, ana)


def take_over(steps: Steps, ana: Clone) -> None:
    """Take over what somebody else merged and ran."""
    with steps.step("Ana: `git pull`, `dvc pull`, `dvc repro`") as see:
        ana.git("pull", "--quiet", "origin", "main")
        ana.dvc("pull")
        ran = ana.repro()
        require(not ran, f"ran {ran}")
        see("0 stages ran; 4 captures")


def runs_of(tracking: str) -> pd.DataFrame:
    mlflow.set_tracking_uri(tracking)
    return mlflow.search_runs(experiment_names=[SCENE])


def with_mlflow(steps: Steps, ana: Clone, ben: Clone, tracking: str, database: str) -> int:
    """Runs are in PostgreSQL, once each; a model comes back through the server; give how many runs there are."""
    with steps.step("publish again from both clones at once") as see:
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(lambda clone: clone.reskin("publish"), (ana, ben)))
        runs = runs_of(tracking)
        current = runs[(runs["tags.kind"] == "training") & (runs["tags.current"] == "true")]
        require(runs["tags.run_key"].is_unique, "a result stands there twice")
        require(len(current) == 4, f"{len(current)} current trainings")
        see(f"{len(runs)} MLflow runs, no duplicates, {len(current)} current trainings")
    with steps.step("query PostgreSQL") as see:
        rows_n = count_rows(database)
        require(rows_n == len(runs), f"{rows_n} rows, {len(runs)} runs")
        see(f"{rows_n} rows in table runs")
    with steps.step("load a model from the server and from its file") as see:
        run_id, name = current.iloc[0][["run_id", "tags.mlflow.runName"]]
        pokes = np.random.default_rng(0).normal(0, 50, (5, 15)).astype(np.float32)
        theirs = np.asarray(mlflow.pyfunc.load_model(f"runs:/{run_id}/model").predict(pokes))
        ours = reskin.load_model(ben.folder / f"data/models/{SCENE}/train_multi/{name}.safetensors")
        require(np.array_equal(theirs, ours.zero(np.zeros(15)).predict(pokes)), "answers differ")
        see("same predictions")
    return rows_n


def count_rows(database: str) -> int:
    connection = psycopg2.connect(database.replace("+psycopg2", ""))
    try:
        with connection.cursor() as cursor:
            cursor.execute("select count(*) from runs where lifecycle_stage = 'active'")
            return int(cursor.fetchone()[0])
    finally:
        connection.close()


def play(steps: Steps, folder: Path) -> None:
    """All of it, in a folder; servers end with their blocks."""
    os.environ.update(KEYS, MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR="false")
    at, ports = [], [servers.free_port() for _ in range(3)]
    try:
        with ExitStack() as up:
            with steps.step("start PostgreSQL (new database), MLflow and an S3-compatible server"):
                database = up.enter_context(servers.postgres(folder / "postgres", ports[0]))
                at.append(database)
                down = up.enter_context(ExitStack())
                tracking = down.enter_context(servers.mlflow(folder / "mlflow", database, ports[1]))
                store = up.enter_context(servers.s3(folder / "s3", ports[2]))
                at += [tracking, store]
                boto3.client("s3", endpoint_url=store).create_bucket(Bucket=BUCKET)
            ana, ben = with_remotes(steps, folder, make_origin(folder, store), tracking)
            merge_two(steps, ana, ben)
            rows_n = with_mlflow(steps, ana, ben, tracking, database)
            with steps.step("restart MLflow on the same database") as see:
                down.close()
                up.enter_context(servers.mlflow(folder / "mlflow", database, ports[1]))
                require(len(runs_of(tracking)) == rows_n, "runs are gone")
                see(f"{rows_n} runs, as before")
    finally:
        with steps.step("stop all servers") as see:
            left = [address.split("@")[-1] for address in at if servers.listens(address)]
            require(not left, f"still there: {left}")
            see(f"{len(at)} ports are closed")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "docs/measured/teams.md")
    parser.add_argument("--keep", type=Path, help="work in this folder, and leave it there")
    asked = parser.parse_args()
    end_on_signals()
    steps = Steps()
    with ExitStack() as kept:
        folder = asked.keep or Path(kept.enter_context(tempfile.TemporaryDirectory()))
        folder.chmod(0o755)  # PostgreSQL's user comes through
        play(steps, folder.resolve())
    steps.write(asked.out, "`make teams`: two people share runs and simulated recordings, on one machine.")


if __name__ == "__main__":
    main()
