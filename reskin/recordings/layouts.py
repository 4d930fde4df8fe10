"""The layouts that have a reader of their own in `readers`, by name. Refuses to know what stands in their files.

Apart, and importing nothing heavy: `reskin --help` lists them.
"""

from typing import Literal

Foreign = Literal["table", "lab", "ini", "eflesh", "eflash7"]
