"""A device is present, absent or unknown."""

from __future__ import annotations

import pytest

from amberbox.core.mode import UNKNOWN
from amberbox.monitoring.modes import device
from amberbox.testing.modes import assert_mode_contract, at_s, one_input


def test_contract() -> None:
    assert_mode_contract(device, "device")


@pytest.mark.parametrize(("second", "present"), [(1, True), (2, False), (3, UNKNOWN), (4, True)])
def test_what_the_probe_saw_last(second: float, present: int) -> None:
    path = one_input(times_s=[1, 2, 3, 4], values=[True, False, None, True])
    results = device.evaluate(device.Config(), [path], at_s(second))
    assert results["present"] == present
    reason = device.explain(device.Config(), {"present": present == 1})
    assert bool(reason) == (present != 1)
