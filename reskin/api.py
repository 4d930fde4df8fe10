"""The public functions and classes of `reskin`, for notebooks and robot programs.

They take names and plain values and return NumPy arrays. Units are in names: mm, N, uT; a channel is Bx, By or Bz of a
chip. Functions import what they need when they are called, so that `import reskin` costs little.
"""

from __future__ import annotations

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
    from reskin.data.rows import Rows
    from reskin.live.session import Skins as LiveSkins
    from reskin.live.tracker import Skin as LiveSkin
    from reskin.models.trained import Network
    from reskin.physics.board import Board
    from reskin.physics.skin import Skin
    from reskin.recordings.labels import Label
    from reskin.universal.model import Universal

Answering = Union[Path, str, Sequence[Path | str], "Model", "Universal"]
Changes = Mapping[str, Any]  # of nominal settings, by name
NOMINAL_BOARD = "rigid"


def load_rows(folder: Path | str, *, force_min_N: float = 0.0) -> Rows:
    """Load ingested readings of contacts, as models are trained on them.

    Parameters
    ----------
    folder : folder of Parquet files, such as `data/indentations/quick` after `dvc repro`
    force_min_N : readings with less normal force are left out

    Returns
    -------
    Rows : `db_uT` [f ch] is the change of field, `target` [f 3] is x_mm, y_mm and Fz_N; `board` and `skin` [f] names

    >>> rows = load_rows("data/indentations/quick")  # doctest: +SKIP
    >>> rows.db_uT, rows.target, rows.board  # doctest: +SKIP
    """
    from reskin.data import folds
    from reskin.data.rows import Selection

    files = sorted(Path(folder).glob("*.parquet"))
    if not files:
        remedy = "Ingest captures first: dvc repro."
        raise ParamsError("load_rows", "the folder", "one with Parquet files", str(folder), remedy)
    return folds.load_rows(files, Selection(force_min_N=force_min_N))


def draw_board(name: str = "b0", *, seed: int = 0, spreads: Changes | None = None, **design: Any) -> Board:
    """Draw a simulated circuit board; the same name and seed give the same board.

    Parameters
    ----------
    name : name of the board
    seed : seed of all draws
    spreads : changes of the standard deviations between boards, such as `{"chip_offset_uT": 0.0}`
    design : changes of the nominal board: `chips_xy_mm` [[x, y], ...] seen from the middle of the skin,
        `chips_turn_deg` [turn, ...], `gap_mm`

    >>> board = draw_board(gap_mm=0.6)
    """
    from reskin.physics import board
    from reskin.physics.board import BoardDesign, Spreads

    settings = parse(BoardDesign, nominal("boards")[NOMINAL_BOARD]["design"] | design, "draw_board")
    return board.draw_board(settings, parse(Spreads, nominal("spreads", spreads), "spreads"), seed=seed, name=name)


def draw_skin(name: str = "b0_s0", *, seed: int = 0, spreads: Changes | None = None, **design: Any) -> Skin:
    """Draw a simulated skin; the same name and seed give the same skin.

    Parameters
    ----------
    name : name of the skin
    seed : seed of all draws
    spreads : changes of the standard deviations between skins, such as `{"skin_modulus": 0.0}`
    design : changes of the nominal skin: `thickness_mm`, `modulus_kPa`, `tip_radius_mm`, ...

    Returns
    -------
    Skin : `nodes_m` [s 3] and `moments_A_m2` [s 3] are the dipoles that the skin is summed of

    >>> skin = draw_skin(seed=1, thickness_mm=3.0)
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
    """Simulated pokes: fields in uT as the chips read them, before and at each poke, and the normal force in N."""

    noload_uT: np.ndarray  # [n ch]
    b_uT: np.ndarray  # [n ch]
    Fz_N: np.ndarray  # [n], positive in compression


def simulate_pokes(
    skin: Skin, pokes: ArrayLike, *, board: Board | None = None, seed: int = 0, chip: Changes | None = None
) -> Pokes:
    """Poke a fresh skin at places [[x_mm, y_mm, depth_mm], ...] [n 3]; the middle of the skin is at (8, 8) mm.

    >>> noload_uT, b_uT, Fz_N = simulate_pokes(draw_skin(), [[8.0, 8.0, 1.0], [2.0, 4.0, 0.5]])  # doctest: +SKIP

    Without a board, it is poked on the default one. `chip` changes the nominal magnetometer, as
    `{"noise_xy_uT": 0.0, "noise_z_uT": 0.0}`. Terms that only some protocols need (ageing, friction) are left out.
    """
    from scipy.constants import milli

    from reskin.data.grid import CENTRE_MM
    from reskin.physics.chip import ChipDesign, read_field
    from reskin.simulation.contact import Terms, respond

    places_mm = np.asarray(pokes, np.float64)
    if places_mm.ndim != 2 or places_mm.shape[1] != 3:
        remedy = "Try: [[8.0, 8.0, 1.0]]"
        raise ParamsError("simulate_pokes", "pokes", "rows of x_mm, y_mm, depth_mm", f"shape {places_mm.shape}", remedy)
    tip_m = (places_mm - (CENTRE_MM, CENTRE_MM, 0.0)) * milli
    board = board or draw_board(seed=seed)
    rngs = {part: rng_for(seed, "poking", skin.name, part) for part in ("drift", "noload", "contact")}
    no_tilt = np.zeros((len(tip_m), 2))
    response = respond(board, skin, tip_m[:, None], tilt=no_tilt, terms=Terms(), rng=rngs["drift"])
    design = parse(ChipDesign, nominal("chip", chip), "chip")
    noload_uT, _ = read_field(response.rest_T, board, design=design, rng=rngs["noload"])
    b_uT, _ = read_field(response.rest_T + response.change_T[:, 0], board, design=design, rng=rngs["contact"])
    return Pokes(noload_uT, b_uT, response.force_N[:, 0, 2])


class Model:
    """A trained network with a no-load reading: `zero` it while nothing touches the skin, then let it `predict`."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self._noload_uT: np.ndarray | None = None

    @property
    def card(self) -> Mapping[str, Any]:
        """What the model was trained on, and how (its JSON card)."""
        return self._network.card

    def zero(self, b_uT: ArrayLike) -> Model:
        """Take the mean of fields in uT without contact, [f ch] or one reading [ch], as the no-load reading."""
        self._noload_uT = self._rows(b_uT).mean(axis=0, dtype=np.float64)
        return self

    def predict(self, b_uT: ArrayLike) -> np.ndarray:
        """Give x_mm, y_mm and the normal force in N, [f 3], of fields in uT [f ch]; of one reading [ch], [3].

        Off contact the three numbers mean nothing: the change of field is then noise.
        """
        if self._noload_uT is None:
            remedy = "First call zero with readings without contact."
            raise ParamsError("predict", "the model", "zeroed", "no no-load reading", remedy)
        rows_uT = self._rows(b_uT)
        answer = self._network((rows_uT - self._noload_uT).astype(np.float32))
        return answer if np.ndim(b_uT) == 2 else answer[0]

    def export_onnx(self, file: Path | str) -> None:
        """Write the network as an ONNX file: changes of field in uT in, x_mm, y_mm and F_N out; needs package onnx."""
        from reskin.models import trained

        trained.write(self._network, Path(file))

    def _rows(self, b_uT: ArrayLike) -> np.ndarray:
        rows_uT, channels_n = np.atleast_2d(np.asarray(b_uT, np.float32)), self.card["input"]["channels_n"]
        if rows_uT.ndim != 2 or rows_uT.shape[1] != channels_n:
            rule, remedy = f"the {channels_n} of the model", "Give Bx, By, Bz of chip 0, then of chip 1, ..."
            raise SchemaError("fields", "channels", rule, f"shape {np.shape(b_uT)}", remedy)
        return rows_uT


def load_model(file: Path | str) -> Model:
    """Load a trained model (.safetensors), its card (.json) beside it.

    >>> model = load_model("data/models/quick/train_multi/NAME.safetensors").zero(noload_uT)  # doctest: +SKIP
    >>> x_mm, y_mm, force_N = model.predict(b_uT)  # doctest: +SKIP
    """
    from reskin.predicting import read_network

    return Model(read_network(Path(file)))


def load_universal(skin: Path | str | None = None) -> Universal:
    """Load the map and network of simulated skins that come with the project, for a skin that nobody calibrated.

    >>> skin = load_universal().zero(noload_uT)  # doctest: +SKIP
    >>> x_mm, y_mm, force_N = skin.predict(b_uT)[0]  # doctest: +SKIP

    It learns while it is used: `see` pokes anywhere, `label` some at known places; `next_place` says which tells most.
    What it was told of a skin can be kept: `skin.save("FILE.safetensors")`, then `load_universal("FILE.safetensors")`.
    """
    from reskin.universal import model as shipped

    return shipped.load_universal(skin)


@overload
def open(port: str, *, model: Answering = (), baud: int = 115200) -> LiveSkin: ...
@overload
def open(port: list[str], *, model: Answering = (), baud: int = 115200) -> LiveSkins: ...
def open(port: str | list[str], *, model: Answering = (), baud: int = 115200) -> LiveSkin | LiveSkins:
    """Open a board's port: its contacts while they happen. In the first second nothing may touch the skin.

    >>> with open("/dev/ttyACM0", model="data/models/quick/train_multi/NAME.safetensors") as skin:  # doctest: +SKIP
    ...     for contact in skin:  # the latest; skin.every() for each
    ...         print(contact.t_s, contact.x_mm, contact.y_mm, contact.F_N, contact.alarms)

    Format and chips are told from the bytes; `port` may also be `socket://host:port`. Without a model the map of
    simulated skins answers (`load_universal`); `model` may be loaded already, also one that learnt this skin, which it
    then keeps but for the no-load reading. Several models give means, and how far they are apart. A list of ports
    gives the latest contacts of all boards, in its order; one that is unplugged does not hold up the others.
    """
    from reskin.board.find import check_named_once
    from reskin.live.answering import check_boards
    from reskin.live.session import Skins
    from reskin.live.tracker import Skin
    from reskin.predicting import read_models
    from reskin.universal.model import Universal

    if not isinstance(port, str):
        check_named_once(port, "reskin.open")
    if isinstance(model, Universal):
        models: Sequence[Network] | Universal = model
    elif isinstance(model, Model):
        models = [model._network]
    else:
        models = read_models([Path(file) for file in ([model] if isinstance(model, str | Path) else model)])
    if isinstance(port, str):
        return Skin(port, models, baud=baud)
    check_boards(models, len(port), "reskin.open")
    return Skins([Skin(each, models, baud=baud) for each in port])


def lifted() -> Label:
    """Make the label of a board that nothing touches; it comes before that of each touch."""
    from reskin.recordings.labels import Label

    return Label(False)


def touch(x_mm: float, y_mm: float, **known: Any) -> Label:
    """Make the label of a touch that stands still; `known`: depth_mm, Fx_N, Fy_N, Fz_N (on the skin), pass_i."""
    from reskin.recordings.labels import Label

    return Label(True, x_mm, y_mm, **known)


def record(
    labels: Iterable[Label] | Callable[[], Label | None], *, port: str | None = None, out: Path | str | None = None,
    seconds: float = float("inf"), dwell_s: float = 0.5, **told: str,
) -> Path:  # fmt: skip
    """Record a board while a program moves a robot and says where it stands; give the capture's folder.

    >>> def pokes():  # doctest: +SKIP
    ...     for x_mm, y_mm in places:  # in random order: skins remember the touch before
    ...         robot.lift_and_go_to(x_mm, y_mm); yield reskin.lifted()
    ...         robot.press(); yield reskin.touch(x_mm, y_mm, Fz_N=robot.force_N())
    >>> reskin.record(pokes(), board="b1", skin="s1", scan="random")  # doctest: +SKIP

    Each label holds for `dwell_s`, in which the program is not asked for the next. In place of a generator: a
    function that is called each time, until it gives None. `told`: board, skin, scan. What came, and what was lost or
    left out, is said on stderr.
    """
    from reskin.board.find import the_board
    from reskin.live.taping import Wanted, record_board
    from reskin.recordings.label_sources import from_program

    board = the_board(None if port is None else [port])
    wanted = Wanted(Path(out) if out is not None else None, seconds, 115200, told)
    done = record_board(board, wanted, from_program(labels, dwell_s))
    print(done.said, file=sys.stderr)
    if done.failed is not None:
        raise done.failed
    return done.folder
