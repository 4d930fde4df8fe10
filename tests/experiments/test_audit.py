"""Tests of the audit: files without leaks pass, and each planted leak is named."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pipeline.experiments import audit as experiment
from pipeline.experiments.audit import AuditSettings, Check, audit, check_fold
from pipeline.settings import Adaptations, Settings, Training
from pipeline.training import jobs as _training
from pipeline.training.jobs import SceneData, adaptation_jobs, make_jobs, read_data, read_pretrained, write_models
from reskin import io
from reskin.data.rows import Rows, Selection, gather, load_rows
from reskin.data.splits import Fold, Split, draw_folds, render_folds
from reskin.errors import LeakError, ParamsError
from reskin.models.batches import prepare
from reskin.models.inputs import FIT, VIEW
from reskin.models.job import TrainingData, TrainingJob, TrainingResult
from reskin.schema import Readings
from reskin.seeds import rng_for
from tests.data.tables import readings
from tests.scenes import ADAPTATIONS, RECIPE, SHARED, TRAINING, recorded_scene, settings
from tests.simulation.scene import SECTIONS

PLACES_N, PASSES_N, READINGS_N, CH_N = 16, 2, 2, 15
NONE = np.zeros(0, np.int64)
PHYSICS = ("skin", "rig", "chip", "spreads")
SKINS = ("b0_s0", "b0_s1", "b1_s0", "b2_s0")
COPY = "b3_s0"  # a copy of skin b0_s0 that is labelled as a skin of another board
SCENE = recorded_scene(
    source="simulated",
    seed=2021,
    experiments=["single_random", "lobo", "triplet", "adapt", "audit"],
    split={"random_test_fraction": 0.1, "random_repeats_n": 1, "pool_passes_n": 1},
    train_single=TRAINING,
    train_multi=TRAINING | {"variants": {"shape": {"inputs": "shape"}}},
    train_triplet=TRAINING | {"recipe": "triplet"},
    adapt=ADAPTATIONS,
    audit={"settings": "chosen"},
)
CHOSEN = {
    stage: {name: value for name, value in recipe.items() if name not in ("steps_n", "base")}
    for stage, recipe in (
        ("train_multi", RECIPE),
        ("train_triplet", RECIPE | {"triplet_weight": 0.1}),
        ("adapt", SHARED["adaptations"]["paper"]),
    )
}
CHOICE = {
    "scene": "tuning", "source": "simulated", "seed": 777, "boards": ["b0", "b1"], "skins": ["b0_s0", "b1_s0"],
    "chosen": CHOSEN,
}  # fmt: skip


def capture(skin: str) -> Readings:
    """Return readings of two passes over a grid of places; the field of each skin depends on the place."""
    rng = rng_for(0, "skin", "b0_s0" if skin == COPY else skin)
    place_i = np.tile(np.arange(PLACES_N), PASSES_N)
    x, y = place_i // 4, place_i % 4
    waves = np.stack([np.ones(len(x)), np.sin(x), np.cos(x), np.sin(y), np.cos(y)], axis=1)
    still_uT = (waves @ rng.normal(0, 120, (5, CH_N))).repeat(READINGS_N, axis=0)
    f = len(still_uT)
    db_uT = (still_uT + rng_for(0, "noise", skin).normal(0, 3, still_uT.shape)).astype(np.float32)
    indentation = np.arange(f, dtype=np.int32) // READINGS_N
    return readings(
        skin, skin[:2], skin, f, source="simulated", indentation=indentation, pass_i=indentation // PLACES_N,
        x_mm=np.float32(4) * x.repeat(READINGS_N).astype(np.float32),
        y_mm=np.float32(4) * y.repeat(READINGS_N).astype(np.float32),
        b_uT=100 + db_uT, noload_uT=np.full((f, CH_N), 100, np.float32),
        temperature_degC=np.full((f, CH_N // 3), 25, np.float32),
    )  # fmt: skip


def build(folder: Path, skins: tuple[str, ...] = SKINS) -> Path:
    """Write the files that the stages of a scene would write, with networks that are not trained."""
    files = [folder / f"indentations/{skin}.parquet" for skin in skins]
    for skin, file in zip(skins, files, strict=True):
        io.write_readings(file, [capture(skin)], {})
    of_scene = settings(SCENE)
    rows = load_rows(files, of_scene.section(Selection, "selection"))
    folds = draw_folds(rows, ("single_random", "lobo"), of_scene.section(Split, "split"), of_scene.seed)
    io.write_json(folder / "folds.json", render_folds(skins, rows, folds))
    data = load_data(folder)

    def write(stage: str, jobs: list[TrainingJob]) -> None:
        write_models(folder / "models" / stage, data, jobs, [untrained(job, data) for job in jobs], stage)

    single, lobo = (data.folds_of(name) for name in ("single_random", "lobo"))
    write("train_single", make_jobs(data, of_scene.section(Training, "train_single"), single))
    write("train_multi", make_jobs(data, of_scene.section(Training, "train_multi"), lobo))
    write("train_triplet", make_jobs(data, of_scene.section(Training, "train_triplet"), lobo, experiment="triplet"))
    bases, named = (
        read_pretrained(folder / "models/train_triplet"),
        ("paper", of_scene.section(Adaptations, "adapt").recipes["paper"]),
    )
    adapted = [adaptation_jobs(data, fold, named, bases, experiment="adapt", pokes_n=8) for fold in lobo]
    write("adapt", [job for jobs in adapted for job in jobs])
    io.write_json(folder / "choice.json", CHOICE)
    return folder


def untrained(job: TrainingJob, data: SceneData) -> TrainingResult:
    prepared, scaler = prepare(job, TrainingData(data.rows.db_uT, data.rows.target, data.rows.skin))
    predicted = np.zeros((len(job.test), 3), np.float32)
    key = f"key of {job.name}"
    return TrainingResult(key, prepared.initial_weights, scaler, [1.0], predicted, None, None, 0.0, 0.0, 0.0)


def load_data(folder: Path) -> SceneData:
    return read_data(settings(SCENE), folder / "indentations", folder / "folds.json")


@pytest.fixture(scope="module")
def clean_scene(tmp_path_factory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("clean")
        patch.chdir(folder)  # the stages write a file with their run times to the working folder
        patch.setattr(_training, "code_version_of", lambda modules: "abc")
        return build(folder / "scene")


@pytest.fixture
def scene(clean_scene, tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return shutil.copytree(clean_scene, tmp_path / "scene")


def run_audit(folder: Path, **section: object) -> list[dict]:
    of_scene: Settings = settings(SCENE, **{name: SECTIONS[name] for name in PHYSICS})
    section_ = AuditSettings(**({"settings": "chosen"} | section))
    files = [folder / name for name in ("indentations", "folds.json", "models", "choice.json", "audit.json")]
    audit(of_scene, section_, *files)
    return io.read_json(folder / "audit.json")["numbers"]


def assert_leak(folder: Path, sentence: str) -> None:
    with pytest.raises(LeakError, match=f"audit of tiny, {sentence}"):
        run_audit(folder)
    assert not (folder / "audit.json").exists()


def test_files_without_leaks_pass_all_checks(scene):
    checks = run_audit(scene)
    where = {what: {check["where"] for check in checks if check["what"] == what} for what in experiment.RULES}
    assert where["copies"] == where["pool skins"] == {"lobo/b0", "lobo/b1", "lobo/b2"}
    networks = {f"{name}.b{i}.seed0" for name in ("lobo.paper", "lobo.shape", "triplet.paper") for i in range(3)}
    adapted = {f"adapt.paper.{skin}.8pokes.seed0" for skin in ("b0.b0_s0", "b0.b0_s1", "b1.b1_s0", "b2.b2_s0")}
    assert where["scaler"] == networks | adapted | {"single_random.paper.repeat0.seed0"}
    assert where["base"] == where["pokes"] == adapted
    assert where["settings: recipe"] == {"train_single", "train_multi", "train_triplet", "adapt"}
    # Only the paper's random split has a leak, which is known.
    assert [(check["where"], check["known"]) for check in checks if not check["holds"]] == [
        ("single_random/repeat0", True)
    ]
    (scene / "choice.json").unlink()  # not needed if settings were not chosen
    assert not any(check["what"].startswith("settings") for check in run_audit(scene, settings="for speed"))


# --- Leaks in files ---


@pytest.mark.parametrize("seen_n", [1, 32])
@pytest.mark.parametrize(("stage", "name"), [("train_multi", "lobo.shape"), ("train_triplet", "triplet.paper")])
def test_scaler_fitted_to_test_rows_is_detected(scene, stage, name, seen_n):
    file, data = scene / f"models/{stage}/{name}.b1.seed0.safetensors", load_data(scene)
    (fold,) = (one for one in data.folds_of("lobo") if one.name == "b1")
    seen = np.concatenate([fold.train, fold.test[:seen_n]])
    view_uT = VIEW["shape" if "shape" in name else "raw"](data.rows.db_uT[seen])
    io.write_tensors(file, io.read_tensors(file)[0] | FIT["standard"](view_uT, data.rows.target[seen]).arrays(), {})
    assert_leak(scene, f"{name}.b1.seed0, scaler: .* Rule: the scaler was fitted to the training rows alone")


@pytest.mark.parametrize(
    ("source", "side", "moved", "sentence"),
    [
        ("test", "train", True, "boards: 1 of 1 on both sides: b0"),
        ("test", "train", False, "readings: 1 of 64 on both sides"),
        ("test", "pool", False, "readings: 1 of 64 on both sides"),
        ("test", "pool", True, "pool indentations: 1 of 33 on both sides"),
        ("train", "pool", True, "pool skins: 1 skins are not held out: b1_s0"),
    ],
)
def test_fold_with_a_reading_on_a_wrong_side_is_detected(scene, source, side, moved, sentence):
    data = load_data(scene)
    (fold,) = (fold for fold in data.folds_of("lobo") if fold.name == "b0")
    rows = getattr(fold, source)
    leak = replace(fold, **{side: np.union1d(getattr(fold, side), rows[:1])} | ({source: rows[1:]} if moved else {}))
    folds = [leak if other is fold else other for other in data.folds]
    io.write_json(scene / "folds.json", render_folds(SKINS, data.rows, folds))
    assert_leak(scene, f"lobo/b0, {sentence}")


def test_copied_capture_is_named_until_the_scene_accepts_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(_training, "code_version_of", lambda modules: "abc")
    folder = build(tmp_path / "scene", (*SKINS, COPY))
    remedy = r"reskin remove tiny b0_s0\. .*tiny.yaml: similar_skins: \[\[b0_s0, b3_s0\]\]"
    assert_leak(folder, rf"lobo/b0, copies: 100.0 % of the indentations of capture b0_s0 match skin b3_s0\. .*{remedy}")
    checks = run_audit(folder, similar_skins=(("b0_s0", "b3_s0"),))
    assert [check["where"] for check in checks if check["what"] == "copies" and check["known"]] == [
        "lobo/b0",
        "lobo/b3",
    ]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda tuning, test, train: tuning | {"from": "key of another fold"}, "base: it was not"),
        (lambda tuning, test, train: tuning | {"indentations": test}, "pokes: of 3 indentations, 3 are tested"),
        (lambda tuning, test, train: tuning | {"indentations": train}, "pokes: .* and 3 are not in the pool"),
    ],
    ids=["a network of another fold", "test pokes", "pokes of a training skin"],
)
def test_wrong_network_or_wrong_pokes_in_an_adaptation_are_detected(scene, change, sentence):
    file = next((scene / "models/adapt").glob("*.json"))
    card, data = io.read_json(file), load_data(scene)
    fold = next(fold for fold in data.folds_of("lobo") if fold.name == card["fold"])
    pokes = [np.unique(data.rows.indentation[side])[:3].tolist() for side in (fold.test, fold.train)]
    io.write_json(file, card | {"tuning": change(card["tuning"], *pokes)})
    assert_leak(scene, f"{file.stem}, {sentence}")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"seed": 2021}, "settings: boards: 2 of 3 tested boards are boards of scene tuning: b0, b1"),
        ({"seed": 2021, "boards": ["b9"]}, "settings: skins: 2 of .*: b0_s0, b1_s0"),
    ],
    ids=["board", "skin"],
)
def test_settings_chosen_on_test_boards_or_skins_are_detected(scene, changes, sentence):
    io.write_json(scene / "choice.json", CHOICE | changes)
    assert_leak(scene, f"all folds, {sentence}")


# --- Copies ---


ROWS = gather([capture(f"b{i // 2}_s{i % 2}") for i in range(6)], Selection(force_min_N=0.0))
ROWS = replace(ROWS, capture=np.char.add("c_", ROWS.skin))
SOURCE, TARGET = ROWS.skin == "b2_s1", ROWS.skin == "b0_s1"  # skin b0_s1 will be a copy of skin b2_s1


def checks_of(db_uT: np.ndarray, rows: Rows = ROWS, board: str = "b0", **section: object) -> list[Check]:
    """Check a fold that holds out one board."""
    fold = Fold("lobo", board, np.flatnonzero(rows.board != board), np.flatnonzero(rows.board == board), NONE)
    data = SceneData("tiny", settings(SCENE), replace(rows, db_uT=db_uT.astype(np.float32)), [fold])
    return list(check_fold(data, fold, AuditSettings(settings="for speed", **section)))


def failing(checks: list[Check]) -> list[str]:
    return [check.what for check in checks if not check.holds]


def planted(fields_uT: np.ndarray, sd_uT: float = 0.0) -> np.ndarray:
    """Return the fields of `ROWS`, in which those of skin b0_s1 are replaced and noise is added to them."""
    db_uT = ROWS.db_uT.copy()
    db_uT[TARGET] = fields_uT + rng_for(1, "copy").normal(0, sd_uT, fields_uT.shape)
    return db_uT


@pytest.mark.parametrize(("sd_uT", "factor"), [(0, 1), (5, 1), (5, 1.05), (3, 0.9), (0, 1.3)])
def test_noisy_or_scaled_copy_of_another_skin_is_detected(sd_uT, factor):
    assert failing(checks_of(ROWS.db_uT)) == []
    checks = checks_of(planted(factor * ROWS.db_uT[SOURCE], sd_uT))
    assert failing(checks) == ["copies"]
    assert checks[-1].found.endswith("of capture c_b0_s1 match skin b2_s1")


def test_copy_is_detected_in_one_of_several_captures_and_in_a_sample_of_presses(monkeypatch):
    monkeypatch.setattr(experiment, "PAIRS_MAX_N", 5_000)
    monkeypatch.setattr(experiment, "SAMPLE_MIN_N", 1)
    few = np.flatnonzero(TARGET)[:24]
    capture, db_uT = ROWS.capture.astype("U20"), ROWS.db_uT.copy()
    capture[few] = "c_b0_s1_more"
    db_uT[few] = ROWS.db_uT[np.flatnonzero(SOURCE)[:24]] + rng_for(1, "copy").normal(0, 4, (24, CH_N))
    assert checks_of(db_uT, replace(ROWS, capture=capture))[-1].found.endswith(
        "of capture c_b0_s1_more match skin b2_s1"
    )


def test_weak_skins_are_named_until_the_scene_accepts_them():
    weak_uT = planted(ROWS.db_uT[TARGET] / 1000)
    check = checks_of(weak_uT)[-1]
    assert (check.holds, check.known, "weak_skins: [b0_s1]" in check.remedy) == (False, False, True)
    assert failing(checks_of(weak_uT, weak_skins=("b0_s1",))) == []  # the other skin of the board is still compared
    weak_uT[ROWS.skin == "b0_s0"] = ROWS.db_uT[SOURCE]
    assert failing(checks_of(weak_uT, weak_skins=("b0_s1",))) == ["copies"]


def test_lab_recordings_pass_but_a_copy_that_is_planted_in_them_is_detected(shared_data):
    tables, channels = [], [f"B{axis}{chip}" for chip in range(5) for axis in "xyz"]
    for board in ("board1", "board2"):
        parts = [pd.read_csv(shared_data / f"lab/{board}_depth{i}.csv").assign(depth_i=i) for i in (1, 3)]
        means = pd.concat(parts).groupby(["phase", "depth_i", "indent"])[channels].mean()
        tables.append((means.loc["contact"] - means.loc["noload"]).to_numpy())
    db_uT, board = np.concatenate(tables), np.repeat(["board1", "board2"], [len(table) for table in tables])
    rows = Rows.of_labels(board.tolist(), board.tolist())
    rows = replace(rows, capture=board)
    assert failing(checks_of(db_uT, rows, "board1")) == []
    copied = 0.95 * db_uT[board == "board2"] + rng_for(1, "copy").normal(0, 5, tables[1].shape)
    assert failing(checks_of(np.concatenate([copied, tables[1]]), replace(rows, capture=board), "board1")) == ["copies"]


# --- Other folds, and scalers ---


@pytest.mark.parametrize("name", ["single_temporal", "single_indentation", "single_pass", "single_random"])
def test_indentation_that_is_split_between_training_and_test_is_detected(name):
    rows = np.flatnonzero(TARGET)
    data = SceneData("tiny", settings(SCENE), ROWS, [])
    whole, split = (Fold(name, "s", rows[:n], rows[n:], NONE) for n in (30, 31))
    section = AuditSettings(settings="for speed")
    assert failing(list(check_fold(data, whole, section))) == []
    (_, leak) = check_fold(data, split, section)
    assert (leak.what, leak.holds, leak.known) == ("indentations", False, name == "single_random")
    with pytest.raises(ParamsError, match="has no rows: 31 to train on, 0"):
        list(check_fold(data, replace(split, test=NONE), section))
    with pytest.raises(ParamsError, match="must be one of"):
        list(check_fold(data, replace(split, experiment="unknown"), section))
