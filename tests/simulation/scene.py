"""A small simulated scene for tests, and changed copies of this scene."""

from reskin.config import parse
from reskin.simulation.settings import SimulationSettings
from tests.physics.test_board import SPREADS

GRID = {"kind": "grid", "boards": "rigid", "skins_n": 4, "passes_n": 2, "depths_mm": (0.6, 1.2), "terms": []}
HAND = {
    "kind": "hand", "boards": "rigid", "skins_n": 1, "lines_n": 3, "pokes_per_line_n": 4, "depth_mm": (0.4, 1.2),
    "place_sd_mm": 0.3, "tilt_sd_deg": 0.0, "terms": [],
}  # fmt: skip
DRAG = {
    "kind": "drag", "boards": "rigid", "skins_n": 1, "passes_n": 1, "depths_mm": (0.6,), "step_mm": 2.0,
    "terms": ["friction"],
}  # fmt: skip
LOAD = {"kind": "load", "boards": "rigid", "skins_n": 1, "passes_n": 2, "force_max_N": 1.0, "step_N": 0.5, "terms": []}
CHIPS_MM = ((0.0, 0.0), (-7.0, 0.0), (0.0, -7.0), (7.0, 0.0), (0.0, 7.0))
RIGID = {"chips_xy_mm": CHIPS_MM, "chips_turn_deg": (0.0, 180.0, 270.0, 90.0, 0.0), "gap_mm": 1.1}
RULE = {"cell_mm": 1.0, "layers_n": 4}
AGEING = {"settling": 0.1, "ageing": 0.01, "fading_per_decade": 0.005, "wandering_uT": 0.2}
TEMPERATURE = {"warming_K": 3.0, "warming_s": 5.0, "swing_K": 0.0, "swing_s": 1.0, "chip_sensitivity_per_K": 0.0}
RELAXATION = {"approach_s": 0.5, "hold_s": 0.5}
SECTIONS = {
    "boards": {
        "rigid": {
            "letter": "b",
            "boards_n": 2,
            "skins_per_board_n": 2,
            "design": RIGID,
            "skin_mm": (20.0, 20.0),
            "quadrature": RULE,
        }
    },
    "protocols": {"grid": GRID},
    "rig": {
        "noload_frames_n": 4,
        "moving_frames_n": 2,
        "settling_frames_n": 1,
        "readings_n": 3,
        "rate_hz": 400.0,
        "robot_place_sd_mm": 0.0,
        "robot_depth_sd_mm": 0.0,
        "place_offset_sd_mm": 0.0,
        "force_noise_N": 0.006,
        "chunk_frames_max_n": 4,
        "arrival_jitter_s": 1e-4,
        "probe_clock_offset_s": 5.0,
        "probe_clock_rate_error": 5e-5,
    },
    "skin": {
        "polarity": "checkerboard",
        "flipped": False,
        "base": "slipping",
        "hold": None,
        "saturation_T": 0.11,
        "half_field_T": 0.8,
        "thickness_mm": 2.0,
        "modulus_kPa": 345.0,
        "stiffening": 0.0,
        "tip_radius_mm": 3.0,
    },
    "chip": {"gain_sel": 6, "noise_xy_uT": 3.3, "noise_z_uT": 5.0, "noise_temperature_degC": 0.1},
    "spreads": SPREADS,
    "terms": {},
}


def synthesis(section: str = "rig", **changes: object) -> SimulationSettings:
    """Return the settings of the small scene with changes in one section."""
    return parse(SimulationSettings, SECTIONS | {section: {**SECTIONS[section], **changes}}, "test")  # type: ignore[dict-item]


def with_protocol(name: str, protocol: dict[str, object], **changes: object) -> SimulationSettings:
    """Return the settings of the small scene with an additional protocol and with other sections."""
    return parse(SimulationSettings, SECTIONS | {"protocols": {"grid": GRID, name: protocol}} | changes, "test")
