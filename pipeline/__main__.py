"""Run a DVC stage (`python -m pipeline STAGE --scene NAME ...`, the form used in dvc.yaml) or a `reskin` command."""

import argparse
import sys
from pathlib import Path

import pipeline


def main() -> None:
    """Run the stage or `reskin` command that is named on the command line."""
    here, code = Path.cwd().resolve(), Path(pipeline.__file__).resolve()
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if not code.is_relative_to(here) and (here / "pipeline/__main__.py").is_file():
        problem = f"{here} is a checkout, but Python imports the code in {code.parent}"
        sys.exit(f"error: {problem}. Try: cd {here}; python -m pipeline")
    try:
        if name == "code":
            from pipeline.stages.code import write_digests

            parser = argparse.ArgumentParser(prog="python -m pipeline code", description=write_digests.__doc__)
            parser.add_argument("--digests", type=Path, required=True)
            write_digests(parser.parse_args(sys.argv[2:]).digests)
            return
        from pipeline.catalogue import is_stage, module_of
        from pipeline.stage import run
    except ModuleNotFoundError as error:
        sys.exit(f"error: package {error.name} is not installed for {sys.executable}. Try: . .venv/bin/activate")
    if is_stage(name):
        scene = run(getattr(module_of(name), name), sys.argv[2:])
        # Imported here and not by a stage, so that changes of the tracking rerun no stage.
        from pipeline.tracking import after_stage

        after_stage(name, scene)
    else:
        from reskin.cli import main as command

        command()


if __name__ == "__main__":
    main()
