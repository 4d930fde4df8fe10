"""Time of one reading, and of one more press, with the calibrated universal model.

`RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_universal_benchmark.py` prints the times, beside those of the
same network in PyTorch: what a user would do instead. All times are processor time of one thread, as medians.
"""

import time
from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from reskin.universal.episodes import Episodes
from reskin.universal.model import load_universal
from reskin.universal.training import SkinReader
from tests.benchmarks import size
from tests.universal.skins import draw

REPEATS_N = size(500, 3)


def median_us(function: Callable[[], object]) -> float:
    times_s = []
    for _ in range(REPEATS_N):
        start_s = time.process_time()
        function()
        times_s.append(time.process_time() - start_s)
    return 1e6 * float(np.median(times_s))


def test_print_times_of_readings_and_presses():
    skin, model = draw(12)[0], load_universal()
    print("\n| calibration | reading / us | the same in PyTorch / us | ratio | ready after one more press / us |")
    print("|---|---|---|---|---|")
    for seen_n, labels_n in ((0, 0), (65, 0), (65, 40)):
        model.zero(skin.rest_uT).see(skin.b_uT[:seen_n])
        if labels_n:
            labels = slice(65, 65 + labels_n)
            model.label(skin.place_mm[labels], skin.force_N[labels], skin.b_uT[labels])
        reading_us = median_us(lambda: model.estimate(skin.b_uT[:1]))
        context_uT = np.zeros((1, seen_n + labels_n, 15))
        parts = (skin.rest_uT[None], context_uT, np.zeros((1, labels_n, 5)), skin.b_uT[None, :1], np.zeros((1, 1, 3)))
        episodes = Episodes(*(part.astype(np.float32) for part in parts), 0.0)
        with torch.inference_mode():
            network = SkinReader(model.weights)
            torch_us = median_us(partial(network, episodes))
        press_us = median_us(lambda: model.see(skin.b_uT[:1]).estimate(skin.b_uT[:1])) if seen_n else float("nan")
        times = f"{reading_us:.0f} | {torch_us:.0f} | {torch_us / reading_us:.1f} | {press_us:.0f}"
        print(f"| {seen_n} + {labels_n} | {times} |")
    assert reading_us > 0
