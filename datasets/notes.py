"""Notes: sentences on a log, or on a run, with what a table or a machine needs of them."""

from __future__ import annotations

from typing import Any

KINDS = {
    "damage": "the recording is damaged, cut off, or not read in full",
    "check": "a check of the log before the run found something wrong",
    "silent": "a sensor of the log has no reading in it",
    "dropped": "rows were left out on reading",
    "repaired": "values were changed on reading",
    "start": "heading or velocity was unknown at the start, or the start was moved",
    "overclaims": "the estimator was started where it is known to claim more than it knows",
    "height": "nothing measures the height, and it is scored",
    "earth": "whether the Earth turns, where the latitude is known",
    "gap": "gaps in the IMU were bridged",
    "outside": "readings lay outside the IMU's time",
    "late_dropped": "readings came too late to be used",
    "gated": "readings were rejected by a gate, or got less weight from a robust loss",
    "late": "readings were received later than they were true",
    "merged": "readings were taken as of the time of another keyframe or epoch",
    "carried": "readings were tied by the IMU to the keyframe before them",
    "void": "readings measured nothing: every sigma was infinite",
    "about": "what the log is and how it was made; nothing went wrong",
}
"""What each kind of note says, the worst first: tables show them in this order, and never "about"."""


class Note(str):
    """A sentence that is also data; a plain string among notes counts as one of kind "about".

    Attributes:
        kind: one of KINDS.
        stream: which sensor it is about; "" for the whole log.
        count: how many rows, readings or gaps.
        of: out of how many.
        seconds: how long in all, s.

    Raises:
        ValueError: no such kind.
    """

    # a note counts rows, as JSON and tables call it, and nobody counts letters in it
    __slots__ = ("count", "kind", "of", "seconds", "stream")  # pyright: ignore[reportIncompatibleMethodOverride]

    kind: str
    stream: str
    count: int | None
    of: int | None
    seconds: float | None

    def __new__(
        cls,
        text: str,
        kind: str = "about",
        stream: str = "",
        count: int | None = None,
        of: int | None = None,
        seconds: float | None = None,
    ) -> Note:
        """Return the note of this text."""
        if kind not in KINDS:
            raise ValueError(f"no kind of note {kind!r}; known: {', '.join(KINDS)}")
        note = super().__new__(cls, text)
        note.kind, note.stream, note.count, note.of, note.seconds = kind, stream, count, of, seconds
        return note

    @property
    def share(self) -> float | None:
        """`count` over `of`; None where one of them is not known."""
        return self.count / self.of if self.count is not None and self.of else None


def as_data(note: str) -> dict[str, Any]:
    """Return a note for JSON: its kind, its text, and what else is known of it."""
    if not isinstance(note, Note):
        note = Note(note)
    known = {"stream": note.stream or None, "count": note.count, "of": note.of}
    known |= {"share": note.share, "seconds": note.seconds}
    return {"kind": note.kind, "text": str(note)} | {name: value for name, value in known.items() if value is not None}
