"""Physical effects that the simulation may neglect.

For each effect, the experiment computes how wrong the simulated field and force are if the effect is neglected.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from magpylib.core import magnet_cuboid_Bfield
from scipy.constants import micro, milli
from scipy.spatial.transform import Rotation

from pipeline.experiments.runtime import box_m, midpoints
from pipeline.settings import Settings
from pipeline.simulation import simulation_settings
from pipeline.stage import say
from reskin import io
from reskin.data.grid import CENTRE_MM
from reskin.physics import aging, chip, deformation, layer, magnet
from reskin.physics.aging import Ageing, Memory, Relaxation
from reskin.physics.board import Board, draw_board
from reskin.physics.magnet import Quadrature, change_of_field
from reskin.physics.shear import Friction
from reskin.physics.skin import Skin, changes_of_field, count_beyond_verified, draw_skin, forces, moved_dipoles
from reskin.seeds import rng_for
from reskin.simulation.capture import list_captures
from reskin.simulation.contact import Response, Terms, drag_tip, simulate_response
from reskin.simulation.protocols import Plan
from reskin.simulation.settings import MAIN, SimulationSettings

# Assumed sizes of effects that a scene may neglect.
AGEING = Ageing(settling=0.10, ageing=0.01, fading_per_decade=0.005, wandering_uT=0.2)
RELAXATION = Relaxation(approach_s=0.5, hold_s=0.5)
MEMORY = Memory(share=(0.11, 0.1), tau_s=(5.0, 60.0), contact_s=5.0, rest_s=1.0)
WARMER_K = 1.0  # rise of the skin's temperature
EARTH_T = np.array([20e-6, 0.0, -45e-6])  # the earth's field at a middle latitude
# Places of the indentations for effects inside the skin: between middle and edge, and near the edge.
PLACES_M = ((4e-3, 2e-3), (-6e-3, 4e-3))
BOXES = Quadrature(cell_m=1.5e-3, layers_n=3)  # boxes of magnetic powder, whose own field is computed
FRICTION = Friction(coefficient=0.8)  # between skin and tip; assumed, within a range of 0.5 to 1.2
FEW = 5  # number of indentations for effects that take long to compute
COARSE = Quadrature(cell_m=1.2e-3, layers_n=4)  # nodes for effects that are computed by tracking every node separately


@dataclass(frozen=True)
class Effect:
    """One effect, and the errors that are made if the effect is neglected.

    - term: name of the effect.
    - done: whether the main protocol neglects the effect ("left out") or computes it ("kept").
    - field_pct: rms error of dB, in percent; None if it does not apply.
    - rest_uT: largest error of the no-load field; None if it does not apply.
    - force_pct: rms error of the force, in percent; None if it does not apply.
    - how: how the errors were computed, in words.
    - left_out_by, computed_by: names of the protocols that neglect the effect, and of the protocols that compute it.
      Both are empty if protocols cannot choose whether the effect is computed.
    """

    term: str
    done: str
    field_pct: float | None
    rest_uT: float | None
    force_pct: float | None
    how: str
    left_out_by: tuple[str, ...] = ()
    computed_by: tuple[str, ...] = ()


@dataclass(frozen=True)
class Subject:
    """The first skin of the main protocol, on which all effects are evaluated, and the plan of that protocol."""

    board: Board
    skin: Skin
    coarse: Skin  # the same skin with fewer nodes
    plan: Plan
    tip_m: Float[np.ndarray, "n p 3"]
    used: tuple[str, ...]  # names of the effects that the main protocol computes


def measure(simulation: SimulationSettings, *, seed: int) -> list[Effect]:
    """Compute the errors of neglecting each effect, with the settings of a scene."""
    subject = _make_subject(simulation, seed)
    plain = _simulate(subject, Terms(), seed)
    protocol_effects = *_over_time(subject, plain, seed), _temperature(subject, plain), _friction(subject)
    return [
        *(_by_protocol(effect, simulation) for effect in protocol_effects),
        _earth(plain), *_hold(subject), *_inside(subject), *_free_edge(subject), _steps(plain, simulation),
        _own_field(subject, simulation), _too_deep(simulation, seed),
    ]  # fmt: skip


def _by_protocol(effect: Effect, simulation: SimulationSettings) -> Effect:
    """Return the effect with the names of the protocols that neglect it, and of the protocols that compute it."""
    computed = tuple(name for name, protocol in simulation.protocols.items() if effect.term in protocol.terms)
    return replace(
        effect, left_out_by=tuple(name for name in simulation.protocols if name not in computed), computed_by=computed
    )


def _make_subject(simulation: SimulationSettings, seed: int) -> Subject:
    kind, (board, skin) = simulation.main_boards, list_captures(simulation, MAIN)[0]
    plan = simulation.main.plan(rng_for(seed, "left out"), kind.skin_mm)
    tip_mm = np.stack([plan.x_mm - CENTRE_MM, plan.y_mm - CENTRE_MM, plan.depth_mm], axis=2)
    return Subject(
        draw_board(kind.design, simulation.spreads, seed=seed, name=board),
        draw_skin(simulation.skin, simulation.spreads, seed=seed, name=skin, rule=kind.quadrature.in_si()),
        draw_skin(simulation.skin, simulation.spreads, seed=seed, name=skin, rule=COARSE),
        plan,
        tip_mm * milli,
        simulation.main.terms,
    )


def _over_time(subject: Subject, plain: Response, seed: int) -> list[Effect]:
    """Evaluate ageing, relaxation and memory, from simulations of the whole protocol with and without each effect."""
    n, relaxation = len(subject.plan), RELAXATION
    rows = []
    for name, terms, description in (
        (
            "ageing",
            Terms(ageing=AGEING),
            f"field at rest and force: at the last of {n} contacts; no-load reading before each contact",
        ),
        (
            "relaxation",
            Terms(relaxation=relaxation),
            f"the tip moves down for {relaxation.approach_s:g} s, and is then held for {relaxation.hold_s:g} s",
        ),
        (
            "memory",
            Terms(memory=MEMORY),
            f"each poke is held for {MEMORY.contact_s:g} s, and the next poke follows {MEMORY.rest_s:g} s later",
        ),
    ):
        simulated = _simulate(subject, terms, seed)
        rest_uT = np.abs(simulated.rest_T[-1] - plain.rest_T[-1]).max() / micro
        force_pct = _error_pct(plain.force_N[-1], simulated.force_N[-1])
        field_pct = _error_pct(plain.change_T, simulated.change_T)
        rows.append(Effect(name, _status(name, subject), field_pct, float(rest_uT), force_pct, description))
    return rows


def _temperature(subject: Subject, plain: Response) -> Effect:
    factor = aging.relative_remanence(np.array([WARMER_K]))[0]
    rest_uT = float(np.abs((factor - 1) * plain.rest_T).max() / micro)
    field_pct = _error_pct(plain.change_T, factor * plain.change_T)
    description = f"the skin is {WARMER_K:g} K warmer; a no-load reading is taken before each contact"
    return Effect("temperature", _status("temperature", subject), field_pct, rest_uT, 0.0, description)


def _friction(subject: Subject) -> Effect:
    tip_m = subject.tip_m[:FEW]
    _, pressed = changes_of_field(subject.board, subject.skin, tip_m.reshape(-1, 3))
    dragged = drag_tip(subject.board, subject.skin, tip_m, tilt=subject.plan.tilt[:FEW], friction=FRICTION)
    field_pct = _error_pct(pressed.reshape(dragged.change_T.shape), dragged.change_T)
    force_pct = 100 * float(np.abs(dragged.force_N).max() / forces(subject.skin, tip_m[..., 2].ravel()).max())
    description = (
        f"friction coefficient {FRICTION.coefficient:g}; {FEW} indentations of the protocol, in which the tip does not "
        "move sideways"
    )
    return Effect("friction", _status("friction", subject), field_pct, 0.0, force_pct, description)


def _earth(plain: Response) -> Effect:
    """Evaluate the earth's field, which changes the no-load reading and the contact reading by the same amount."""
    rest_T = plain.rest_T[:, None] + EARTH_T
    measured_T = (rest_T + plain.change_T) - rest_T
    description = (
        "the field is constant, because the board does not rotate; a no-load reading is taken before each contact, and "
        "subtracted"
    )
    rest_uT = float(np.abs(EARTH_T).max() / micro)
    return Effect("the earth's field", "left out", _error_pct(plain.change_T, measured_T), rest_uT, 0.0, description)


def _hold(subject: Subject) -> list[Effect]:
    """Evaluate the effect that the base holds the skin.

    The simulated skin is compared with an infinite linearly elastic layer that slides freely.
    """
    if subject.skin.hold is None:
        return []
    free, deepest_m = replace(subject.skin, hold=None), np.array([subject.tip_m[..., 2].max()])
    pokes_m = subject.tip_m[:FEW].reshape(-1, 3)
    held_T, free_T = (changes_of_field(subject.board, skin, pokes_m)[1] for skin in (subject.skin, free))
    force_pct = _error_pct(forces(free, deepest_m), forces(subject.skin, deepest_m))
    description = (
        "compared with an infinite layer that slides freely, whose force follows from linear elasticity; change of "
        f"field: {FEW} indentations; force: at the largest depth"
    )
    return [Effect("the base's hold", "kept", _error_pct(free_T, held_T), 0.0, force_pct, description)]


def _free_edge(subject: Subject) -> list[Effect]:
    """Evaluate the free edge, by comparison of the simulated infinite layer with a disc of radius R whose edge is free.

    Material at radius r moves outwards by c / r in the infinite layer, where c is a constant. In the disc, it moves
    outwards by c / r + c r / (3 R^2).
    """
    if subject.skin.base == "bonded":
        return []
    depth_m = float(subject.tip_m[..., 2].max())
    poke_m = np.array([[*subject.skin.seat_m, depth_m]])
    [(_, before, after)] = moved_dipoles(subject.skin, poke_m)
    edge_m = min(subject.skin.sides_m) / 2
    offset_m, moved_m = (dipoles[0][:, :2] - subject.skin.seat_m for dipoles in (before, after))
    far = np.argmax(np.hypot(*offset_m.T))
    growth_m2 = float((moved_m[far] ** 2).sum() - (offset_m[far] ** 2).sum())
    stretched_m = np.column_stack(
        [moved_m * (1 + growth_m2 / 2 / (3 * edge_m**2)) + subject.skin.seat_m, after[0][:, 2]]
    )
    endless_T = change_of_field(before, after, subject.board.chips_m)
    ended_T = change_of_field(before, (stretched_m, after[1]), subject.board.chips_m)
    description = (
        f"compared with a disc that has a free edge and a diameter of {2 * edge_m / milli:g} mm, in plane stress, "
        f"poked in its middle to a depth of {depth_m / milli:.2g} mm"
    )
    return [Effect("the skin's free edge", "left out", _error_pct(endless_T, ended_T), 0.0, None, description)]


def _inside(subject: Subject) -> list[Effect]:
    """Evaluate parts of the deformation model by omitting or changing one part at a time, for a few indentations."""
    skin, depth_m = subject.skin, float(subject.tip_m[..., 2].max()) + subject.skin.depth_zero_m
    base: layer.Base = "bonded" if skin.base == "slipping" else "slipping"
    press = layer.IndentedLayer(skin.thickness_m, skin.tip_radius_m, skin.base)
    swapped = replace(press, base=base)
    complete = _flow(subject, depth_m, press)
    swapped_N, complete_N = (
        layer.force(np.array([depth_m]), **asdict(pressed), modulus_Pa=skin.modulus_Pa) for pressed in (swapped, press)
    )
    cases: dict[str, tuple[list[Moved], float, str]] = {
        "rotation of the magnetisation": (
            [(r, z, np.zeros_like(a)) for r, z, a in complete], 0.0, "the magnetic moments do not rotate",
        ),
        "increments": (
            [_one_shot(subject, place_m, depth_m, press) for place_m in PLACES_M], 0.0,
            "the full depth is reached in one linear step",
        ),
        f"{skin.base} base": (
            _flow(subject, depth_m, swapped), _error_pct(swapped_N, complete_N),
            f"the base is {base} instead of {skin.base}",
        ),
    }  # fmt: skip
    complete_T, pokes = _change(subject, complete), f"{len(PLACES_M)} pokes to {depth_m / milli:.2g} mm"
    return [
        Effect(term, "kept", _error_pct(_change(subject, moved), complete_T), 0.0, force_pct, f"{description}; {pokes}")
        for term, (moved, force_pct, description) in cases.items()
    ]


Moved = tuple[Float[np.ndarray, " s"], Float[np.ndarray, " s"], Float[np.ndarray, " s"]]  # r_m, z_m, angle_rad


def _flow(subject: Subject, depth_m: float, press: layer.IndentedLayer) -> list[Moved]:
    """Return the displaced nodes under each indentation, if the depth increases in small steps.

    All indentations have the same depth and thus the same contact pressures. Therefore, a single call to `follow`
    tracks the nodes of all indentations.
    """
    r_m = np.concatenate([np.hypot(*(subject.coarse.nodes_m[:, :2] - place_m).T) for place_m in PLACES_M])
    z_m = np.tile(subject.coarse.nodes_m[:, 2], len(PLACES_M))
    end = deformation.follow(r_m, z_m, deformation.depth_steps((depth_m,), press), press=press)[-1]
    moved = (np.split(values, len(PLACES_M)) for values in (end.r_m, end.z_m, deformation.rotation_angle(end.f)))
    return list(zip(*moved, strict=True))


def _one_shot(subject: Subject, place_m: tuple[float, float], depth_m: float, press: layer.IndentedLayer) -> Moved:
    """Return the displaced nodes under one indentation, if the full depth is reached in a single linear step."""
    r_m, z_m = np.hypot(*(subject.coarse.nodes_m[:, :2] - place_m).T), subject.coarse.nodes_m[:, 2].copy()
    u = layer.displacement(r_m, z_m, layer.waves(press.contact(depth_m), press.thickness_m, press.base))
    return r_m + u.r_m, z_m + u.z_m, (u.r_z - u.z_r) / 2


def _change(subject: Subject, moved: Sequence[Moved]) -> Float[np.ndarray, "p k 3"]:
    """Return dB at the chips for each indentation, from its displaced nodes."""
    skin, changes_T = subject.coarse, []
    for place_m, (moved_r_m, moved_z_m, angle_rad) in zip(PLACES_M, moved, strict=True):
        away_m = skin.nodes_m[:, :2] - place_m
        r_m = np.hypot(*away_m.T)
        out = away_m / np.where(r_m > 0, r_m, 1.0)[:, None]
        moved_m = np.column_stack([place_m + out * moved_r_m[:, None], moved_z_m])
        axis = np.column_stack([-out[:, 1], out[:, 0], np.zeros(len(out))])
        moments = Rotation.from_rotvec(angle_rad[:, None] * axis).apply(skin.moments_A_m2)
        changes_T.append(change_of_field((skin.nodes_m, skin.moments_A_m2), (moved_m, moments), subject.board.chips_m))
    return np.array(changes_T)


def _steps(plain: Response, simulation: SimulationSettings) -> Effect:
    change_uT = plain.change_T / micro
    step_uT = chip.steps_uT(simulation.chip.gain_sel)
    fraction = np.sqrt((step_uT**2 / 12).mean() / (change_uT**2).mean())
    return Effect(
        "the chips' steps", "kept", float(100 * fraction), float(step_uT.max() / 2), 0.0, "only rounding, no noise"
    )


def _own_field(subject: Subject, simulation: SimulationSettings) -> Effect:
    """Evaluate how much the magnetic field of the powder itself changes the magnetisation of the powder.

    The effect is computed to first order. The powder's field is computed with magpylib, as the field of uniformly
    magnetised boxes.
    """
    rest = midpoints(subject.skin.thickness_m, BOXES)
    b_T = magnet.array_field(rest.nodes_m, subject.skin.thickness_m, simulation.skin.polarity)
    sizes = {"saturation_T": simulation.skin.saturation_T, "half_field_T": simulation.skin.half_field_T}
    j_T, boxes_n = magnet.magnetise(b_T, **sizes), len(b_T)
    away_m = (rest.nodes_m[:, None] - rest.nodes_m).reshape(-1, 3)
    boxes_m = np.tile(box_m(subject.skin.thickness_m, BOXES), (boxes_n**2, 1))
    own_T = magnet_cuboid_Bfield(away_m, boxes_m, np.tile(j_T, (boxes_n, 1))).reshape(boxes_n, boxes_n, 3).sum(axis=1)
    with_own_T = magnet.magnetise(b_T + own_T - j_T, **sizes)  # the field that magnetises the powder is mu0 H = B - J
    pokes_m = np.array([(*place_m, float(subject.tip_m[..., 2].max())) for place_m in PLACES_M])
    nodes_m = rest.nodes_m + np.append(subject.skin.seat_m, 0.0)
    moments = [magnet.moments(magnetisation_T, rest.volumes_m3) for magnetisation_T in (j_T, with_own_T)]
    skins = [replace(subject.skin, nodes_m=nodes_m, moments_A_m2=moments_A_m2) for moments_A_m2 in moments]
    changes_T = [changes_of_field(subject.board, skin, pokes_m)[1] for skin in skins]
    description = (
        f"computed to first order, for {boxes_n} boxes of powder and {len(PLACES_M)} pokes; the magnetisation itself "
        f"changes by {_error_pct(j_T, with_own_T):.2g} %"
    )
    return Effect("the powder's own field", "left out", _error_pct(*changes_T), None, 0.0, description)


def _too_deep(simulation: SimulationSettings, seed: int) -> Effect:
    """Return the effect of depths beyond 0.6 of the thickness, which published solutions do not cover.

    The error at such depths is unknown. The description states the percentage of stops at such depths, over all skins.
    """
    depth_m = milli * simulation.main.plan(rng_for(seed, "left out"), simulation.main_boards.skin_mm).depth_mm.ravel()
    skins = [
        draw_skin(simulation.skin, simulation.spreads, seed=seed, name=skin, rule=COARSE)
        for _, skin in list_captures(simulation, MAIN)
    ]
    share_pct = 100 * sum(count_beyond_verified(skin, depth_m) for skin in skins) / (len(depth_m) * len(skins))
    description = (
        f"not computed, because no published solution covers these depths; {share_pct:.3g} % of the stops of "
        f"{len(skins)} skins are deeper than 0.6 of the thickness"
    )
    return Effect("depths past 0.6 of the thickness", "kept", None, None, None, description)


def _simulate(subject: Subject, terms: Terms, seed: int) -> Response:
    rng = rng_for(seed, "left out", "walk")
    return simulate_response(subject.board, subject.skin, subject.tip_m, tilt=subject.plan.tilt, terms=terms, rng=rng)


def _status(term: str, subject: Subject) -> str:
    return "kept" if term in subject.used else "left out"


def _error_pct(without: Float[np.ndarray, "..."], true: Float[np.ndarray, "..."]) -> float:
    return float(100 * np.linalg.norm(without - true) / np.linalg.norm(true))


def neglected_effects(settings: Settings, results: Path) -> None:
    """Evaluate every effect on the scene's first skin, and list the protocols that neglect it."""
    simulation, seed = simulation_settings(settings), settings.seed
    effects = measure(simulation, seed=seed)
    io.write_json(results, [asdict(effect) for effect in effects])
    neglected = ", ".join(effect.term for effect in effects if effect.done == "left out")
    say(f"{settings.scene}: computed the errors of these effects, which the main protocol neglects: {neglected}")


MEANING = (
    "The error that is made if an effect is neglected. It is computed for the first skin and the main protocol of this "
    "scene, even if this protocol does not neglect the effect. Change of field: root mean square error over all "
    "changes of field, relative to their root mean square. Field at rest: largest error of the no-load field, before "
    "it is subtracted. Force: relative error of the force. Two effects are always neglected, and their errors are not "
    "known: the corner tabs of the skin, and the single screws that hold the skin."
)


def neglected_effects_table(rows: Sequence[Mapping[str, Any]], source: str) -> pd.DataFrame:
    """Tabulate every effect and the protocols that neglect it. Effects that the main protocol neglects come first."""
    ordered = sorted(rows, key=lambda row: row["done"] != "left out")
    table = pd.DataFrame(
        {
            "effect": row["term"],
            "in this scene": _where(row),
            "error of the change of field, %": _show(row["field_pct"]),
            "error of the field at rest, µT": _show(row["rest_uT"]),
            "error of the force, %": _show(row["force_pct"]),
            "measured": row["how"],
            "source": source,
        }
        for row in ordered
    )
    table.attrs["meaning"] = MEANING
    return table


def _where(row: Mapping[str, Any]) -> str:
    protocols_by_status = {"neglected": row["left_out_by"], "computed": row["computed_by"]}
    text = "; ".join(
        f"{status}: {', '.join(protocols)}" for status, protocols in protocols_by_status.items() if protocols
    )
    return text or row["done"].replace("left out", "neglected")


def _show(value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"
