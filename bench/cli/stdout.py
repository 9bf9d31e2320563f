"""Standard output and standard error of the command: on a terminal without our letters, and in a pipe that closes."""

from __future__ import annotations

import codecs
import io
import os
import sys
import unicodedata

WORDS = {
    "–": "-",
    "—": "-",
    "−": "-",
    "─": "-",
    "━": "-",
    "…": "...",
    "×": "x",
    "°": "deg",
    "σ": "sigma",
    "χ": "chi",
    "Δ": "delta",
    "▲": "^",
    "▼": "v",
    "±": "+-",
    "≥": ">=",
    "≤": "<=",
    "→": "->",
    "√": "sqrt",
    "∞": "inf",
    "µ": "u",
    "μ": "u",
    "·": "*",
    "’": "'",
    "“": '"',
    "”": '"',
}
"""What tables, captions and bars say in letters beyond ASCII."""
HANDLER = "fathom-ascii"


def in_ascii(letter: str) -> str:
    """Return a letter in ASCII: a word for it, the letter without its accent, or its code as Python writes it."""
    if letter in WORDS:
        return WORDS[letter]
    plain = unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode()
    return plain or letter.encode("ascii", "backslashreplace").decode()


def _replace(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(map(in_ascii, error.object[error.start : error.end])), error.end


class Output(io.TextIOWrapper):
    """A text stream that writes in ASCII what its encoding lacks, and nowhere once its reader has gone."""

    def write(self, text: str) -> int:
        """Write a text."""
        try:
            return super().write(text)
        except BrokenPipeError:
            self._write_nowhere()
            return len(text)

    def flush(self) -> None:
        """Write what is held back."""
        try:
            super().flush()
        except BrokenPipeError:
            self._write_nowhere()

    def _write_nowhere(self) -> None:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self.fileno())
        os.close(nowhere)


def set_up() -> None:
    """Let the process print on any terminal, and into a pipe that closes."""
    codecs.register_error(HANDLER, _replace)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper) and not isinstance(stream, Output):
            encoding, buffers = stream.encoding, stream.line_buffering
            setattr(sys, name, Output(stream.detach(), encoding, HANDLER, line_buffering=buffers))
