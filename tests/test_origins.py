"""Tests of reading the files of a given commit from a repository, a mirror or a folder."""

from pathlib import Path

import pytest

from pipeline.manage.fetch import Origin, open_origin
from reskin.errors import CaptureError
from tests import repositories

# These files have line ends that git would convert, binary data, a name that a shell would expand, and a name that git
# quotes.
FILES = {
    "data/crlf.csv": b"a,b\r\n1,2\r\n",
    "data/lf.csv": b"a,b\n1,2\n",
    "data/3*3/samples.npz": bytes(range(256)),
    "data/µT.txt": b"",
    ".gitattributes": b"data/lf.csv text eol=crlf\n",
}


@pytest.fixture
def home(tmp_path) -> Path:
    return tmp_path / "home"


@pytest.fixture
def scratch(tmp_path) -> Path:
    (tmp_path / "scratch").mkdir()
    return tmp_path / "scratch"


def contents(origin: Origin) -> dict[str, bytes]:
    return {path: origin.read(path) for path in origin.paths}


def assert_error(message: str, *arguments) -> None:
    with pytest.raises(CaptureError, match=message) as caught:
        open_origin(*arguments)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("filters", [True, False])
def test_files_of_a_repository_are_read_as_they_were_committed(tmp_path, home, scratch, filters):
    commit = repositories.commit(home, FILES)
    url = repositories.bare(home, tmp_path / "mirror.git", filters=filters)
    assert contents(open_origin(url, commit, scratch)) == FILES


@pytest.mark.parametrize("kind", ["working clone", "bare mirror", "bundle"])
def test_mirror_can_be_any_kind_of_clone(tmp_path, home, scratch, kind):
    commit = repositories.commit(home, FILES)
    repositories.bare(home, tmp_path / "mirror.git", filters=True)
    repositories.git(home, "bundle", "create", "--quiet", str(tmp_path / "home.bundle"), "HEAD", "--all")
    where = {"working clone": home, "bare mirror": tmp_path / "mirror.git", "bundle": tmp_path / "home.bundle"}[kind]
    assert contents(open_origin(str(where), commit, scratch)) == FILES


def test_files_of_a_folder_are_read_unchanged(home, scratch):
    repositories.commit(home, FILES)
    assert contents(open_origin(str(home / "data"), "0" * 40, scratch)) == {
        path.removeprefix("data/"): content for path, content in FILES.items() if path.startswith("data/")
    }


def test_file_is_read_as_it_was_at_an_older_commit(tmp_path, home, scratch):
    first = repositories.commit(home, FILES)
    repositories.commit(home, {"data/lf.csv": b"edited\n"})
    url = repositories.bare(home, tmp_path / "mirror.git", filters=True)
    assert open_origin(url, first, scratch).read("data/lf.csv") == FILES["data/lf.csv"]


def test_newest_commit_is_the_default(tmp_path, home, scratch):
    repositories.commit(home, FILES)
    repositories.commit(home, {"data/lf.csv": b"edited\n"})
    url = repositories.bare(home, tmp_path / "mirror.git", filters=True)
    assert open_origin(url, None, scratch).read("data/lf.csv") == b"edited\n"


def test_older_commit_is_read_from_a_server_with_the_old_git_protocol(tmp_path, home, scratch, monkeypatch):
    first = repositories.commit(home, FILES)
    repositories.commit(home, {"data/lf.csv": b"edited\n"})
    url = repositories.bare(home, tmp_path / "mirror.git", filters=False)
    for name, value in {"COUNT": "1", "KEY_0": "protocol.version", "VALUE_0": "0"}.items():
        monkeypatch.setenv(f"GIT_CONFIG_{name}", value)  # the old protocol offers only branches and tags
    assert open_origin(url, first, scratch).read("data/lf.csv") == FILES["data/lf.csv"]


def test_only_needed_files_are_transferred(tmp_path, home, scratch):
    large = bytes(i * i % 251 for i in range(200_000))
    commit = repositories.commit(home, {**FILES, "large.bin": large})
    url = repositories.bare(home, tmp_path / "mirror.git", filters=True)
    origin = open_origin(url, commit, scratch)
    origin.read("data/lf.csv")
    # Git lists missing objects with a question mark.
    (fetched,) = scratch.iterdir()
    missing = repositories.git(fetched, "rev-list", "--objects", "--missing=print", commit).splitlines()
    assert f"?{repositories.git(home, 'rev-parse', f'{commit}:large.bin')}" in missing
    assert origin.read("large.bin") == large


def test_missing_commit_is_an_error(tmp_path, home, scratch):
    repositories.commit(home, FILES)
    url = repositories.bare(home, tmp_path / "mirror.git", filters=True)
    assert_error(f"the repository does not have commit {'0' * 40}, from which", url, "0" * 40, scratch)


def test_shallow_clone_without_the_commit_is_an_error(tmp_path, home, scratch):
    first = repositories.commit(home, FILES)
    repositories.commit(home, {"data/lf.csv": b"edited\n"})
    repositories.git(tmp_path, "clone", "--quiet", "--depth=1", home.as_uri(), "shallow")
    assert_error("an incomplete clone that was made with --depth", str(tmp_path / "shallow"), first, scratch)


@pytest.mark.parametrize("filters", [True, False])
def test_shallow_clone_that_contains_the_commit_can_be_a_mirror(tmp_path, home, scratch, filters):
    repositories.commit(home, {"data/lf.csv": b"older\n"})
    commit = repositories.commit(home, FILES)
    repositories.git(tmp_path, "clone", "--quiet", "--depth=1", home.as_uri(), "shallow")
    repositories.git(tmp_path / "shallow", "config", "uploadpack.allowFilter", str(filters).lower())
    assert contents(open_origin(str(tmp_path / "shallow"), commit, scratch)) == FILES


def test_error_for_a_path_that_is_not_a_repository_contains_the_message_of_git(tmp_path, scratch):
    assert_error("nowhere: no such mirror or folder", str(tmp_path / "nowhere"), None, scratch)
    nowhere = (tmp_path / "nowhere.git").as_uri()
    assert_error("nowhere.git: cannot read the repository: fatal: .*--from", nowhere, None, scratch)
    (tmp_path / "file").write_bytes(b"no bundle")
    assert_error("file: cannot read the repository", str(tmp_path / "file"), None, scratch)


def test_folder_is_read_without_git(tmp_path, home, scratch, monkeypatch):
    commit = repositories.commit(home, FILES)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert_error("git is not installed.", str(home), commit, scratch)
    assert open_origin(str(home / "data"), commit, scratch).read("lf.csv") == FILES["data/lf.csv"]


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ("data/raw/a.csv", "data/raw/a.csv"),
        ("raw/a.csv", "data/raw/a.csv"),
        ("home/data/old/a.csv", "data/old/a.csv"),
        ("elsewhere/a.csv", "data/old/a.csv"),  # two paths match equally well, so the first one is found
        ("raw/ba.csv", None),
        ("raw", None),
    ],
)
def test_file_is_found_by_the_end_of_its_path(wanted, expected):
    assert Origin("", ["data/raw/a.csv", "data/old/a.csv", "raw/b.csv"], lambda _: b"").find(wanted) == expected
