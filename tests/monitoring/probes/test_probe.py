"""Results of a probe, converted so that any of them can be recorded."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from amberbox.monitoring.probe_runner import Probe, encode


@pytest.mark.parametrize(
    ("kind", "value", "recorded"),
    [
        ("float", np.float32("nan"), None),
        ("float", np.float32("inf"), None),
        ("float", "1e999", None),
        ("float", 1 << 70, float(1 << 70)),
        ("float", np.int64(3), 3.0),
        ("int", np.inf, None),
        ("int", 1 << 70, None),
        ("int", np.float32(3), 3),
        ("bool", np.bool_(True), True),
        ("bool", np.nan, None),
        ("string", "usb \udcff", "usb ?"),
        ("string", np.nan, "nan"),
    ],
)
def test_every_value_can_be_recorded(kind: str, value: Any, recorded: Any) -> None:
    """One probe's odd value must not end the others."""
    probe = Probe("odd", lambda subject: {"ok": True, "x": value}, {"x": (kind, "", "")})
    row = probe.measure_once("a\udcff")
    assert row == {"subject": "a?", "ok": True, "error": "", "x": recorded}
    assert type(row["x"]) is type(recorded)
    assert encode(row)


def test_what_the_system_says_can_be_recorded() -> None:
    def measure(subject: str) -> dict[str, Any]:
        raise OSError(2, "No such file", subject)

    row = Probe("odd", measure).measure_once("/dev/\udcff")
    assert row["error"] == "/dev/?: No such file"
    assert encode(row)


def test_a_probe_that_would_end_the_program_is_unknown() -> None:
    def measure(subject: str) -> dict[str, Any]:
        raise SystemExit(3)

    assert Probe("odd", measure).measure_once("a")["error"] == "crashed: SystemExit: 3"
