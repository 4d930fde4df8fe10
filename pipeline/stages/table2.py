"""Stage table2: cards of four arms -> the paper's table 2 and its figure, minutes before the report has everything.

Refuses to know all else of the report, and to train.
"""

from pathlib import Path

from pipeline.report.formatting import rounded, to_markdown
from pipeline.report.headline import headline_figures, short_table
from pipeline.report.numbers import learned
from pipeline.report.statistics import tidy
from pipeline.scenes import TABLE_2, stages
from pipeline.stage import run, say
from reskin import io
from reskin.config import Files, read_settings
from reskin.models.recipe import HEADLINE


def table2(scene: str, files: Files, models: Path, shown: Path) -> None:
    """Score the held-out boards, print the table and draw its figure; the report shows the same numbers again."""
    source = read_settings("table2", scene, files).words("source")
    arms = stages(TABLE_2.values(), "models")
    cards = [io.read_json(file) for arm in arms for file in sorted((models / arm).glob("*.json"))]
    numbers = rounded({"provenance": {"scene": scene, "source": source}, **learned(tidy(cards, {}), headline=HEADLINE)})
    table = to_markdown(short_table(numbers))
    io.write_texts(shown, {"table2.md": table, **headline_figures(numbers, source)})
    say(f"{scene} ({source})\n{table}\n{scene}: {', '.join(str(file) for file in sorted(shown.iterdir()))}")


if __name__ == "__main__":
    run(table2)
