"""Update constraints.txt to the newest versions that fit together: python -m release.constraints [FILE].

pip resolves all extras except `fuzz`, whose package exists for few processors, and installs nothing. Run it with the
oldest supported Python, so that all versions exist for that Python; run `make test` before you commit the result.
"""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

from reskin import io

HEAD = "# Exact versions with all extras but fuzz; made with `make constraints`. torch is {torch} and nothing else.\n"
EXCLUDED = "fuzz"
OF_CUDA = ("nvidia-", "cuda-", "triton")  # left out, because torch without CUDA does not need them
RESOLVE = ("-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed", "--report", "-")


def resolve(python: str, wanted: str) -> dict[str, str]:
    """Let pip resolve the versions; return them by name, without build tags (`+cpu`)."""
    report = json.loads(subprocess.check_output([python, *RESOLVE, wanted]))
    packages = (item["metadata"] for item in report["install"])
    return {package["name"]: package["version"].partition("+")[0] for package in packages}


def render(versions: dict[str, str]) -> str:
    """Write versions in pip's format, in the order of `pip freeze`, without this project.

    >>> print(render({"torch": "2.0", "Attrs": "1.0", "nvidia-nccl": "3", "reskin": "0.1"}).splitlines()[1:])
    ['Attrs==1.0', 'torch==2.0']
    """
    kept = {name for name in versions if name != "reskin" and not name.startswith(OF_CUDA)}
    lines = "".join(f"{name}=={versions[name]}\n" for name in sorted(kept, key=str.lower))
    return HEAD.format(torch=versions["torch"]) + lines


def wanted(project: str) -> str:
    """Return the requirement for pip: the project with its extras.

    >>> wanted('[project.optional-dependencies]\\ndev = ["pytest"]\\ndask = ["dask"]\\nfuzz = ["atheris"]')
    '.[dask,dev]'
    """
    extras = tomllib.loads(project)["project"]["optional-dependencies"]
    return f".[{','.join(sorted(extras.keys() - {EXCLUDED}))}]"


def main() -> None:
    file = Path(sys.argv[1] if len(sys.argv) > 1 else "constraints.txt")
    text = render(resolve(sys.executable, wanted(Path("pyproject.toml").read_text(encoding="utf-8"))))
    before = set(file.read_text(encoding="utf-8").splitlines()) if file.is_file() else set()
    with io.replacing(file) as temporary:
        temporary.write_text(text, encoding="utf-8")
    changed = [line for line in text.splitlines() if line not in before and not line.startswith("#")]
    print(f"{file}: {len(text.splitlines()) - 1} packages, changed: {', '.join(changed) or 'none'}")


if __name__ == "__main__":
    main()
