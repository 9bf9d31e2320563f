"""Columns of Parquet files as NumPy or pandas hold them: times exact in any unit and zone, and sizes bounded."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ...errors import DatasetError
from ...times import DAY_NS, NS_PER
from .table import short

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

MOST_UNPACKED = 1000
"""The wanted columns may be this many times larger than the file: those of an IMU are 1 to 10 times larger."""
SMALL_BYTES = 64 << 20
"""Up to here they may be, however small the file: it may hold one value, a million times."""
ABSENT = np.iinfo(np.int64).min
"""Stands for an integer or a time that is absent: no time that we accept, and NumPy's NaT."""


def check_size(path: Path, file: pq.ParquetFile, names: Collection[str]) -> None:
    """Refuse a file whose wanted columns claim to be very much larger than the file.

    Raises:
        DatasetError: they would need more than 64 MiB, and more than 1000 times the file.
    """
    meta, claimed = file.metadata, file.metadata.num_rows * 8 * len(names)
    for group in range(meta.num_row_groups):
        row_group = meta.row_group(group)
        chunks = (row_group.column(i) for i in range(row_group.num_columns))
        claimed += sum(chunk.total_uncompressed_size for chunk in chunks if chunk.path_in_schema in names)
    most = max(SMALL_BYTES, MOST_UNPACKED * path.stat().st_size)
    if claimed > most:
        raise DatasetError(
            f"{path}: its {meta.num_rows} rows would need {claimed >> 20} MiB, over {MOST_UNPACKED} times the file"
        )


def read_known(path: Path, names: Collection[str]) -> pd.DataFrame:
    """Return those of some columns that a file has.

    Raises:
        DatasetError: as `check_size`; what else pyarrow raises is passed on.
    """
    import pyarrow.parquet as pq

    with path.open("rb") as raw, pq.ParquetFile(raw) as file:
        found = [name for name in file.schema_arrow.names if name in names]
        check_size(path, file, found)
        return file.read(columns=found).to_pandas(ignore_metadata=True)


def unpacked(array: pa.Array[Any], *, as_written: bool) -> pd.Series | NDArray[Any]:
    """Return a column: times as datetime64 or timedelta64 in ns (UTC), and exact integers if `as_written`."""
    import pyarrow as pa

    kind = array.type
    if pa.types.is_temporal(kind):
        is_date, since_when = pa.types.is_date(kind), pa.types.is_timestamp(kind) or pa.types.is_date(kind)
        small = pa.types.is_date32(kind) or pa.types.is_time32(kind)
        ints = array.cast(pa.int32()).cast(pa.int64()) if small else array.cast(pa.int64())
        unit_ns = (DAY_NS if pa.types.is_date32(kind) else NS_PER["ms"]) if is_date else NS_PER[kind.unit]
        return _ns(ints, unit_ns).view("datetime64[ns]" if since_when else "timedelta64[ns]")
    if pa.types.is_dictionary(kind):
        used, place = np.unique(array.indices.fill_null(-1).to_numpy(zero_copy_only=False), return_inverse=True)
        words = array.dictionary.take(pa.array(used, pa.int64(), mask=used < 0)).to_pylist()
        return np.array([None if word is None else short(word) for word in words], object)[place]
    if as_written and pa.types.is_integer(kind) and array.null_count and not pa.types.is_uint64(kind):
        return _integers(array.cast(pa.int64()))
    return array.to_pandas()


def _integers(ints: pa.Array[Any]) -> NDArray[np.int64]:
    return ints.fill_null(ABSENT).to_numpy(zero_copy_only=False)


def _ns(ints: pa.Array[Any], unit_ns: int) -> NDArray[np.int64]:
    """Return nanoseconds; ABSENT where they are absent, or no int64."""
    values = _integers(ints)
    fits = np.abs(values.astype(float)) * unit_ns < 2.0**63
    return np.where(fits, np.where(fits, values, 0) * unit_ns, ABSENT)
