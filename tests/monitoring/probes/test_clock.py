"""Whether the kernel calls its clock synchronised."""

from __future__ import annotations

import pytest

from amberbox.core.clock import SystemClock
from amberbox.core.errors import UsageError
from amberbox.monitoring.probes.clock import KernelClock, judge, measure


def test_this_computer_agrees_with_the_recorders_own_look() -> None:
    found = measure("system")
    assert found["ok"] == SystemClock().synchronised()
    assert 0 <= found["max_error_ms"] <= 16_000


@pytest.mark.parametrize(
    ("state", "status", "ok", "offset_ms"),
    [
        (0, 0x2001, True, -1.5),
        (0, 0x1, True, -1500.0),
        (5, 0x40, False, -1500.0),
        (5, 0x0, False, -1500.0),
        (1, 0x2001, True, -1.5),
    ],
)
def test_what_the_kernel_says_is_read(state: int, status: int, ok: bool, offset_ms: float) -> None:
    found = judge(state, KernelClock(offset=-1_500_000, max_error=250_000, status=status))
    assert found["ok"] is ok
    assert found["offset_ms"] == pytest.approx(offset_ms)
    assert found["max_error_ms"] == pytest.approx(250)


def test_other_clocks_are_refused() -> None:
    with pytest.raises(UsageError, match="no clock 'gps'"):
        measure("gps")
