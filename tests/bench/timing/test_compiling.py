from __future__ import annotations

import pytest
from fathom.bench.timing.compiling import compile_cpu_seconds


@pytest.mark.slow
def test_compiling_is_counted_from_an_empty_cache() -> None:
    found = compile_cpu_seconds(["dead-reckoning"])
    again = compile_cpu_seconds(["dead-reckoning"])
    assert found.compilations == again.compilations > 5
    assert found.cpu_s > 0.5
    assert [name for name, _, _ in found.by_function if name.endswith("preintegrate_dvl")]
    assert sum(seconds for _, seconds, _ in found.by_function) == found.cpu_s
