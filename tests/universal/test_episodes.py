"""Tests of the random episodes on which the network is trained."""

import numpy as np
import pytest

from reskin.seeds import rng_for
from reskin.universal import episodes
from reskin.universal.episodes import RecordedBoard, Shape, disturb, disturb_labels, draw_episodes, order_presses
from reskin.universal.layout import paper_layout
from reskin.universal.network import LOG_N, PLACE_MM
from reskin.universal.population import PRESSES_N, Population, draw_places

RNG = rng_for(0, "episodes")
PLACE_MM_OF = np.stack([draw_places(rng_for(i, "places"), paper_layout().area) for i in range(3)])


def made_of(place_mm: np.ndarray, force_N: np.ndarray) -> np.ndarray:
    """Return field changes whose first channels are the place and the force."""
    parts = [place_mm, force_N[..., None], np.zeros((*force_N.shape, 12))]
    return 1e4 * np.concatenate(parts, axis=-1)  # far larger than noise


SKINS = Population(
    *(
        part.astype(np.float32)
        for force_N in [np.exp(RNG.uniform(-1, 2, (3, PRESSES_N)))]
        for part in (np.stack([made_of(PLACE_MM_OF, force_N)] * 2, axis=1), np.ones((3, 15)), PLACE_MM_OF, force_N)
    )
)


@pytest.fixture
def _exact(monkeypatch):
    """Switch off all errors, so that readings and labels can be compared."""
    for name in ("MEMORY_MAX", "DIFFERENCE_MAX", "EXTERNAL_SHARE", "UNKNOWN_FORCE_SHARE"):
        monkeypatch.setattr(episodes, name, 0.0)
    for name in ("LAW_ERROR", "LAW_ERROR_OF_RECORDED"):
        monkeypatch.setattr(episodes, name, (0.0, 0.0))
    for name in ("LABEL_ERROR_MM", "LABEL_ERROR_LOG_N"):
        monkeypatch.setattr(episodes, name, (1e-9, 1e-9))


@pytest.mark.usefixtures("_exact")
def test_targets_and_labels_belong_to_their_readings_and_no_query_is_in_the_context():
    of_board = made_of(PLACE_MM_OF[0], np.ones(PRESSES_N))[:, None].astype(np.float32)
    board = RecordedBoard(
        "b", of_board, np.ones(15, np.float32), PLACE_MM_OF[0].astype(np.float32), np.ones((PRESSES_N, 1), np.float32)
    )
    for seed in range(20):
        drawn = draw_episodes(SKINS, [board], rng_for(seed, "draw"))
        assert len(drawn.rest_uT) == episodes.SKINS_PER_STEP_N
        for fields_uT, values in (
            (drawn.query_uT, drawn.target),
            (drawn.context_uT[:, : drawn.labels.shape[1]], drawn.labels),
        ):
            np.testing.assert_allclose(fields_uT[..., :2] / 1e4, PLACE_MM * values[..., :2], atol=0.02)
            np.testing.assert_allclose(fields_uT[..., 2] / 1e4, np.exp(LOG_N * values[..., 2]), atol=0.02)
        for context_uT, query_uT in zip(drawn.context_uT, drawn.query_uT, strict=True):
            apart = np.linalg.norm(context_uT[:, None] - query_uT, axis=-1)
            assert apart.size == 0 or apart.min() > 100


def test_labelled_presses_of_one_side_are_there_and_others_anywhere():
    place_mm = PLACE_MM_OF[0].astype(np.float32)
    order = order_presses(place_mm, Shape(20, 40, "one side"), rng_for(3, "order"))
    assert sorted(order) == list(range(PRESSES_N))
    labelled, others = place_mm[order[:20]], place_mm[order[20:60]]
    axis = labelled.mean(axis=0) / np.linalg.norm(labelled.mean(axis=0))
    assert (labelled @ axis).min() > -4
    assert (others @ axis).min() < -3
    assert (others @ axis).max() > 3


def test_context_of_few_places_is_near_them(monkeypatch):
    monkeypatch.setattr(episodes, "PLACES_MAX_N", 1)
    place_mm = PLACE_MM_OF[0].astype(np.float32)
    order = order_presses(place_mm, Shape(5, 5, "few places"), rng_for(1, "order"))
    assert sorted(order) == list(range(PRESSES_N))
    assert np.ptp(place_mm[order[:10]], axis=0).max() < 6
    assert np.ptp(place_mm[order[10:]], axis=0).min() > 14


def test_errors_have_the_stated_sizes():
    skins_n = 40
    db_uT = np.full((skins_n, 2, PRESSES_N, 15), 1000.0, np.float32)
    place_mm = np.tile(PLACE_MM_OF[:1], (skins_n, 1, 1)).astype(np.float32)
    force_N = np.ones((skins_n, PRESSES_N), np.float32)
    of_law = disturb(db_uT, place_mm, force_N, (0.3, 0.3), rng_for(0, "disturb")) / 1000 - 1
    # Memory removes 5 % on average; the rest is the law's error of 30 % and smaller differences.
    assert of_law.mean() == pytest.approx(-episodes.MEMORY_MAX / 2, abs=0.03)
    assert of_law.std() == pytest.approx(0.3, rel=0.15)
    # The error of the law is the same in both sessions, and similar at neighbouring places.
    assert np.corrcoef(of_law[:, 0].ravel(), of_law[:, 1].ravel())[0, 1] > 0.85
    known = disturb_labels(np.zeros((2000, 4, 3), np.float32), rng_for(1, "labels"))
    assert known[..., 4].mean() == pytest.approx(1 - episodes.UNKNOWN_FORCE_SHARE, abs=0.03)
    assert PLACE_MM * np.abs(known[..., :2]).max() < 5 * episodes.LABEL_ERROR_MM[1]
    assert (known[known[..., 4] == 0][:, 2] == 0).all()
