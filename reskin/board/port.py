"""Open the port of a board, and read the bytes that have arrived there.

A port is either a serial port of this machine, or a network address written as `socket://host:port`.
"""

import errno
import os
import re
import select

import serial
from serial.serialutil import SerialBase
from serial.tools import list_ports

from reskin.errors import CaptureError

# Longest time for which one read waits for bytes. A recording checks only between two reads whether it must end, so it
# may end later by this time.
READ_TIMEOUT_s = 0.1
READ_BYTES_MAX_N = 65536
SOCKET = "socket://"

Device = SerialBase  # an open port


def open_port(port: str, baud: int) -> Device:
    """Open a serial port, exclusively for this process, or connect to `socket://host:port`.

    This function opens the ports of boards and of force gauges. Bytes that arrived before the port was opened are
    discarded. Use `read_waiting` to read from the port, because the read timeout of a socket is set to 0.
    """
    check_name(port)
    try:
        device = serial.serial_for_url(port, baud, timeout=READ_TIMEOUT_s, exclusive=None if "://" in port else True)
    except (OSError, ValueError) as error:
        number = error.errno if isinstance(error, OSError) else None
        reason = f"{error}. {found_ports()}"
        if number == errno.ENOENT:
            reason = f"no such port. {found_ports()}"
        elif number == errno.EAGAIN:
            reason = "another program uses it (perhaps reskin live or a serial monitor). Close this program."
        elif "Could not configure port" in str(error):  # pyserial's text for devices without a baud rate
            reason = f"it is not a serial port. {found_ports()}"
        raise CaptureError(f"{port}: cannot open the port: {reason}") from None
    if not isinstance(device, serial.Serial):
        device.timeout = 0
    return device


def check_name(port: str) -> None:
    """Raise `CaptureError` for a name that cannot be a port, such as the name of a file."""
    reason = ""
    if port.startswith(SOCKET):
        if not re.fullmatch(r".+:\d{1,5}([/?].*)?", port.removeprefix(SOCKET)):
            reason = f"its port number is missing. Write {SOCKET}HOST:PORT."
    elif "://" in port:  # pyserial accepts more schemes, some of which load code
        reason = f"the only supported URL is {SOCKET}HOST:PORT."
    elif os.path.isdir(port):  # unlike `Path.is_dir`, never raises for names such as COM3
        reason = f"it is a folder. {found_ports()}"
    elif os.path.isfile(port):
        reason = "it is a file. To read a file, use reskin decode or reskin predict."
    if reason:
        raise CaptureError(f"{port}: cannot open the port: {reason}")


def read_waiting(device: Device, bytes_max_n: int = READ_BYTES_MAX_N) -> bytes:
    """Return the bytes that are waiting or arrive within `READ_TIMEOUT_s`; raise `OSError` if the board is gone."""
    if isinstance(device, serial.Serial):  # first wait for one byte, and then read all other bytes that have arrived
        first = device.read(min(1, bytes_max_n))
        waiting_n = min(device.in_waiting, READ_BYTES_MAX_N, bytes_max_n) - 1 if first else 0
        return first + device.read(waiting_n) if waiting_n > 0 else first
    # A socket does not report how many bytes have arrived, so wait until it can be read, and read once.
    ready, _, _ = select.select([device], [], [], READ_TIMEOUT_s)
    return device.read(min(READ_BYTES_MAX_N, bytes_max_n)) if ready else b""


def port_names() -> list[str]:
    """List the serial ports of this machine."""
    return sorted(port.device for port in list_ports.comports())


def found_ports() -> str:
    """Return a sentence that lists the ports of this machine, for error messages."""
    names = port_names()
    return (
        f"Ports found: {', '.join(names)}."
        if names
        else "No serial port was found. Check that the board is plugged in."
    )
