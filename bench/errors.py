"""The one exception of this package that a caller might catch."""

from __future__ import annotations

from ..datasets.errors import FathomError


class ExperimentError(FathomError):
    """An experiment file cannot be used; says which file, which key, and what to write instead."""
