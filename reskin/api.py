"""The public functions and classes of `reskin`, for notebooks and robot programs.

Most functions take names and plain values, and return NumPy arrays. The names of arguments and results end in their
units: mm, N, s, uT. In docstrings, [n 3] is the shape of an array with n rows and 3 columns. The channels of a field
are Bx, By, Bz of chip 0, then of chip 1, and so on; ch is the number of channels.

The no-load reading is the mean field while nothing touches the skin. The field change is a reading minus the no-load
reading.

Each function imports its dependencies only when it is called, so that `import reskin` is quick.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Union, overload

import numpy as np
from numpy.typing import ArrayLike

from reskin.config import parse
from reskin.errors import ParamsError, SchemaError
from reskin.seeds import rng_for
from reskin.simulation.defaults import nominal

if TYPE_CHECKING:
    import pandas as pd

    from reskin.data.rows import Rows
    from reskin.live.tracker import LiveSkin, LiveSkins
    from reskin.models.trained import Network
    from reskin.physics.board import Board
    from reskin.physics.skin import Skin
    from reskin.recordings.labels import Label
    from reskin.universal.model import Universal

AnyModel = Union[Path, str, "Model", "Universal", Sequence[Union[Path, str, "Model", "Universal"]]]
Changes = Mapping[str, Any]  # values of the settings that differ from the nominal settings, by the setting's name
NOMINAL_BOARD = "rigid"  # name of the nominal board among the nominal settings


def load_rows(folder: Path | str, *, force_min_N: float = 0.0) -> Rows:
    """Load readings in contact, in the form in which networks are trained on them.

    The readings must have been ingested, which means that a recording was converted to a table with one row per reading
    (`dvc repro` does this for the recordings of a scene).

    Parameters
    ----------
    folder : path
        A folder with tables of ingested readings (Parquet), such as `data/indentations/quick` after `dvc repro`.
    force_min_N : float
        Smallest normal force. Readings with a smaller force are left out.

    Returns
    -------
    Rows
        An object with these attributes, for f readings with ch channels: `db_uT` [f ch] contains the field changes.
        `target` [f 3] contains x_mm, y_mm and Fz_N. `board` [f] and `skin` [f] contain the names of each reading's
        board and skin.

    Raises
    ------
    ParamsError
        If the folder contains no Parquet file.

    Examples
    --------
    >>> rows = reskin.load_rows("data/indentations/quick")  # doctest: +SKIP
    >>> rows.db_uT.shape, rows.target.shape  # doctest: +SKIP
    ((8190, 15), (8190, 3))
    """

    from reskin.data.rows import Selection
    from reskin.data.rows import load_rows as load

    files = sorted(Path(folder).glob("*.parquet"))
    if not files:
        raise ParamsError(f"{folder}: no Parquet files in this folder. To create them from captures, run `dvc repro`.")
    return load(files, Selection(force_min_N=force_min_N))


def draw_board(name: str = "b0", *, seed: int = 0, spreads: Changes | None = None, **design: Any) -> Board:
    """Draw a simulated circuit board at random.

    The board deviates from the nominal board by random tolerances, as real boards do.

    Parameters
    ----------
    name, seed : str, int
        Name of the board, and seed of the random numbers. The same name and seed give the same board.
    spreads : mapping, optional
        Standard deviations of the tolerances, which replace the nominal ones, such as `{"chip_offset_uT": 0.0}`.
    **design
        Settings that replace those of the nominal board: `chips_xy_mm` [[x, y], ...] (positions relative to the skin's
        centre), `chips_turn_deg` [angle, ...] (rotations in the plane of the board), `gap_mm` (between chips and skin).

    Returns
    -------
    Board
        `chips_m` [k 3] is the position of each chip in m.

    Raises
    ------
    ParamsError
        If a setting is unknown or its value is invalid.

    Examples
    --------
    >>> board = reskin.draw_board(chips_xy_mm=[[0, 0], [7, 0]], chips_turn_deg=[0, 90])
    >>> board.chips_m.shape
    (2, 3)
    """
    from reskin.physics import board
    from reskin.physics.board import BoardDesign, Spreads

    settings = parse(BoardDesign, nominal("boards")[NOMINAL_BOARD]["design"] | design, "draw_board")
    return board.draw_board(settings, parse(Spreads, nominal("spreads", spreads), "spreads"), seed=seed, name=name)


def draw_skin(name: str = "b0_s0", *, seed: int = 0, spreads: Changes | None = None, **design: Any) -> Skin:
    """Draw a simulated skin at random.

    The skin deviates from the nominal skin by random tolerances, as real skins do.

    Parameters
    ----------
    name, seed : str, int
        Name of the skin, and seed of the random numbers. The same name and seed give the same skin.
    spreads : mapping, optional
        Standard deviations of the tolerances, which replace the nominal ones, such as `{"skin_modulus": 0.0}`.
    **design
        Settings that replace those of the nominal skin: `thickness_mm`, `modulus_kPa`, `tip_radius_mm`, ...

    Returns
    -------
    Skin
        The magnetisation of the skin is represented by s dipoles. `nodes_m` [s 3] contains their positions, and
        `moments_A_m2` [s 3] contains their magnetic moments.

    Raises
    ------
    ParamsError
        If a setting is unknown or its value is invalid.

    Examples
    --------
    >>> skin = reskin.draw_skin(seed=1, thickness_mm=3.0)
    """
    from scipy.constants import milli

    from reskin.physics import skin
    from reskin.physics.board import Spreads
    from reskin.physics.magnet import QuadratureSettings

    boards = nominal("boards")[NOMINAL_BOARD]
    return skin.draw_skin(
        parse(skin.SkinDesign, nominal("skin", design), "draw_skin"),
        parse(Spreads, nominal("spreads", spreads), "spreads"),
        seed=seed,
        name=name,
        rule=parse(QuadratureSettings, boards["quadrature"], "quadrature").in_si(),
        sides_m=(boards["skin_mm"][0] * milli, boards["skin_mm"][1] * milli),
    )


class Pokes(NamedTuple):
    """The fields and forces of simulated indentations, as `simulate_pokes` returns them."""

    noload_uT: np.ndarray  # [n ch] field before each indentation
    b_uT: np.ndarray  # [n ch] field during each indentation
    Fz_N: np.ndarray  # [n] normal forces, positive in compression


def simulate_pokes(
    skin: Skin, pokes: ArrayLike, *, board: Board | None = None, seed: int = 0, chip: Changes | None = None
) -> Pokes:
    """Simulate indentations of a skin: the readings of the chips, and the normal force.

    The skin is new. Its wear and ageing, and friction at the tip, are not simulated.

    Parameters
    ----------
    skin : Skin
        A skin from `draw_skin`.
    pokes : array [n 3]
        x_mm, y_mm and depth_mm of n indentations; n may be 0. The centre of the skin is at x = y = 8 mm.
    board : Board, optional
        The board under the skin, from `draw_board`. Default: a board that is drawn with `seed`.
    seed : int
        Seed of the noise of the chips, and of the board if no board is given.
    chip : mapping, optional
        Settings that replace those of the nominal magnetometer, such as `{"noise_xy_uT": 0.0, "noise_z_uT": 0.0}`.

    Returns
    -------
    Pokes
        Fields before (`noload_uT` [n ch]) and during (`b_uT` [n ch]) each indentation, and normal forces `Fz_N` [n].

    Raises
    ------
    ParamsError
        If `pokes` does not have shape [n 3], or a setting is invalid.

    Examples
    --------
    >>> skin = reskin.draw_skin(seed=1)
    >>> noload_uT, b_uT, force_N = reskin.simulate_pokes(skin, [[8.0, 8.0, 1.0], [2.0, 4.0, 0.5]])
    >>> b_uT.shape, force_N.shape
    ((2, 15), (2,))
    """
    from scipy.constants import milli

    from reskin.data.grid import CENTRE_MM
    from reskin.physics.chip import ChipDesign, read_field
    from reskin.simulation.contact import Terms, simulate_response

    places_mm = np.asarray(pokes, np.float64)
    if places_mm.ndim != 2 or places_mm.shape[1] != 3:
        raise ParamsError(
            f"simulate_pokes: pokes has shape {places_mm.shape}; it needs rows of x_mm, y_mm, depth_mm. "
            "Try: [[8.0, 8.0, 1.0]]"
        )
    tip_m = (places_mm - (CENTRE_MM, CENTRE_MM, 0.0)) * milli
    board = board or draw_board(seed=seed)
    design = parse(ChipDesign, nominal("chip", chip), "chip")
    if not len(places_mm):
        empty_uT = np.zeros((0, 3 * len(board.chips_m)), np.float32)
        return Pokes(empty_uT, empty_uT.copy(), np.zeros(0))
    rngs = {part: rng_for(seed, "poking", skin.name, part) for part in ("drift", "noload", "contact")}
    no_tilt = np.zeros((len(tip_m), 2))
    response = simulate_response(board, skin, tip_m[:, None], tilt=no_tilt, terms=Terms(), rng=rngs["drift"])
    noload_uT, _ = read_field(response.rest_T, board, design=design, rng=rngs["noload"])
    b_uT, _ = read_field(response.rest_T + response.change_T[:, 0], board, design=design, rng=rngs["contact"])
    return Pokes(noload_uT, b_uT, response.force_N[:, 0, 2])


def simulate_recording(
    folder: Path | str,
    *,
    skin: str = "b0_s0",
    board: str = "b0",
    depths_mm: Sequence[float] = (0.4, 0.8, 1.2),
    passes_n: int = 1,
    seed: int = 0,
) -> Path:
    """Simulate a recording of a board with labels, and write it to a new folder as a capture.

    A simulated robot presses the skin at the 65 places of the paper's grid. The capture has the same files as a capture
    that `reskin record` writes for a real board. Its header states that the source is "simulated".

    Parameters
    ----------
    folder : path
        Folder to create for the capture.
    skin, board, seed : str, str, int
        Names of the skin and of the board, and seed of the random numbers. The same names and seed give the same skin
        (as `draw_skin` draws it), the same board (`draw_board`) and the same noise.
    depths_mm : sequence of float
        Depths of the indentations. All places are pressed to the first depth, then all places to the second depth, and
        so on.
    passes_n : int
        Number of passes. In each pass, all places are pressed to all depths.

    Returns
    -------
    Path
        The folder of the capture.

    Raises
    ------
    ReskinError
        If the folder exists already, a name is not allowed, or a setting is out of range.

    Examples
    --------
    >>> folder = reskin.simulate_recording("captures/run1", depths_mm=[1.0])  # doctest: +SKIP
    """
    from reskin.recordings import header as headers
    from reskin.simulation.capture import simulate_capture, to_files
    from reskin.simulation.defaults import SHARED
    from reskin.simulation.settings import MAIN, parse_simulation

    target, where = Path(folder), "simulate_recording"
    if target.exists():
        raise ParamsError(f"{where}: {target} exists. Choose another folder.")
    for what, name in (("folder", target.name), ("skin", skin), ("board", board)):
        if not re.fullmatch(headers.NAME, name):
            raise ParamsError(where, f"the {what}'s name", headers.NAME_RULE, repr(name), "Choose another name.")
    presses = nominal("protocols")[MAIN] | {"depths_mm": list(depths_mm), "passes_n": passes_n}
    section = {"boards": nominal("boards"), "protocols": {MAIN: presses}}
    simulation = parse_simulation(section, {name: nominal(name) for name in SHARED}, where)
    header, files = to_files(simulate_capture(simulation, MAIN, board=board, skin=skin, seed=seed), simulation)
    headers.write_capture(target, header.model_copy(update={"capture": target.name}), files)
    return target


class Model:
    """A trained network, as `load_model` returns it.

    Before you call `predict`, call `zero` with readings that were taken while nothing touched the skin.

    Attributes
    ----------
    card : mapping
        The content of the model's JSON card, which describes the training data, the settings of the training, the
        inputs and the outputs.
    """

    def __init__(self, network: Network) -> None:
        self._network = network
        self._noload_uT: np.ndarray | None = None

    @property
    def card(self) -> Mapping[str, Any]:
        return self._network.card

    def zero(self, b_uT: ArrayLike) -> Model:
        """Set the no-load reading, which `predict` subtracts from its inputs.

        Parameters
        ----------
        b_uT : array [f ch] or [ch]
            One or several readings that were taken without contact. The no-load reading is their mean.

        Returns
        -------
        Model
            The model itself.

        Raises
        ------
        SchemaError
            If the number of channels differs from the model's.
        """
        self._noload_uT = self._rows(b_uT).mean(axis=0, dtype=np.float64)
        return self

    def predict(self, b_uT: ArrayLike) -> np.ndarray:
        """Predict the place and the normal force of a contact.

        Parameters
        ----------
        b_uT : array [f ch] or [ch]
            One or several readings that were taken in contact. Predictions for readings without contact are
            meaningless.

        Returns
        -------
        array [f 3] or [3]
            x_mm, y_mm and the normal force in N, for each reading.

        Raises
        ------
        ParamsError
            If `zero` was not called before.
        SchemaError
            If the number of channels differs from the model's.
        """
        if self._noload_uT is None:
            raise ParamsError("predict: the no-load reading is missing. First call zero with readings without contact.")
        rows_uT = self._rows(b_uT)
        predicted = self._network((rows_uT - self._noload_uT).astype(np.float32))
        return predicted if np.ndim(b_uT) == 2 else predicted[0]

    def export_onnx(self, file: Path | str) -> None:
        """Write the network as an ONNX file.

        The inputs of the ONNX model are field changes in uT, and its outputs are x_mm, y_mm and F_N. This method
        requires the package onnx (`pip install '.[onnx]'`).
        """
        from reskin.models import trained

        trained.write_onnx(self._network, Path(file))

    def _rows(self, b_uT: ArrayLike) -> np.ndarray:
        rows_uT, channels_n = np.atleast_2d(np.asarray(b_uT, np.float32)), self.card["input"]["channels_n"]
        if rows_uT.ndim != 2 or rows_uT.shape[1] != channels_n:
            raise SchemaError(
                f"fields of shape {np.shape(b_uT)} do not fit the {channels_n} channels of the model. "
                "Pass Bx, By, Bz of chip 0, then of chip 1, ..."
            )
        return rows_uT


def load_model(file: Path | str) -> Model:
    """Load a trained network.

    Parameters
    ----------
    file : path
        The file of the weights (.safetensors). The model's JSON card must be in the same folder, with the same name and
        suffix .json.

    Returns
    -------
    Model

    Raises
    ------
    ReskinError
        If one of the two files is missing, or if the model that the JSON card describes does not fit the weights.

    Examples
    --------
    >>> file = "data/models/quick/train_multi/NAME.safetensors"
    >>> model = reskin.load_model(file).zero(noload_uT)  # doctest: +SKIP
    >>> x_mm, y_mm, force_N = model.predict(b_uT)[0]  # doctest: +SKIP
    """
    from reskin.models.trained import read_network

    return Model(read_network(Path(file)))


def load_universal(
    skin: Path | str | None = None, *, file: Path | str | None = None, external_uT: float = 0.0
) -> Universal:
    """Load the universal model, which estimates contacts on skins that it was not trained on.

    The model needs at least the no-load reading of your skin (method `zero`). Further data of the skin make its
    estimates more accurate: presses at unknown places (method `see`) and presses at known places (method `label`). With
    many labels, `refine` trains the network further. `save` writes what is known of the skin to a file.

    Parameters
    ----------
    skin : path, optional
        A file that `save` wrote. The returned model is calibrated to this skin, and can be calibrated further.
    file : path, optional
        A model (.safetensors, with its JSON card) that `reskin model make` made for the layout of a board. Default: the
        model for the paper's board, which comes with the library.
    external_uT : float
        Size of the external fields, for a board that a robot moves. When the board turns, the external field at its
        chips changes, for example the earth's field. `external_uT` is the standard deviation of each component of this
        change since the no-load reading. It is about 30 for the earth's field. Default: 0, for a board at rest.

    Returns
    -------
    Universal

    Raises
    ------
    ReskinError
        If a file is missing or of a wrong kind, if the skin was saved with a model for another board, or if
        `external_uT` is out of range.

    Examples
    --------
    >>> noload_uT, b_uT, force_N = reskin.simulate_pokes(reskin.draw_skin(seed=1), [[8.0, 8.0, 1.5]])
    >>> model = reskin.load_universal().zero(noload_uT)
    >>> model.predict(b_uT).shape  # x_mm, y_mm, F_N
    (1, 3)
    """
    from reskin.universal.model import FILE
    from reskin.universal.model import load_universal as load

    return load(skin, file=FILE if file is None else file, external_uT=external_uT)


def load_recording(path: Path | str, *, frames: bool = False, rate_hz: float = 400.0) -> pd.DataFrame:
    """Load a recording as a pandas DataFrame.

    This function requires the package pandas (`pip install '.[learn]'`).

    Parameters
    ----------
    path : path
        A recording. The function detects which of these kinds it is:

        - the folder of a capture, as `reskin record` and `reskin add` write it
        - a log that a board wrote to an SD card
        - a file that `reskin decode` wrote
        - a table with labels (CSV or Parquet, layout `table` in data/README.md)
        - an ingested capture, `data/indentations/SCENE/CAPTURE.parquet`
    frames : bool
        Whether to load all frames of a capture with labels. By default, only the readings that have a label are loaded.
    rate_hz : float
        Number of frames per second. It is used only for a file from `reskin decode` that contains no times.

    Returns
    -------
    DataFrame
        If the recording has labels, there is one row for each reading in contact, as in an ingested capture. The
        columns are those of data/README.md (`board`, `x_mm`, `Fz_N`, ...). For each channel, there are three columns:
        the field (`bx0_uT`), the no-load reading (`noload_bx0_uT`) and their difference (`dbx0_uT`).

        If the recording has no labels, or if `frames` is True, there is one row for each frame. The columns are the
        time (`t_s`), the field (`bx0_uT`, `by0_uT` and so on) and the temperature of each chip (`temperature0_degC` and
        so on). For the folder of a capture, there are also the columns `capture`, `board`, `skin` and `source`.

        The names of the columns end in their units. In addition, the dictionary `frame.attrs["units"]` contains the
        unit of each column ("1" for counts, "" for text). The dictionary `frame.attrs["counts"]` contains the numbers
        of frames and rows that were read, and for each reason, the number of those that were dropped.

        Faulty readings are dropped according to section `faults` of `params.yaml`.

    Raises
    ------
    ReskinError
        If the path does not exist, if the recording is damaged or of none of these kinds, or if pandas is missing.

    Examples
    --------
    >>> frame = reskin.load_recording("captures/run1")  # doctest: +SKIP
    >>> frame.attrs["units"]["Fz_N"]  # doctest: +SKIP
    'N'
    >>> X, y = frame.filter(like="db"), frame[["x_mm", "y_mm", "Fz_N"]]  # doctest: +SKIP
    """
    from reskin.recordings import loading

    return loading.load_recording(Path(path), frames=frames, rate_hz=rate_hz)


@overload
def open(port: str, *, model: AnyModel = (), baud: int = 115200, wire: str | None = None) -> LiveSkin: ...
@overload
def open(port: list[str], *, model: AnyModel = (), baud: int = 115200, wire: str | None = None) -> LiveSkins: ...
def open(
    port: str | list[str], *, model: AnyModel = (), baud: int = 115200, wire: str | None = None
) -> LiveSkin | LiveSkins:
    """Read contacts from one or several boards as they happen. Use the result in a `with` statement.

    The `with` statement opens the port, detects the wire format (how a board encodes its readings) and the number of
    chips, and measures the no-load reading. Therefore, nothing may touch the skin in the first second. A background
    thread reads the port, so that no bytes are lost if your loop is slow.

    Parameters
    ----------
    port : str or list of str
        A serial port, or the address of a TCP server (`socket://host:port`). For several boards, a list of these.
    model : optional
        The model that estimates contacts. Default: the universal model that comes with the library. Other values are:

        - one or several trained networks, as files or `Model` objects
        - a universal model, as a `Universal` object (which is not modified) or as a file
        - the file of a calibration of the universal model, or a list of the files of a model and of its calibration

        For a board that a robot moves, pass `load_universal(external_uT=...)`.
    baud : int
        Baud rate of the serial port. Ports of boards that are connected by USB ignore it.
    wire : str, optional
        The format of other firmware: `text:` with the names of the columns of a line, such as
        `text:Bx0,By0,Bz0,Bx1,By1,Bz1`, or the name of a YAML file (docs/live.md). Default: one of the known formats,
        which is detected.

    Returns
    -------
    LiveSkin or LiveSkins
        An object over which you can iterate. Each iteration yields the latest `Contact`, which contains the time, the
        place and the force with their standard deviations, the field, and alarms. If your loop is slow, older contacts
        are skipped. To get a contact for each reading, iterate over `every()` instead. With a list of ports, each
        iteration yields a tuple of contacts, in the order of the ports. A board that is unplugged does not delay the
        other boards.

    Raises
    ------
    ReskinError
        If a model cannot be read or a port is listed twice. The `with` statement also raises this error, if a port
        cannot be opened or sends no readings, or if the board and the model have different numbers of chips.

    Examples
    --------
    >>> with reskin.open("/dev/ttyACM0") as skin:  # doctest: +SKIP
    ...     for contact in skin:
    ...         print(contact.t_s, contact.x_mm, contact.y_mm, contact.F_N, contact.alarms)
    """
    from reskin.board.other_firmware import custom_wire
    from reskin.live.tracker import LiveSkin, LiveSkins, check_ports

    models, custom = _load_all(model), custom_wire(wire, "wire")
    if isinstance(port, str):
        return LiveSkin(port, models, baud=baud, wire=custom)
    check_ports(port, models, "reskin.open")
    return LiveSkins([LiveSkin(name, models, baud=baud, wire=custom) for name in port])


def _load_all(model: AnyModel) -> Sequence[Network] | Universal:
    """Load the models that are given as files.

    Returns all networks in the given order, or the universal model.
    """
    from reskin.predicting import read_models
    from reskin.universal.model import Universal

    given = list(model) if isinstance(model, Iterable) and not isinstance(model, str) else [model]
    for item in given:
        if not isinstance(item, str | Path | Model | Universal):
            remedy = "Pass a path, or an object that load_model or load_universal returned."
            raise ParamsError("reskin.open", "a model", "a file or a loaded model", type(item).__name__, remedy)
    if len(given) == 1 and isinstance(given[0], Universal):
        return given[0]
    files = [Path(item) for item in given if isinstance(item, str | Path)]
    read = read_models(files) if files or not given else []
    if isinstance(read, Universal) and len(given) == len(files):
        return read
    if isinstance(read, Universal) or any(isinstance(item, Universal) for item in given):
        raise ParamsError("reskin.open: a universal model cannot be combined with other models. Use it alone.")
    from_files = iter(read)
    return [item._network if isinstance(item, Model) else next(from_files) for item in given]


def lifted() -> Label:
    """Return a label for `record` that means: nothing touches the skin.

    There must be such a label before each touch, because the no-load reading is measured then.
    """
    from reskin.recordings.labels import Label

    return Label(False)


def touch(
    x_mm: float,
    y_mm: float,
    *,
    depth_mm: float = math.nan,
    Fx_N: float = math.nan,
    Fy_N: float = math.nan,
    Fz_N: float = math.nan,
    pass_i: int = 0,
) -> Label:
    """Return a label for `record` that means: the robot touches the skin at this place and does not move.

    Parameters
    ----------
    x_mm, y_mm : float
        Place of the touch.
    depth_mm, Fx_N, Fy_N, Fz_N : float, optional
        Depth of the indentation, and components of the force on the skin (Fz is positive in compression). Default: NaN,
        which means that the value is unknown.
    pass_i : int
        Number of the current pass, counted from 0, if the program visits all places several times.

    Examples
    --------
    >>> reskin.touch(8.0, 4.0, Fz_N=0.5).Fz_N
    0.5
    """
    from reskin.recordings.labels import Label

    return Label(True, x_mm, y_mm, depth_mm, Fx_N, Fy_N, Fz_N, pass_i)


def record(
    labels: Iterable[Label] | Callable[[], Label | None],
    *,
    port: str | None = None,
    out: Path | str | None = None,
    seconds: float = float("inf"),
    dwell_s: float = 0.5,
    board: str | None = None,
    skin: str | None = None,
    scan: str | None = None,
) -> Path:
    """Record a board while your program moves a robot and labels the contacts.

    A label states where and how hard the robot touches the skin (see `touch`), or that nothing touches it (see
    `lifted`). At the end, a summary is printed to stderr: how much data was recorded, lost and left out.

    Parameters
    ----------
    labels : iterable or callable
        An iterable that moves the robot and then yields a label, `lifted()` or `touch(...)`, each time the robot has
        stopped. Or a function that returns such a label at each call, and None at the end.
    port : str, optional
        The board's port. Default: the port of the only connected board.
    out : path, optional
        Folder to create for the capture. Default: `captures/DATE-TIME`.
    seconds : float
        Maximum duration of the recording.
    dwell_s : float
        Time in s for which each label is valid. The robot must not move during this time. The next label is requested
        after it.
    board, skin, scan : str, optional
        Names of the board and of the skin, and the order in which places are touched ("random", "snake" or a
        description). They are written to the header of the capture.

    Returns
    -------
    Path
        The capture's folder, which `reskin add` accepts.

    Raises
    ------
    ReskinError
        If no board is detected, or if the board sends no readings.
    Exception
        Any exception that `labels` raises. The data that were recorded until then are kept.

    Examples
    --------
    >>> def presses():
    ...     for x_mm, y_mm in places:  # in random order, because each touch affects the next touch
    ...         robot.lift_and_go_to(x_mm, y_mm)
    ...         yield reskin.lifted()
    ...         robot.press()
    ...         yield reskin.touch(x_mm, y_mm, Fz_N=robot.force_N())
    >>> reskin.record(presses(), board="b1", skin="s1", scan="random")  # doctest: +SKIP
    """
    from reskin.board.find import find_board
    from reskin.live.record import record_board
    from reskin.recordings.labels import from_program

    names = {"board": board, "skin": skin, "scan": scan}
    detected = find_board(None if port is None else [port])
    folder = Path(out) if out is not None else None
    result = record_board(detected, from_program(labels, dwell_s), folder=folder, seconds=seconds, names=names)
    print(result.summary, file=sys.stderr)
    if result.error is not None:
        raise result.error
    return result.folder
