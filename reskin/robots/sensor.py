"""A skin as a sensor of a robot in LeRobot, with the methods that LeRobot's cameras have.

The package lerobot is not needed. The class of a robot creates the sensor from its configuration, and connects and
disconnects the sensor together with the motors and cameras. The class adds the sensor's `observation_features` to the
features of the robot, and the values that `async_read` returns to each observation (see docs/python.md).
"""

import math
import threading
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import reskin
from reskin.api import AnyModel
from reskin.board import find
from reskin.board.port import BAUD
from reskin.errors import CaptureError
from reskin.live.tracker import Estimates, LiveSkin

WAIT_S = 0.1  # longest time for which the background thread waits for data before it checks whether it must stop
READ_MS = 10_000.0  # longest time for which `read` and `zero` wait; the same as for `read` of LeRobot's cameras
ESTIMATE = ("x_mm", "y_mm", "F_N", "sd_x_mm", "sd_y_mm", "sd_F_N", "contact")


class SkinConnectionError(CaptureError, ConnectionError):
    """Raised if the sensor is not connected, is connected already, or cannot be connected."""


@dataclass(kw_only=True)
class SkinSensorConfig:
    """Configuration of a sensor.

    Parameters
    ----------
    port : serial port or socket://host:port
    model : the model, as in `reskin.open`; by default, the universal model without calibration
    baud : baud rate; USB ports ignore it
    without_contact : value of x_mm, y_mm and the standard deviations in readings without contact. The default is NaN.
        Policies cannot use NaN. If a policy uses these values, choose a number such as 0, and give the policy `contact`
        and `F_N` as well, so that it can distinguish this number from an estimate.
    """

    port: str
    model: AnyModel = ()
    baud: int = BAUD
    without_contact: float = math.nan


class SkinSensor:
    """A skin that a background thread reads continuously.

    Use the sensor in a `with` statement, or call `connect` and `disconnect`. A reading is a dict of numbers. It
    contains the field of each chip (Bx0_uT, By0_uT, Bz0_uT, Bx1_uT, ...). If the model can be used with this board, it
    also contains the estimate: x_mm, y_mm, F_N, their standard deviations, and contact (1 or 0). Readings that are not
    usable, such as failed reads of a chip, are never returned.
    """

    def __init__(self, config: SkinSensorConfig) -> None:
        self.config = config
        self._skin: LiveSkin | None = None
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._changed = threading.Condition()  # the lock under which the following attributes are read and written
        self._latest: dict[str, float] | None = None
        # time of arrival of the latest reading, and whether this reading has not been returned yet
        self._latest_s, self._is_new = -math.inf, False
        self._error: Exception | None = None

    def __str__(self) -> str:
        return f"SkinSensor({self.config.port})"

    def __enter__(self) -> "SkinSensor":
        self.connect()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.disconnect()

    @staticmethod
    def find_skins() -> list[dict[str, Any]]:
        """Return the port, wire format, number of chips and rate of each connected board."""
        boards = [board for board in find.scan_ports() if board.problem is None]
        return [
            {"type": "skin", "id": board.port, "wire": board.wire, "chips_n": board.chips_n, "rate_hz": board.rate_hz}
            for board in boards
        ]

    @property
    def is_connected(self) -> bool:
        """Whether `connect` was called, and `disconnect` was not called afterwards.

        The value stays True while the board is unplugged.
        """
        return self._skin is not None

    @property
    def observation_features(self) -> dict[str, type]:
        """Names and types of the values of a reading, in the form in which LeRobot's robots describe observations."""
        skin = self._connected()
        estimated = ESTIMATE if skin.estimator is not None else ()
        return dict.fromkeys([*_field_names(skin.detected.chips_n), *estimated], float)

    def connect(self, warmup: bool = True) -> None:
        """Open the port, and take the no-load reading.

        Nothing may touch the skin during the first second.

        Parameters
        ----------
        warmup : whether to wait for the first reading

        Raises
        ------
        SkinConnectionError : the sensor is connected already; the port cannot be opened or sends no frames; or the
            skin was touched
        """
        if self._skin is not None:
            raise SkinConnectionError(f"{self} is connected already. Call disconnect first.")
        skin = reskin.open(self.config.port, model=self.config.model, baud=self.config.baud)
        try:
            skin.__enter__()
        except (CaptureError, OSError) as error:
            raise SkinConnectionError(str(error)) from error
        self._skin, self._latest, self._is_new, self._error = skin, None, False, None
        self._stop.clear()
        self._thread = threading.Thread(target=self._follow, args=[skin], name=str(self), daemon=True)
        self._thread.start()
        if warmup:
            try:
                self.async_read(READ_MS)
            except BaseException:
                self.disconnect()
                raise

    def disconnect(self) -> None:
        """Stop reading, and close the port; raise SkinConnectionError if the sensor is not connected."""
        skin = self._connected()
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        skin.__exit__()
        self._skin = self._thread = None

    def read(self) -> dict[str, float]:
        """Wait for the next reading, and return it; raise TimeoutError if none arrives within 10 s."""
        self._connected()
        with self._changed:
            self._is_new = False
        return self.async_read(READ_MS)

    def async_read(self, timeout_ms: float = 200.0) -> dict[str, float]:
        """Return the latest reading; if it was returned before, wait for the next reading and return that.

        Raises
        ------
        SkinConnectionError : the sensor is not connected
        TimeoutError : no usable reading arrived within `timeout_ms`; the message contains the alarms of the board
        """
        skin = self._connected()
        with self._changed:
            if not self._changed.wait_for(lambda: self._is_new or self._error is not None, timeout_ms / 1000):
                raise TimeoutError(f"{self}: no usable reading within {timeout_ms:g} ms. {_reasons(skin)}")
            self._is_new = False
            return self._reading()

    def read_latest(self, max_age_ms: float = 500.0) -> dict[str, float]:
        """Return the latest reading without waiting; raise TimeoutError if it is older than `max_age_ms`."""
        skin = self._connected()
        with self._changed:
            age_ms = 1000 * (skin.reader.unix_s() - self._latest_s)
            if self._error is None and (self._latest is None or age_ms > max_age_ms):
                raise TimeoutError(
                    f"{self}: the latest usable reading is older than {max_age_ms:g} ms. {_reasons(skin)}"
                )
            return self._reading()

    def zero(self) -> None:
        """Take a new no-load reading, and wait until it is complete.

        Nothing may touch the skin for a second. Raises TimeoutError if there is no new no-load reading within 10 s.
        """
        skin = self._connected()
        with self._changed:
            skin.zero()
            self._latest, self._is_new = None, False
        end_s = time.monotonic() + READ_MS / 1000
        while not skin.zeroed:
            if time.monotonic() > end_s or self._error is not None:
                raise TimeoutError(f"{self}: could not take a no-load reading. {_reasons(skin)}")
            time.sleep(0.01)

    def _connected(self) -> LiveSkin:
        if self._skin is None:
            raise SkinConnectionError(f"{self} is not connected. Call connect first.")
        return self._skin

    def _reading(self) -> dict[str, float]:
        if self._error is not None:
            raise self._error
        assert self._latest is not None, "a new reading has arrived"
        return dict(self._latest)

    def _follow(self, skin: LiveSkin) -> None:
        """Store each usable reading as the latest reading, until the sensor is disconnected."""
        try:
            while not self._stop.is_set():
                estimates = skin.poll(WAIT_S, latest=True)
                if estimates is None or not skin.usable(estimates)[-1]:
                    continue
                reading = self._values(estimates, estimated=skin.estimator is not None)
                with self._changed:
                    # If there is no no-load reading now, `zero` was called while this reading was evaluated. The
                    # reading was then evaluated with the old no-load reading, so it is dropped.
                    if skin.zeroed:
                        self._latest, self._latest_s, self._is_new = reading, float(estimates.t_s[-1]), True
                        self._changed.notify_all()
        except Exception as error:  # stored here; the methods that read raise it in the caller's thread
            with self._changed:
                self._error = error
                self._changed.notify_all()

    def _values(self, estimates: Estimates, *, estimated: bool) -> dict[str, float]:
        b_uT = estimates.b_uT[-1].tolist()
        values = dict(zip(_field_names(len(b_uT) // 3), b_uT, strict=True))
        if estimated:
            x_mm, y_mm, force_N = estimates.target[-1].tolist()
            contact, unknown = bool(estimates.contact[-1]), self.config.without_contact
            sd_x_mm, sd_y_mm = estimates.sd_mm[-1].tolist()
            sd_F_N = float(estimates.sd_F_N[-1])
            if not contact:
                x_mm = y_mm = sd_x_mm = sd_y_mm = sd_F_N = unknown
            estimate = (x_mm, y_mm, force_N, sd_x_mm, sd_y_mm, sd_F_N, float(contact))
            values |= dict(zip(ESTIMATE, estimate, strict=True))
        return values


def _field_names(chips_n: int) -> list[str]:
    return [f"B{axis}{chip}_uT" for chip in range(chips_n) for axis in "xyz"]


def _reasons(skin: LiveSkin) -> str:
    return f"The board says: {'; '.join(skin.alarms()) or 'no alarm'}."
