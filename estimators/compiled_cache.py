"""Keep numba's cache true: it notices a change in a function's own file, not in the files of what that calls."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path


def forget_stale_code(folder: Path = Path(__file__).parent) -> None:
    """Drop the compiled code of `folder` if any of its sources has changed since it was compiled.

    Where the folder cannot be written there is nothing to drop: numba then keeps its cache elsewhere, by file.
    """
    sources = sorted(folder.glob("*.py"))
    state = "\n".join(f"{path.name} {path.stat().st_mtime_ns} {path.stat().st_size}" for path in sources)
    cache = folder / "__pycache__"
    stamp = cache / "compiled-from.txt"
    with suppress(OSError):
        if stamp.is_file() and stamp.read_text() == state:
            return
        cache.mkdir(exist_ok=True)
        for compiled in (*cache.glob("*.nbi"), *cache.glob("*.nbc")):
            compiled.unlink(missing_ok=True)
        stamp.write_text(state)
