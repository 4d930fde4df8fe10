"""Flexible boards: networks that were trained on rigid boards are adapted to flexible boards (paper section 5)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from pipeline.experiments.results import read_captures, read_losses, write_results
from pipeline.formatting import TITLES
from pipeline.plot import COLOURS, drawing, svg
from pipeline.scores import join, select, write_scores
from pipeline.settings import Adaptations, Settings
from pipeline.simulation import simulation_settings
from pipeline.statistics import Stat, statistic
from pipeline.training.jobs import SceneData, adaptation_jobs, preload_training, read_data, read_pretrained
from pipeline.training.variants import (  # fmt: skip
    AFTER,
    BEFORE,
    CONTROL,
    FORCE,
    VariantPrediction,
    adapt_and_predict,
    compare_variants,
    force_biases,
    predict_before,
    score_variants,
    summarise_variants,
)
from reskin.data.rows import Selection, gather, stack
from reskin.data.splits import Split, hold_out_skins
from reskin.models.recipe import HEADLINE
from reskin.schema import Readings
from reskin.seeds import rng_for

DEPTH_DECIMALS = 2  # commanded depths in mm are rounded to this many decimals
DRAWN_N = 400  # number of points in a panel of the figure
FORCE_DECIMALS = 3  # forces in N are rounded to this many decimals for the figure
# Optional recipe whose inputs are the direction and length of dB. Its networks are expected to depend less on the gap
# between skin and chips.
SHAPE = "shape"


def flexible(
    settings: Settings, folds: Path, main: Path, indentations: Path, pretrained: Path, scores: Path, results: Path
) -> None:
    """Adapt networks that were trained on rigid boards to each flexible skin; test them on later passes of the skin.

    The networks are those of the first fold of experiment `lobo` (leave one board out).
    """
    preload_training()
    data = read_data(settings, main, folds)
    starts, captures = read_pretrained(pretrained), read_captures(indentations)
    adapting, first, trained_n = data.settings.section(Adaptations, "adapt"), data.folds_of("lobo")[0], len(data.rows)
    poked = gather(captures, data.settings.section(Selection, "selection"))
    data = replace(data, rows=stack(data.rows, poked))
    sides = (first.train, np.arange(trained_n, len(data.rows)))
    fold = hold_out_skins(data.rows, "flexible", first.name, sides, data.settings.section(Split, "split"))
    variants = {HEADLINE: AFTER, CONTROL: CONTROL, SHAPE: SHAPE}  # name of a recipe -> name of the variant
    recipes = {name: adapting.recipes[name] for name in variants if name in adapting.recipes}
    jobs = [
        (variants[name], job)
        for name, recipe in recipes.items()
        for job in adaptation_jobs(data, fold, (name, recipe), starts, experiment="flexible", pokes_n=adapting.pokes_n)
    ]
    skins = [str(skin) for skin in np.unique(data.rows.skin[fold.test])]
    before = {
        name: [prediction for skin in skins for prediction in predict_before(data, fold, recipe, starts, skin)]
        for name, recipe in recipes.items()
        if name != CONTROL
    }
    after, trainings = adapt_and_predict(data, jobs, "flexible")
    of_paper = before[HEADLINE] + [prediction for prediction in after if prediction.variant != SHAPE]
    tables = [score_variants("flexible", of_paper, recipe=HEADLINE)]
    if SHAPE in recipes:
        shaped = before[SHAPE] + [replace(one, variant=AFTER) for one in after if one.variant == SHAPE]
        tables.append(score_variants("flexible", shaped, recipe=SHAPE))
    write_scores(scores, join(tables))
    numbers: dict[str, Any] = {
        "pokes_n": adapting.pokes_n, "fold": first.name,
        "trained_on_skins_n": len(np.unique(data.rows.skin[fold.train])),
        "strength_ratio": strength_ratio(
            [sizes_by_depth(capture) for capture in captures],
            [sizes_by_depth(capture) for capture in read_captures(main)],
        ),
    } | gaps(data)  # fmt: skip
    plot_data = draw_forces(of_paper, rng_for(data.settings.seed, "flexible", "drawn"))
    write_results(results, numbers, plot_data, read_losses(indentations, poked.dropped), trainings)


ByDepth = Mapping[float, Float[np.ndarray, " d"]]  # |dB| in uT by commanded depth in mm


def sizes_by_depth(readings: Readings) -> dict[float, np.ndarray]:
    """Return |dB| in uT of the readings of a capture, by commanded depth in mm."""
    size_uT = np.linalg.norm(readings.b_uT - readings.noload_uT, axis=1)
    depth_mm = np.round(readings.depth_mm.astype(float), DEPTH_DECIMALS)
    return {float(depth): size_uT[depth_mm == depth] for depth in np.unique(depth_mm)}


def strength_ratio(flexible: Sequence[ByDepth], rigid: Sequence[ByDepth]) -> Stat:
    """Return median |dB| of flexible boards / median |dB| of rigid boards, summarised over their common depths."""

    def median_uT(captures: Sequence[ByDepth], depth_mm: float) -> float:
        return float(np.median(np.concatenate([capture[depth_mm] for capture in captures if depth_mm in capture])))

    common_mm = set().union(*flexible) & set().union(*rigid)
    return statistic([median_uT(flexible, depth) / median_uT(rigid, depth) for depth in sorted(common_mm)])


def gaps(data: SceneData) -> dict[str, Any]:
    """Return the gaps between skin and chips on rigid and on flexible boards, and the difference in percent."""
    simulation = simulation_settings(data.settings)
    protocols = {"rigid": "grid", "flexible": "flexible"}
    gap_mm = {
        kind: simulation.boards[simulation.protocols[name].boards].design.gap_mm for kind, name in protocols.items()
    }
    return {"gap_mm": gap_mm, "gap_less_pct": 100 * (1 - gap_mm["flexible"] / gap_mm["rigid"])}


def summarise(scores: pd.DataFrame, measured: Mapping[str, Any]) -> dict[str, Any]:
    """Summarise the networks of the paper's recipe and, if the scene has recipe `shape`, of this recipe."""
    by_recipe = {name: select(scores, recipe=name) for name in (HEADLINE, SHAPE)}
    counts = {f"{name}s_n": by_recipe[HEADLINE][name].nunique() for name in ("skin", "board", "seed")}
    shape = {SHAPE: _summarise_recipe(by_recipe[SHAPE])} if len(by_recipe[SHAPE]) else {}
    return {**measured, **counts, **_summarise_recipe(by_recipe[HEADLINE]), **shape}


def _summarise_recipe(scores: pd.DataFrame) -> dict[str, Any]:
    """Summarise scores and force bias of each variant, and the change of scores by adaptation, over boards."""
    differences = {f"{AFTER}_minus_{BEFORE}": compare_variants(scores, AFTER, BEFORE)}
    return {**summarise_variants(scores), **force_biases(scores), "paired": differences}


def draw_forces(
    predictions: Sequence[VariantPrediction], rng: np.random.Generator
) -> dict[str, dict[str, list[float]]]:
    """Return true forces of random readings, and forces predicted by the networks of the first seed, in N.

    The readings are the same before and after adaptation.
    """
    first = {
        name: [prediction for prediction in predictions if prediction.variant == name and prediction.seed_i == 0]
        for name in (BEFORE, AFTER)
    }
    chosen = rng.permutation(sum(len(prediction.true) for prediction in first[BEFORE]))[:DRAWN_N]
    return {
        name: {
            f"{side}_N": np.round(
                np.concatenate([getattr(prediction, side)[:, FORCE] for prediction in first[name]])[chosen],
                FORCE_DECIMALS,
            ).astype(float).round(FORCE_DECIMALS).tolist()
            for side in ("true", "predicted")
        }
        for name in first
    }  # fmt: skip


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Plot predicted against true force before and after adaptation, with the diagonal and the bias."""
    every_N = [value for forces in drawn.values() for side in forces.values() for value in side]
    ends_N = [min(every_N), max(every_N)]
    with drawing(2.9, f"Trained on rigid boards, tested on flexible boards ({source})") as figure:
        panels = figure.subplots(1, len(drawn), sharex=True, sharey=True)
        for axes, (name, forces), colour in zip(panels, drawn.items(), COLOURS[1:], strict=False):
            axes.plot(ends_N, ends_N, color="0.3", marker="", linewidth=0.8)
            axes.scatter(forces["true_N"], forces["predicted_N"], s=7, color=colour, alpha=0.6, linewidths=0)
            bias_N = numbers["bias_f_N"][name]["mean"]
            axes.set(xlabel="true force / N", title=f"{TITLES[name]}:\nbias {bias_N:+.2f} N")
        panels[0].set_ylabel("predicted force / N")
        return {"flexible.svg": svg(figure)}
