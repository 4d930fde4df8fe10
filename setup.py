"""What pyproject.toml cannot say of the wheel: params.yaml stands above the package, and goes into it."""

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class WithParams(build_py):
    """Build the package with the checkout's params.yaml in it, which simulated scenes need."""

    def run(self) -> None:
        super().run()
        if not self.editable_mode:  # an editable install reads the checkout's own
            self.copy_file("params.yaml", str(Path(self.build_lib, "pipeline/params.yaml")))


setup(cmdclass={"build_py": WithParams})
