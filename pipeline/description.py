"""Summarise the readings of a skin: fields, noise, resolution and forces, as numbers with units in their names.

Simulated and recorded skins are summarised in the same way, so that they can be compared.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int64, Shaped

from pipeline.statistics import summarise
from reskin.board.faults import find_lsb
from reskin.schema import AXES_PER_CHIP_N, Readings

FORCES_N = (0.5, 1.0, 2.0, 3.0)  # forces at which field changes are compared
NEAR = 0.2  # a reading belongs to a force in `FORCES_N` if the relative difference of the forces is at most this
LARGEST = "force_max_N"
ENOUGH_N = 20  # a statistic is computed only if there are at least this many readings
LAGS_N = (1, 10, 100, 1000)  # numbers of contacts between the two no-load readings that are compared
STEP_READINGS_N = 2000  # number of readings that determine the chips' resolution
PRESSED_N = 0.5  # below this force, the field change of a weak chip is mostly noise


def describe(readings: Readings) -> dict[str, float]:
    """Summarise the readings of one capture: values by quantity; quantities with too few readings are omitted."""
    # A reading with a force but without a place is not a contact. A reading without either is an unlabelled contact.
    touched = ~(readings.Fz_N <= 0) & ~(np.isnan(readings.x_mm) & ~np.isnan(readings.Fz_N))
    change_uT = readings.db_uT.astype(np.float64)
    return {
        **_rest(readings.noload_uT),
        **_wander(readings),
        **_noise(readings, touched),
        **_steps(readings),
        **_rate(readings),
        **_forces(readings.Fz_N[touched]),
        **_changes(change_uT[touched], readings.Fz_N[touched]),
    }


def without_rest(described: Mapping[str, float]) -> dict[str, float]:
    """Remove the fields at rest and their changes, because they are unknown if the recorder subtracted a baseline."""
    prefixes = ("field_at_rest", "rest_changes")
    return {name: number for name, number in described.items() if not name.startswith(prefixes)}


def over_skins(described: Sequence[tuple[str, Mapping[str, float]]]) -> dict[str, dict[str, float]]:
    """Summarise every quantity over skins: mean, standard deviation, minimum and maximum.

    described: pairs of a skin's name and the description of one of its captures. The descriptions of a skin's captures
    are averaged first. Only the largest force is not averaged; it is the largest force in all captures of the skin.
    """
    rows = pd.DataFrame([numbers for _, numbers in described])
    by_skin = rows.groupby([skin for skin, _ in described], sort=False)
    skins = by_skin.mean()
    if LARGEST in skins:
        skins[LARGEST] = by_skin[LARGEST].max()
    weak, strong = "change_at_1_N_uT", "change_at_3_N_uT"
    if {weak, strong} <= set(skins):  # computed per skin, because a capture may contain only one of the two forces
        skins["change_at_3_N_over_1_N"] = skins[strong] / skins[weak]
    summary = summarise(skins)
    return {name: stat.to_json() | {"least": float(skins[name].min()), "most": float(skins[name].max())}
            for name, stat in summary.items()}  # fmt: skip


def rank(label: Shaped[np.ndarray, " f"]) -> Int64[np.ndarray, " f"]:
    """Number the runs of equal labels, and return the number of its run for each row.

    A run consists of successive rows with the same label. Runs are numbered from 0. `label` is, for example, the
    indentation or the pass of each row of a capture, in order of time.
    """
    return np.cumsum(np.concatenate([[0], label[1:] != label[:-1]])).astype(np.int64)[: len(label)]


def first_rows(readings: Readings) -> Int64[np.ndarray, " n"]:
    """Return the number of the first reading of each indentation."""
    return np.unique(rank(readings.indentation), return_index=True)[1]


def rms(values: Float[np.ndarray, "..."]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values.astype(float) ** 2)))


def norm_error(found: Float[np.ndarray, "*any"], truth: Float[np.ndarray, "*any"]) -> float:
    """Return rms error / rms true value."""
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


def _rest(noload_uT: Float[np.ndarray, "f ch"]) -> dict[str, float]:
    b_uT = np.abs(np.median(noload_uT.astype(np.float64), axis=0)).reshape(-1, AXES_PER_CHIP_N)
    return {
        "field_at_rest_chip_median_uT": float(np.median(np.linalg.norm(b_uT, axis=1))),
        "field_at_rest_channel_max_uT": float(b_uT.max()),
    }


def _wander(readings: Readings) -> dict[str, float]:
    """Return the rms difference between the fields at rest before two contacts, for each lag in `LAGS_N`.

    The lag is the number of contacts between the two fields at rest. The result helps to distinguish two causes of a
    difference. If the field at rest is a random walk, the difference grows as the square root of the lag. If contacts
    have after-effects, the difference has its full size already at lag 1, and it repeats when the rig presses the same
    places again in the same order.
    """
    rest_uT = readings.noload_uT[first_rows(readings)].astype(np.float64)
    lags = [lag_n for lag_n in LAGS_N if len(rest_uT) >= 2 * lag_n + ENOUGH_N]
    return {
        f"rest_changes_in_{lag_n}_uT": float(np.sqrt(((rest_uT[lag_n:] - rest_uT[:-lag_n]) ** 2).mean()))
        for lag_n in lags
    }


def _noise(readings: Readings, touched: Bool[np.ndarray, " f"]) -> dict[str, float]:
    """Return the standard deviation of one reading's noise (median over chips), for x and y together and for z."""
    # An indentation has stops, during which the tip does not move. Deviations of readings from the mean of their stop
    # are therefore noise. The variance of the noise is pooled over all stops.
    stops = [column[touched] for column in (readings.indentation, readings.x_mm, readings.y_mm)]
    by_stop = pd.DataFrame(readings.b_uT[touched].astype(np.float64)).groupby(stops, dropna=False, sort=False)
    dof_n = int(touched.sum()) - by_stop.ngroups
    if dof_n < ENOUGH_N:
        return {}
    deviation_uT = readings.b_uT[touched] - by_stop.transform("mean").to_numpy()
    sd_uT = np.sqrt((deviation_uT**2).sum(axis=0) / dof_n).reshape(-1, AXES_PER_CHIP_N)
    return {"noise_xy_uT": float(np.median(sd_uT[:, :2])), "noise_z_uT": float(np.median(sd_uT[:, 2]))}


def _steps(readings: Readings) -> dict[str, float]:
    """Return the size of one digital step (median over chips), for x and y together and for z."""
    lsb_uT = find_lsb(readings.b_uT[:STEP_READINGS_N])
    known = {"step_xy_uT": lsb_uT[:, 0], "step_z_uT": lsb_uT[:, 1]}
    return {name: float(np.nanmedian(steps)) for name, steps in known.items() if np.isfinite(steps).any()}


def _rate(readings: Readings) -> dict[str, float]:
    """Return the median rate of readings within a stop, in Hz, if the capture has a clock."""
    between_s = np.diff(readings.t_s)[(np.diff(readings.indentation) == 0) & (np.diff(readings.reading_i) == 1)]
    known_s = between_s[between_s > 0]  # captures without a clock have NaN as times, which this excludes
    return {"rate_hz": float(1 / np.median(known_s))} if len(known_s) >= ENOUGH_N else {}


def _forces(force_N: Float[np.ndarray, " f"]) -> dict[str, float]:
    known_N = force_N[np.isfinite(force_N)]
    if len(known_N) < ENOUGH_N:
        return {}
    return {"force_median_N": float(np.median(known_N)), LARGEST: float(known_N.max())}


def _changes(change_uT: Float[np.ndarray, "f ch"], force_N: Float[np.ndarray, " f"]) -> dict[str, float]:
    """Return the median field change at each force in `FORCES_N`, and the median ratio of weakest to strongest chip."""
    size_uT = np.linalg.norm(change_uT, axis=1)
    numbers = {}
    for level_N in FORCES_N:
        near = np.abs(force_N - level_N) <= NEAR * level_N
        if near.sum() >= ENOUGH_N:
            numbers[f"change_at_{level_N:g}_N_uT"] = float(np.median(size_uT[near]))
    chips_uT = np.linalg.norm(
        change_uT.reshape(len(change_uT), change_uT.shape[1] // AXES_PER_CHIP_N, AXES_PER_CHIP_N), axis=2
    )
    pressed = ~(force_N < PRESSED_N)
    if pressed.sum() >= ENOUGH_N and chips_uT.shape[1] > 1:
        ratio = chips_uT[pressed].min(axis=1) / chips_uT[pressed].max(axis=1)
        numbers["weakest_over_strongest_chip"] = float(np.median(ratio))
    return numbers
