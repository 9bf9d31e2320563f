"""The rows of one stream, from its columns as read to those that are used; what is bad is refused, or dropped."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError
from ..formats.tables.table import Columns, Flaws
from ..log import is_noise
from ..notes import Note
from ..state import LIMIT_NS, Array, TimeArray
from ..times import UNIT_NAMES, far, far_complaint, finer_unit, times_ns
from . import description as d
from .order import complaint, disorder, laps, unwrapped
from .sources import Opening

Mask = NDArray[Any]
LARGEST_SHARE = 0.5
"""Of a stream's rows that --repair drops, for all reasons together; of what is worse, the description is wrong."""
REPEATED_SHARE = 0.5
"""A reading that changes repeats itself by chance in far fewer rows, in all of its components at once."""
CHANGES = 5
"""Readings that change less often are those of something that stands still."""
JITTER = 0.01
"""Of the length of means: by so much they may overlap, as clocks jitter; neighbours then share 1 % of their errors."""
COMMA = re.compile(r"[-+]?\d+,\d+")
COMMA_HINT = "; `decimal: ','`?"


@dataclass
class Rows:
    """The remaining rows of one stream, with their number in the source.

    Attributes:
        stream: its name.
        opening: what it is read from.
        raw: (n,) per column, not converted.
        words: by column and number, the fields that are text instead of numbers.
        number: (n,) row in the source, from 0.
        t_ns, received_ns: (n,).
        timed: (n,) whether the row has these two times.
        stamps: the columns of times.
        values: (n, …) by name, converted; `keep` keeps them in step with the rows.
        total, dropped: how many rows there were to judge, and how many of them were bad.
        reasons, complaints: what was wrong: with how many rows, and with the first.
    """

    stream: str
    opening: Opening
    raw: Columns
    words: Mapping[d.Column, Mapping[int, str]]
    number: TimeArray
    t_ns: TimeArray
    received_ns: TimeArray
    timed: NDArray[np.bool_]
    stamps: frozenset[d.Column] = frozenset()
    values: dict[str, Array] = field(default_factory=dict)
    total: int = 0
    dropped: int = 0
    reasons: dict[str, int] = field(default_factory=dict)
    complaints: list[str] = field(default_factory=list)

    def keep(self, mask: Mask) -> None:
        """Keep the rows of a mask."""
        self.raw = {column: values[mask] for column, values in self.raw.items()}
        self.values = {name: values[mask] for name, values in self.values.items()}
        self.number, self.t_ns, self.received_ns = self.number[mask], self.t_ns[mask], self.received_ns[mask]
        self.timed = self.timed[mask]

    def leave_out(self, mask: Mask, what: str) -> None:
        """Drop the rows of a mask, as the description says, and count them in the notes."""
        count = int(np.count_nonzero(mask))
        if count:
            text = f"{self.stream}: {count} rows {what} dropped"
            self.opening.notes.append(Note(text, "dropped", self.stream, count, self.total))
            self.total -= count
            self.keep(~mask)

    def error(self, what: str) -> DatasetError:
        """Return the error that names this stream."""
        return DatasetError(f"{self.opening.folder}: {self.stream}: {what}")

    def refuse(self, bad: Mask, complaint: Callable[[int], str], what: str) -> None:
        """Drop the rows of `bad`, which `settle` notes with repair and raises without; complaint(row) names the first.

        Raises:
            DatasetError: more than half of the rows were bad by now, so that no repair would help.
        """
        count = int(np.count_nonzero(bad))
        if not count:
            return
        first = int(np.flatnonzero(bad)[0])
        self.bad(count, f"row {self.number[first]} ({count} in all): {complaint(first)}", what)
        self.keep(~bad)

    def bad(self, count: int, complaint: str, what: str) -> None:
        """Count bad rows, as `refuse` does."""
        self.complaints.append(complaint)
        self.reasons[what] = self.reasons.get(what, 0) + count
        self.dropped += count
        if self.dropped > LARGEST_SHARE * self.total:
            reasons = " or ".join(self.reasons)
            raise self.error(
                f"{self.dropped} of {self.total} rows are {reasons}, too many to drop (--repair drops at most half of "
                f"a stream); {self.complaints[0]}"
            )

    def settle(self) -> None:
        """Note what was dropped with repair.

        Raises:
            DatasetError: rows are bad, and may not be repaired.
        """
        if self.complaints and not self.opening.repair:
            raise self.error(f"{self.complaints[0]}; --repair drops such rows")
        for what, count in self.reasons.items():
            text = f"{self.stream}: {count} rows {what} (repair) dropped"
            self.opening.notes.append(Note(text, "dropped", self.stream, count, self.total))

    def si(self, quantity: d.Quantity) -> Array:
        """Return (n, k): the quantity's columns in SI, in the axes of the source."""
        values = np.stack([self.raw[c] for c in quantity.columns], axis=1).astype(float, copy=False)
        factor = quantity.units[quantity.unit]
        with np.errstate(over="ignore", invalid="ignore"):
            if np.any(np.not_equal(quantity.scale, 1.0)):
                values = values * np.asarray(quantity.scale)
            if np.any(np.not_equal(quantity.offset, 0.0)):
                values = values + np.asarray(quantity.offset)
            return values if factor == 1.0 else values * factor

    def put_in_order(self, every: int = 1, averaged_over_s: float = 0.0) -> None:
        """Refuse times out of order, settle what was wrong with the rows, and keep every n-th without overlap.

        Raises:
            DatasetError: as `settle`; or the times are not what the description says.
        """
        columns = [values for column, values in self.raw.items() if column not in self.stamps]
        found = disorder(self.t_ns, self.number, columns)
        if found is not None:
            t_ns, twins = self.t_ns, int(np.count_nonzero(found.twins))
            lost = int(np.count_nonzero(found.lost))
            if found.why:
                raise self.error(f"{lost} of {len(t_ns)} rows are out of order, too many to drop: {found.why}")
            self.total, self.dropped = self.total - twins, self.dropped - twins
            self.refuse(found.lost | found.twins, lambda row: complaint(t_ns, row), "out of order")
        self.settle()
        if averaged_over_s:
            mask = apart(self.t_ns, averaged_over_s)
            kept = f"{int(mask.sum())} of {len(mask)} rows kept, which do not overlap"
            text = f"{self.stream}: means over {averaged_over_s:g} s; {kept}"
            self.opening.notes.append(text)
            self.keep(mask)
        if every > 1:
            mask = np.zeros(len(self.t_ns), bool)
            mask[::every] = True
            self.opening.notes.append(f"{self.stream}: every {every}th row kept, {int(mask.sum())} of {len(mask)}")
            self.keep(mask)


def apart(t_ns: TimeArray, averaged_over_s: float) -> NDArray[np.bool_]:
    """Return which of increasing times (n,) to keep, from the first on, so that means over so many seconds are apart.

    Means that overlap by JITTER of their length count as apart.
    """
    mask = np.zeros(len(t_ns), bool)
    step_ns, row = round((1 - JITTER) * averaged_over_s * 1e9), 0
    while row < len(t_ns):
        mask[row] = True
        row = max(row + 1, int(np.searchsorted(t_ns, t_ns[row] + step_ns)))
    return mask


def read_rows(
    opening: Opening, stream: str, part: Any, numbers: Sequence[d.Column], places: Sequence[d.Column] = ()
) -> Rows:
    """Read a stream's rows: those that are valid, within its window, timed, and of finite numbers.

    Args:
        opening: the log.
        stream: its name in messages.
        part: its description.
        numbers: the columns of its quantities.
        places: those of its latitude and longitude, which are not converted.
    """
    time: d.Time = part.time
    valid: d.Valid | None = part.valid
    spread: d.Quantity | None = getattr(part, "spread", None)
    numbers = [*numbers, *(() if spread is None else spread.columns)]
    stamps = [column for columns in time.stamps for column in columns]
    flags = [] if valid is None else [valid.column]
    texts = [*stamps, *places, *(flags if valid is not None and valid.texts else [])]
    plain = [*numbers, *(flags if valid is not None and not valid.texts else [])]
    for column in texts:
        if column in plain:
            what = "a time" if column in stamps else "text"
            raise DatasetError(f"{opening.folder}: {stream}: column {column!r} cannot be {what} and something else")
    raw, flaws = opening.columns(part, plain, texts)
    rows = _timed(opening, stream, time, raw, flaws)
    rows.t_ns = rows.t_ns - round(0.5e9 * getattr(part, "averaged_over_s", 0.0))
    if valid is not None:
        _use_valid(rows, valid)
    _refuse_other_unit(rows, time, stamps)
    rows.refuse(
        ~rows.timed,
        lambda row: f"time is {_shown([rows.raw[column][row] for column in stamps])}",
        "without a time",
    )
    rows.refuse(far(rows.t_ns), lambda row: far_complaint(rows.t_ns, row), "more than 400 days from the others")
    _align_counter(rows, time)
    if isinstance(part, d.Window):
        inside = opening.window(stream, part, rows.t_ns)
        rows.total -= int(np.count_nonzero(~inside))
        rows.keep(inside)
    _without_repeats(rows, part, [*numbers, *places])
    _refuse_infinite(rows, [column for column in numbers if spread is None or column not in spread.columns])
    if spread is not None:
        _spread(rows, spread)
    early = np.asarray(rows.received_ns < rows.t_ns)
    rows.refuse(early, lambda row: "received before it was true", "received before they were true")
    return rows


def _timed(opening: Opening, stream: str, time: d.Time, raw: Columns, flaws: Flaws) -> Rows:
    """Return all rows with their times."""
    count = len(next(iter(raw.values())))
    if time.column is None:
        assert time.row_rate_hz is not None
        both = [times_ns(time.start_s + np.arange(count) / time.row_rate_hz, "s")]
    else:
        both = [_sum_ns(raw, columns, time) for columns in time.stamps]
    offset_ns, (stamp_ns, _), (received_ns, _) = round(time.clock_offset_s * 1e9), both[0], both[-1]
    timed = np.all([good for _, good in both], axis=0)
    t_ns = stamp_ns + offset_ns - round(time.delay_s * 1e9)
    stamps = frozenset(column for columns in time.stamps for column in columns)
    rows = Rows(stream, opening, raw, flaws.words, np.arange(count), t_ns, received_ns + offset_ns, timed, stamps)
    rows.total = count
    if flaws.other_lines:
        opening.notes.append(f"{stream}: {flaws.other_lines} lines of other kinds left out")
    if flaws.cut_off:
        text = f"{stream}: the last line is cut off, and left out; it ends in {flaws.cut_off!r}"
        opening.notes.append(Note(text, "damage", stream, 1, count + 1))
    if flaws.too_long:
        rows.total += flaws.too_long
        rows.bad(flaws.too_long, "lines have more fields than the first", "with too many fields")
    return rows


def _sum_ns(raw: Columns, columns: tuple[d.Column, ...], time: d.Time) -> tuple[TimeArray, NDArray[np.bool_]]:
    """Return the times that columns add up to, with the wraps of their counter, and which rows have one."""
    parts = [times_ns(raw[column], unit) for column, unit in zip(columns, time.units, strict=True)]
    t_ns: TimeArray = np.sum([ns for ns, _ in parts], axis=0)
    good = np.all([fine for _, fine in parts], axis=0) & (np.abs(t_ns) < LIMIT_NS)
    if time.wraps_at_s is not None:
        t_ns[good] = unwrapped(t_ns[good], round(time.wraps_at_s * 1e9))
    return t_ns, good


def _use_valid(rows: Rows, valid: d.Valid) -> None:
    """Leave out the rows that the description calls invalid."""
    column, values = valid.column, rows.raw[valid.column]
    words = rows.words.get(column)
    if words and not valid.texts:
        bad = np.isnan(values)
        rows.refuse(bad, lambda row: _no_number(rows, column, row) + "; `valid` may name text", "not finite")
        values = rows.raw[column]
    if values.dtype.kind == "T":
        told = [text.strip() if isinstance(text, str) else "" for text in values]
        good = np.array([text in valid.texts or number_or_nan(text) in valid.numbers for text in told], bool)
    else:
        good = np.isin(values, valid.numbers)
    if len(good) and not good.any():
        found = ", ".join(dict.fromkeys(str(value)[:20] for value in values[:100].tolist()))
        wanted = ", ".join(value if isinstance(value, str) else f"{value:g}" for value in valid.values)
        text = f"{rows.stream}: no row is valid: column {column!r} holds {found}, never {wanted}"
        rows.opening.notes.append(Note(text, "silent", rows.stream, len(good), len(good)))
    rows.leave_out(~good, "invalid")


def _refuse_other_unit(rows: Rows, time: d.Time, stamps: Sequence[d.Column]) -> None:
    """Refuse a column of times that are mostly too large for their unit, and not for a finer one.

    Raises:
        DatasetError: names the unit that is probably meant.
    """
    if np.count_nonzero(~rows.timed) <= LARGEST_SHARE * len(rows.timed):
        return
    row = int(np.flatnonzero(~rows.timed)[0])
    for at, column in enumerate(stamps):
        unit, stamp = time.units[at % len(time.units)], rows.raw[column][row]
        if meant := finer_unit(stamp, unit):
            raise rows.error(
                f"row {rows.number[row]}: column {column!r} is {stamp}, with `unit: {unit}`; "
                f"this looks like {UNIT_NAMES[meant]}: `unit: {meant}`"
            )


def _shown(stamps: Sequence[Any]) -> str:
    comma = any(COMMA.fullmatch(str(stamp)) for stamp in stamps)
    return (", ".join(map(str, stamps)) or "beyond the clock") + (COMMA_HINT if comma else "")


def number_or_nan(text: Any) -> float:
    """Return a text as a number; NaN where it is none."""
    try:
        return float(text)
    except ValueError:
        return np.nan


def _no_number(rows: Rows, column: d.Column, row: int) -> str:
    """Return what a field holds instead of a finite number."""
    word = rows.words.get(column, {}).get(int(rows.number[row]))
    if word is None:
        return f"column {column!r} is {rows.raw[column][row]}"
    return f"column {column!r} holds {word!r}, not a number" + (COMMA_HINT if COMMA.fullmatch(word) else "")


def _align_counter(rows: Rows, time: d.Time) -> None:
    """Move a stream of a counter by whole periods onto the IMU's time, unless the description says how far."""
    imu_ns = rows.opening.imu_ns
    if time.wraps_at_s is None or imu_ns is None or not len(rows.t_ns) or "clock_offset_s" in time.model_fields_set:
        return
    period_ns = round(time.wraps_at_s * 1e9)
    by, ambiguous = laps((int(rows.t_ns.min()), int(rows.t_ns.max())), period_ns, imu_ns)
    if ambiguous:
        raise rows.error(
            f"its counter begins again every {time.wraps_at_s:.10g} s, and the stream fits into the IMU's time at "
            "several places; give `clock_offset_s`, 0 if it begins with the IMU"
        )
    if by:
        rows.t_ns, rows.received_ns = rows.t_ns + by * period_ns, rows.received_ns + by * period_ns
        text = f"{rows.stream}: moved by {by} periods of its counter, onto the IMU's time"
        rows.opening.notes.append(Note(text, "repaired", rows.stream))


def _without_repeats(rows: Rows, part: Any, columns: Sequence[d.Column]) -> None:
    """Leave out rows with the values of the row before, if the description says so; note it if most rows are such."""
    again = np.zeros(len(rows.t_ns), bool)
    if len(again) < 2 or not columns:
        return
    values = [rows.raw[column] for column in columns]
    again[1:] = np.all([each[1:] == each[:-1] for each in values], axis=0)
    if getattr(part, "drop_repeats", False):
        rows.leave_out(again, "with the values of the row before")
    elif len(columns) > 1:
        zero = np.all([each == 0 for each in values if each.dtype.kind != "T"], axis=0)
        share = np.count_nonzero(again & ~zero) / len(again)
        if share > REPEATED_SHARE and np.count_nonzero(~again) > CHANGES:
            text = (
                f"{rows.stream}: {share:.0%} of the rows have the values of the row before; if they were published "
                "again, `drop_repeats: true` leaves them out"
            )
            rows.opening.notes.append(Note(text, "check", rows.stream, int(np.count_nonzero(again)), len(again)))


def _refuse_infinite(rows: Rows, columns: Sequence[d.Column]) -> None:
    if not columns:
        return
    finite = np.isfinite(np.stack([rows.raw[column].astype(float) for column in columns], axis=1))
    rows.refuse(
        ~np.all(finite, axis=1),
        lambda row: _no_number(rows, columns[int(np.flatnonzero(~finite[row])[0])], row),
        "not finite",
    )


def _spread(rows: Rows, quantity: d.Quantity) -> None:
    """Put "spread": sigma, SI, from columns of it or of variances; refuse what is not positive."""
    read = rows.si(quantity)
    with np.errstate(invalid="ignore", over="ignore"):
        rows.values["spread"] = np.sqrt(read) if isinstance(quantity, d.Variances) else read
        bad = ~is_noise(rows.values["spread"])
    what = "variance" if isinstance(quantity, d.Variances) else "sigma"
    rows.refuse(bad, lambda row: f"{what} must be positive, found {read[row]}", f"without a positive {what}")


def sigma(rows: Rows, part: Any, width: int) -> Array:
    """Return (n, width): standard deviations, SI."""
    if part.spread is not None:
        spread = rows.values["spread"]
        return spread if spread.shape[1] == width else np.repeat(spread, width, axis=1)
    fixed = np.asarray(getattr(part, part.sigma_field), float)
    if part.sigma_field == "sigma_deg":
        fixed = np.radians(fixed)
    return np.tile(np.broadcast_to(fixed, (width,)), (len(rows.t_ns), 1))


def check_width(rows: Rows, part: Any, width: int) -> None:
    """Refuse columns of sigma or variance that are neither one nor `width`."""
    if part.spread is not None and len(part.spread.columns) not in (1, width):
        raise rows.error(f"{'sigma' if part.sigma is not None else 'variance'}: expected {width} columns")


def drop_outliers(rows: Rows, outliers: d.Outliers | None, name: str, unit: str) -> None:
    """Leave out the rows where the norm of the value `name` exceeds the bound."""
    if outliers is None:
        return
    values = rows.values[name]
    chosen = list(range(values.shape[1])) if outliers.components is None else list(outliers.components)
    if max(chosen, default=0) >= values.shape[1]:
        raise rows.error(f"outliers: it has {values.shape[1]} components only")
    rows.leave_out(np.linalg.norm(values[:, chosen], axis=1) > outliers.above, f"over {outliers.above:g} {unit}")
