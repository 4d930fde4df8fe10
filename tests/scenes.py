"""Scenes for tests, as dictionaries, and their settings as a stage reads them."""

from pipeline.catalogue import EXPERIMENTS, stages
from pipeline.scenes import Scene, check_scene
from pipeline.settings import Settings
from tests.recordings.headers import DEFAULT_POLICY

RECIPE = {
    "architecture": "paper", "inputs": "raw", "scaling": "standard", "triplet_weight": 0.0, "steps_n": 1, "batch_n": 64,
    "rate_max": 3e-3, "gradient_norm_max": 1.0, "weight_decay": 0.0,
}  # fmt: skip


SHARED_RECIPE = {name: value for name, value in RECIPE.items() if name != "steps_n"}
TRAINING = {"recipe": "paper", "steps_n": 1, "seeds_n": 1, "variants": {}}


def recorded_scene(**changes: object) -> dict[str, object]:
    scene: dict[str, object] = {
        "source": "recorded", "seed": 1, "experiments": ["lobo"], "selection": {"force_min_N": 0.0}, "split": {},
        "train_multi": TRAINING,
    }  # fmt: skip
    return scene | changes


SCHEDULE = {"batch_n": 64, "rate_max": 1e-3, "gradient_norm_max": 1.0, "weight_decay": 0.0}
ADAPTATIONS = {"adaptation": "paper", "base": "paper", "steps_n": 1, "pokes_n": 8, "variants": {}}
NEW_BOARD = {"presses_n": [12], "labels_n": [0, 10], "draws_n": 1, "model": None}
# The content of params.yaml in tests.
SHARED: dict[str, object] = {
    "lost_fraction_max": 0.05,
    "faults": DEFAULT_POLICY.model_dump(),
    "recipes": {"paper": SHARED_RECIPE, "triplet": SHARED_RECIPE | {"triplet_weight": 0.1}},
    "adaptations": {"paper": {"unlabelled_weight": 0.1} | SCHEDULE},
    "skin": {}, "rig": {}, "chip": {}, "spreads": {}, "terms": {},
}  # fmt: skip

# Sections of a scene that each experiment needs.
SECTIONS: dict[str, dict[str, object]] = {
    "lobo": {"train_multi": TRAINING},
    "transfer": {"train_single": TRAINING},
    "single_random": {"train_single": TRAINING},
    "single_temporal": {"train_single": TRAINING},
    "triplet": {"train_triplet": TRAINING},
    "adapt": {"adapt": ADAPTATIONS},
    "pokes": {"sweep_pokes": {"pokes_n": [0, 8], "boards_n": 1}},
    "sensors": {},
    "new_board": {
        "new_board": NEW_BOARD, "adapt": ADAPTATIONS, "compare": {"layout": "reskin", "labels_mirrored": False},
    },
    "audit": {"audit": {"settings": "chosen"}},
    "choice": {},
}  # fmt: skip
SECTIONS |= {
    "single_indentation": {"train_single": TRAINING},
    "single_pass": {"train_single": TRAINING},
    "drift": {
        "drift": {
            "unit": "pass", "train_n": 1, "test_n": 1, "every_n": 1, "policies": ["initial", "each"],
            "training": TRAINING,
        },
    },
}  # fmt: skip
# Settings in section `split` that each experiment needs.
SPLIT_SETTINGS: dict[str, dict[str, object]] = {
    "transfer": {"transfer_skins_n": 1},
    "single_random": {"random_test_fraction": 0.1, "random_repeats_n": 1},
    "single_temporal": {"temporal_test_fraction": 0.1},
    "single_indentation": {"random_test_fraction": 0.1, "random_repeats_n": 1},
    "single_pass": {"random_test_fraction": 0.1, "random_repeats_n": 1},
    "adapt": {"pool_passes_n": 1},
    "sensors": {"sensors_skins_n": [1], "sensors_draws_n": 1},
}


def scene_with(*experiments: str, **changes: object) -> dict[str, object]:
    """Return a recorded scene with exactly the settings that these experiments need."""
    scene = {name: value for name, value in recorded_scene().items() if name != "train_multi"}
    split: dict[str, object] = {}
    for experiment in experiments:
        scene |= SECTIONS[experiment]
        split |= SPLIT_SETTINGS.get(experiment, {})
    return scene | {"experiments": list(experiments), "split": split} | changes


def settings(scene: dict[str, object], name: str = "tiny", **shared: object) -> Settings:
    """Return all settings of a scene, as a stage reads them."""
    experiments = scene["experiments"]
    held_out = tuple(one for one in experiments if EXPERIMENTS[one].folds is not None)
    models = tuple(stages(experiments, "models"))
    return Settings(name, f"{name}.yaml", scene, SHARED | shared, (), held_out, models)


def check(scene: dict[str, object]) -> Scene:
    """Check a scene as `reskin scenes check` does."""
    return check_scene(Settings("scene", "scene.yaml", scene, SHARED))
