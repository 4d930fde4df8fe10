"""Convert an .npz archive of pickled samples, as the rig of layout `lab` writes it, to a CSV file of layout `lab`.

The archive contains pickles, which could execute any code if they were loaded with `pickle`. Therefore, this module
interprets their opcodes (the instructions of a pickle) itself, and imports or executes nothing that a pickle names. A
pickle with anything but plain values and NumPy numbers is refused.
"""

import pickletools
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import Any, NoReturn

import numpy as np

from reskin.errors import CaptureError

CHIPS_N = 5
COLUMNS = [f"{quantity}{chip}" for chip in range(CHIPS_N) for quantity in ("T", "Bx", "By", "Bz")]
HEAD = ",".join(["indent", "phase", "x_mm", "y_mm", *COLUMNS, "Fx", "Fy", "Fz"])
PHASES = {"noload": "bl_arr", "contact": "cont_arr"}  # phase -> name of its samples in the archive
REMEDY = "Check that the archive is a complete copy, and that it contains the recording of one port at one depth."
BYTES_MAX_N = 500_000_000  # the archives of scene lab have 10 to 30 MB
MARK = object()  # the mark that opcode MARK puts on the stack


def to_lab_csv(archive: bytes, where: str) -> bytes:
    """Return the samples of an archive as CSV text.

    The lines are sorted by indentation; in each indentation, the no-load samples come first. Values are rounded to 1e-4
    degC, 1e-4 uT and 1e-6 N. Lines end in CR LF, as in RFC 4180.
    """
    try:
        with zipfile.ZipFile(BytesIO(archive)) as file:
            if (bytes_n := sum(member.file_size for member in file.infolist())) > BYTES_MAX_N:
                raise CaptureError(
                    f"{where}: the unpacked archive would have {bytes_n} bytes, which is more than {BYTES_MAX_N}. "
                    f"{REMEDY}"
                )
            samples = {phase: decode_array(file.read(f"{name}.npy"), where) for phase, name in PHASES.items()}
        rows = [(int(sample["Indent"]), phase, _row(sample)) for phase in PHASES for sample in samples[phase]]
    except CaptureError:
        raise
    # An archive may contain anything, so any exception is possible. Its text becomes part of the error message.
    except Exception as error:
        samples_of = " and ".join(PHASES.values())
        raise CaptureError(
            f"{where}: not an .npz archive with samples in the arrays {samples_of}: {_describe(error)}. {REMEDY}"
        ) from None
    rows.sort(key=lambda row: row[0])  # the sort is stable, so the no-load rows of an indentation stay first
    return "".join(f"{line}\r\n" for line in [HEAD, *(f"{i},{phase},{cells}" for i, phase, cells in rows)]).encode()


def _row(sample: Mapping[str, Any]) -> str:
    place, fields, forces = (sample[key] for key in ("Location", "ReSkin Data", "Force Data"))
    if (len(place), len(fields), len(forces)) != (2, len(COLUMNS), 3):
        raise ValueError(f"a sample has {len(place)} coordinates, {len(fields)} readings and {len(forces)} forces")
    cells = [f"{mm:g}" for mm in place] + [f"{value:.4f}" for value in fields] + [f"{force:.6f}" for force in forces]
    return ",".join(cells)


def decode_array(npy: bytes, where: str) -> Any:
    """Return the plain values of the array of objects in an .npy file."""
    stream = BytesIO(npy)
    version = np.lib.format.read_magic(stream)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    _, _, dtype = read_header(stream)
    if not dtype.hasobject:
        raise CaptureError(f"{where}: the array contains values of type {dtype} instead of objects. {REMEDY}")
    return decode(stream.read(), where)


def decode(pickled: bytes, where: str) -> Any:
    """Return the content of a pickle as lists, tuples, dicts, numbers, text and bytes.

    NumPy numbers become numbers, and NumPy arrays become lists. The function supports protocols 3 and 4, which NumPy
    uses to write arrays of objects.
    """
    stack = _Stack([], {})
    try:
        for opcode, arg, byte_i in pickletools.genops(pickled):
            if opcode.name not in STEPS:
                raise CaptureError(
                    f"{where} @{byte_i}: the pickle has opcode {opcode.name}, which plain values and NumPy numbers "
                    f"do not need. {REMEDY}"
                )
            STEPS[opcode.name](stack, arg)
        return plain(stack.values.pop())
    except CaptureError:
        raise
    # Arbitrary bytes may cause any exception, for example in pickletools, in NumPy, or because the stack is empty.
    except Exception as error:
        raise CaptureError(f"{where}: the pickle cannot be read: {_describe(error)}. {REMEDY}") from None


@dataclass
class Call:
    """A call of a function that a pickle contains.

    The function is never called: only its name and its arguments are stored. `state` is the state that opcode BUILD
    would set on the result of the call.
    """

    name: str
    args: Any
    state: Any = None


NESTED = (list, tuple, dict, Call)


@dataclass
class _Stack:
    """The memory of the virtual machine that executes the opcodes of a pickle.

    `values` is the machine's stack. `memo` contains values that later opcodes use again.
    """

    values: list[Any]
    memo: dict[int, Any]

    def push(self, value: Any) -> None:
        self.values.append(value)

    def last(self, length: int) -> list[Any]:
        """Pop `length` values from the stack."""
        taken = self.values[-length:]
        del self.values[-length:]
        return taken

    def since_mark(self) -> list[Any]:
        """Pop the values since the last mark and the mark itself; return the values."""
        mark_i = max(i for i, value in enumerate(self.values) if value is MARK)
        taken = self.values[mark_i + 1 :]
        del self.values[mark_i:]
        return taken

    def extend(self, values: list[Any]) -> None:
        self.values[-1].extend(values)

    def set_items(self, values: list[Any]) -> None:
        self.values[-1].update(zip(values[::2], values[1::2], strict=True))

    def build(self) -> None:
        state = self.values.pop()
        self.values[-1].state = state

    def remember(self, i: int) -> None:
        self.memo[i] = self.values[-1]


Step = Callable[[_Stack, Any], None]


NUMBERS = ("BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT")
TEXTS = ("BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "GLOBAL")
STEPS: Mapping[str, Step] = {
    **dict.fromkeys(("PROTO", "FRAME", "STOP"), lambda stack, _: None),
    **dict.fromkeys((*NUMBERS, *TEXTS), _Stack.push),
    "NONE": lambda stack, _: stack.push(None),
    "NEWTRUE": lambda stack, _: stack.push(True),
    "NEWFALSE": lambda stack, _: stack.push(False),
    "MARK": lambda stack, _: stack.push(MARK),
    "EMPTY_LIST": lambda stack, _: stack.push([]),
    "EMPTY_DICT": lambda stack, _: stack.push({}),
    "EMPTY_TUPLE": lambda stack, _: stack.push(()),
    "TUPLE1": lambda stack, _: stack.push(tuple(stack.last(1))),
    "TUPLE2": lambda stack, _: stack.push(tuple(stack.last(2))),
    "TUPLE3": lambda stack, _: stack.push(tuple(stack.last(3))),
    "TUPLE": lambda stack, _: stack.push(tuple(stack.since_mark())),
    "APPEND": lambda stack, _: stack.extend(stack.last(1)),
    "APPENDS": lambda stack, _: stack.extend(stack.since_mark()),
    "SETITEM": lambda stack, _: stack.set_items(stack.last(2)),
    "SETITEMS": lambda stack, _: stack.set_items(stack.since_mark()),
    "STACK_GLOBAL": lambda stack, _: stack.push(" ".join(stack.last(2))),
    "REDUCE": lambda stack, _: stack.push(Call(*stack.last(2))),
    "BUILD": lambda stack, _: stack.build(),
    "MEMOIZE": lambda stack, _: stack.remember(len(stack.memo)),
    **dict.fromkeys(("BINPUT", "LONG_BINPUT"), lambda stack, i: stack.remember(i)),
    **dict.fromkeys(("BINGET", "LONG_BINGET"), lambda stack, i: stack.push(stack.memo[i])),
}  # keys are opcodes of pickletools; any other opcode is refused


def plain(value: Any, converted: dict[int, Any] | None = None) -> Any:
    """Convert calls of NumPy functions in a value to lists and numbers; raise `ValueError` for any other call.

    A pickle may use a value several times. Such a value is converted only once, because the time could otherwise grow
    exponentially with the depth of nested values. `converted` maps the `id` of a value to the result of its conversion.
    """
    converted = {} if converted is None else converted
    if not isinstance(value, NESTED):
        return value
    if id(value) not in converted:
        converted[id(value)] = _plain(value, converted)
    return converted[id(value)]


def _plain(value: Any, converted: dict[int, Any]) -> Any:
    match value:
        # A list may contain a million numbers, so `plain` is called only for items that need a conversion.
        case list() | tuple():
            return type(value)(plain(item, converted) if isinstance(item, NESTED) else item for item in value)
        case dict():
            return {plain(key, converted): plain(item, converted) for key, item in value.items()}
    return _numbers(value)


def _numbers(call: Call) -> Any:
    """Convert a call that creates a NumPy number to a number, and a call that creates an array to nested lists."""
    match call.name.replace("numpy._core", "numpy.core"):  # NumPy 2 renamed the module to numpy._core
        case "numpy.core.multiarray scalar":
            return np.frombuffer(plain(call.args[1]), _dtype(call.args[0]))[0].item()
        case "numpy.core.multiarray _reconstruct":
            _, shape, dtype, by_columns, content = call.state
            if isinstance(content, list):
                return plain(content) if len(shape) == 1 else _refuse(f"an array of objects {shape}")
            array = np.frombuffer(plain(content), _dtype(dtype))
            return array.reshape(shape, order="F" if by_columns else "C").tolist()
    return _refuse(f"a call of {call.name}")


def _dtype(call: Call) -> "np.dtype[Any]":
    kind, order = call.args[0], call.state[1]
    if call.name != "numpy dtype" or kind[:1] not in "biuf":
        _refuse(f"{call.name} {kind}")
    return np.dtype(kind if order == "|" else order + kind)


def _refuse(got: str) -> NoReturn:
    raise ValueError(got)


def _describe(error: Exception) -> str:
    return f"{type(error).__name__} {error}".strip()[:200]
