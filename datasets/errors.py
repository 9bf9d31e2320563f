"""Errors that a user can correct, and the wording of their messages."""

from __future__ import annotations

import difflib
import re
import signal
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import EntryPoint
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, Union, get_args, get_origin

if TYPE_CHECKING:
    from pydantic import ValidationError


def shown(text: str) -> str:
    r"""Return a text as a terminal, a page or a table may show it: what cannot be printed stands there as its code.

    These are control characters (line ends too), marks that turn the direction of writing, and lone surrogates: they
    come from files and names of other people, and could hide, forge or colour what we say. "\x1b[2J" is shown so.
    """
    return text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


class FathomError(ValueError):
    """What a user can correct; the message says what, where and what to do.

    Args:
        lines: of the message, each shown as `shown` does.
    """

    def __init__(self, *lines: str) -> None:
        super().__init__(*map(shown, lines))

    def __str__(self) -> str:
        return "\n".join(self.args)


class DatasetError(FathomError):
    """A log, a description or a trajectory file cannot be used."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean 'x'?" for the known name closest to `name`, or "" if none is close; ignores case."""
    folded = {other.casefold(): other for other in known}
    close = difflib.get_close_matches(name.casefold(), folded, n=1)
    return f"; did you mean {folded[close[0]]!r}?" if close else ""


def nearest_file(path: Path, *, folders: bool = False) -> str:
    """Return `nearest` for a missing file, among the files (and folders) next to it."""
    beside = path.parent.iterdir() if path.parent.is_dir() else []
    return nearest(path.name, [other.name for other in beside if folders or other.is_file()])


LONGEST_MESSAGE = 2000
"""Characters of another program's message that are kept: a page."""


def message_of(error: BaseException) -> str:
    """Return the message of an error on one line, as `shown` does; another package's error may not have one to show."""
    try:
        return shown(" ".join(str(error).split())[:LONGEST_MESSAGE])
    except Exception:  # its class may raise anything here
        return "(its message cannot be shown)"


def one_line(error: BaseException) -> str:
    """Return the class and the message of an error, on one line, as `shown` does."""
    return f"{shown(type(error).__name__)}: {message_of(error)}".rstrip()


LOAD_S = 60.0
"""How long another package's code may take to be imported or configured, s; large libraries take ten from a disk."""


@contextmanager
def given_up_after(seconds: float) -> Iterator[None]:
    """Interrupt Python code inside that takes longer; not in a thread, on Windows, or within one call of compiled code.

    Raises:
        TimeoutError: inside, and again every second, as code may catch it.
    """
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "setitimer"):
        yield
        return

    def interrupt(*_: object) -> None:
        raise TimeoutError(f"not done after {seconds:g} s, and given up")

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL if before is None else before)


def load(point: EntryPoint) -> Any:
    """Return what an entry point of an installed package names.

    Raises:
        Exception, SystemExit: anything, as importing a foreign module may; TimeoutError after LOAD_S.
    """
    with given_up_after(LOAD_S):
        return point.load()


def not_loaded(point: EntryPoint, error: BaseException) -> str:
    """Return that an entry point of an installed package cannot be loaded, and why."""
    package = point.dist.name if point.dist else point.value
    return f"cannot be loaded from the package {package!r}: {one_line(error)}"


MOST_COMPLAINTS = 50
"""About one file; a screen full. A long list of wrong values has one for each."""
LONGEST_VALUE = 60
"""Characters of an invalid value that an error shows."""


def complaints(
    error: ValidationError, model: Any, above: Sequence[str] = (), renamed: Mapping[str, str] | None = None
) -> list[str]:
    """Translate pydantic's errors into sentences: the key's path, the problem, and the value found.

    Unknown keys come first, with the nearest known key, since a misspelt key is reported as missing as well.

    Args:
        error: raised by validating `model`.
        model: a pydantic model or dataclass.
        above: the path of the model in the file.
        renamed: old names of keys, with their new names, relative to the place of the old one.
    """
    every = error.errors(include_url=False)
    # where no item of a list fits, pydantic also says that the list is empty
    every = [problem for problem in every if not (problem["type"] == "too_short" and problem["input"])]
    every.sort(key=lambda problem: problem["type"] not in UNKNOWN_KEY)
    told = _together([_complaint(problem, model, above, renamed or {}) for problem in every[:MOST_COMPLAINTS]])
    return told if len(every) <= MOST_COMPLAINTS else [*told, f"and {len(every) - MOST_COMPLAINTS} more of this kind"]


UNKNOWN_KEY = ("extra_forbidden", "unexpected_keyword_argument")
"""Pydantic's types of error for an unknown key, in a model and in a dataclass."""


class _Complaint(NamedTuple):
    """What is wrong at a place; or what was expected there instead of what was found, by a member of a union or all."""

    place: str
    what: str
    found: str = ""
    hint: str = ""


def _together(every: list[_Complaint]) -> list[str]:
    """Return sentences, one for each place and value: the members of a union expect different things of one value."""
    told: dict[tuple[str, str], list[_Complaint]] = {}
    for each in every:
        within = any(other.place.startswith((f"{each.place}[", f"{each.place}.")) for other in every)
        if not (each.found and each.place and within):  # else a member of the union looks further in
            told.setdefault((each.place, each.found or each.what), []).append(each)
    sentences = []
    for (place, _), same in told.items():
        what = " or ".join(dict.fromkeys(each.what for each in same))
        found, hint = same[0].found, next((each.hint for each in same if each.hint), "")
        text = f"expected {what}, found {found}{hint}" if found else what
        sentences.append(f"`{place}`: {text}" if place else text)
    return sentences


def _complaint(problem: Any, model: Any, above: Sequence[str], renamed: Mapping[str, str]) -> _Complaint:
    steps, known, inner = _followed(problem["loc"], model)
    place = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in (*above, *steps)).lstrip(".")
    if problem["type"] in UNKNOWN_KEY:
        key = str(problem["loc"][-1])
        if re.split("[.,]", renamed.get(key, ""))[0] in known:  # a key that is new at this place
            return _Complaint("", f"`{place}` is called `{renamed[key]}` now")
        return _Complaint("", f"unknown key `{place}`{nearest(key, known)} (known: {', '.join(known)})")
    if problem["type"] in ("missing", "missing_argument"):
        return _Complaint("", f"missing key `{place}`")
    if problem["type"] == "value_error":
        return _Complaint(place, problem["msg"].removeprefix("Value error, "))
    what, hint = _expected(problem, inner)
    return _Complaint(place, what, repr(problem["input"])[:LONGEST_VALUE], hint)


NO_KEYS = ("dict_type", "mapping_type", "dataclass_type", "model_type", "model_attributes_type")
"""Pydantic's types of error for a value that should have keys."""
NAMING = ("log", "name")
"""Keys whose value is a name: one of them was probably meant where a name stands instead of keys and values."""
EXPECTED = {
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "a whole number"),
    **dict.fromkeys(("float_type", "float_parsing"), "a number"),
    **dict.fromkeys(("bool_type", "bool_parsing"), "true or false"),
    **dict.fromkeys(("list_type", "tuple_type", "set_type", "frozen_set_type", "iterable_type"), "a list"),
    "string_type": "text",
    "finite_number": "a finite number",
    "none_required": "null",
    "invalid_key": "text as a key",
    "string_pattern_mismatch": "text that matches {pattern}",
    "literal_error": "{expected}",
    "enum": "{expected}",
    "too_short": "a list of at least {min_length}",
    "too_long": "a list of at most {max_length}",
}
"""What was expected, by pydantic's type of error; the braces are of its context."""


def _expected(problem: Any, known: Sequence[str]) -> tuple[str, str]:
    """Return what was expected, in a file's words instead of Python's, and a hint; `known`: keys the value may have."""
    if problem["type"] in NO_KEYS:
        key = next((key for key in NAMING if key in known), None)
        keys = f" ({', '.join(known)})" if known else ""
        hint = f"; write {{{key}: {problem['input']}}}" if key and isinstance(problem["input"], str) else ""
        return f"keys and values{keys}", hint
    if problem["type"] in EXPECTED:
        what, value = EXPECTED[problem["type"]].format(**problem.get("ctx", {})), problem["input"]
        return what, nearest(value, re.findall(r"'([^']*)'", what)) if isinstance(value, str) else ""
    return str(problem["msg"]).removeprefix("Input should be ").removeprefix("expected "), ""


def _followed(loc: Sequence[str | int], model: Any) -> tuple[list[str | int], list[str], list[str]]:
    """Return the steps of a place without pydantic's names for members of unions, and the keys beside it and in it."""
    steps: list[str | int] = []
    kind, known = model, list(_keys(model))
    for step in loc:
        members = [member for member in _members(kind) if member is not NoneType]
        if len(members) > 1 and step not in {key for member in members for key in _keys(member)}:
            kind = next((m for m in members if step in (_tag(m), getattr(m, "__name__", None))), None)
            continue  # the name of a member
        steps.append(step)
        parts = [part for part in map(_bare, members) if _keys(part)]
        known = list(dict.fromkeys(key for part in parts for key in _keys(part)))
        if isinstance(step, int):
            kind = next((arg for member in members for arg in get_args(_bare(member)) if arg is not Ellipsis), None)
        else:
            kind = next((_keys(part)[step] for part in parts if step in _keys(part)), None)
    return steps, known, [key for member in _members(kind) for key in _keys(_bare(member))]


def _members(kind: Any) -> Iterator[Any]:
    """Yield the members of a union; or the type itself if it is no union."""
    bare = _bare(kind)
    if get_origin(bare) in (Union, UnionType):
        for member in get_args(bare):
            yield from _members(member)
    else:
        yield kind


def _bare(kind: Any) -> Any:
    return _bare(get_args(kind)[0]) if get_origin(kind) is Annotated else kind


def _tag(kind: Any) -> str | None:
    """Return the tag that identifies a member of a union; None if it has none."""
    return next((note.tag for note in getattr(kind, "__metadata__", ()) if hasattr(note, "tag")), None)


def _keys(kind: Any) -> dict[str, Any]:
    """Return the keys of a model or a dataclass as a file writes them, and their types (None: a plain dataclass's)."""
    fields = getattr(kind, "__pydantic_fields__", None)
    if fields is None:
        return dict.fromkeys(getattr(kind, "__dataclass_fields__", ()))
    return {field.alias or name: field.annotation for name, field in fields.items()}
