"""The machine and the versions that numbers were measured with, as text."""

from __future__ import annotations

import json

PACKAGES = ("python", "numpy", "numba", "gtsam")


def machine_text(machine: str, versions: str) -> str:
    """Return both in a line, from what `provenance` says of them."""
    about, known = json.loads(machine), json.loads(versions)
    packages = ", ".join(f"{name} {known[name]}" for name in PACKAGES if name in known)
    return f"{about['cpu']}, {about['cores']} cores; {packages}"
