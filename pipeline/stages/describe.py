"""Stage describe: the readings of one folder of captures -> what skins look like there, as numbers.

Refuses to know folds and models.
"""

from pathlib import Path

from pipeline.report.description import describe as describe_one
from pipeline.report.description import over_skins, without_rest
from pipeline.stage import run, say
from reskin import io
from reskin.config import Files, read_settings


def describe(scene: str, files: Files, indentations: Path, description: Path) -> None:
    """Describe every capture of a folder, and put them together over skins."""
    names = read_settings("describe", scene, files).captures_in(indentations)
    captures = [io.read_readings(indentations / f"{name}.parquet") for name in names]
    accounts = {one.capture: io.read_account(indentations / f"{one.capture}.parquet") for one in captures}
    described = {one.capture: describe_one(one) for one in captures}
    described |= {
        name: without_rest(described[name])
        for name, account in accounts.items()
        if account.get("baseline_subtracted_rows_n")
    }
    together = over_skins([(one.skin, described[one.capture]) for one in captures])
    readings_n = sum(map(len, captures))
    counts = {"captures_n": len(captures), "readings_n": readings_n}
    counts["indentations_n"] = sum(account.get("indentations_n", 0) for account in accounts.values())
    io.write_json(description, {"counts": counts, "source": captures[0].source, "over_skins": together})
    say(f"{scene}: {indentations}: {readings_n} readings of {len(captures)} captures described")


if __name__ == "__main__":
    run(describe)
