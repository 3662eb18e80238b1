"""Every probe keeps the contract of ``core.probe``, and is documented; unknown is never green."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from amberbox.monitoring.probe_runner import known_probes, load_probe

PAGE = (Path(__file__).parents[3] / "docs" / "robot" / "probes.md").read_text(encoding="utf-8")
PLUGINS = known_probes()
NONSENSE = "/../ -no such thing- /.."


def test_the_probes_that_are_promised_are_there() -> None:
    promised = {
        *("path_exists", "usb_device", "network_interface", "unit_active", "process", "container"),
        *("ros_node", "ros_topic", "ros_master", "ros_service", "ros2_node", "ping", "wifi"),
        *("disk", "cpu", "memory", "temperature", "clock", "http"),
    }
    assert promised <= set(PLUGINS)


@pytest.mark.parametrize("kind", PLUGINS)
def test_a_probe_says_what_it_measures(kind: str) -> None:
    module = PLUGINS[kind].load()
    assert ("such as" in module.SUBJECT) or module.SUBJECT in ("system", "ram, or swap")
    for name, (type_, unit, doc) in module.MEASURES.items():
        assert name.isidentifier()
        assert name not in ("ok", "error", "subject", "index", "seq", "received", "timestamp")
        assert type_ in ("bool", "int", "float", "string")
        assert doc and isinstance(unit, str)


@pytest.mark.parametrize("kind", PLUGINS)
def test_nonsense_is_never_green_and_never_a_crash(kind: str) -> None:
    probe = load_probe(kind)
    assert 0 < probe.period_s <= 2, "inputs are stale after 5 s unless said otherwise"
    assert probe.timeout_s >= 1
    row = probe.measure_once(NONSENSE)
    assert list(row) == ["subject", "ok", "error", *probe.measures]
    assert row["ok"] is False or (row["ok"] is None and row["error"])
    assert "crashed" not in row["error"]
    json.dumps(row, allow_nan=False)


@pytest.mark.parametrize("kind", PLUGINS)
def test_the_page_has_every_probe_its_period_and_all_that_it_measures(kind: str) -> None:
    module = PLUGINS[kind].load()
    section = re.search(rf"^### `{kind}`\n(.*?)(?=^##|\Z)", PAGE, re.M | re.S)
    assert section is not None
    for name, (_, unit, _) in module.MEASURES.items():
        assert re.search(rf"^\| `{name}` \| {re.escape(unit) or '.*'} \|", section[1], re.M), name
    period = f"every {getattr(module, 'PERIOD_S', 1):g} s"
    assert period.replace("every 1 s", "every second") in section[1]
