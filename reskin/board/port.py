"""Open a board's port and read the bytes that wait in it.

The port is a serial port or `socket://host:port`.
"""

import select

import serial
from serial.serialutil import SerialBase
from serial.tools import list_ports

from reskin.errors import CaptureError

READ_TIMEOUT_s = 0.1  # how late a stop, a silence or the end of the duration may be noticed
READ_BYTES_MAX_N = 65536
SOCKET = "socket://"

Device = SerialBase  # an open port


def open_port(port: str, baud: int) -> Device:
    """Open a serial port, exclusively for this process, or connect to `socket://host:port`.

    Boards and force gauges are opened here. Bytes that waited in the port are discarded. A socket becomes
    non-blocking: read from either with `read_waiting`.
    """
    try:
        if "://" in port and not port.startswith(SOCKET):  # pyserial has more schemes, some of which load code
            raise ValueError(f"of all URLs, only {SOCKET}host:port is supported")
        device = serial.serial_for_url(port, baud, timeout=READ_TIMEOUT_s, exclusive=None if "://" in port else True)
    except (OSError, ValueError) as error:
        raise CaptureError(f"{port}: cannot open the port: {error}. {found_ports()}") from None
    if not isinstance(device, serial.Serial):
        device.timeout = 0
    return device


def read_waiting(device: Device, bytes_max_n: int = READ_BYTES_MAX_N) -> bytes:
    """Return the bytes that wait, or come within `READ_TIMEOUT_s`; raise `OSError` if the board is gone."""
    if isinstance(device, serial.Serial):  # it sleeps until a byte comes; with it come others
        first = device.read(min(1, bytes_max_n))
        waiting_n = min(device.in_waiting, READ_BYTES_MAX_N, bytes_max_n) - 1 if first else 0
        return first + device.read(waiting_n) if waiting_n > 0 else first
    ready, _, _ = select.select([device], [], [], READ_TIMEOUT_s)  # a socket cannot say how many wait
    return device.read(min(READ_BYTES_MAX_N, bytes_max_n)) if ready else b""


def port_names() -> list[str]:
    """List the serial ports of this machine."""
    return sorted(found.device for found in list_ports.comports())


def found_ports() -> str:
    """Say which ports were found, for the remedy of an error."""
    names = port_names()
    return f"Ports found: {', '.join(names)}." if names else "No serial port was found: is the board plugged in?"
