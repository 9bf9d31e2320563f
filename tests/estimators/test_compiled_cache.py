"""Compiled code does not outlive a change in any of the sources."""

from __future__ import annotations

from pathlib import Path

from fathom.estimators.compiled_cache import forget_stale_code


def test_a_change_in_any_source_drops_all_compiled_code(tmp_path: Path) -> None:
    source, compiled = tmp_path / "called.py", tmp_path / "__pycache__" / "caller.f-1.py311.1.nbc"
    source.write_text("x = 1\n")
    forget_stale_code(tmp_path)
    compiled.write_text("machine code")
    forget_stale_code(tmp_path)
    assert compiled.exists()
    source.write_text("x = 22\n")
    forget_stale_code(tmp_path)
    assert not compiled.exists()
