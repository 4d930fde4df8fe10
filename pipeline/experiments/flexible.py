"""Networks of rigid boards on flexible ones (paper section 5)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from pipeline.experiments.results import read_captures, read_losses, write_results
from pipeline.report.drawing import COLOURS, drawing, svg
from pipeline.report.formatting import COLUMNS, OF_PAPER, show, show_difference, tabulate
from pipeline.report.paper import FLEXIBLE, FLEXIBLE_BIAS, FLEXIBLE_GAP_LESS_PCT
from pipeline.settings import Settings
from pipeline.simulation import simulation_settings
from pipeline.statistics import statistic
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
    summarise_variants,
)
from reskin.data.rows import Selection, gather, stack
from reskin.data.splits import Split, hold_out_skins
from reskin.models.recipe import HEADLINE
from reskin.schema import Readings
from reskin.seeds import rng_for

DEPTH_DECIMALS = 2  # of a commanded depth in mm: nearer ones are one
DRAWN_N = 400  # more points than these are not told apart in a panel
FORCE_DECIMALS = 3  # in newtons: more than are seen

ByDepth = Mapping[float, Float[np.ndarray, " d"]]  # |dB| in uT by commanded depth in mm


def by_depth(depth_mm: Float[np.ndarray, " f"], db_uT: Float[np.ndarray, "f ch"]) -> dict[float, np.ndarray]:
    """Sort the lengths of changes of field by commanded depth."""
    length_uT, depth_mm = np.linalg.norm(db_uT, axis=1), np.round(depth_mm.astype(float), DEPTH_DECIMALS)
    return {float(depth): length_uT[depth_mm == depth] for depth in np.unique(depth_mm)}


def strength_ratio(flexible: Sequence[ByDepth], rigid: Sequence[ByDepth]) -> dict[str, float]:
    """Median |dB| of flexible boards' captures over that of rigid ones, at each depth that both have, over depths."""
    both = set().union(*flexible) & set().union(*rigid)
    return statistic([_median_uT(flexible, depth) / _median_uT(rigid, depth) for depth in sorted(both)])


def gap_less_pct(gap_mm: Mapping[str, float]) -> float:
    """By how much nearer chips of flexible boards are to their skins than those of rigid ones, in % of the latter."""
    return 100 * (1 - gap_mm["flexible"] / gap_mm["rigid"])


def answer_flexible(answers: Sequence[VariantPrediction]) -> dict[str, Any]:
    """Summarise over boards, by arm; the force bias and the gain by adaptation apart."""
    differences = {f"{AFTER}_minus_{BEFORE}": compare_variants(answers, AFTER, BEFORE)}
    return summarise_variants(answers) | force_biases(answers) | {"paired": differences}


def forces_drawn(answers: Sequence[VariantPrediction], rng: np.random.Generator) -> dict[str, dict[str, list[float]]]:
    """Choose equal readings of both arms' first networks at random: true and predicted force, in newtons."""
    arms = {arm: [one for one in answers if one.variant == arm and one.seed_i == 0] for arm in (BEFORE, AFTER)}
    shown = rng.permutation(sum(len(one.true) for one in arms[BEFORE]))[:DRAWN_N]
    return {
        arm: {
            f"{side}_N": np.round(np.concatenate([getattr(one, side)[:, FORCE] for one in own])[shown], FORCE_DECIMALS)
            .astype(float).round(FORCE_DECIMALS).tolist()
            for side in ("true", "predicted")
        }
        for arm, own in arms.items()
    }  # fmt: skip


def _median_uT(captures: Sequence[ByDepth], depth_mm: float) -> float:
    return float(np.median(np.concatenate([one[depth_mm] for one in captures if depth_mm in one])))


SHAPE = "shape"  # the recipe on directions, if the scene has one: it ought to care less about the gap


def flexible(settings: Settings, folds: Path, main: Path, indentations: Path, pretrained: Path, results: Path) -> None:
    """Adapt the networks of the first fold of lobo to every flexible skin, and test on its later passes."""
    preload_training()
    data = read_data(settings, main, folds)
    starts, captures = read_pretrained(pretrained), read_captures(indentations)
    adapting, first, trained_n = data.settings.adaptations(), data.folds_of("lobo")[0], len(data.rows)
    poked = gather(captures, data.settings.section(Selection, "selection"))
    data = replace(data, rows=stack(data.rows, poked))
    sides = (first.train, np.arange(trained_n, len(data.rows)))
    fold = hold_out_skins(data.rows, "flexible", first.name, sides, data.settings.section(Split, "split"))
    arms = {
        name: arm for name, arm in ((HEADLINE, AFTER), (CONTROL, CONTROL), (SHAPE, SHAPE)) if name in adapting.recipes
    }
    jobs = [
        (arm, job)
        for name, arm in arms.items()
        for job in adaptation_jobs(
            data, fold, (name, adapting.recipes[name]), starts, experiment="flexible", pokes_n=adapting.pokes_n
        )
    ]
    skins = [str(skin) for skin in np.unique(data.rows.skin[fold.test])]
    before = {
        name: [one for skin in skins for one in predict_before(data, fold, adapting.recipes[name], starts, skin)]
        for name in arms if name != CONTROL
    }  # fmt: skip
    after, trainings = adapt_and_predict(data, jobs, "flexible")
    own = before[HEADLINE] + [one for one in after if one.variant != SHAPE]
    numbers: dict[str, Any] = {
        "skins_n": len(skins), "boards_n": len(np.unique(data.rows.board[fold.test])),
        "seeds_n": len({one.seed_i for one in own}), "pokes_n": adapting.pokes_n, "fold": first.name,
        "trained_on_skins_n": len(np.unique(data.rows.skin[fold.train])),
        "strength_ratio": strength_ratio(_by_depth(captures), _by_depth(read_captures(main))),
    } | _gaps(data) | answer_flexible(own)  # fmt: skip
    if SHAPE in arms:
        numbers[SHAPE] = answer_flexible(
            before[SHAPE] + [replace(one, variant=AFTER) for one in after if one.variant == SHAPE]
        )
    drawn = forces_drawn(own, rng_for(data.settings.seed, "flexible", "drawn"))
    write_results(results, numbers, drawn, read_losses(indentations, poked.dropped), trainings)


def _by_depth(captures: Sequence[Readings]) -> list[dict[float, np.ndarray]]:
    return [by_depth(one.depth_mm, one.b_uT - one.noload_uT) for one in captures]


def _gaps(data: SceneData) -> dict[str, Any]:
    """Tell the gaps between skin and chips of both kinds of boards, and by how much one is less."""
    kinds = {"rigid": "grid", "flexible": "flexible"}
    of = simulation_settings(data.settings)
    gap_mm = {kind: of.boards[of.protocols[name].boards].design.gap_mm for kind, name in kinds.items()}
    return {"gap_mm": gap_mm, "gap_less_pct": gap_less_pct(gap_mm)}


ARMS = {"before": "before", "after": "adapted", "control": "as long, without pokes"}
OF_SHAPE = "direction and length of the change of field (ours): "


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Show the arms of the paper's recipe, then those of ours on directions where there is one."""
    lines = [_line(ARMS[arm], numbers, arm, source) for arm in ARMS if arm in numbers]
    if "shape" in numbers:
        lines += [_line(OF_SHAPE + ARMS[arm], numbers["shape"], arm, source) for arm in ARMS if arm in numbers["shape"]]
    spread = (
        f"[low, high] is the 95 % interval over n boards, each skin the mean of {numbers['seeds_n']} networks; one "
        "fold's networks answer for all these boards, so it says nothing of other training boards. ± (seeds) is the "
        f"standard deviation over {numbers['seeds_n']} network seeds on one skin, mean over skins."
    )
    return {"flexible": tabulate(lines, meaning=_meaning(numbers), spread=spread)}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw predicted against true force before and after adaptation, with the diagonal and the bias."""
    every_N = [value for arm in drawn.values() for side in arm.values() for value in side]
    ends_N = [min(every_N), max(every_N)]
    with drawing(6.4, 3.7) as figure:
        panels = figure.subplots(1, len(drawn), sharex=True, sharey=True)
        for axes, (arm, forces), colour in zip(panels, drawn.items(), COLOURS[1:], strict=False):
            axes.plot(ends_N, ends_N, color=COLOURS[0], linewidth=0.8)
            axes.scatter(forces["true_N"], forces["predicted_N"], s=7, color=colour, alpha=0.6, linewidths=0)
            bias = f"bias {show_difference(numbers['bias_f_N'][arm])} N"
            axes.set_title(f"{ARMS[arm]}:\n{bias}", loc="left", fontsize=9)
            axes.set(xlabel="true force / N")
        panels[0].set_ylabel("predicted force / N")
        title = (
            f"Networks of rigid boards on flexible boards ({source})\n"
            f"bias over {numbers['seeds_n']} network seeds, points of the first"
        )
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        return {"flexible.svg": svg(figure)}


def _meaning(numbers: Mapping[str, Any]) -> str:
    gap_mm = numbers["gap_mm"]
    return (
        f"Networks of fold {numbers['fold']}, trained on {numbers['trained_on_skins_n']} skins of rigid boards, on "
        f"{numbers['skins_n']} skins of {numbers['boards_n']} flexible boards; adapted by {numbers['pokes_n']} pokes. "
        "Bias: mean of predicted less true force, and as a part of the mean force; the paper names "
        f"{FLEXIBLE_BIAS} after adaptation, without a number. Ours: |dB| is {show(numbers['strength_ratio'])} times as "
        f"strong at equal depth (± over depths). Skins lie {gap_mm['flexible']:g} mm over the chips instead of "
        f"{gap_mm['rigid']:g} mm, {numbers['gap_less_pct']:.0f} % less; the paper's {FLEXIBLE_GAP_LESS_PCT:g} % less. "
        "The paper's numbers are after adaptation, its accuracy about."
    )


def _line(name: str, numbers: Mapping[str, Any], arm: str, source: str) -> dict[str, str]:
    line = {"networks": name, "source": source}
    paper = FLEXIBLE if arm == "after" else {}
    for metric, title in COLUMNS.items():
        line[f"{title} (ours)"] = show(numbers[arm].get(metric))
        if metric in OF_PAPER:
            line[f"{title} (paper)"] = f"{paper[metric]:g}" if metric in paper else "–"
    line |= {"bias of F, N": show_difference(numbers["bias_f_N"][arm])}
    line |= {"bias of F, %": show_difference(numbers["bias_f_pct"][arm])}
    return line | {"n": str(numbers[arm]["accuracy_pct"]["n"])}
