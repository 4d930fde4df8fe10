"""Git repositories for tests, with recordings."""

import subprocess
from collections.abc import Mapping
from pathlib import Path

AUTHOR = ("-c", "user.name=rig", "-c", "user.email=rig@example.org", "-c", "commit.gpgsign=false")


def git(folder: Path, *arguments: str) -> str:
    result = subprocess.run(["git", *AUTHOR, "-C", str(folder), *arguments], capture_output=True, text=True, check=True)
    return result.stdout.strip()


def commit(folder: Path, files: Mapping[str, bytes]) -> str:
    """Write files to a git repository (created if necessary) and commit them; return the hash of the commit."""
    if not (folder / ".git").exists():
        folder.mkdir(parents=True)
        git(folder, "init", "--quiet")
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    git(folder, "-c", "core.autocrlf=false", "add", "--all")
    git(folder, "commit", "--quiet", "--message", "recordings")
    return git(folder, "rev-parse", "HEAD")
