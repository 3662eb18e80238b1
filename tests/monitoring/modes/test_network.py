"""Wireless links and answers from afar, by probes or by recorded variables."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from amberbox.core.mode import FALSE, TRUE, UNKNOWN, Input
from amberbox.core.plugins import get
from amberbox.monitoring.modes import network as mode
from amberbox.monitoring.modes.network import Config
from amberbox.testing.modes import assert_mode_contract, at_s, one_input

PARTS = ("quality_percent", "signal_dbm", "latency_ms", "loss_percent")


def wifi(ok: bool | None, quality: float | None, dbm: int | None) -> Input:
    parts: dict[str, list[Any]] = {"quality_percent": [quality], "signal_dbm": [dbm]}
    return one_input("wifi wlan0", times_s=[0], values=[ok], parts=parts)


def ping(ok: bool | None, latency: float | None, loss: float) -> Input:
    parts: dict[str, list[Any]] = {"latency_ms": [latency], "loss_percent": [loss]}
    return one_input("ping box", times_s=[0], values=[ok], parts=parts)


def test_contract() -> None:
    parts = dict.fromkeys(PARTS, "float")
    assert_mode_contract(mode, "network", parts=parts)
    variables = [Config(values=("quality", "latency_ms"))]
    assert_mode_contract(mode, "network", configs=variables, parts=parts, examples=20)


@pytest.mark.parametrize(
    ("text", "expected"),
    [("wifi wlan1", ("wifi", "wlan1")), ("wlp3s0", ("wifi", "wlp3s0")), ("wifi", ("wifi", "wlan0")),
     ("ping 192.168.1.7:22", ("ping", "192.168.1.7:22")),
     ("interface eth0", ("network_interface", "eth0"))],
)  # fmt: skip
def test_inputs_name_probes(text: str, expected: tuple[str, str]) -> None:
    assert mode.probe_of(Config(), text) == expected
    assert get("amberbox.monitoring.probes", expected[0], defines=("measure",))


def test_probes_give_what_they_measure() -> None:
    found = mode.evaluate(Config(), [wifi(True, 70.0, -55), ping(True, 12.5, 0.0)], at_s(0))
    assert int(found["connected"]) == TRUE
    assert [float(found[n]) for n in ("quality", "signal_dbm", "latency_ms", "loss_percent")] == [
        70.0, -55.0, 12.5, 0.0
    ]  # fmt: skip


def test_one_lost_connection_is_enough() -> None:
    inputs = [wifi(True, 70.0, -55), ping(False, None, 100.0)]
    found = mode.evaluate(Config(), inputs, at_s(0))
    assert int(found["connected"]) == FALSE
    assert np.isnan(found["latency_ms"])
    unknown = mode.evaluate(Config(), [wifi(None, None, None)], at_s(0))
    assert int(unknown["connected"]) == UNKNOWN


def test_variables_are_named_by_their_order() -> None:
    inputs = [one_input(times_s=[0, 1], values=[61.0, 5.0]), one_input(times_s=[0], values=[-70])]
    config = Config(values=("quality", "signal_dbm"))
    found = mode.evaluate(config, inputs, at_s(0, 1))
    assert found["quality"].tolist() == [61.0, 5.0]
    assert found["signal_dbm"].tolist() == [-70.0, -70.0]
    assert found["connected"].tolist() == [TRUE, TRUE]
    gone = [one_input(times_s=[0], values=[np.nan]), inputs[1]]
    assert int(mode.evaluate(config, gone, at_s(0))["connected"]) == FALSE


def test_explanation() -> None:
    assert mode.explain(Config(), {"connected": False}) == "there is no connection"
    assert mode.explain(Config(), {"connected": None}) == ""
