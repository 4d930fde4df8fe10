"""What is read from a repository is what was committed to it, at the commit that was asked for, or an error."""

from pathlib import Path

import pytest

from pipeline.manage.fetch import Origin, open_origin
from reskin.errors import CaptureError
from tests import repositories

# Line ends that git would change, bytes that are no text, a name that a shell would expand, one that git would quote.
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


def refuse(sentence: str, *words) -> None:
    with pytest.raises(CaptureError, match=sentence) as caught:
        open_origin(*words)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("filters", [True, False])
def test_a_repository_gives_the_bytes_that_were_committed(tmp_path, home, scratch, filters):
    commit = repositories.commit(home, FILES)
    url = repositories.bare(home, tmp_path / "mirror.git", filters=filters)
    assert contents(open_origin(url, commit, scratch)) == FILES


@pytest.mark.parametrize("kind", ["working clone", "bare mirror", "bundle"])
def test_a_mirror_may_be_a_clone_of_any_kind(tmp_path, home, scratch, kind):
    commit = repositories.commit(home, FILES)
    repositories.bare(home, tmp_path / "mirror.git", filters=True)
    repositories.git(home, "bundle", "create", "--quiet", str(tmp_path / "home.bundle"), "HEAD", "--all")
    where = {"working clone": home, "bare mirror": tmp_path / "mirror.git", "bundle": tmp_path / "home.bundle"}[kind]
    assert contents(open_origin(str(where), commit, scratch)) == FILES


def test_a_folder_gives_its_files(home, scratch):
    repositories.commit(home, FILES)
    assert contents(open_origin(str(home / "data"), "0" * 40, scratch)) == {
        path.removeprefix("data/"): content for path, content in FILES.items() if path.startswith("data/")
    }


def test_a_commit_that_is_not_the_newest_is_taken_as_it_was(tmp_path, home, scratch):
    first = repositories.commit(home, FILES)
    repositories.commit(home, {"data/lf.csv": b"mended\n"})
    url = repositories.bare(home, tmp_path / "mirror.git", filters=True)
    assert open_origin(url, first, scratch).read("data/lf.csv") == FILES["data/lf.csv"]


def test_without_a_commit_the_newest_is_taken(tmp_path, home, scratch):
    repositories.commit(home, FILES)
    repositories.commit(home, {"data/lf.csv": b"mended\n"})
    url = repositories.bare(home, tmp_path / "mirror.git", filters=True)
    assert open_origin(url, None, scratch).read("data/lf.csv") == b"mended\n"


def test_a_server_that_gives_no_commit_by_its_hash_is_asked_for_its_branches(tmp_path, home, scratch, monkeypatch):
    first = repositories.commit(home, FILES)
    repositories.commit(home, {"data/lf.csv": b"mended\n"})
    url = repositories.bare(home, tmp_path / "mirror.git", filters=False)
    for name, value in {"COUNT": "1", "KEY_0": "protocol.version", "VALUE_0": "0"}.items():
        monkeypatch.setenv(f"GIT_CONFIG_{name}", value)  # the old protocol, whose servers offer branches and tags only
    assert open_origin(url, first, scratch).read("data/lf.csv") == FILES["data/lf.csv"]


def test_only_what_is_read_is_transferred(tmp_path, home, scratch):
    large = bytes(i * i % 251 for i in range(200_000))
    commit = repositories.commit(home, {**FILES, "large.bin": large})
    url = repositories.bare(home, tmp_path / "mirror.git", filters=True)
    origin = open_origin(url, commit, scratch)
    origin.read("data/lf.csv")
    # Git prints the objects that it has not got with a question mark.
    (fetched,) = scratch.iterdir()
    missing = repositories.git(fetched, "rev-list", "--objects", "--missing=print", commit).splitlines()
    assert f"?{repositories.git(home, 'rev-parse', f'{commit}:large.bin')}" in missing
    assert origin.read("large.bin") == large


def test_a_commit_that_is_not_there_is_refused_and_no_other_is_taken(tmp_path, home, scratch):
    repositories.commit(home, FILES)
    url = repositories.bare(home, tmp_path / "mirror.git", filters=True)
    refuse(f"the repository does not have commit {'0' * 40}, at which", url, "0" * 40, scratch)


def test_a_clone_that_is_cut_off_before_the_commit_is_refused(tmp_path, home, scratch):
    first = repositories.commit(home, FILES)
    repositories.commit(home, {"data/lf.csv": b"mended\n"})
    repositories.git(tmp_path, "clone", "--quiet", "--depth=1", home.as_uri(), "shallow")
    refuse("a clone made with --depth", str(tmp_path / "shallow"), first, scratch)


@pytest.mark.parametrize("filters", [True, False])
def test_a_clone_that_is_cut_off_at_the_commit_is_a_mirror(tmp_path, home, scratch, filters):
    repositories.commit(home, {"data/lf.csv": b"older\n"})
    commit = repositories.commit(home, FILES)
    repositories.git(tmp_path, "clone", "--quiet", "--depth=1", home.as_uri(), "shallow")
    repositories.git(tmp_path / "shallow", "config", "uploadpack.allowFilter", str(filters).lower())
    assert contents(open_origin(str(tmp_path / "shallow"), commit, scratch)) == FILES


def test_what_is_no_repository_is_refused_with_the_reason_that_git_gives(tmp_path, scratch):
    refuse("nowhere: no such mirror or folder", str(tmp_path / "nowhere"), None, scratch)
    nowhere = (tmp_path / "nowhere.git").as_uri()
    refuse("nowhere.git: cannot read the repository: fatal: .*--from", nowhere, None, scratch)
    (tmp_path / "file").write_bytes(b"no bundle")
    refuse("file: cannot read the repository", str(tmp_path / "file"), None, scratch)


def test_without_git_a_repository_cannot_be_read_and_a_folder_can(tmp_path, home, scratch, monkeypatch):
    commit = repositories.commit(home, FILES)
    monkeypatch.setenv("PATH", str(tmp_path))
    refuse("git is not installed.", str(home), commit, scratch)
    assert open_origin(str(home / "data"), commit, scratch).read("lf.csv") == FILES["data/lf.csv"]


@pytest.mark.parametrize(
    ("wanted", "found"),
    [
        ("data/raw/a.csv", "data/raw/a.csv"),
        ("raw/a.csv", "data/raw/a.csv"),
        ("home/data/old/a.csv", "data/old/a.csv"),
        ("elsewhere/a.csv", "data/old/a.csv"),  # none is nearer: the first of the shortest
        ("raw/ba.csv", None),
        ("raw", None),
    ],
)
def test_a_file_is_found_by_the_end_of_its_path(wanted, found):
    assert Origin("", ["data/raw/a.csv", "data/old/a.csv", "raw/b.csv"], lambda _: b"").find(wanted) == found
