"""The errors a user can cause: one class a boundary, one sentence each.

Every message reads `<where>: <what> must be <rule>; got <value>. <what to try>`; an error that passes on somebody's
sentence takes it whole. Raised at the door and shown without a traceback; `assert` is for our own mistakes. Refuses to
know who raises them.
"""


class ReskinError(ValueError):
    """Bad input from outside: a recording, a parameter or a file that breaks a contract.

    >>> print(ReskinError("b3_s2/stream.bin @8192", "frame", "whole", "40 bytes", "Wrong baud rate?"))
    b3_s2/stream.bin @8192: frame must be whole; got 40 bytes. Wrong baud rate?
    """

    exit_code = 2

    def __init__(self, where: object, what: str = "", rule: str = "", got: object = "", remedy: str = "") -> None:
        super().__init__(f"{where}: {what} must be {rule}; got {got}. {remedy}" if what else str(where))


class CaptureError(ReskinError):
    """Bytes, headers or recordings that cannot be read."""


class SchemaError(ReskinError):
    """A table whose columns, types or units are not those of `pipeline.core.schema`."""


class ParamsError(ReskinError):
    """A YAML file, a scene or a command line that asks for what cannot be."""


class TrainingError(ReskinError):
    """A training that cannot go on: no rows, or a loss that is no longer finite."""


class LeakError(ReskinError):
    """A result that would rest on rows it is tested on."""
