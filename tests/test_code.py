"""Tests of the digest of a module: it changes with the code, but not with comments and line breaks."""

import pytest

from reskin import code

SOURCE = '''"""A module."""

RATE = 2.0  # of what


class Skin:
    """A skin."""

    def doubled(self, x, y=None):
        """Double it."""
        return 2 * x
'''


def digest(monkeypatch, folder, source: str, beside: str = "") -> str:
    (folder / "pipeline").mkdir(exist_ok=True)
    (folder / "pipeline/one.py").write_text(source)
    (folder / "pipeline/one.yaml").write_text(beside)
    monkeypatch.setattr(code, "ROOT", folder)
    code.digest.cache_clear()
    return code.digest("pipeline.one")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"""A module."""', '"""Another word."""'),
        ('"""Double it."""\n', "\n"),
        ("  # of what", ""),
        ("2 * x", "(\n            2 * x)"),
    ],
)
def test_comments_and_line_breaks_do_not_change_the_digest(monkeypatch, tmp_path, old, new):
    assert old in SOURCE
    assert digest(monkeypatch, tmp_path, SOURCE.replace(old, new)) == digest(monkeypatch, tmp_path, SOURCE)


@pytest.mark.parametrize(
    ("old", "new"), [("2.0", "2"), ("x, y=None", "x"), ("2 * x", "x * 2"), ("Skin:", "Skin(object):")]
)
def test_changed_code_changes_the_digest(monkeypatch, tmp_path, old, new):
    assert old in SOURCE
    assert digest(monkeypatch, tmp_path, SOURCE.replace(old, new)) != digest(monkeypatch, tmp_path, SOURCE)


def test_digest_of_a_module_includes_the_data_file_of_the_same_name(monkeypatch, tmp_path):
    assert digest(monkeypatch, tmp_path, SOURCE, "a: 1") != digest(monkeypatch, tmp_path, SOURCE, "a: 2")


def test_digest_includes_imported_modules_of_the_packages():
    names = code.imported("reskin.models.train")
    assert {"reskin.models.train", "reskin.seeds"} <= set(names)
    assert {"reskin", "reskin.models"} <= set(names)  # Importing a module first runs the __init__.py of these packages.
    assert all(name.split(".")[0] in code.PACKAGES for name in names)


def test_digest_of_a_stage_includes_the_modules_of_the_library_that_it_uses():
    assert {"reskin.models.train", "pipeline.stages.train"} <= set(code.imported("pipeline.stages.train"))
