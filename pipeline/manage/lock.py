"""A lock for commands that change a checkout, so that they do not disturb each other or a running `dvc repro`."""

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from filelock import FileLock

from reskin.errors import ParamsError

LOCK = ".dvc/tmp/reskin.lock"


@contextmanager
def changing(root: Path) -> Iterator[None]:
    """Hold the lock of a checkout in a `with` block that changes files which stages read.

    Other commands with this lock wait. If DVC runs a command in the checkout, `ParamsError` is raised. If DVC is
    started during the block, DVC refuses to run stages.
    """
    from dvc.exceptions import DvcException  # imported here, because the import takes a second
    from dvc.repo import Repo
    from dvc.rwlock import rwlock

    (root / LOCK).parent.mkdir(parents=True, exist_ok=True)
    with FileLock(root / LOCK, is_singleton=True), ExitStack() as held:
        try:
            # DVC holds the lock of its repository between stages. While a stage runs, DVC holds read and write locks of
            # the stage's paths instead. A write lock of the whole checkout excludes all of them. It has the same owner
            # as the locks of `Repo.add` in this process: process id and command line.
            with Repo(str(root)) as repo, repo.lock:
                command, hardlink = " ".join(sys.argv), repo.config["core"].get("hardlink_lock", False)
                held.enter_context(rwlock(repo.tmp_dir, repo.fs, command, [], [repo.root_dir], hardlink))
        except DvcException as error:
            reason = " ".join(str(error).split())
            raise ParamsError(
                f"nothing was changed, because DVC could not lock this checkout: {reason} If DVC is running, run the "
                "command again when it has ended."
            ) from None
        yield
