"""What a page holds for its scripts: JSON as it is, or compressed; no text in it can end a script element."""

from __future__ import annotations

import gzip
import json
import math
from base64 import b64encode
from typing import Any

from ....datasets.errors import shown

LEVEL = 6
"""Of compression: 9 takes twice the time for 1 % less."""


def embedded(value: Any) -> Any:
    """Return a value as JSON for a script element, which no text in it can end; non-finite numbers are null."""
    from markupsafe import Markup

    return Markup(_json(value).replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))


def packed(value: Any) -> str:
    """Return a value as the base64 of its compressed JSON; non-finite numbers are null."""
    return packed_text(_json(value))


def packed_text(text: str) -> str:
    """Return a text as the base64 of gzip; the same text gives the same letters."""
    return b64encode(gzip.compress(text.encode(errors="backslashreplace"), LEVEL, mtime=0)).decode("ascii")


def _json(value: Any) -> str:
    return json.dumps(_plain(value), separators=(",", ":"))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {shown(str(key)): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, str):
        return shown(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value
