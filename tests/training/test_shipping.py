"""What the shipped model says of a place is what the tested experts say of it: the same place, as sure."""

import numpy as np
import pytest

from pipeline.training import shipping
from pipeline.training.shipping import read_inputs, shown, tell_sureness
from pipeline.training.universal import SURENESS, Experts, by_own_labels, read_both, ready, told_of
from reskin.seeds import rng_for
from reskin.universal.calibration import LikelihoodPowers
from reskin.universal.map import NOMINAL, OF_NOMINAL
from reskin.universal.model import Universal, load_universal
from reskin.universal.population import POKES_N, Population
from reskin.universal.training import Syllabus
from tests.universal.skins import DESIGN, SETUP


@pytest.fixture
def model() -> Universal:
    return load_universal()


def skins_of(model: Universal, skins_n: int, missed: float = 0.3) -> Population:
    """Skins off the nominal one, with pokes on the lattice of which each is off by a part of its field."""
    tables, rng = model.tables, rng_for(0, "shipping")
    at = rng.integers(2, len(tables.axis_mm) - 2, (2, skins_n, POKES_N))
    force_i = rng.integers(1, len(tables.force_N), (skins_n, POKES_N))
    number = 0.5 * rng.standard_normal((skins_n, len(tables.names)))
    db_uT = tables.mean_uT[*at, force_i] + np.einsum("smct,st->smc", tables.slope_uT[*at, force_i], number)
    size_uT = np.linalg.norm(db_uT, axis=2, keepdims=True) / np.sqrt(db_uT.shape[2])
    db_uT = db_uT + missed * size_uT * rng.standard_normal(db_uT.shape)
    rest_uT = tables.rest_uT + number @ tables.rest_slope_uT.T
    parts = db_uT, rest_uT, np.moveaxis(tables.axis_mm[at], 0, -1), tables.force_N[force_i]
    return Population(*(part.astype(np.float32) for part in parts))


@pytest.mark.parametrize("labels_n", [0, 3, 10])
def test_told_the_same_it_answers_as_surely_as_the_tested_experts(model, labels_n):
    skins = skins_of(model, 1)
    b_uT, _ = shown(model, skins, 0, (65, labels_n), even=True, seed=0)
    nominal = Experts(model.tables, model.networks, None, Syllabus("nominal", NOMINAL, OF_NOMINAL, SETUP))
    told, asked = told_of(nominal, skins, 0, seed=0)
    sureness = model.powers.of(65, labels_n, even=True)
    tempers = by_own_labels(told, labels_n, [told.tempers((sureness, sureness))])
    ((_, tested),) = read_both(ready(told, labels_n), asked.db_uT, tempers)
    found = model.estimate(b_uT)
    assert model.misfit == pytest.approx(told.misfit, rel=1e-3)
    assert model.power == pytest.approx(tempers[0][1], rel=1e-3)
    np.testing.assert_allclose(found.place_mm - 8, tested.place_mm, atol=1e-3)  # mm; fields in single precision
    np.testing.assert_allclose(found.sd_mm, tested.sd_mm, rtol=1e-3)


@pytest.mark.parametrize("pokes_n", [12, 65])
def test_pokes_that_fit_worse_make_it_less_sure_and_a_few_tell_nothing_of_that(model, pokes_n):
    misfits, tempers = [], []
    for missed in (0.1, 1.0):
        shown(model, skins_of(model, 1, missed), 0, (pokes_n, 0), even=False, seed=0)
        misfits.append(model.misfit)
        tempers.append(model.power)
        shown(model, skins_of(model, 1, missed), 0, (5, 0), even=False, seed=0)
        assert (model.misfit, model.power) == (1.0, model.powers.of(0, 0, even=False))
    assert misfits[1] > 3 * misfits[0]
    assert tempers == pytest.approx([min(1, model.powers.of(pokes_n, 0, even=False) / of) for of in misfits])


def test_sureness_is_told_for_every_number_of_pokes_and_labels(model, monkeypatch):
    monkeypatch.setattr(shipping, "FURTHER_N", 1)
    monkeypatch.setattr(shipping, "skins_of_prior", lambda *_: skins_of(model, 1))
    nominal = Experts(model.tables, model.networks, None, Syllabus("nominal", NOMINAL, OF_NOMINAL, SETUP))
    found = tell_sureness(nominal, (0, 10), seed=0)
    assert {n: set(of) for n, of in found.anywhere.items()} == {n: {0, 10} for n in (0, 12, 65)}
    assert {*found.even.values(), *(one for of in found.anywhere.values() for one in of.values())} <= set(SURENESS)
    assert found == LikelihoodPowers.from_card(found.to_card())


def test_the_shipped_model_is_made_from_the_nominal_skin_and_the_settings_of_scene_lab(model):
    inputs = read_inputs()
    assert inputs.setup.design == DESIGN.model_copy(update={"tip_radius_mm": inputs.setup.tip_radius_mm})
    assert inputs.lessons.model_dump() | {"seed": inputs.seed} == model.card["lessons"]
    assert set(inputs.labels_n) == set(model.powers.even)
