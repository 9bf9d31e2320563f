"""Compile what the tests run, on every core, before they start: their processes would compile much of it twice."""

from __future__ import annotations

from fathom.bench.execution.cold_start import compile_first
from fathom.estimators import ESTIMATORS, create

OPTIONS = {
    "window": [{"dvl": ["preintegrated-loose"]}, {"robust": {"dvl": "huber"}}],
    "fls": [{"dvl": ["preintegrated-loose"]}, {"dvl": ["preintegrated-tight"]}, {"robust": {"dvl": "huber"}}],
    "batch": [{"engine": "window"}],
}
"""Beside the defaults: options that run other code."""

if __name__ == "__main__":
    compile_first(create(name, **options) for name in ESTIMATORS for options in [{}, *OPTIONS.get(name, [])])
