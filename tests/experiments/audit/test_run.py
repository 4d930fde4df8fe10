"""Tests of the audit stage on a tiny scene.

The audit looks for leaks, such as test rows that were used in training. Files without leaks must pass, and each leak
that a test plants must be detected and named.
"""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.experiments.audit import AuditSettings, audit
from pipeline.settings import Adaptations, Settings, Training
from pipeline.training import jobs as _training
from pipeline.training.jobs import SceneData, adaptation_jobs, make_jobs, read_data, read_pretrained, write_models
from reskin import io
from reskin.data.rows import Selection, load_rows
from reskin.data.splits import Fold, Split, draw_folds, parse_folds, render_folds
from reskin.errors import LeakError
from reskin.models.batches import prepare
from reskin.models.inputs import FIT, VIEW
from reskin.models.job import TrainingData, TrainingJob, TrainingResult
from reskin.schema import Readings
from reskin.seeds import rng_for
from tests.data.tables import readings
from tests.scenes import ADAPTATIONS, RECIPE, SHARED, TRAINING, recorded_scene, settings
from tests.simulation.scene import SECTIONS

PLACES_N, PASSES_N, READINGS_N, CH_N = 16, 2, 2, 15
SEED = 2021
ROOT = Path(__file__).resolve().parents[3]
PHYSICS = ("skin", "rig", "chip", "spreads")
MODELS = ("train_single", "train_multi", "train_triplet", "adapt")
SKINS = ("b0_s0", "b0_s1", "b1_s0", "b2_s0")
COPY = "b3_s0"  # This skin is a copy of skin b0_s0, but is labelled as a skin of another board.
TRIPLET = RECIPE | {"triplet_weight": 0.1}
ADAPTATION = SHARED["adaptations"]["paper"]
SCENE = recorded_scene(
    source="simulated",
    seed=SEED,
    experiments=["single_random", "lobo", "triplet", "adapt", "audit"],
    split={"random_test_fraction": 0.1, "random_repeats_n": 1, "pool_passes_n": 1},
    train_single=TRAINING,
    train_multi=TRAINING | {"variants": {"shape": {"inputs": "shape"}}},
    train_triplet=TRAINING | {"recipe": "triplet"},
    adapt=ADAPTATIONS,
    audit={"settings": "chosen"},
)
NOT_CHOSEN = {"steps_n", "base"}
CHOICE = {
    "scene": "tuning", "source": "simulated", "seed": 777, "boards": ["b0", "b1"], "skins": ["b0_s0", "b1_s0"],
    "chosen": {
        stage: {name: value for name, value in words.items() if name not in NOT_CHOSEN}
        for stage, words in (("train_multi", RECIPE), ("train_triplet", TRIPLET), ("adapt", ADAPTATION))
    },
}  # fmt: skip


def capture(skin: str) -> Readings:
    """Return readings of two passes over a grid of places.

    The field of each skin depends on the place, and its changes exceed the noise.
    """
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
    """Write the files that the stages of a scene would write. Their networks are not trained."""
    for skin in skins:
        io.write_readings(folder / f"indentations/{skin}.parquet", [capture(skin)], {})
    io.write_json(folder / "scene.json", SCENE)
    parsed = settings(SCENE)
    rows = load_rows(
        [folder / f"indentations/{skin}.parquet" for skin in skins], parsed.section(Selection, "selection")
    )
    folds = draw_folds(rows, ("single_random", "lobo"), parsed.section(Split, "split"), parsed.seed)
    io.write_json(folder / "folds.json", render_folds(skins, rows, folds))
    data = load_scene_data(folder)
    for stage, section, experiment in (
        ("train_single", parsed.section(Training, "train_single"), "single_random"),
        ("train_multi", parsed.section(Training, "train_multi"), "lobo"),
    ):
        write(folder, stage, data, make_jobs(data, section, data.folds_of(experiment)))
    write(
        folder,
        "train_triplet",
        data,
        make_jobs(data, parsed.section(Training, "train_triplet"), data.folds_of("lobo"), experiment="triplet"),
    )
    starts, named = (
        read_pretrained(folder / "models/train_triplet"),
        ("paper", parsed.section(Adaptations, "adapt").recipes["paper"]),
    )
    adapted = [
        adaptation_jobs(data, fold, named, starts, experiment="adapt", pokes_n=8) for fold in data.folds_of("lobo")
    ]
    write(folder, "adapt", data, [job for jobs in adapted for job in jobs])
    io.write_json(folder / "choice.json", CHOICE)
    return folder


def load_scene_data(folder: Path) -> SceneData:
    return read_data(settings(SCENE), folder / "indentations", folder / "folds.json")


def write(folder: Path, stage: str, data: SceneData, jobs: list[TrainingJob]) -> None:
    write_models(folder / "models" / stage, data, jobs, [initial_result(job, data) for job in jobs], stage)


def initial_result(job: TrainingJob, data: SceneData) -> TrainingResult:
    prepared, scaler = prepare(job, TrainingData(data.rows.db_uT, data.rows.target, data.rows.skin))
    predicted = np.zeros((len(job.test), 3), np.float32)
    weights = prepared.initial_weights
    return TrainingResult(f"key of {job.name}", weights, scaler, [1.0], predicted, None, None, 0.0, 0.0, 0.0)


@pytest.fixture(autouse=True)
def _working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # The stages write a file with their run times to the working folder.
    monkeypatch.setattr(_training, "code_version_of", lambda modules: "abc")


@pytest.fixture(scope="module")
def clean_scene(tmp_path_factory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("honest")
        patch.chdir(folder)
        patch.setattr(_training, "code_version_of", lambda modules: "abc")
        return build(folder / "scene")


@pytest.fixture
def scene(clean_scene, tmp_path) -> Path:
    return shutil.copytree(clean_scene, tmp_path / "scene")


def settings_of(folder: Path) -> Settings:
    return settings(io.read_json(folder / "scene.json"), **{name: SECTIONS[name] for name in PHYSICS})


def run_audit(folder: Path) -> list[dict]:
    results = folder / "audit.json"
    of_scene = settings_of(folder)
    audit(
        of_scene, of_scene.section(AuditSettings, "audit"), folder / "indentations",
        folder / "folds.json", folder / "models", folder / "choice.json",
        results,
    )  # fmt: skip
    return io.read_json(results)


def assert_leak(folder: Path, sentence: str) -> None:
    with pytest.raises(LeakError, match=sentence):
        run_audit(folder)
    assert not (folder / "audit.json").exists()


def test_files_without_leaks_pass_all_checks(scene, capsys):
    checks = run_audit(scene)
    assert {check["where"] for check in checks if check["what"] == "copies"} == {"lobo/b0", "lobo/b1", "lobo/b2"}
    assert {check["where"] for check in checks if check["what"] == "pool indentations"} == {
        "lobo/b0", "lobo/b1", "lobo/b2"
    }  # fmt: skip
    trained = {"single_random.paper.repeat0.seed0"}
    trained |= {f"{variant}.b{i}.seed0" for variant in ("lobo.paper", "lobo.shape", "triplet.paper") for i in range(3)}
    trained |= {f"adapt.paper.{skin}.8pokes.seed0" for skin in ("b0.b0_s0", "b0.b0_s1", "b1.b1_s0", "b2.b2_s0")}
    assert {check["where"] for check in checks if check["what"] == "scaler"} == trained
    variants = {check["where"] for check in checks if check["what"] == "settings: recipe"}
    assert variants == {"train_single", "train_multi", "train_triplet", "adapt"}
    # Only the paper's random split has a leak.
    assert [check["where"] for check in checks if not check["holds"]] == ["single_random/repeat0"]
    assert f"tiny: {len(checks)} checks found no leak. In addition, 1 known" in capsys.readouterr().err


def test_audit_needs_no_record_of_the_choice_if_settings_affect_only_speed(scene):
    io.write_json(scene / "scene.json", SCENE | {"audit": {"settings": "for speed"}})
    (scene / "choice.json").unlink()
    assert not any(check["what"].startswith("settings") for check in run_audit(scene))


@pytest.mark.parametrize("seen_n", [1, 32])
@pytest.mark.parametrize(
    ("stage", "name"),
    [
        ("train_multi", "lobo.paper.b1.seed0"),
        ("train_multi", "lobo.shape.b1.seed0"),
        ("train_triplet", "triplet.paper.b1.seed0"),
    ],
)
def test_scaler_fitted_to_test_rows_is_detected(scene, stage, name, seen_n):
    file, data = scene / f"models/{stage}/{name}.safetensors", load_scene_data(scene)
    (fold,) = (one for one in data.folds_of("lobo") if one.name == "b1")
    seen = np.concatenate([fold.train, fold.test[:seen_n]])
    view = VIEW["shape" if ".shape." in name else "raw"](data.rows.db_uT[seen])
    leaked = FIT["standard"](view, data.rows.target[seen]).arrays()
    io.write_tensors(file, io.read_tensors(file)[0] | leaked, {})
    assert_leak(
        scene,
        f"audit of tiny, {name}, scaler: relative difference .* Rule: the scaler was fitted to the training rows alone",
    )


def change_fold(folder: Path, change: Callable[[Fold, SceneData], Fold]) -> None:
    """Change the fold that holds out board b0, in file folds.json."""
    data = load_scene_data(folder)
    folds = [change(fold, data) if (fold.experiment, fold.name) == ("lobo", "b0") else fold for fold in data.folds]
    io.write_json(
        folder / "folds.json", render_folds(io.read_json(folder / "folds.json")["captures"], data.rows, folds)
    )
    assert len(parse_folds(io.read_json(folder / "folds.json"), data.rows, "folds.json")) == len(data.folds)


def train_on_a_test_skin(fold: Fold, data: SceneData) -> Fold:
    on_skin = data.rows.skin[fold.test] == "b0_s0"
    pool = fold.pool[data.rows.skin[fold.pool] != "b0_s0"]
    return Fold(fold.experiment, fold.name, np.union1d(fold.train, fold.test[on_skin]), fold.test[~on_skin], pool)


def train_on_a_test_reading(fold: Fold, data: SceneData) -> Fold:
    return Fold(fold.experiment, fold.name, np.union1d(fold.train, fold.test[:1]), fold.test, fold.pool)


def adapt_to_a_test_reading(fold: Fold, data: SceneData) -> Fold:
    return Fold(fold.experiment, fold.name, fold.train, fold.test, np.union1d(fold.pool, fold.test[:1]))


def adapt_to_a_test_indentation(fold: Fold, data: SceneData) -> Fold:
    return Fold(fold.experiment, fold.name, fold.train, fold.test[1:], np.union1d(fold.pool, fold.test[:1]))


def adapt_to_a_training_skin(fold: Fold, data: SceneData) -> Fold:
    return Fold(fold.experiment, fold.name, fold.train[1:], fold.test, np.union1d(fold.pool, fold.train[:1]))


@pytest.mark.parametrize(
    ("leak", "sentence"),
    [
        (train_on_a_test_skin, "boards: 1 of 1 test boards are also in training: b0"),
        (train_on_a_test_reading, "readings: 1 of 64 test readings are also used"),
        (adapt_to_a_test_reading, "readings: 1 of 64 test readings are also used"),
        (adapt_to_a_test_indentation, "pool indentations: 1 of 33 indentations for adaptation are also tested"),
        (adapt_to_a_training_skin, "pool skins: 1 of 3 skins for adaptation are not held out: b1_s0"),
    ],
)
def test_fold_that_trains_on_test_rows_is_detected(scene, leak, sentence):
    change_fold(scene, leak)
    assert_leak(scene, f"audit of tiny, lobo/b0, {sentence}")


def test_copied_capture_is_reported_until_the_scene_accepts_it(tmp_path):
    folder = build(tmp_path / "scene", (*SKINS, COPY))
    found = r"100.0 % of the 16 compared indentations of capture b0_s0 match skin b3_s0\. Rule: .*"
    remedy = r"reskin remove tiny b0_s0\. .*tiny.yaml: similar_skins: \[\[b0_s0, b3_s0\]\]"
    assert_leak(folder, rf"audit of tiny, lobo/b0, copies: 2 of 2 test captures compared\. {found}{remedy}")
    io.write_json(
        folder / "scene.json", SCENE | {"audit": {"settings": "chosen", "similar_skins": [["b0_s0", "b3_s0"]]}}
    )
    accepted = [check["where"] for check in run_audit(folder) if check["what"] == "copies" and check["known"]]
    assert accepted == ["lobo/b0", "lobo/b3"]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"seed": SEED}, "all folds, settings: boards: 2 of 3 tested boards were used to choose the settings: b0, b1"),
        ({"seed": SEED, "boards": ["b9"]}, "all folds, settings: skins: 2 of .*: b0_s0, b1_s0"),
    ],
    ids=["board", "skin"],
)
def test_settings_chosen_on_test_boards_or_skins_are_detected(scene, changes, sentence):
    io.write_json(scene / "choice.json", CHOICE | changes)
    assert_leak(scene, f"audit of tiny, {sentence}")


@pytest.mark.parametrize(
    ("chosen", "stage", "found"),
    [
        (
            CHOICE["chosen"] | {"adapt": CHOICE["chosen"]["adapt"] | {"rate_max": 3e-3}},
            "adapt", "not chosen by the study: rate_max 0.001 (study: 0.003)",
        ),
        (
            {"train_multi": CHOICE["chosen"]["train_multi"]},
            "train_triplet", "not chosen by the study: the study chose no recipe for this stage",
        ),
    ],
    ids=["recipe with another rate", "no chosen recipe"],
)  # fmt: skip
def test_recipe_that_differs_from_the_chosen_settings_is_reported(scene, chosen, stage, found):
    io.write_json(scene / "choice.json", CHOICE | {"chosen": chosen})
    rows = {check["where"]: check for check in run_audit(scene) if check["what"] == "settings: recipe"}
    assert (rows[stage]["found"], rows[stage]["holds"]) == (found, True)
    assert rows["train_multi"]["found"] == "equal"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            lambda tuning, at: tuning | {"from": "key of another fold"},
            "base: the pretrained network is not of the same fold and seed",
        ),
        (lambda tuning, at: tuning | {"indentations": at["tested"]}, "pokes: of 3 indentations for adaptation, "),
        (lambda tuning, at: tuning | {"indentations": at["trained"]}, "pokes: of 3 indentations for adaptation, "),
    ],
    ids=["a network trained on the board", "test pokes", "pokes of a training skin"],
)
def test_wrong_network_or_wrong_pokes_in_an_adaptation_are_detected(scene, change, sentence):
    file = next((scene / "models/adapt").glob("*.json"))
    card = io.read_json(file)
    data = load_scene_data(scene)
    fold = next(fold for fold in data.folds_of("lobo") if fold.name == card["fold"])
    sides = {"tested": fold.test, "trained": fold.train}
    by_side = {name: np.unique(data.rows.indentation[rows])[:3].tolist() for name, rows in sides.items()}
    io.write_json(file, card | {"tuning": change(card["tuning"], by_side)})
    assert_leak(scene, f"{file.stem}, {sentence}")
