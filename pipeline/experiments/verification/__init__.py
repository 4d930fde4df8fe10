"""Verification of the simulator: each part is compared with a reference that shares no code with it."""

from dataclasses import asdict
from pathlib import Path

from scipy.constants import milli

from pipeline.experiments.verification.checks import Check
from pipeline.experiments.verification.mechanics import (
    check_contact,
    check_indentations,
    check_kinematics,
    check_sideways,
)
from pipeline.experiments.verification.signals import check_electronics, check_field, check_frames, check_relaxation
from pipeline.settings import Settings
from pipeline.simulation import simulation_settings
from pipeline.stage import say
from reskin import io
from reskin.physics.layer import IndentedLayer
from reskin.simulation.settings import SimulationSettings


def verify(simulation: SimulationSettings, *, depths_m: tuple[float, ...], seed: int) -> list[Check]:
    """Compare every part of the simulator with a reference, for the settings of a scene.

    depths_m: the commanded depths of the indentations to check.
    """
    board, skin = simulation.main_boards, simulation.skin
    press = IndentedLayer(skin.thickness_mm * milli, skin.tip_radius_mm * milli, skin.base)
    rule = board.quadrature.in_si()
    return [
        *check_field(skin, seed),
        *check_contact(skin),
        *check_kinematics(press, max(depths_m)),
        *check_sideways(skin),
        *check_indentations(board.design, simulation.spreads, skin=skin, rule=rule, depths_m=depths_m, seed=seed),
        *check_relaxation(),
        *check_electronics(simulation.chip, seed),
        *check_frames(simulation.chip.gain_sel, len(board.design.places_mm), seed),
    ]


def verification(settings: Settings, results: Path) -> None:
    """Run all checks with a scene's skins, indentations and chips, and write the results."""
    simulation = simulation_settings(settings)
    checks = verify(
        simulation, depths_m=tuple(milli * depth_mm for depth_mm in simulation.main.depths_mm), seed=settings.seed
    )
    io.write_json(results, [asdict(check) | {"holds": check.holds} for check in checks])
    for check in checks:
        if not check.holds:
            say(
                f"warning: {settings.scene}: {check.subject}, {check.law}: "
                f"error {check.error:.3g} exceeds the tolerance {check.tolerance:.3g}"
            )
    say(f"{settings.scene}: {sum(check.holds for check in checks)} of {len(checks)} checks of the physics hold")
