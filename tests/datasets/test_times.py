"""Times are exact, whatever other code does to the process's arithmetic."""

from __future__ import annotations

import decimal

import numpy as np
import pytest
from fathom.datasets.times import finer_unit, seconds_to_ns, times_ns
from fathom.estimators.other_code import process_kept


@pytest.mark.parametrize("traps", [True, False])
def test_the_decimal_context_of_the_process_is_no_matter(traps: bool) -> None:
    with decimal.localcontext() as context:
        context.prec = 6
        context.rounding = decimal.ROUND_DOWN
        if not traps:
            context.clear_traps()
        assert seconds_to_ns("1700000000.123456789") == 1_700_000_000_123_456_789
        texts = np.array(["1700000000.123456789", "nan", "soon"], np.dtypes.StringDType(na_object=np.nan))
        ns, good = times_ns(texts, "s")
        assert ns.tolist() == [1_700_000_000_123_456_789, 0, 0]
        assert good.tolist() == [True, False, False]
        for wrong in ("nan", "inf", "1e30"):
            with pytest.raises(ValueError, match="not a time in seconds"):
                seconds_to_ns(wrong)


def test_other_code_leaves_decimals_arithmetic_as_it_was() -> None:
    before = decimal.getcontext().prec
    with process_kept():
        decimal.getcontext().prec = 6
    assert decimal.getcontext().prec == before


def test_a_stamp_beyond_the_clock_is_probably_in_a_finer_unit() -> None:
    assert finer_unit("1732960000000", "s") == "ms"
    assert finer_unit(1.73296e15, "s") == "us"
    assert finer_unit(1732960000000000000, "ms") == "ns"
    assert [finer_unit(stamp, "s") for stamp in ("soon", "nan", "inf", "1e40", "1732960000")] == [""] * 5
