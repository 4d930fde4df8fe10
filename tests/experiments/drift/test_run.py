"""Tests of experiments drift and variation on a skin whose field is a simple formula, with the settings of scene ci."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

from pipeline.experiments import drift as drift_pages
from pipeline.experiments import variation as variation_pages
from pipeline.experiments.drift import Drift, add_walk, drift
from pipeline.experiments.variation import Variation, variation
from pipeline.settings import Settings, read_shared_files
from reskin import io
from reskin.data.grid import points_mm
from reskin.errors import ParamsError
from reskin.schema import Readings
from reskin.seeds import rng_for
from tests.data.tables import readings

ROOT = Path(__file__).resolve().parents[3]
# A capture has 390 contacts. With each contact, the no-load field of every channel drifts by DRIFT_uT.
DEPTHS_MM, PASSES_N, DRIFT_uT = (0.6, 1.2), 3, 0.3
EVERY_s, WARMING_K_PER_s = 0.5, 0.01


def capture(name: str, board: str = "b0", skin: str = "s0", gain: float = 1.0, pokes_n: int | None = None) -> Readings:
    """Return a capture with two readings per contact.

    The field change is linear in place and force, and the no-load field drifts.
    """
    places = np.tile(points_mm(), (len(DEPTHS_MM) * PASSES_N, 1))[:pokes_n]
    depth_mm = np.tile(np.repeat(DEPTHS_MM, 65), PASSES_N)[:pokes_n]
    n = len(places)
    target = np.repeat(np.column_stack([places, 2 * depth_mm]), 2, axis=0)
    poke_i = np.repeat(np.arange(n, dtype=np.int32), 2)
    mix = gain * rng_for(0, "mix").normal(0, 10, (3, 15))
    noload_uT = 1000 + DRIFT_uT * poke_i[:, None] * np.ones(15)
    x_mm, y_mm, Fz_N = target.T.astype(np.float32)
    return replace(
        readings(name, board, skin, f=2 * n), source="simulated", indentation=poke_i, n_contacts=poke_i,
        pass_i=poke_i // 130, reading_i=np.tile(np.arange(2, dtype=np.int32), n), x_mm=x_mm, y_mm=y_mm, Fz_N=Fz_N,
        depth_mm=np.repeat(depth_mm, 2).astype(np.float32), b_uT=(noload_uT + target @ mix).astype(np.float32),
        noload_uT=noload_uT.astype(np.float32), t_s=EVERY_s * poke_i,
        temperature_degC=(25 + WARMING_K_PER_s * EVERY_s * poke_i[:, None] * np.ones(5)).astype(np.float32),
    )  # fmt: skip


def write(folder: Path, *captures: Readings) -> Path:
    for one in captures:
        io.write_readings(folder / f"{one.capture}.parquet", [one], {})
    return folder


@pytest.fixture
def scene(tmp_path, monkeypatch) -> dict[str, Any]:
    """Return the command-line options of both stages.

    They select scene ci with longer training, and a cache in the folder of the test.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RESKIN_EXECUTOR", "here")
    settings = YAML(typ="safe").load((ROOT / "pipeline/scenes/ci.yaml").read_text())
    settings["drift"]["training"]["steps_n"] = 300
    settings["variation"]["skins_n"] = 2
    return {
        "settings": Settings("ci", "ci.yaml", settings, read_shared_files(ROOT)),
        "results": tmp_path / "results.json",
    }


def drift_section(scene: dict[str, Any]) -> Drift:
    return scene["settings"].section(Drift, "drift")


def test_errors_are_largest_with_the_no_load_reading_from_the_start_if_the_skin_drifts(scene, tmp_path):
    drift(section=drift_section(scene), indentations=write(tmp_path / "wear", capture("s0-wear")), **scene)
    results = io.read_json(scene["results"])
    numbers = results["numbers"]
    assert {name: numbers[name] for name in ("skins_n", "seeds_n", "train_n", "left_out_units_n")} == {
        "skins_n": 1, "seeds_n": 2, "train_n": 100, "left_out_units_n": 0,
    }  # fmt: skip
    for policy in ("initial", "regular", "each"):
        assert [row["contacts_n"] for row in numbers[policy]] == [100, 200, 300]
    # Under policy "each", a no-load reading before each contact removes the whole drift. Under policy "initial",
    # nothing is removed. Under policy "regular", the drift of at most 20 contacts remains.
    off_uT = {policy: numbers[policy][-1]["noload_off_uT"] for policy in ("initial", "regular", "each")}
    assert off_uT["each"] == 0
    assert off_uT["initial"] == pytest.approx(DRIFT_uT * np.sqrt(np.mean(np.arange(300, 330) ** 2.0)), rel=1e-3)
    ranks = np.arange(300, 330) % 20
    assert off_uT["regular"] == pytest.approx(DRIFT_uT * np.sqrt(np.mean(ranks**2.0)), rel=1e-3)
    last = {policy: numbers[policy][-1]["mse_xy_mm2"] for policy in off_uT}
    assert last["initial"] > 2 * max(last["regular"], last["each"])
    # The skin does not soften, so the force at a given depth stays at 100 % of the early force.
    assert numbers["late"]["force_left_pct"] == pytest.approx(100)
    assert numbers["late"]["indentations_n"] == len(results["drawn"]["late"]["true_N"]) == 30
    assert len(numbers["late"]["network_bias_N"]) == 2
    assert all(row["spread"]["mse_xy_mm2"] > 0 for policy in off_uT for row in numbers[policy])
    assert all(numbers["last_window"][policy]["mse_xy_mm2"]["sd_seeds"] > 0 for policy in off_uT)
    assert {one["verdict"] for one in numbers["findings"]} == {"not judged (fewer than 4 boards)"}
    # The size of the field change of a contact does not depend on the policy.
    db_uT = capture("s0-wear").b_uT - capture("s0-wear").noload_uT
    assert numbers["field"]["contact_uT"] == pytest.approx(np.sqrt(np.mean(db_uT.astype(float) ** 2)), rel=1e-6)
    assert numbers["contact_every_s"] == pytest.approx(EVERY_s)
    assert numbers["lasts_s"] == pytest.approx(389 * EVERY_s)
    assert len(numbers["findings"]) == 4
    assert set(drift_pages.tables(numbers, "simulated")) == {"drift", "drift_findings", "drift_wander"}
    svgs = drift_pages.figures(numbers, results["drawn"], "simulated")
    assert set(svgs) == {"drift.svg", "drift_wander.svg", "drift_force.svg"}
    # A random walk with steps of 0 uT adds nothing, so the errors are those of the last window. Under policy "each",
    # the errors do not depend on the walk, because its no-load readings remove any walk.
    for policy, (without_walk, _) in numbers["wander"].items():
        last = {name: numbers[policy][-1][name] for name in ("accuracy_pct", "mse_xy_mm2", "noload_off_uT")}
        assert {name: without_walk[name] for name in last} == pytest.approx(last)
        assert without_walk["spread"]["mse_xy_mm2"] == pytest.approx(numbers[policy][-1]["spread"]["mse_xy_mm2"])
    assert numbers["wander"]["each"][1]["mse_xy_mm2"] == pytest.approx(numbers["each"][-1]["mse_xy_mm2"], rel=1e-3)


def test_adding_a_random_walk_to_recordings_is_refused(scene, tmp_path):
    wear = write(tmp_path / "wear", replace(capture("s0-wear"), source="recorded"))
    with pytest.raises(ParamsError, match="drift.wander_uT is .* a recorded scene already contains real drift"):
        drift(section=drift_section(scene), indentations=wear, **scene)


@pytest.mark.parametrize(
    ("captures", "sentence"),
    [
        ([capture("c0"), capture("c1")], "the order in time of the 2 captures of skin s0 is unknown"),
        (
            [capture("c0", pokes_n=129)],
            "the shortest capture must be at least drift.every_n . drift.test_n = 130 units long; got 129",
        ),
    ],
)
def test_captures_of_unknown_order_or_too_few_contacts_are_refused(scene, tmp_path, captures, sentence):
    with pytest.raises(ParamsError, match=sentence):
        drift(section=drift_section(scene), indentations=write(tmp_path / "wear", *captures), **scene)
    assert not (tmp_path / ".reskin").exists()


def test_experiment_variation_recovers_the_known_drift_and_gain_of_skins(scene, tmp_path):
    wear = write(tmp_path / "wear", capture("s0-wear"))
    main = write(
        tmp_path / "main", capture("s0"), capture("s1", "b1", "s1", gain=1.5), capture("s2", "b0", "s2", gain=9)
    )
    variation(section=scene["settings"].section(Variation, "variation"), main=main, indentations=wear, **scene)
    results = io.read_json(scene["results"])
    assert results["numbers"]["contact_every_s"] == pytest.approx(EVERY_s)
    # The plotted visits are those within the first 200 contacts.
    assert results["numbers"]["shown_s"] == pytest.approx(199 * EVERY_s)
    # The relative tolerance allows for temperatures in single precision.
    assert results["numbers"]["warmer_K"] == pytest.approx(199 * EVERY_s * WARMING_K_PER_s, rel=1e-4)
    for place in results["numbers"]["places"]:
        # There are three passes. Two of them visit the place within the first 200 contacts.
        assert place["time"]["visits_n"] == 2
        assert place["time"]["raw_change_uT"] == pytest.approx(DRIFT_uT * 130, rel=1e-3)
        # The tolerance is the rounding of fields of 1000 uT to single precision.
        assert place["time"]["db_change_uT"] < 1e-3
        assert place["skins"]["skins"] == ["s0", "s1"]  # Only the first skin of each board is plotted.
        # The second skin has 1.5 times the field of the first, so the two fields differ by half the weaker one. The
        # spread is relative to the rms of both fields.
        assert place["skins"]["spread_pct"] == pytest.approx(100 * 0.5 / np.sqrt((1 + 1.5**2) / 2), rel=1e-4)
    assert set(variation_pages.figures(results["numbers"], results["drawn"], "simulated")) == {
        "variation_time.svg", "variation_skins.svg",
    }  # fmt: skip
    assert len(variation_pages.tables(results["numbers"], "simulated")["variation"]) == 6


AFTER_N = 100


def walk_uT(step_uT: float, seed: int = 0) -> np.ndarray:
    line = capture("s0-wear")
    further = add_walk(line, step_uT, after_n=AFTER_N, seed=seed)
    np.testing.assert_allclose(further.b_uT - line.b_uT, further.noload_uT - line.noload_uT, atol=2e-3)
    # There are two readings per contact, of which the first is used.
    return (further.noload_uT - line.noload_uT)[::2].astype(float)


def test_added_random_walk_grows_with_the_root_of_the_contacts_after_training():
    walk = np.concatenate([walk_uT(2.0, seed) for seed in range(20)], axis=1)
    assert np.abs(walk[:AFTER_N]).max() == 0
    for contacts_n in (1, 16, 256):
        rms_uT = np.sqrt((walk[AFTER_N - 1 + contacts_n] ** 2).mean())
        # The tolerance allows for the sampling error of an rms over 300 random walks.
        assert rms_uT == pytest.approx(2.0 * np.sqrt(contacts_n), rel=0.15)


def test_added_random_walk_is_proportional_to_its_step():
    np.testing.assert_allclose(walk_uT(2.0), 2 * walk_uT(1.0), atol=2e-3)
    assert np.abs(walk_uT(0.0)).max() == 0
