"""The columns of a description's streams, read from their tables or, in one pass, from a recording's messages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError
from ..formats.recording import Recording, Wanted
from ..formats.tables.columns import read_table
from ..formats.tables.table import Columns, Flaws
from ..notes import Note
from ..state import Array, TimeArray
from ..times import NS_PER
from . import description as d
from .device_clock import common_instants

DEVICE = "device"
"""The column added by a message's own clock."""


@dataclass
class Opening:
    """The state of opening one folder: description, strictness, notes, the IMU's time, and messages so far."""

    description: d.Description
    folder: Path
    repair: bool
    notes: list[str] = field(default_factory=list)
    imu_ns: tuple[int, int] | None = None
    messages: dict[tuple[str, int | None], Mapping[str, NDArray[Any]]] | None = None

    def columns(
        self, part: d.SourceDescription | d.TruthDescription, numbers: Sequence[d.Column], texts: Sequence[d.Column]
    ) -> tuple[Columns, Flaws]:
        """Read the raw columns of a part from its table or its messages; those in `texts` are not converted."""
        if part.table is not None:
            flaws = Flaws(too_long=0 if self.repair else None)
            return read_table(self.folder, part.table, numbers, texts, flaws), flaws
        assert part.message is not None
        return self._joined(part.message, [*numbers, *texts]), Flaws()

    def window(self, stream: str, part: d.Window, t_ns: TimeArray) -> NDArray[np.bool_]:
        """Return which rows of a stream or of the truth are in the window; the IMU's rows, read first, set its zero.

        Raises:
            DatasetError: the stream lies wholly outside the IMU's time, so that some clock is wrong.
        """
        inside = np.ones(len(t_ns), bool)
        if not len(t_ns):
            return inside
        span_ns = int(t_ns.min()), int(t_ns.max())
        self.imu_ns = self.imu_ns or span_ns
        window = self.description.window(part)
        if not window.from_s and window.until_s is None:
            return inside
        start_ns = self.imu_ns[0]
        if span_ns[1] < start_ns or span_ns[0] > self.imu_ns[1]:
            raise DatasetError(f"{self.folder}: {wrong_clock(stream, span_ns, self.imu_ns)}")
        inside &= t_ns >= start_ns + round(window.from_s * 1e9) if window.from_s else True
        inside &= t_ns < start_ns + round(window.until_s * 1e9) if window.until_s is not None else True
        end = "" if window.until_s is None else f" until {window.until_s:g} s"
        left_out = (
            f"{np.count_nonzero(~inside)} of {len(t_ns)} rows are outside the window from {window.from_s:g} s{end}"
        )
        if stream == "imu" and np.count_nonzero(inside) < 2:
            raise DatasetError(f"{self.folder}: imu: {left_out}; change `from_s` or `until_s`")
        if not inside.all():
            self.notes.append(f"{stream}: {left_out} and left out")
        return inside

    def _joined(self, message: d.Message, wanted: list[d.Column]) -> Columns:
        """Return columns of messages; `device` is their own clock, mapped to the host's."""
        if self.messages is None:
            self._read_messages()
        assert self.messages is not None
        recording = self.description.recording
        assert recording is not None
        found = [self.messages[name, message.entity] for name in message.names]
        picks: list[Any] = [slice(None)] * len(found)
        device: Array | None = None
        if message.clock is not None:
            column, unit = recording.host_clock
            host_s = [part[column] * (NS_PER[unit] * 1e-9) for part in found]
            device_s = [part[message.clock.field].astype(float) for part in found]
            picks, device = common_instants(host_s, device_s, message.clock.wraps_at_s)
            if not len(device):
                where = recording.path(self.folder)
                raise DatasetError(f"{where}: {' and '.join(message.names)} have no device time in common")
        columns: Columns = {}
        for column in wanted:
            if column == DEVICE and device is not None:
                columns[column] = device
            else:
                which, field_name = _field(message, str(column), recording, self.folder)
                columns[column] = found[which][field_name][picks[which]]
        return columns

    def _read_messages(self) -> None:
        """Read everything that the description needs from its recording, in one pass."""
        recording = self.description.recording
        assert recording is not None
        asked: dict[tuple[str, int | None], dict[str, None]] = {}
        for part, wanted in _sources(self.description):
            if part.message is None:
                continue
            for name in part.message.names:
                columns = asked.setdefault((name, part.message.entity), {})
                if part.message.clock is not None:
                    columns |= dict.fromkeys((recording.host_clock[0], part.message.clock.field))
            for column in wanted:
                if column != DEVICE or part.message.clock is None:
                    which, field_name = _field(part.message, str(column), recording, self.folder)
                    asked[part.message.names[which], part.message.entity][field_name] = None
        read = recording.read(self.folder, [Wanted(*key, tuple(columns)) for key, columns in asked.items()])
        self.messages = dict(zip(asked, read.columns, strict=True))
        self.notes += [note if isinstance(note, Note) else Note(note, "damage") for note in read.notes]


def _field(message: d.Message, column: str, recording: Recording, folder: Path) -> tuple[int, str]:
    """Return the index of the joined message that has a column, and its field; the host's stamp is the first one's."""
    if len(message.names) == 1 or column == recording.host_clock[0]:
        return 0, column
    for which, name in enumerate(message.names):
        if column.startswith(f"{name}."):
            return which, column.removeprefix(f"{name}.")
    raise DatasetError(f"{folder}: column {column!r}: expected `Name.field` of one of {', '.join(message.names)}")


def _sources(description: d.Description) -> Iterator[tuple[Any, list[d.Column]]]:
    """Yield every source of columns of a description, with the columns to read from it."""
    for part in description.parts.values():
        if isinstance(part, d.ImuDescription) and part.accel_source is not None:
            yield part.accel_source, [*d.columns_of(part.accel_source), *part.accel.columns]
            yield part, d.columns_of(part.model_copy(update={"accel": None}))
        else:
            yield part, d.columns_of(part)


def wrong_clock(name: str, span_ns: tuple[int, int], imu_ns: tuple[int, int]) -> str:
    """Return that a stream lies wholly outside the IMU's time; both from first to last, ns."""
    span, imu = (f"{first * 1e-9:.3f} s to {last * 1e-9:.3f} s" for first, last in (span_ns, imu_ns))
    return (
        f"{name}: {span} lies wholly outside the IMU's time, {imu}; "
        "check its clock (`clock_offset_s`) and the `unit` of its time"
    )
