from __future__ import annotations

import pytest
from fathom.bench.timing.compiling import compile_cpu_seconds


@pytest.mark.slow
def test_compiling_is_counted_from_an_empty_cache() -> None:
    found = compile_cpu_seconds(["dead-reckoning"])
    assert [times for name, _, times in found.by_function if name.endswith("preintegrate_dvl")] == [1]
    assert sum(times for _, _, times in found.by_function) == found.compilations
    assert sum(seconds for _, seconds, _ in found.by_function) == pytest.approx(found.cpu_s)
    assert found.cpu_s > 0.5
