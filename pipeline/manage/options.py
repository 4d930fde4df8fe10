"""Options of `reskin add` for single layouts, and how a recording is prepared with them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from reskin.board.other_firmware import CustomWire, read_wire
from reskin.errors import ParamsError
from reskin.recordings import ReaderLayout, preparing
from reskin.recordings.preparing import CaptureNames, Prepared

Layout = Literal["capture", "serial-binary", "serial-text", ReaderLayout]
SERIAL = ("serial-binary", "serial-text")
NATIVE = ("capture", *SERIAL)
LAYOUTS_OF = {
    "probe": NATIVE, "mark": NATIVE, "chips": SERIAL, "rate_hz": SERIAL, "wire": SERIAL, "rows_late": ("ini",),
    "force_axis": ("eflesh",), "pad": ("leaphand",), "columns": ("table",),
}  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of `reskin add`; None if an option is not given. `reskin add --help` explains them."""

    probe: Path | None = None
    mark: list[str] | None = None
    chips: int | None = None
    rate_hz: float | None = None
    wire: str | None = None
    rows_late: int | None = None
    force_axis: str | None = None
    pad: int | None = None
    columns: Path | None = None

    def check(self, layout: Layout) -> None:
        """Raise `ParamsError` if an option is given that the layout does not use."""
        for name, layouts in LAYOUTS_OF.items():
            if getattr(self, name) is not None and layout not in layouts:
                option = f"--{name.replace('_', '-')}"
                raise ParamsError(
                    f"{option} is only for --layout {' and '.join(layouts)}, not {layout}. Omit {option}."
                )

    def prepare(self, recording: Path, layout: Layout, names: CaptureNames) -> Prepared:
        """Read the header of a recording, and list its files."""
        marks = preparing.parse_marks(self.mark or [])
        if layout == "capture":
            return preparing.native(recording, names, self.probe, marks)
        if layout == "serial-binary" or layout == "serial-text":
            wire = read_wire(self.wire or ("binary" if layout == "serial-binary" else "text-xyzt"))
            chips_n = wire.chips_n if isinstance(wire, CustomWire) else self.chips or 5
            rate_hz = 400.0 if self.rate_hz is None else self.rate_hz
            return preparing.dump(
                recording, names, wire=wire, chips_n=chips_n, rate_hz=rate_hz, probe=self.probe, marks=marks
            )
        if self.columns is not None:
            return preparing.mapped(recording, names, self.columns)
        given = {"rows_late": self.rows_late, "pad": self.pad}
        options = {name: str(value) for name, value in given.items() if value is not None}
        if layout == "eflesh":
            options["force_axis"] = self.force_axis or "z"
        return preparing.foreign(recording, layout, names, options)
