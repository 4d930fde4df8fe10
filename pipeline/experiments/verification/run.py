"""Stage verification: a simulated scene's physics against independent references -> the rows of one table."""

from dataclasses import asdict
from pathlib import Path

from scipy.constants import milli

from pipeline.core import io
from pipeline.core.config import Files, read_settings
from pipeline.core.stage import run, say
from pipeline.experiments.verification.survey import Designs
from pipeline.experiments.verification.survey import verify as check_all
from pipeline.synthesis.settings import synthesis_of


def verification(scene: str, files: Files, answer: Path) -> None:
    """Check the scene's own skins, pokes and chips."""
    settings = read_settings("verification", scene, files)
    of, seed = synthesis_of(settings), settings.seed
    depths_m = tuple(milli * depth_mm for depth_mm in of.main.depths_mm)
    designs = Designs(of.main_boards.design, of.spreads, of.skin, of.chip, of.main_boards.quadrature.quadrature())
    checks = check_all(designs, depths_m=depths_m, seed=seed)
    io.write_json(answer, [asdict(check) | {"holds": check.holds} for check in checks])
    for check in checks:
        if not check.holds:
            say(f"warning: {scene}: {check.subject}, {check.law}: error {check.error:.3g}, past {check.tolerance:.3g}")
    say(f"{scene}: {sum(check.holds for check in checks)} of {len(checks)} checks of the physics hold")


if __name__ == "__main__":
    run(verification)
