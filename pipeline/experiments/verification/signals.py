"""Checks of magnetic fields, chips, wire formats and relaxation.

The references are magpylib, Maxwell's equations, the chip's data sheet, recorded noise, Python's `struct`, and mpmath
with 50 digits.
"""

import struct
from collections.abc import Callable
from itertools import product

import magpylib
import mpmath
import numpy as np
from jaxtyping import Float, Float32
from magpylib.core import dipole_Hfield
from scipy.constants import micro, milli, mu_0

from pipeline.experiments.verification.checks import Check, max_error, relative_error, scaled_error
from reskin.board import wire
from reskin.board.stream import decode_all
from reskin.board.wire import Frames, Wire
from reskin.physics import magnet
from reskin.physics.aging import SKIN_RELAXATION, Prony, advance, relax
from reskin.physics.board import Board
from reskin.physics.chip import ChipDesign, Overruns, read_field, read_temperature, steps_uT
from reskin.physics.magnet import Dipoles, Quadrature, change_of_field, place_nodes
from reskin.physics.skin import SkinDesign
from reskin.seeds import rng_for

NEAR_CELLS, FAR_CELLS = 0.6, 50.0  # range of distances from the centre of a box, in side lengths of the box
COARSE = Quadrature(cell_m=1.5e-3, layers_n=3)  # its nodes are the places in the skin where the field is checked
# Relative tolerance of comparisons with magpylib. The values of the magnetic constant mu_0 that CODATA published in
# different years differ by 1e-10 to 1e-9.
MU_0_DIGITS = 1e-8
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # rotation by a quarter turn about z


def check_field(skin: SkinDesign, seed: int) -> list[Check]:
    """Check the fields of cuboids, of dipoles, and of the magnetising array (the magnets that magnetise a skin)."""
    return [*boxes(seed), octupole(), *array(skin.polarity, skin.thickness_mm * milli, seed), *dipoles(seed)]


def boxes(seed: int, side_m: float = 0.5 * milli) -> list[Check]:
    rng = rng_for(seed, "verification", "box")
    directions = rng.standard_normal((2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    places_m = side_m * directions * np.geomspace(NEAR_CELLS, FAR_CELLS, len(directions))[:, None]
    inside_m = side_m * rng.uniform(-0.49, 0.49, (500, 3))
    found_T, truth_T = magnet.cuboid_field(places_m, 1.0, sides_m=(side_m,) * 3), cuboid(side_m).getB(places_m)
    relative = np.linalg.norm(found_T - truth_T, axis=1) / np.linalg.norm(truth_T, axis=1)
    return [
        Check("field of a box", f"outside, {NEAR_CELLS:g} to {FAR_CELLS:g} sides from the centre", "magpylib Cuboid",
              float(relative.max()), "1", 1e-8,
              "The contributions of the box's corners almost cancel at a distance r, because the field decreases as "
              "(side / r)^3. This increases relative rounding errors 1e5-fold up to 50 sides."),
        Check("field of a box", "inside, including the polarisation J", "magpylib Cuboid",
              inside_a_box(inside_m, side_m), "1", 1e-11,
              "Near an edge, logarithms almost cancel. This increases rounding errors as (side / distance)^2, which is "
              "2e4-fold at a distance of 1 % of a side."),
    ]  # fmt: skip


def inside_a_box(places_m: Float[np.ndarray, "o 3"], side_m: float) -> float:
    """Return the relative error of the field at places inside a cube, compared with magpylib."""
    return scaled_error(magnet.cuboid_field(places_m, 1.0, sides_m=(side_m,) * 3), cuboid(side_m).getB(places_m))


def cuboid(side_m: float, j_T: float = 1.0, place_m: tuple[float, ...] = (0, 0, 0)) -> magpylib.magnet.Cuboid:
    """Return a magpylib cube with the polarisation `j_T` along z."""
    return magpylib.magnet.Cuboid(polarization=(0, 0, j_T), dimension=(side_m,) * 3, position=place_m)


def octupole() -> Check:
    place, moment = np.array([[0.3, -0.4, np.sqrt(0.75)]]), np.array([[0.0, 0.0, 1 / mu_0]])
    near, far = (
        scaled_error(magnet.field(np.zeros((1, 3)), moment, sides * place),
              magnet.cuboid_field(sides * place, 1.0, sides_m=(1.0, 1.0, 1.0)))
        for sides in (8.0, 16.0)
    )  # fmt: skip
    return Check("dipole instead of a cube", "relative error decreases with the distance r as (side / r)^4",
                 "an error 16 times as small at twice the distance", abs(near / far / 16 - 1), "1", 0.02,
                 "The next term of the series, (side / r)^6, changes this ratio by 1 % between 8 and 16 sides."
                 )  # fmt: skip


def cuboids(polarity: magnet.Polarity, thickness_m: float, cubes_n: tuple[int, int]) -> list[magpylib.magnet.Cuboid]:
    """Return the cubes of the magnetising array, above and below the skin, as magpylib objects."""
    side_m, swaps = magnet.CUBE_SIDE_M, -1 if polarity == "checkerboard" else 1
    heights_m = (-magnet.ARRAY_BELOW_M - side_m / 2, thickness_m + magnet.ARRAY_ABOVE_M + side_m / 2)
    return [
        cuboid(side_m, magnet.ARRAY_REMANENCE_T * swaps ** (i + j),
               ((i - (cubes_n[0] - 1) / 2) * side_m, (j - (cubes_n[1] - 1) / 2) * side_m, z_m))
        for i, j, z_m in product(*map(range, cubes_n), heights_m)
    ]  # fmt: skip


def array(polarity: magnet.Polarity, thickness_m: float, seed: int) -> list[Check]:
    nodes_m = place_nodes(thickness_m, COARSE).nodes_m
    here_T, turned_T = (magnet.array_field(places_m, thickness_m, polarity) for places_m in (nodes_m, nodes_m @ TURN.T))
    swaps = -1 if polarity == "checkerboard" else 1
    theirs_T = magpylib.getB(cuboids(polarity, thickness_m, magnet.CUBES_N), nodes_m, sumup=True)
    divergence, curl = _slopes(rng_for(seed, "verification", "array"), thickness_m, polarity)
    differences = (
        "Central differences have a relative error of about (step / distance to an edge of a magnet)^2, which is at "
        "most (1/250)^2: steps are 1 um, distances at least 0.25 mm."
    )
    name = f"magnetising array, {polarity}"
    return [
        Check(name, "field in the skin", "32 magpylib Cuboids", scaled_error(here_T, theirs_T), "1", 1e-12,
              "Rounding errors are increased where cubes meet, because the contributions of the 32 cubes almost cancel "
              "there."),
        Check(name, "div B = 0", "central differences of the field", divergence, "1", 1e-4, differences),
        Check(name, "curl B = 0", "central differences of the field", curl, "1", 1e-4, differences),
        Check(name, "a quarter turn turns the field" + (", and swaps the poles" if swaps < 0 else ""),
              "the original field, turned", scaled_error(turned_T, swaps * here_T @ TURN.T), "1", 1e-12,
              "Rounding errors are increased where cubes meet, as for the field in the skin."),
    ]  # fmt: skip


def _slopes(rng: np.random.Generator, thickness_m: float, polarity: magnet.Polarity) -> tuple[float, float]:
    """Return the largest divergence and the largest curl of the array's field at random places in the skin.

    Both are relative to the largest derivative of the field at the same place.
    """
    step_m = 1e-6
    low, high = np.array([-9e-3, -9e-3, 0.05 * thickness_m]), np.array([9e-3, 9e-3, 0.95 * thickness_m])
    places_m = rng.uniform(low, high, (200, 3))
    steps_m = (np.eye(3)[:, None] * np.array([step_m, -step_m])[:, None]).reshape(6, 3)
    around_m = (places_m[:, None] + steps_m).reshape(-1, 3)
    b_T = magnet.array_field(around_m, thickness_m, polarity).reshape(-1, 3, 2, 3)
    slope = (b_T[:, :, 0] - b_T[:, :, 1]) / (2 * step_m)
    size = np.abs(slope).max(axis=(1, 2))
    divergence = np.abs(np.trace(slope, axis1=1, axis2=2)) / size
    curl = np.abs(slope - slope.transpose(0, 2, 1)).max(axis=(1, 2)) / size
    return float(divergence.max()), float(curl.max())


def dipoles(seed: int, factor: float = 2.5) -> list[Check]:
    rng = rng_for(seed, "verification", "dipoles")
    # If the dipoles were centred at the origin, a wrong sign of the separation could go unnoticed.
    nodes_m = rng.uniform((2e-3, -9e-3, 1e-3), (9e-3, 4e-3, 3e-3), (60, 3))
    moments = 1e-5 * rng.standard_normal((60, 3))
    moved_m, turned = nodes_m + 1e-4 * rng.standard_normal((60, 3)), moments + 1e-6 * rng.standard_normal((60, 3))
    observers_m = rng.uniform((-3e-3, -3e-3, -2e-3), (3e-3, 3e-3, -1e-3), (5, 3))
    before_T, after_T = (
        magpylib.getB([magpylib.misc.Dipole(moment=m, position=x) for x, m in zip(places_m, m_A_m2, strict=True)],
                      observers_m, sumup=True)
        for places_m, m_A_m2 in ((nodes_m, moments), (moved_m, turned))
    )  # fmt: skip
    change_T = change_of_field((nodes_m, moments), (moved_m, turned), observers_m)
    scaled_T = change_of_field((nodes_m, factor * moments), (moved_m, factor * turned), observers_m)
    year = "Only rounding errors occur, unless magpylib uses the value of mu_0 of another CODATA year."
    return [
        Check("field of dipoles", "at rest", "magpylib Dipole",
              scaled_error(magnet.field(nodes_m, moments, observers_m), before_T), "1", MU_0_DIGITS, year),
        Check("change of field", "dipoles that move and turn",
              "magpylib Dipole, field after the motion minus field before",
              scaled_error(change_T, after_T - before_T), "1", 10 * MU_0_DIGITS,
              f"{year} The change is a tenth of the fields, so its relative error is ten times as large."),
        Check("change of field", "proportional to the moments", f"the original change, multiplied by {factor:g}",
              scaled_error(scaled_T, factor * change_T), "1", 1e-12,
              "Only the rounding errors of a few thousand operations occur."),
    ]  # fmt: skip


def field_of(sources: Dipoles, observers_m: Float[np.ndarray, "o 3"]) -> Float[np.ndarray, "o 3"]:
    """Return the field of dipoles at observers in T, from one call of magpylib.core for all pairs."""
    places_m, moments = sources
    separation_m = (observers_m[:, None] - places_m).reshape(-1, 3)
    h_A_m = dipole_Hfield(observers=separation_m, moments=np.tile(moments, (len(observers_m), 1)))
    return mu_0 * h_A_m.reshape(len(observers_m), -1, 3).sum(axis=1)


# Field per count in uT (x, y, z), by the chip's setting GAIN_SEL, if its setting RES is 0
PUBLISHED_STEPS_uT = {7: (0.150, 0.150, 0.242), 6: (0.200, 0.200, 0.3227)}
PUBLISHED_GAINS = (5.0, 4.0, 3.0, 2.5, 2.0, 1.667, 1.333, 1.0)  # gains for GAIN_SEL 0 to 7
# Ranges of the noise's standard deviation in three recorded data sets, for the x and y axes, and for the z axis.
RECORDED_NOISE_uT = ((3.0, 3.7), (4.5, 7.0))
STILL_FRAMES_N = 20_000  # readings of a board at rest


def check_electronics(chip: ChipDesign, seed: int) -> list[Check]:
    """Check the conversion to counts, the wrap of int16, the temperature and the noise of a scene's chip."""
    return [*steps(), *conversion(chip.gain_sel, seed), *noise(chip, seed), temperature(seed)]


def quiet(gain_sel: int) -> ChipDesign:
    """Return a chip without noise."""
    return ChipDesign(gain_sel=gain_sel, noise_xy_uT=0.0, noise_z_uT=0.0, noise_temperature_degC=0.0)


def read_bare(
    b_T: Float[np.ndarray, "f 3"], design: ChipDesign, rng: np.random.Generator
) -> tuple[Float32[np.ndarray, "f 3"], Overruns]:
    """Read the fields `b_T` with one chip that is not rotated, and that has a gain of one and no offset."""
    eye = np.eye(3)[None]
    return read_field(b_T[:, None], Board("bare", np.zeros((1, 3)), eye, eye, np.zeros((1, 3))), design=design, rng=rng)


def steps() -> list[Check]:
    sheet = np.array([[PUBLISHED_STEPS_uT[7][axis] * gain for axis in range(3)] for gain in PUBLISHED_GAINS])
    ours = np.array([steps_uT(gain_sel) for gain_sel in range(8)])
    published = max(max_error(ours[gain_sel], np.array(step)) for gain_sel, step in PUBLISHED_STEPS_uT.items())
    return [
        Check("chip", "field per count, GAIN_SEL 6 and 7", "data sheet, as published by the firmware's authors",
              published, "uT", 5e-5, "The published values have four decimals."),
        Check("chip", "field per count, all gains", "data sheet, 0.150 uT (x, y) and 0.242 uT (z) times the gain",
              relative_error(ours, sheet), "1", 3e-4,
              "The gains 5/3 and 4/3 are published with three decimals."),
    ]  # fmt: skip


def conversion(gain_sel: int, seed: int) -> list[Check]:
    rng, step_uT = rng_for(seed, "verification", "chip"), steps_uT(gain_sel)
    field_uT = (rng.uniform(-1, 1, (2000, 3)) * 0.99 * 2**15 * step_uT).clip(-49e3, 49e3)
    inside_uT, _ = read_bare(field_uT * micro, quiet(gain_sel), rng)
    past_uT = rng.uniform(-50, 50, (2000, 3)) * milli / micro
    read_uT, _ = read_bare(past_uT * micro, quiet(7), rng)
    counts = np.rint(past_uT / PUBLISHED_STEPS_uT[7]).astype(np.int64)
    int16_uT = counts.astype("<i8").view("<i2")[:, ::4] * np.array(PUBLISHED_STEPS_uT[7])
    return [
        Check("chip", f"readings of fields up to 99 % of the range, GAIN_SEL {gain_sel}", "the fields",
              float((np.abs(inside_uT - field_uT) / step_uT).max()), "counts", 0.51,
              "Rounding to whole counts causes an error of up to half a count, and float32 adds rounding errors."),
        Check("chip", "readings of fields beyond the range, up to 50 mT, GAIN_SEL 7", "the lower 16 bits of the count",
              float((np.abs(read_uT - int16_uT) / PUBLISHED_STEPS_uT[7]).max()), "counts", 0.01,
              "Only rounding errors of float32 occur."),
    ]  # fmt: skip


def noise(chip: ChipDesign, seed: int) -> list[Check]:
    read_uT, _ = read_bare(np.zeros((STILL_FRAMES_N, 3)), chip, rng_for(seed, "verification", "noise"))
    sd_uT = read_uT.std(axis=0)
    # The expected standard deviation combines the design's noise with the error of rounding to counts.
    design_uT = np.array([chip.noise_xy_uT, chip.noise_xy_uT, chip.noise_z_uT])
    expected_uT = np.sqrt(design_uT**2 + steps_uT(chip.gain_sel) ** 2 / 12)
    low_uT, high_uT = np.array([RECORDED_NOISE_uT[axis == 2] for axis in range(3)]).T
    outside_uT = np.maximum(low_uT - sd_uT, sd_uT - high_uT).clip(min=0)
    return [
        Check("chip", "noise of a board at rest", "standard deviation in the settings, plus rounding to counts",
              relative_error(sd_uT, expected_uT), "1", 4 / np.sqrt(2 * STILL_FRAMES_N),
              f"The tolerance is four standard errors. With n = {STILL_FRAMES_N} readings, the relative standard error "
              "of a standard deviation is 1 / sqrt(2 n)."),
        Check("chip", "noise of a board at rest, distance from the range of recorded noise",
              "recorded standard deviations, 3.0-3.7 uT in x and y, 4.5-7.0 uT in z", float(outside_uT.max()), "uT",
              0.1, "The simulated value varies with the random samples, and the recorded values have two digits."),
    ]  # fmt: skip


def temperature(seed: int) -> Check:
    rng = rng_for(seed, "verification", "temperature")
    true_degC = rng.uniform(0, 60, (500, 5))
    raw = np.rint((true_degC - 25) * 45.2 + 46244)  # counts, by the inverse of the data sheet's formula
    error_degC = max_error(read_temperature(true_degC, quiet(7), rng), 25 + (raw - 46244) / 45.2)
    return Check("chip", "temperature", "25 + (raw - 46244) / 45.2, data sheet", error_degC, "degC", 4e-6,
                 "Only rounding errors of float32 occur, which are largest at 60 degC.")  # fmt: skip


FRAMES_N = 300
# A temperature whose float32 bytes contain CR LF, the two bytes that end each frame in a stream.
CRLF_degC = 34.513275
CRLF_SHARE = 0.05  # fraction of temperatures that have this value


def check_frames(gain_sel: int, chips_n: int, seed: int) -> list[Check]:
    """Check encoding and decoding in each wire format, against independent encoders and decoders."""
    frames = make_frames(FRAMES_N, chips_n, gain_sel=gain_sel, rng=rng_for(seed, "verification", "frames"))
    laws: dict[Wire, Callable[[Frames, Wire], list[Check]]] = {
        "binary": binary,
        "binary-clock": binary,
        "text-xyzt": text,
        "text-txyz": text,
    }
    return [check for layout, law in laws.items() for check in law(frames, layout)]


def make_frames(frames_n: int, chips_n: int, *, gain_sel: int, rng: np.random.Generator) -> Frames:
    """Return random frames whose fields are whole counts of the chip; some temperatures contain the bytes CR LF."""
    counts = rng.integers(-20_000, 20_000, (frames_n, chips_n, 3))
    b_uT = (counts * steps_uT(gain_sel)).reshape(frames_n, -1).astype(np.float32)
    usual_degC = (rng.integers(2000, 4000, (frames_n, chips_n)) / 100).astype(np.float32)
    temperature_degC = np.where(rng.random(usual_degC.shape) < CRLF_SHARE, np.float32(CRLF_degC), usual_degC)
    return Frames(b_uT, temperature_degC, np.arange(frames_n) / 512.0, np.zeros(frames_n, np.int64))


def binary(frames: Frames, layout: Wire) -> list[Check]:
    values, clock = _txyz(frames), "f" if layout == "binary-clock" else ""
    form = struct.Struct(f"<{clock}{values.shape[1]}fcc")
    rows = np.column_stack([frames.device_s, values]).tolist() if clock else values.tolist()
    theirs = b"".join(form.pack(*row, b"\r", b"\n") for row in rows)
    ours = wire.encode(frames, layout)
    unpacked = np.array([row[:-2] for row in form.iter_unpack(ours)])[:, len(clock) :]
    decoded, _ = decode_all(theirs, layout, frames.temperature_degC.shape[1], "verification")
    same = "Encoding and decoding must not change any bit."
    return [
        Check(f"frames, {layout}", "bytes that the simulator encodes", f"bytes from Python's struct {form.format!r}",
              _differing(ours, theirs), "bytes", 0.0, same),
        Check(f"frames, {layout}", "values that struct decodes from the simulator's bytes",
              f"the encoded values (struct {form.format!r})", float(np.abs(unpacked - values).max()),
              "uT or degC", 0.0, same),
        Check(f"frames, {layout}", "values that our decoder reads, also if a value contains the bytes CR LF",
              "the values that struct encoded", _missed(decoded, values), "uT or degC", 0.0, same),
    ]  # fmt: skip


def text(frames: Frames, layout: Wire) -> list[Check]:
    values = _txyz(frames)
    numbers = values.reshape(len(frames), -1, 4)
    ordered = numbers if layout == "text-txyz" else np.roll(numbers, -1, axis=2)
    # AnySkin's firmware sends layout text-txyz. It writes no tab between the values of two chips.
    gap = "" if layout == "text-txyz" else "\t"
    lines = [gap.join("\t".join(f"{value:.2f}" for value in chip) for chip in row) + gap for row in ordered.tolist()]
    theirs = "".join(line + "\r\n" for line in lines).encode()
    ours = wire.encode(frames, layout)
    decoded, _ = decode_all(theirs, layout, frames.temperature_degC.shape[1], "verification")
    return [
        Check(f"frames, {layout}", "bytes that the simulator encodes", "text that Python formats with two decimals",
              _differing(ours, theirs), "bytes", 0.0, "Both must write the same text."),
        Check(f"frames, {layout}", "values that our decoder reads", "the values before they were written as text",
              _missed(decoded, values), "uT or degC", 5.5e-3,
              "Two decimals cause an error of up to 0.005, and float32 adds rounding errors."),
    ]  # fmt: skip


def _txyz(frames: Frames) -> np.ndarray:
    b_uT = frames.b_uT.reshape(len(frames), -1, 3)
    return np.concatenate([frames.temperature_degC[:, :, None], b_uT], axis=2).reshape(len(frames), -1)


def _differing(ours: bytes, theirs: bytes) -> float:
    return float(abs(len(ours) - len(theirs)) + sum(a != b for a, b in zip(ours, theirs, strict=False)))


def _missed(decoded: Frames, values: np.ndarray) -> float:
    decoded_values = _txyz(decoded)
    return float(np.abs(decoded_values - values).max()) if decoded_values.shape == values.shape else np.inf


# Number of indentations, time from one indentation to the next, and times of lowering and of holding the tip.
POKES_N, CYCLE_S, RAMP_S, HOLD_S = 20, 1.5, 0.3, 0.7
NAME = "relaxation of the force"
STATE = np.array([0.7, -0.2, 0.4])  # state of the relaxation before a time step, one value per relaxation time
RATIOS = (1e3, 1e4, 1e5, 1e6, 1e7, 1e8)  # slowest / fastest relaxation time; the fastest is 1 ms
STEPS = (1e-16, 1e-9, 1e-3, 1.0, 40.0, 1e8)  # time step / fastest relaxation time
ROUNDING = 1e-14  # relative rounding error of a few dozen operations on doubles


def check_relaxation() -> list[Check]:
    """Check the relaxation of the force: in repeated indentations, in single time steps, and in a held indentation."""
    steps = [step_error(1e-3 * dt, stiff(ratio)) for ratio, dt in product(RATIOS, STEPS)]
    return [
        many_pokes(),
        Check(NAME, "one step dt, with tau_max / tau_min from 1e3 to 1e8 and dt / tau_min from 1e-16 to 1e8",
              "the same formula, evaluated with 50 digits (mpmath)", float(np.max(steps)), "1", ROUNDING,
              "Only the rounding errors of a few dozen operations on doubles occur."),
        held(np.geomspace(1e-5, 1e6, 200) - 1e-5),
    ]  # fmt: skip


def stiff(ratio: float) -> Prony:
    """Return a Prony series with three relaxation times: 1 ms, `ratio` ms, and the geometric mean of these two."""
    return Prony(np.array([1e-3, 1e-3 * np.sqrt(ratio), 1e-3 * ratio]), np.array([0.3, 0.2, 0.1]))


def many_pokes() -> Check:
    starts_s = CYCLE_S * np.arange(POKES_N)
    time_s = np.sort(np.concatenate([starts_s, starts_s + RAMP_S, starts_s + RAMP_S + HOLD_S]))
    elastic = np.tile([0.0, 2.0, 2.0], POKES_N)
    error = scaled_error(relax(time_s, elastic, SKIN_RELAXATION), hereditary(time_s, elastic, SKIN_RELAXATION))
    return Check(NAME, f"{POKES_N} pokes over {POKES_N * CYCLE_S:g} s", "hereditary integral with 50 digits (mpmath)",
                 error, "1", 1e-13,
                 "Each of the 60 steps is exact except for rounding errors, which add up.")  # fmt: skip


def held(time_s: Float[np.ndarray, " t"]) -> Check:
    closed = 3.0 * (1 - (SKIN_RELAXATION.share * -np.expm1(-time_s[:, None] / SKIN_RELAXATION.tau_s)).sum(axis=1))
    return Check(NAME, "a poke that is held, up to 12 days", "1 - sum of share * (1 - exp(-t / tau)), in closed form",
                 scaled_error(relax(time_s, np.full(len(time_s), 3.0), SKIN_RELAXATION), closed), "1", 1e-13,
                 "Each of the 200 steps is exact except for rounding errors, which add up.")  # fmt: skip


def step_error(dt_s: float, prony: Prony) -> float:
    """Return the relative error of `aging.advance` in one time step, from its formula evaluated with 50 digits."""
    with mpmath.workdps(50):
        truth = []
        for q, tau, share in zip(STATE.tolist(), prony.tau_s.tolist(), prony.share.tolist(), strict=True):
            x = mpmath.mpf(dt_s) / mpmath.mpf(tau)
            mean = (1 - mpmath.exp(-x)) / x
            truth.append(float(mpmath.exp(-x) * mpmath.mpf(q) + mpmath.mpf(share) * mpmath.mpf(1.3) * mean))
    return scaled_error(advance(STATE, 1.3, dt_s, prony), np.array(truth))


def hereditary(
    time_s: Float[np.ndarray, " t"], elastic: Float[np.ndarray, " t"], prony: Prony
) -> Float[np.ndarray, " t"]:
    """Return the relaxed force at each time, from the hereditary integral of Lee & Radok with 50 digits.

    The integrand is relaxation(t - s) d elastic(s), and the integral is over all earlier times s. Between two
    successive times, the elastic force is linear, so the integral over this interval has a closed form. The function
    sums these closed forms over all intervals. Unlike `aging.relax`, it does not compute the state at one time from the
    state at the time before.
    """
    with mpmath.workdps(50):
        t, e, tau, share = (
            [mpmath.mpf(value) for value in values.tolist()] for values in (time_s, elastic, prony.tau_s, prony.share)
        )
        force = []
        for now_i, now in enumerate(t):
            ramps = [(e[i + 1] - e[i], t[i], t[i + 1]) for i in range(now_i) if e[i + 1] != e[i]]
            memory = sum(
                g * rise * tau_p / (b - a) * (mpmath.exp(-(now - b) / tau_p) - mpmath.exp(-(now - a) / tau_p))
                for rise, a, b in ramps
                for g, tau_p in zip(share, tau, strict=True)
            )
            force.append(float((1 - sum(share)) * e[now_i] + memory))
    return np.array(force)
