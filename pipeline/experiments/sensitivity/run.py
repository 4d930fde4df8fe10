"""Stage sensitivity: a glass that is filled on a skin -> the smallest weight told apart (section 6)."""

from pathlib import Path

from pipeline.core.config import Files, parse_parts, read_settings
from pipeline.core.stage import run, say
from pipeline.dataset.baseline import subtract
from pipeline.experiments.answer import read_folder, read_losses, write_answer
from pipeline.experiments.only import only
from pipeline.experiments.sensitivity.weights import answer_of, levels_of
from pipeline.synthesis.pressing import weights_N
from pipeline.synthesis.protocols import Load


def sensitivity(scene: str, files: Files, indentations: Path, answer: Path) -> None:
    """Tell how small a weight the one skin tells that was loaded."""
    glass = read_settings("sensitivity", scene, files).words("simulate.protocols.glass")
    asked = parse_parts(Load, glass, "simulate.protocols.glass")
    one = only(read_folder(indentations), indentations)
    weight_N = weights_N(asked.force_max_N, asked.step_N)
    change_uT = subtract(one.b_uT, one.noload_uT)
    levels_uT = levels_of(change_uT, one.indentation, one.Fz_N, levels_n=len(weight_N), where=one.capture)
    numbers, drawn = answer_of(levels_uT, weight_N)
    write_answer(answer, numbers, drawn, read_losses(indentations, {}))
    say(f"{scene}: weights {numbers['smallest_step_N']} N apart are told, in {numbers['fillings_n']} fillings")


if __name__ == "__main__":
    run(sensitivity)
