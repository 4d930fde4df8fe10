"""Tests of `reskin add`: it adds a recording, or prints an error of one line and leaves no files."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from ruamel.yaml import YAML
from typer.testing import CliRunner

from pipeline import PLAN, SCENES, plan
from pipeline.cli import app
from pipeline.experiments.new_board import NewBoard
from pipeline.manage import add
from pipeline.manage import new as creating
from pipeline.manage.registry import read_registry
from pipeline.scenes import read_scene
from pipeline.settings import read_settings
from pipeline.training.board_model import read_layout_of
from pipeline.training.recorded import Compare
from reskin.board.wire import encode
from reskin.errors import ReskinError
from reskin.layouts import FOLDER
from reskin.recordings import preparing, probe
from reskin.recordings.header import Clock, write_capture
from reskin.recordings.ingest import open_capture, read_header
from reskin.recordings.preparing import CaptureNames
from reskin.recordings.probe import ProbeLog
from reskin.recordings.readers import leaphand, table
from reskin.seeds import rng_for
from reskin.universal.layout import paper_layout
from tests.board.signals import make_frames
from tests.fields import fields_uT
from tests.recordings.headers import DEFAULT_POLICY, make_header
from tests.recordings.readers.test_lab import PRESSES, row, write
from tests.recordings.readers.test_leaphand import numbers
from tests.recordings.readers.test_leaphand import write as write_leaphand
from tests.scenes import recorded_scene
from tests.stages.checkout import copy_checkout, copy_without_code, run


@pytest.fixture(scope="module")
def empty(tmp_path_factory) -> Path:
    """Return a copy of the checkout whose plan has no scenes."""
    root = copy_checkout(tmp_path_factory.mktemp("checkout"))
    plan.use(root, [])
    with (root / SCENES / "small.yaml").open("w") as stream:
        YAML().dump(recorded_scene(), stream)
    return root


@pytest.fixture
def root(empty, tmp_path) -> Path:
    return copy_without_code(empty, tmp_path / "checkout")


@pytest.fixture
def root_with_code(empty, tmp_path) -> Path:
    return shutil.copytree(empty, tmp_path / "checkout", symlinks=True)


@pytest.fixture
def lab_file(tmp_path) -> Path:
    (tmp_path / "recording").mkdir()
    return write(tmp_path / "recording", *PRESSES) / "readings.csv"


def labels(board: str = "board1", skin: str = "skin1", name: str | None = None) -> CaptureNames:
    return CaptureNames(board, skin, name)


def add_lab(root: Path, file: Path, *, allow_copy: bool = False, **arguments: str):
    return add.add(root, "small", preparing.foreign(file, "lab", labels(**arguments), {}), allow_copy=allow_copy)


def contents(root: Path) -> dict[str, bytes]:
    found = [path for path in root.rglob("*") if path.is_file() and ".dvc/" not in str(path)]
    return {str(path.relative_to(root)): path.read_bytes() for path in found if "__pycache__" not in str(path)}


def assert_refused(root: Path, attempt, message: str) -> None:
    before = contents(root)
    with pytest.raises(ReskinError, match=message) as caught:
        attempt()
    assert "\n" not in str(caught.value)
    assert contents(root) == before


def test_added_recording_is_tracked_by_dvc_and_is_in_the_registry_and_the_plan(root, lab_file):
    header = add_lab(root, lab_file)
    assert header.capture == "board1_skin1_readings"
    assert (root / "data/raw/small/board1_skin1_readings.dvc").exists()
    assert read_registry(root).captures["small"]["board1_skin1_readings"].board == "board1"
    assert plan.check(root).scenes == {}  # a recording does not put its scene into the plan
    plan.use(root, ["small"])
    params = plan.check(root)
    assert list(params.stages["ingest"]) == ["small-board1_skin1_readings"]
    add.remove(root, "small", "board1_skin1_readings")
    assert plan.check(root).scenes == {}
    assert not list((root / "data/raw").rglob("*readings*"))


def test_recording_with_repeated_readings_is_added_with_a_warning(root, tmp_path, capsys):
    """If a recorder reads faster than the chips convert, it writes each reading twice."""
    press = [row(0, "noload", 90.0), *(row(0, "contact", 100.0 + i // 2) for i in range(80))]
    add_lab(root, write(tmp_path, *press) / "readings.csv")
    assert "board1_skin1_readings: 50% of readings equal the reading before." in capsys.readouterr().err


def test_recording_with_exchanged_coordinates_is_added_with_a_warning(root, tmp_path, lab_file, capsys):
    columns = table.columns_of(5)
    for i, swapped in enumerate((False, True)):
        places_mm = rng_for(i, "places").uniform(0, 16, (40, 2)).round(2)
        changes_uT = fields_uT(places_mm - 8, np.full(40, 2.0))
        labels_mm = places_mm[:, ::-1] if swapped else places_mm
        noise_uT = rng_for(i, "noise").normal(0, 3, (80, 15))
        rows = pd.DataFrame({"phase": ["noload", "contact"] * 40})
        rows[["x_mm", "y_mm"]] = labels_mm.repeat(2, axis=0)
        rows[columns[3:18]] = 500.0 + noise_uT + np.where([[False], [True]] * 40, changes_uT.repeat(2, axis=0), 0.0)
        rows.to_csv(tmp_path / f"board{i}.csv", index=False)
        prepared = preparing.foreign(tmp_path / f"board{i}.csv", "table", labels(f"board{i}", f"skin{i}"), {})
        add.add(root, "small", prepared, allow_copy=False)
        assert ("other captures only with x and y swapped" in capsys.readouterr().err) == swapped


def test_recording_that_was_added_before_is_refused_unless_copies_are_allowed(root, lab_file):
    add_lab(root, lab_file)
    assert_refused(root, lambda: add_lab(root, lab_file), "the scene already has a capture with the name")
    assert_refused(root, lambda: add_lab(root, lab_file, name="again"), "Nothing has to be added")
    assert_refused(root, lambda: add_lab(root, lab_file, board="board2", skin="skin2"), "--allow-copy")
    assert_refused(root, lambda: add_lab(root, lab_file, board="board2", name="x"), "the same readings as")
    plan.use(root, ["small"])
    add_lab(root, lab_file, board="board2", skin="skin2", allow_copy=True)
    assert len(plan.check(root).stages["ingest"]) == 2  # the plan of a planned scene follows its captures


def test_copy_of_a_recording_is_recognised_although_its_numbers_are_formatted_differently(root, lab_file, tmp_path):
    add_lab(root, lab_file)
    (tmp_path / "copy.csv").write_text(lab_file.read_text().replace("21.5,", "21.50,"))
    assert_refused(root, lambda: add_lab(root, tmp_path / "copy.csv", board="board2", skin="skin2"), "--allow-copy")


def test_failed_removal_changes_no_files(root, lab_file):
    add_lab(root, lab_file)
    plan.use(root, ["small"])
    file = root / PLAN
    file.write_text(file.read_text().replace("  small:\n", "  nowhere: [lobo]\n  small:\n", 1))
    assert_refused(root, lambda: add.remove(root, "small", "board1_skin1_readings"), "nowhere")


def test_folder_left_by_a_killed_add_is_reported(root, lab_file):
    (root / "data/raw/small/board1_skin1_readings").mkdir(parents=True)
    assert_refused(root, lambda: add_lab(root, lab_file), "`reskin add` was killed before")


@pytest.mark.parametrize("text", ["", "1", "1,2,3", "a,b", "nan,1", "1e999,1", "1.2.3,1", "1_0,2", "\u0663,2"])
def test_invalid_mark_is_an_error(text):
    with pytest.raises(ReskinError, match="--mark: a mark must be STREAM_S,PROBE_S"):
        preparing.parse_marks([text])


@pytest.mark.parametrize(
    "content", [b"", b"x", bytes(range(256)) * 40, b"indent,phase\n0,contact\n", b"\x00" * 4096, "µ".encode() * 9]
)
def test_adding_a_broken_recording_raises_and_leaves_no_files(root, tmp_path, content):
    (tmp_path / "broken.csv").write_bytes(content)
    assert_refused(root, lambda: add_lab(root, tmp_path / "broken.csv"), "broken.csv|readings.csv")


@pytest.mark.parametrize("ignored", ["", "/other", "/other\n"])
def test_failing_add_leaves_the_scenes_gitignore_as_it_is(root, tmp_path, ignored):
    (root / "data/raw/small").mkdir(parents=True)
    (root / "data/raw/small/.gitignore").write_text(ignored)
    (tmp_path / "broken.csv").write_bytes(b"")
    assert_refused(root, lambda: add_lab(root, tmp_path / "broken.csv"), "broken.csv|readings.csv")


def test_scenes_check_names_captures_that_are_not_registered(root, lab_file, monkeypatch):
    monkeypatch.chdir(root)
    add_lab(root, lab_file)
    assert CliRunner().invoke(app, ["scenes", "check"]).stderr == ""
    (root / "data/captures.yaml").write_text("captures: {}\n")
    (root / "data/raw/small/b7.dvc").write_text("")
    assert "small/b7, small/board1_skin1_readings" in CliRunner().invoke(app, ["scenes", "check"]).stderr


def test_missing_recording_is_an_error(root, tmp_path):
    missing = "none: file not found"
    for layout in ("lab", "ini", "eflesh", "leaphand"):
        assert_refused(root, lambda: preparing.foreign(tmp_path / "none", layout, labels(), {}), missing)  # noqa: B023
    assert_refused(root, lambda: preparing.native(tmp_path / "none", labels(), None, ()), missing)


def test_error_for_a_wrong_layout_suggests_the_right_one(lab_file, tmp_path):
    (tmp_path / "dump.bin").write_bytes(encode(FRAMES, "binary"))
    cases = {
        lab_file: ("ini", "lab"),
        native_folder(tmp_path / "run1"): ("eflesh", "capture"),
        tmp_path / "dump.bin": ("lab", "serial-binary"),
    }
    for recording, (wrong, right) in cases.items():
        with (
            pytest.raises(ReskinError, match=f"It can be read with --layout {right}."),
            preparing.suggesting_layout(recording, wrong),
        ):
            preparing.foreign(recording, wrong, labels(), {})
    with (
        pytest.raises(ReskinError, match=r"one that is taken\. Choose another\.$"),
        preparing.suggesting_layout(lab_file, "lab"),
    ):
        raise ReskinError("capture c", "its name", "new", "one that is taken", "Choose another.")


@pytest.mark.parametrize("name", ["../up", "a b", "", "x" * 80, "ä", "/abs"])
def test_invalid_name_is_an_error(root, lab_file, tmp_path, name):
    assert_refused(root, lambda: add_lab(root, lab_file, board=name), "--board: a name must be")
    folder = native_folder(tmp_path / "run1")
    assert_refused(root, lambda: preparing.native(folder, labels(name=name), None, ()), "--name: a name must be")


def test_recording_cannot_be_added_to_a_simulated_scene(root, lab_file):
    prepared = preparing.foreign(lab_file, "lab", labels(), {})
    assert_refused(
        root,
        lambda: add.add(root, "ci", prepared, allow_copy=False),
        "scene ci is simulated, but .* is recorded.* reskin new NEW",
    )


@pytest.mark.parametrize("press_uT", [0.0, 20.0])
def test_recording_whose_presses_do_not_change_the_field_is_named(root, tmp_path, capsys, press_uT):
    rng = rng_for(0, "signal")
    lines = ["phase,x_mm,y_mm,Bx0,By0,Bz0,Fz_N"]
    for row_i in range(400):
        press, contact = row_i // 20, row_i % 20 >= 10
        fields = ",".join(f"{value:.2f}" for value in 500 + press_uT * contact + rng.normal(0, 4, 3))
        lines.append(f"{'contact' if contact else 'noload'},{press % 5 * 2},{press // 5 * 2},{fields},{2.0 * contact}")
    (tmp_path / "table.csv").write_text("\n".join(lines) + "\n")
    add.add(root, "small", preparing.foreign(tmp_path / "table.csv", "table", labels(), {}), allow_copy=False)
    assert ("noise" in capsys.readouterr().err) == (press_uT == 0)


# Native captures in the following tests have two indentations with ten frames per dwell, at 400 Hz.
FRAMES = make_frames(60, 2, seed=0)


def probe_log(frame_s: float = 1 / 400) -> ProbeLog:
    starts = np.array([0, 15, 30, 45]) * frame_s
    label = np.array([4, 4, 8, 8], np.float32)
    return ProbeLog(
        indentation=np.array([0, 0, 1, 1], np.int32), pass_i=np.zeros(4, np.int32), contact=np.array([False, True] * 2),
        t_start_s=starts, t_end_s=starts + 10.5 * frame_s, x_mm=label, y_mm=label, depth_mm=label / 10, Fx_N=label,
        Fy_N=label, Fz_N=label,
    )  # fmt: skip


def native_folder(folder: Path, stream: bytes = encode(FRAMES, "binary"), source: str = "recorded") -> Path:
    header = make_header(
        capture=folder.name, layout="native", wire="binary", chips_n=2, source=source,
        clock=Clock(kind="rate", rate_hz=400.0, marks=((0.0, 0.0),)),
    )  # fmt: skip
    files = {"stream.bin": stream, "probe.csv": probe.render(probe_log()).encode()}
    write_capture(folder, header, files)
    return folder


def test_recording_of_an_emulated_board_can_be_added_to_a_scene_for_emulated_boards(root, tmp_path):
    folder = native_folder(tmp_path / "run1", source="simulated")
    creating.new(root, "emulated", ["board1", "b2"], 4, 1, "reskin", "simulated")
    prepared = preparing.native(folder, labels(), None, ())
    header = add.add(root, "emulated", prepared, allow_copy=False)
    assert header.source == read_scene(root, "emulated").source == "simulated"
    planned = plan.plan_of(root, ["emulated"])
    assert planned["stages"]["ingest"] == {"emulated-run1": {"scene": "emulated", "capture": "run1"}}
    assert planned["stages"]["simulate"] == {}


def test_native_capture_keeps_its_header(root, tmp_path):
    folder = native_folder(tmp_path / "run1")
    header = add.add(root, "small", preparing.native(folder, labels(), None, ()), allow_copy=False)
    assert header == read_header(root / "data/raw/small/run1")
    _, blocks, account = open_capture(root / "data/raw/small/run1", DEFAULT_POLICY)
    assert sum(map(len, blocks)) == account["frames_contact_n"] > 0


def test_native_capture_is_an_error_if_its_labels_or_bytes_contradict_its_header(root, tmp_path):
    folder = native_folder(tmp_path / "run1")
    assert_refused(
        root,
        lambda: preparing.native(folder, labels(board="board7"), None, ()),
        "--board is 'board7', but the header says 'board1'",
    )
    (folder / "stream.bin").write_bytes(b"other")
    assert_refused(
        root,
        lambda: preparing.native(folder, labels(), None, ()),
        "stream.bin: the file has changed since it was recorded",
    )
    (folder / "header.json").write_bytes(b"\xff{")
    assert_refused(root, lambda: preparing.native(folder, labels(), None, ()), "header.json")


@pytest.mark.parametrize(
    ("damage", "message"),
    [(b"", "no frame found in 0 bytes"), (b"x", "no frame found"), (bytes(range(251)) * 99, "no frame found")],
)
def test_dump_without_frames_is_an_error(root, tmp_path, damage, message):
    (tmp_path / "dump.bin").write_bytes(damage)
    (tmp_path / "probe.csv").write_text(probe.render(probe_log()))
    what = {"wire": "binary", "chips_n": 2, "rate_hz": 400.0, "probe": tmp_path / "probe.csv"}
    assert_refused(
        root,
        lambda: add.add(root, "small", preparing.dump(tmp_path / "dump.bin", labels(), **what), allow_copy=False),
        message,
    )


def test_error_for_a_wrong_number_of_chips_suggests_the_right_one(root, tmp_path):
    (tmp_path / "dump.bin").write_bytes(encode(FRAMES, "binary"))
    (tmp_path / "probe.csv").write_text(probe.render(probe_log()))
    what = {"wire": "binary", "chips_n": 5, "rate_hz": 400.0, "probe": tmp_path / "probe.csv"}
    assert_refused(
        root,
        lambda: add.add(root, "small", preparing.dump(tmp_path / "dump.bin", labels(), **what), allow_copy=False),
        "The bytes fit binary with 2 chips",
    )
    assert_refused(
        root,
        lambda: preparing.dump(tmp_path / "dump.bin", labels(), wire="binary", chips_n=2, rate_hz=400.0, probe=None),
        "Add --probe",
    )


def test_capture_with_many_lost_bytes_is_an_error(root, tmp_path):
    stream = encode(FRAMES, "binary")
    damaged = native_folder(tmp_path / "run1", stream[:1000] + bytes(1500) + stream[1000:])
    assert_refused(
        root,
        lambda: add.add(root, "small", preparing.native(damaged, labels(), None, ()), allow_copy=False),
        r"more than 5% of \d+ bytes are lost: .*skipped_resync_bytes",
    )


def test_reskin_add_prints_an_error_of_one_line(root_with_code, tmp_path):
    (tmp_path / "broken.csv").write_bytes(b"")
    arguments = ["--layout", "lab", "--board", "b", "--skin", "s", "--scene", "small"]
    done = run(root_with_code, "reskin", "add", str(tmp_path / "broken.csv"), *arguments, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert len(done.stderr.strip().splitlines()) == 1


def output_of(arguments: list[str]) -> str:
    """Run a command in this process, in the working directory; return its output or error."""
    done = CliRunner().invoke(app, arguments)
    return str(done.exception) if isinstance(done.exception, ReskinError) else done.stdout


@pytest.mark.parametrize(
    ("layout", "option", "used"), [("table", "--chips=4", "serial-binary"), ("lab", "--rows-late=0", "ini")]
)
def test_options_of_another_layout_are_refused(root, lab_file, monkeypatch, layout, option, used):
    monkeypatch.chdir(root)
    arguments = ["add", str(lab_file), "--layout", layout, "--board", "b", "--skin", "s", "--scene", "small", option]
    assert_refused(root, lambda: run_and_raise(arguments), f"{option.partition('=')[0]} is only for --layout .*{used}")


def run_and_raise(arguments: list[str]) -> None:
    raise CliRunner().invoke(app, arguments).exception


def test_recording_without_contact_is_an_error_if_no_experiment_of_the_scene_uses_it(root, tmp_path):
    write_leaphand(tmp_path, numbers(30))
    prepared = preparing.foreign(tmp_path / leaphand.READINGS, "leaphand", labels(), {"pad": "1"})
    message = "nothing touches the skin in this recording, and no experiment of scene small uses such recordings"
    assert_refused(root, lambda: add.add(root, "small", prepared, allow_copy=False), message)


def test_reskin_new_creates_a_scene_with_the_experiments_that_its_boards_allow(root, tmp_path, monkeypatch):
    monkeypatch.chdir(root)
    created = output_of(["new", "mine", "--boards", "b1,b2,b3", "--presses", "60", "--passes", "2"])
    assert "describe your boards in this file" in created
    scene = read_scene(root, "mine")
    assert scene.experiments == ("transfer", "lobo", "triplet", "adapt", "audit", "compare", "new_board")
    assert read_settings("mine", root).section(NewBoard, "new_board").model is None
    layout = read_settings("mine", root).section(Compare, "compare").layout
    assert layout == paper_layout().model_copy(update={"name": "mine"})
    assert read_layout_of(root / SCENES / "mine.yaml")[0] == layout
    assert "exists already. Choose another name" in output_of(["new", "mine", "--boards", "b1,b2", "--presses", "60"])
    assert "one board cannot be held out" in output_of(["new", "one", "--boards", "b1", "--presses", "60"])
    own = tmp_path / "own.yaml"
    own.write_text((FOLDER / "reskin.yaml").read_text().replace("gap_mm: 1.6", "gap_mm: 2").replace("reskin", "own", 1))
    for name, layout, tested in (("like_paper", "reskin", True), ("own", str(own), False)):
        output_of(["new", name, "--boards", "b1,b2", "--presses", "12", "--layout", layout])
        scene = read_scene(root, name)
        assert "adapt" not in scene.experiments
        section = read_settings(name, root).section(NewBoard, "new_board")
        assert (section.model is not None, section.presses_n, section.labels_n) == (tested, (4,), (0, 1))
    assert read_settings("own", root).section(Compare, "compare").layout.gap_mm == 2


def test_board_and_skin_of_several_recordings_are_taken_from_the_names_of_their_files(root, tmp_path, monkeypatch):
    monkeypatch.chdir(root)
    output_of(["new", "mine", "--boards", "b1,b2", "--presses", "12"])
    for i, name in enumerate(("b1_s1", "b2_s1_more", "b3_s1")):
        write(tmp_path, *(press.replace("162.0", f"16{i}.5") for press in PRESSES))
        (tmp_path / "readings.csv").rename(tmp_path / f"{name}.csv")

    def add_two(name: str) -> str:
        files = [str(tmp_path / f"{one}.csv") for one in ("b1_s1", name)]
        done = CliRunner().invoke(app, ["add", *files, "--layout", "lab", "--scene", "mine"])
        return f"{done.output} {done.exception or ''}"

    before = contents(root)
    assert "board b3 is not a board of scene mine" in add_two("b3_s1")
    assert contents(root) == before
    with pytest.raises(ReskinError, match=r"file's name is not of the form BOARD_SKIN\.csv"):
        add.names_of(root, "mine", Path("b2.csv"), labels("", ""))
    add_two("b2_s1_more")
    captures = read_registry(root).captures["mine"]
    assert {name: (entry.board, entry.skin) for name, entry in captures.items()} == {
        "b1_s1": ("b1", "b1_s1"), "b2_s1_more": ("b2", "b2_s1")
    }  # fmt: skip
