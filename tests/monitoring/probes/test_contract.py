"""Every probe keeps the contract of ``core.probe``: names, types, and unknown where unknown."""

from __future__ import annotations

import json

import pytest

from amberbox.monitoring.probing.probe import known_probes, load_probe

KINDS = sorted(known_probes())
NONSENSE = "/../ -no such thing- /.."


def test_the_probes_that_are_promised_are_there() -> None:
    promised = {
        *("path_exists", "usb_device", "network_interface", "unit_active", "process", "container"),
        *("ros_node", "ros_topic", "ros_master", "ping", "wifi", "disk", "cpu", "memory"),
        *("temperature", "clock", "http"),
    }
    assert promised <= set(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_a_probe_says_what_it_measures(kind: str) -> None:
    module = known_probes()[kind].load()
    assert ("such as" in module.SUBJECT) or module.SUBJECT in ("system", "ram, or swap")
    for name, (type_, unit, doc) in module.MEASURES.items():
        assert name.isidentifier() and name not in ("ok", "error", "subject", "index", "seq")
        assert type_ in ("bool", "int", "float", "string")
        assert doc and isinstance(unit, str)
    probe = load_probe(kind)
    assert 0 < probe.period_s <= 10
    assert probe.timeout_s >= 1


@pytest.mark.parametrize("kind", KINDS)
def test_nonsense_is_never_green_and_never_a_crash(kind: str) -> None:
    row = load_probe(kind).look(NONSENSE)
    assert list(row)[:3] == ["subject", "ok", "error"]
    assert set(load_probe(kind).measures) == set(row) - {"subject", "ok", "error"}
    assert row["ok"] is False or (row["ok"] is None and row["error"])
    assert "crashed" not in row["error"]
    json.dumps(row, allow_nan=False)
