"""YAML as every file of ours is written: descriptions, scenarios, experiments, and the metadata of ROS 2 bags.

One value is built from one event of PyYAML's parser, with the constructors of its safe loader for single values. So a
key that stands twice is seen, aliases and merges (`<<`) are counted as what they stand for, and the depth is bounded.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from ..errors import DatasetError, shown
from ..files import regular_file

MOST_BYTES = 16 << 20
"""Of a file; an experiment of 1000 logs with every key spelled out has 5 MB."""
MOST_VALUES = 500_000
"""In a file, keys included: ten times those of the largest experiment that we know. A value needs some 100 bytes here,
and 1 kB where every one of them is an error."""
MOST_REPEATED = 10_000
"""Values that all aliases together stand for; a covariance has 225. It keeps small files small."""
TEXT_OF_A_VALUE = 100
"""Characters of text that count as one value more, since aliases can repeat long text as well."""
MOST_LEVELS = 50
"""Lists and mappings in one another; our deepest file has 9."""
LONGEST_NUMBER = 100
"""Characters. 64 bits need 20, a float 24; more is a mistake, and slow to read."""
LEADING_ZERO = re.compile(r"[-+]?0[0-9_]+")
"""YAML 1.1 takes 045 for octal, 37, and 087 for text."""
SIXTIETHS = re.compile(r"[-+]?[0-9][0-9_]*(:[0-5]?[0-9])+(\.[0-9_]*)?")
"""YAML 1.1 takes 1:30 for 90."""
_PLAIN = {f"tag:yaml.org,2002:{kind}" for kind in ("seq", "map")}
_NUMBERS = {f"tag:yaml.org,2002:{kind}" for kind in ("int", "float")}
_MERGE = "tag:yaml.org,2002:merge"


def read_yaml(path: Path) -> Any:
    """Return what a YAML file holds: mappings, lists, text, numbers, truth values, dates, or None if it is empty.

    Raises:
        DatasetError: it cannot be read, is no YAML, holds a key twice (names both lines), or is larger than the bounds
            of this module; names file and line.
    """
    if regular_file(path).stat().st_size > MOST_BYTES:
        raise DatasetError(f"{path}: larger than {MOST_BYTES >> 20} MiB, which no file of YAML should be")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}") from None
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = data.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise DatasetError(f"{path}: line {line}: not YAML: no UTF-8 ({error.reason}); save it as UTF-8") from None
    return parse_yaml(text, str(path))


def parse_yaml(text: str, where: str) -> Any:
    """Return what a text in YAML holds; as `read_yaml`, with `where` in place of the file."""
    directive = re.search("^%TAG", text, re.MULTILINE)
    if directive is not None:  # many of them take the parser a time that grows with their square
        line = text.count("\n", 0, directive.start()) + 1
        raise DatasetError(f"{where}: line {line}: %TAG is not known here; leave it out")
    try:
        return _Builder(text, where).document()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        what = " ".join(part for part in (error.problem, error.context) if part)
        raise DatasetError(f"{where}: line {mark.line + 1 if mark else '?'}: not YAML: {what}{_hint(what)}") from None
    except yaml.reader.ReaderError as error:
        line = text.encode().count(b"\n", 0, error.position) + 1
        raise DatasetError(f"{where}: line {line}: not YAML: an invisible character, {error.character:#x}") from None


def _hint(what: str) -> str:
    if "cannot start any token" in what:
        return "; indent with blanks, not with tabs, and put text that begins with % @ ` or a tab in quotes"
    if "mapping values are not allowed" in what:
        return "; put text that contains `: ` in quotes, and indent keys alike"
    return ""


_Loader: Any = yaml.CSafeLoader if yaml.__with_libyaml__ else yaml.SafeLoader


class _Builder(_Loader):
    """Builds the value of a document, event by event."""

    def __init__(self, text: str, where: str) -> None:
        super().__init__(text)
        self.where, self.values, self.repeated = where, 0, 0
        self.named: dict[str, tuple[Any, int]] = {}
        """By anchor: the value, and how many values it counts as."""

    def document(self) -> Any:
        """Return the value of the only document."""
        self.get_event()  # the stream's start
        if self.check_event(yaml.StreamEndEvent):
            return None
        self.get_event()  # the document's start
        value = self._value(0)
        self.get_event()  # the document's end
        if not self.check_event(yaml.StreamEndEvent):
            raise self._refused(self.get_event(), "a second document begins (`---`); write one document in a file")
        return value

    def _refused(self, event: Any, what: str) -> DatasetError:
        return DatasetError(f"{self.where}: line {event.start_mark.line + 1}: {what}")

    def _count(self, event: Any, values: int) -> None:
        self.values += values
        if self.values > MOST_VALUES:
            raise self._refused(event, f"more than {MOST_VALUES} values in one file")

    def _value(self, level: int) -> Any:
        event, before = self.get_event(), self.values
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in self.named:
                raise self._refused(event, f"the alias *{event.anchor} has no &{event.anchor} before it")
            value, count = self.named[event.anchor]
            self.repeated += count
            if self.repeated > MOST_REPEATED:
                what = f"aliases (*) stand for more than {MOST_REPEATED} values in all"
                raise self._refused(event, f"{what}; write out what is meant, or leave it out")
            self._count(event, count)
            return value
        if level > MOST_LEVELS:
            raise self._refused(event, f"more than {MOST_LEVELS} lists and mappings in one another")
        if isinstance(event, yaml.ScalarEvent):
            self._count(event, 1 + len(event.value) // TEXT_OF_A_VALUE)
            value = self._scalar(event)
        else:
            self._count(event, 1)
            if event.tag is not None and event.tag not in _PLAIN:
                raise self._refused(event, f"the tag {event.tag[:60]} is not known here; leave it out")
            value = self._list(level) if isinstance(event, yaml.SequenceStartEvent) else self._mapping(level)
        if event.anchor is not None:
            self.named[event.anchor] = value, self.values - before
        return value

    def _scalar(self, event: Any) -> Any:
        tag = event.tag
        if tag is None or tag == "!":
            tag = self.resolve(yaml.ScalarNode, event.value, event.implicit)
        if tag == _MERGE:
            return event.value
        if tag in _NUMBERS and len(event.value) > LONGEST_NUMBER:
            raise self._refused(event, f"a number of more than {LONGEST_NUMBER} characters; put text in quotes")
        if event.implicit[0] or tag in _NUMBERS:
            self._refuse_other_bases(event, tag)
        construct = self.yaml_constructors.get(tag)
        if construct is None or tag in _PLAIN:
            raise self._refused(event, f"the tag {tag[:60]} is not known here; leave it out")
        try:
            return construct(self, yaml.ScalarNode(tag, event.value, event.start_mark, event.end_mark))
        except (ValueError, TypeError, AttributeError, LookupError) as error:
            what = f"{shown(event.value)[:60]!r} cannot be read as {tag.rpartition(':')[2]}: {error}"
            raise self._refused(event, f"{what}; put text in quotes") from None

    def _refuse_other_bases(self, event: Any, tag: str) -> None:
        """Refuse a plain number that means something else in YAML 1.1 than to its writer."""
        text = event.value
        if LEADING_ZERO.fullmatch(text[:LONGEST_NUMBER]):
            plain = text.replace("_", "").lstrip("+-0") or "0"
            meant = f"-{plain}" if text.startswith("-") and plain != "0" else plain
            what = f"{text[:60]} is a number with a leading zero, which YAML may read as octal"
            raise self._refused(event, f"{what}; write {meant[:60]}, or put text in quotes")
        if tag in _NUMBERS and SIXTIETHS.fullmatch(text):
            what = f"{text[:60]} is a number in base 60 to YAML (1:30 is 90)"
            raise self._refused(event, f"{what}; write a decimal number, or put text in quotes")

    def _list(self, level: int) -> list[Any]:
        found = []
        while not self.check_event(yaml.SequenceEndEvent):
            found.append(self._value(level + 1))
        self.get_event()
        return found

    def _mapping(self, level: int) -> dict[Any, Any]:
        found: dict[Any, Any] = {}
        merged: dict[Any, Any] = {}
        lines: dict[Any, int] = {}
        while not self.check_event(yaml.MappingEndEvent):
            event = self.peek_event()
            key = self._value(level + 1)
            if not isinstance(key, Hashable) or (isinstance(key, int) and abs(key) >= 2**63):
                raise self._refused(event, "a key is a list, a mapping or a huge number; put text in quotes")
            line = event.start_mark.line + 1
            if key in lines:
                what = f"the key {shown(str(key))[:60]!r} stands there twice, in line {lines[key]} and in line {line}"
                raise self._refused(event, f"{what}; leave one of them out")
            lines[key] = line
            value = self._value(level + 1)
            if isinstance(event, yaml.ScalarEvent) and event.implicit[0] and key == "<<":
                merged = self._merged(event, value)
            else:
                found[key] = value
        self.get_event()
        return merged | found

    def _merged(self, event: Any, value: Any) -> dict[Any, Any]:
        """Return the keys that `<<` brings: of one mapping, or of several, of which the first that has a key wins."""
        every = value if isinstance(value, list) else [value]
        if not all(isinstance(each, dict) for each in every):
            raise self._refused(event, "`<<` takes a mapping, or a list of mappings")
        found: dict[Any, Any] = {}
        for each in reversed(every):
            found |= each
        return found
