"""The experiments that come with Fathom: names and files, without importing what reads them."""

from __future__ import annotations

from pathlib import Path

SHIPPED = Path(__file__).parents[1] / "experiments"


def shipped_experiments() -> dict[str, Path]:
    """Return the experiments that come with Fathom, by name."""
    return {path.stem: path for path in sorted(SHIPPED.glob("*.yaml"))}
