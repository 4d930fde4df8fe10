"""Scenes for tests, as plain words."""

RECIPE = {
    "architecture": "paper", "inputs": "raw", "scaling": "standard", "triplet_weight": 0.0, "steps_n": 1, "batch_n": 64,
    "rate_max": 3e-3, "weight_decay": 0.0,
}  # fmt: skip


def recorded(**changes: object) -> dict[str, object]:
    scene: dict[str, object] = {
        "source": "recorded", "seed": 1, "questions": ["lobo"], "selection": {"force_min_N": 0.0}, "split": {},
        "train_multi": {"seeds_n": 1, "recipes": {"paper": RECIPE}},
    }  # fmt: skip
    return scene | changes
