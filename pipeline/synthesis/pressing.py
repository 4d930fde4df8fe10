"""Presses that change while they are read: weights step by step, half sines, footfalls. In: sizes. Out: `Stops`.

A press is a stop a frame: its depth is a half sine of time, at one place of the paper's grid. Frames without contact
are stops above the skin. Refuses to know sections of scenes, rigs, skins' fields and clocks.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64
from scipy.optimize import brentq

from pipeline.core.errors import ParamsError
from pipeline.dataset.grid import points_mm
from pipeline.physics.skin import Skin, forces

LIFTED_MM = -1.0  # depth of a stop above the skin: no contact, and no dwell of the robot's log
DEPTH_STEP_M = 1e-12  # to which the depth under a weight is found: 1e-8 N on a skin of 10 N/mm
DEEPEST_SHARE = 0.999  # of the lesser of thickness and tip radius, where the force's model ends

Range = tuple[float, float]


@dataclass(frozen=True)
class Stops:
    """Where the tip is at each stop, axes n indentations and p stops, in mm."""

    x_mm: Float64[np.ndarray, "n p"]
    y_mm: Float64[np.ndarray, "n p"]
    depth_mm: Float64[np.ndarray, "n p"]


def weights_N(force_max_N: float, step_N: float) -> Float64[np.ndarray, " p"]:
    """List the weights of one filling: nothing, a step, two steps, ... the most."""
    return step_N * np.arange(round(force_max_N / step_N) + 1)


def depths_under(skin: Skin, weight_N: Float[np.ndarray, "n p"]) -> Float64[np.ndarray, "n p"]:
    """Find the commanded depth in m at which the skin bears each weight; no weight just touches it."""
    distinct_N, index = np.unique(weight_N, return_inverse=True)
    return np.array([_depth_under(skin, float(distinct)) for distinct in distinct_N])[index].reshape(weight_N.shape)


def presses(presses_n: int, *, duration_s: Range, depth_mm: Range, rate_hz: float, rng: np.random.Generator) -> Stops:
    """Draw presses at grid places, durations log-uniform; after a short one the tip stays lifted."""
    long_s = np.exp(rng.uniform(np.log(duration_s[0]), np.log(duration_s[1]), size=presses_n))
    long_n = np.maximum(np.round(long_s * rate_hz).astype(np.int64), 1)
    place_mm = _places_mm(presses_n, rng)
    depths_mm = np.full((presses_n, int(long_n.max())), LIFTED_MM)
    for i, peak_mm in enumerate(rng.uniform(*depth_mm, size=presses_n)):
        depths_mm[i, : long_n[i]] = half_sine(int(long_n[i]), float(peak_mm))
    flat = np.ones(depths_mm.shape)
    return Stops(place_mm[:, :1] * flat, place_mm[:, 1:] * flat, depths_mm)


def footfalls(
    steps_n: int, *, stance_s: Range, swing_s: Range, depth_mm: Range, rate_hz: float, rng: np.random.Generator
) -> Stops:
    """Draw one walk: a footfall, a swing above the skin, and so on; one indentation of many stops."""
    stance_n, swing_n = (
        np.maximum(np.round(rng.uniform(*range_s, size=steps_n) * rate_hz).astype(np.int64), 1)
        for range_s in (stance_s, swing_s)
    )
    peaks_mm = rng.uniform(*depth_mm, size=steps_n)
    place_mm = np.repeat(_places_mm(steps_n, rng), stance_n + swing_n, axis=0)
    parts = [
        part
        for stance, swing, peak_mm in zip(stance_n, swing_n, peaks_mm, strict=True)
        for part in (half_sine(int(stance), float(peak_mm)), np.full(int(swing), LIFTED_MM))
    ]
    return Stops(place_mm[None, :, 0], place_mm[None, :, 1], np.concatenate(parts)[None])


def half_sine(frames_n: int, peak_mm: float) -> Float64[np.ndarray, " p"]:
    """Give the depth in the middle of each frame of a press of `frames_n` frames."""
    return peak_mm * np.sin(np.pi * (np.arange(frames_n) + 0.5) / frames_n)


def _places_mm(places_n: int, rng: np.random.Generator) -> Float64[np.ndarray, "n 2"]:
    grid_mm = points_mm()
    return grid_mm[rng.integers(len(grid_mm), size=places_n)]


def _depth_under(skin: Skin, weight_N: float) -> float:
    if weight_N == 0:
        return -skin.depth_zero_m
    deepest_m = DEEPEST_SHARE * min(skin.thickness_m, skin.tip_radius_m) - skin.depth_zero_m

    def missing_N(depth_m: float) -> float:
        return float(forces(skin, np.array([depth_m]))[0]) - weight_N

    if missing_N(deepest_m) < 0:
        rule = f"at most {missing_N(deepest_m) + weight_N:.3g} N, which the skin bears at its deepest"
        raise ParamsError(f"skin {skin.name}", "weight", rule, f"{weight_N:.3g} N", "Lower force_max_N.")
    return float(brentq(missing_N, -skin.depth_zero_m, deepest_m, xtol=DEPTH_STEP_M))
