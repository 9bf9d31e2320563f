"""Packed parts of recordings (bz2, lz4, zstd), unpacked piece by piece up to a bound: 50 bytes can hold terabytes."""

from __future__ import annotations

import bz2
from collections.abc import Iterator
from io import BytesIO
from typing import IO, Any

from ..errors import DatasetError
from .recording import extra

RATIO = 100
"""A part may unpack to that many times its size: lz4 reaches 255 on zeros, recordings of sensors seldom 10."""
SPARE_BYTES = 64 << 20
"""And a part to that much more, for small parts of zeros: 64 MiB, above the chunks of every recorder (below 10 MB)."""
SPARE_PARTS = 4
"""All parts of a file together may use this much of SPARE_BYTES beyond their RATIO."""
PIECE_BYTES = 1 << 20
"""Unpacked at a time: 1 MiB."""


def _most(size: int) -> int:
    """Return how many bytes a file of so many may unpack to."""
    return SPARE_PARTS * SPARE_BYTES + RATIO * size


class Bounded:
    """A stream that unpacks a file meanwhile, and ends with an error where that is more than it may."""

    def __init__(self, stream: IO[bytes], where: str, size: int) -> None:
        self._stream, self._where, self._left = stream, where, _most(size)

    def read(self, size: int) -> bytes:
        """Return the next bytes.

        Raises:
            DatasetError: the file unpacks to more than it may.
        """
        data = self._stream.read(size)
        self._left -= len(data)
        if self._left < 0:
            raise DatasetError(f"{self._where}: unpacks to more than {RATIO} times its size; that is no recording")
        return data


class Unpacking:
    """Unpacks the parts of one file.

    A part may take SPARE_BYTES and RATIO times its size, all parts of the file SPARE_PARTS times SPARE_BYTES and RATIO
    times the file's size. So memory and time are bounded by the file, whatever it claims.

    Args:
        where: the file, in errors.
        size: of the file, bytes.
        needs: the extra of this package that has the decompressors.
    """

    def __init__(self, where: str, size: int, needs: str = "ros") -> None:
        self.where, self.needs = where, needs
        self.left = _most(size)

    def unpacked(self, compression: str, data: bytes, *, whole: bool = True) -> bytes:
        """Return a part unpacked; "" and "none" are not packed. Of one that is not `whole`, what can be read.

        Raises:
            DatasetError: it unpacks to more than it may.
            Exception: damaged, in the decompressors' many ways.
        """
        if compression in ("", "none"):
            return data
        pieces = bytearray()
        try:
            for piece in self.pieces(compression, BytesIO(data), len(data)):
                pieces += piece
        except DatasetError:
            raise
        except Exception:
            if whole:
                raise
        return bytes(pieces)

    def pieces(self, compression: str, packed: IO[bytes], size: int) -> Iterator[bytes]:
        """Yield a part of `size` packed bytes in pieces; see `unpacked`."""
        stream = self._opened(compression, packed)
        most = min(self.left, SPARE_BYTES + RATIO * size)
        while piece := stream.read1(PIECE_BYTES):  # what comes before damage, too
            most -= len(piece)
            self.left -= len(piece)
            if most < 0:
                raise DatasetError(
                    f"{self.where}: {size} bytes of {compression} unpack to more than {RATIO} times their size and "
                    f"{SPARE_BYTES >> 20} MiB; that is no recording. If it is, store it without compression"
                )
            yield piece

    def _opened(self, compression: str, packed: IO[bytes]) -> Any:
        if compression == "bz2":
            return bz2.BZ2File(packed)
        with extra(self.needs):
            if compression == "lz4":
                import lz4.frame

                return lz4.frame.LZ4FrameFile(packed)
            if compression == "zstd":
                import zstandard

                return zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
        raise ValueError(f"unknown compression {compression!r}")
