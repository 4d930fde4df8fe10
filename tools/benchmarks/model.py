"""Time of one reading, and of one more press, with the calibrated shipped model.

The times are printed beside those of the same network in PyTorch: what a user would do instead. All are processor time
of one thread, as medians.
"""

import time
from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from reskin.universal.episodes import Episodes
from reskin.universal.model import load_universal
from reskin.universal.training import SkinReader
from tests.universal.skins import draw
from tools.benchmarks.common import table


def median_us(function: Callable[[], object], repeats_n: int) -> float:
    times_s = []
    for _ in range(repeats_n):
        start_s = time.process_time()
        function()
        times_s.append(time.process_time() - start_s)
    return 1e6 * float(np.median(times_s))


def main(repeats_n: int = 500) -> None:
    skin, model, rows = draw(12)[0], load_universal(), []
    for seen_n, labels_n in ((0, 0), (65, 0), (65, 40)):
        model.zero(skin.rest_uT).see(skin.b_uT[:seen_n])
        if labels_n:
            labels = slice(65, 65 + labels_n)
            model.label(skin.place_mm[labels], skin.force_N[labels], skin.b_uT[labels])
        reading_us = median_us(lambda: model.estimate(skin.b_uT[:1]), repeats_n)
        context_uT = np.zeros((1, seen_n + labels_n, 15))
        parts = (skin.rest_uT[None], context_uT, np.zeros((1, labels_n, 5)), skin.b_uT[None, :1], np.zeros((1, 1, 3)))
        rest_uT, context, labels_known, queried_uT, target = (part.astype(np.float32) for part in parts)
        episodes = Episodes(rest_uT, context, labels_known, queried_uT, target, 0.0)
        with torch.inference_mode():
            torch_us = median_us(partial(SkinReader(model.weights), episodes), repeats_n)
        press_us = float("nan")
        if seen_n:
            press_us = median_us(lambda: model.see(skin.b_uT[:1]).estimate(skin.b_uT[:1]), repeats_n)
        rows.append({
            "presses + labels": f"{seen_n} + {labels_n}", "reading / us": f"{reading_us:.0f}",
            "in PyTorch / us": f"{torch_us:.0f}", "ratio": f"{torch_us / reading_us:.1f}",
            "ready after one more press / us": f"{press_us:.0f}",
        })  # fmt: skip
    print(table(rows))


if __name__ == "__main__":
    main()
