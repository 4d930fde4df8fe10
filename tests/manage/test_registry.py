import pytest

from pipeline.manage.registry import (
    REGISTRY,
    Entry,
    Registry,
    read_registry,
    with_entry,
    without_capture,
    write_registry,
)
from reskin.errors import CaptureError
from tests.repositories import commit, git

EMPTY = Registry(captures={})


Named = tuple[str, Entry]


def header(capture: str = "c0", board: str = "b0", skin: str = "s0", chips_n: int = 5) -> Named:
    return capture, Entry(board=board, skin=skin, layout="lab", chips_n=chips_n, fingerprints=(), copy_of=None)


def register(registry: Registry, named: Named, fingerprint: str, *, allow_copy: bool = False) -> Registry:
    entry = named[1].model_copy(update={"fingerprints": (fingerprint, f"stream of {fingerprint}")})
    return with_entry(registry, "lab", named[0], entry, allow_copy=allow_copy)


ONE = register(EMPTY, header(), "aa")


def test_board_and_skin_can_have_several_captures():
    assert sorted(register(ONE, header("c1"), "bb").captures["lab"]) == ["c0", "c1"]


def test_same_recording_twice_is_an_error():
    with pytest.raises(CaptureError, match="it has the same readings as c0. Nothing has to be added"):
        register(ONE, header("c1"), "aa", allow_copy=True)


def test_relabelled_copy_is_an_error_unless_copies_are_allowed():
    copy = header("c1", board="b1", skin="s1")
    with pytest.raises(CaptureError, match="--allow-copy"):
        register(ONE, copy, "aa")
    assert register(ONE, copy, "aa", allow_copy=True).captures["lab"]["c1"].copy_of == "c0"


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (header("c0"), "already has a capture with the name c0"),
        (header("c1", board="b1"), "the board of skin s0 must be b0, as in c0; got b1"),
        (header("c1", skin="s1", chips_n=10), "10 chips, but c0 in the same scene has 5"),
    ],
)
def test_contradictory_capture_is_an_error(second, message):
    with pytest.raises(CaptureError, match=message):
        register(ONE, second, "bb")


def test_removing_a_capture_restores_the_registry():
    assert without_capture(register(ONE, header("c1"), "bb"), "lab", "c1") == ONE
    assert without_capture(ONE, "lab", "c0") == EMPTY


def test_unknown_capture_cannot_be_removed():
    with pytest.raises(CaptureError, match="no capture c7. Its captures: c0"):
        without_capture(ONE, "lab", "c7")
    with pytest.raises(CaptureError, match="scene lba has no recorded captures. Did you mean lab"):
        without_capture(ONE, "lba", "c0")


def entry(board: str, skin: str, fingerprint: str) -> Entry:
    return Entry(board=board, skin=skin, layout="table", chips_n=5, fingerprints=(fingerprint,), copy_of=None)


@pytest.fixture
def branches(tmp_path):
    """Return a function that merges two branches of a git repository, each with one capture, and reads the registry."""

    def merge(*entries: Entry) -> Registry:
        write_registry(tmp_path, Registry(captures={"lab": {"c0": entry("b0", "s0", "00")}}))
        base = commit(tmp_path, {".gitattributes": f"{REGISTRY} merge=union\n".encode()})
        for name, added in zip(("mine", "theirs"), entries, strict=True):
            git(tmp_path, "checkout", "--quiet", "-b", name, base)
            captures = read_registry(tmp_path).captures["lab"]
            write_registry(tmp_path, Registry(captures={"lab": captures | {name: added}}))
            commit(tmp_path, {})
        git(tmp_path, "merge", "--quiet", "mine", "-m", "both")
        return read_registry(tmp_path)

    (tmp_path / "data").mkdir()
    git(tmp_path, "init", "--quiet")
    return merge


def test_git_merges_captures_of_two_branches(branches):
    assert sorted(branches(entry("b1", "s1", "11"), entry("b2", "s2", "22")).captures["lab"]) == [
        "c0",
        "mine",
        "theirs",
    ]


@pytest.mark.parametrize(
    ("mine", "theirs", "message"),
    [
        (("b1", "s1", "11"), ("b2", "s1", "22"), "skin s1 is on two boards, b2 and b1"),
        (("b1", "s1", "11"), ("b2", "s2", "11"), "has the same readings as another capture"),
    ],
)
def test_merged_captures_that_contradict_each_other_are_an_error(branches, mine, theirs, message):
    with pytest.raises(CaptureError, match=message):
        branches(entry(*mine), entry(*theirs))
