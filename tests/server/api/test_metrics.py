"""Metrics for Prometheus, and health, which reveals nothing."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.link.frames import LinkRow
from amberbox.server.bus import ServerChange
from amberbox.server.services.health import MetricFamily, MetricSample, metrics_text
from tests.server.house import House, house

_TEXT = r'"(\\.|[^"\\])*"'
_LINE = re.compile(rf"[a-z_]+(\{{[a-z]+={_TEXT}(,[a-z]+={_TEXT})*\}})? [0-9.e+-]+")


@pytest.fixture
def home(tmp_path: Path) -> Iterator[House]:
    with house(tmp_path / "server") as found:
        yield found


def test_figures_are_there(home: House) -> None:
    rows = [LinkRow("watch", 1, n, "amberbox/event", 0, b"12345") for n in range(3)]
    home.services.bus.publish(ServerChange("rows", "ropod_001", {"store_id": "s", "rows": rows}))
    technician = home.client("technician")
    technician.get("/api/v1/robots/ropod_001")
    technician.get("/api/v1/robots/secret_name")
    technician.get("/api/v1/nothing/there")
    found = technician.get("/api/v1/metrics")
    assert found.headers["content-type"].startswith("text/plain; version=0.0.4")
    values = dict(line.rsplit(" ", 1) for line in found.text.splitlines() if line[0] != "#")
    assert values["amberbox_robots"] == "3" and values["amberbox_robots_online"] == "0"
    assert values["amberbox_rows_received_total"] == "3"
    assert values["amberbox_link_unknown_frames_total"] == "0"
    assert values["amberbox_row_bytes_received_total"] == "15"
    assert int(values["amberbox_database_bytes"]) > 4096
    assert float(values["process_resident_memory_bytes"]) > 1e7
    counted = 'amberbox_requests_total{method="GET",route="/api/v1/robots/{robot}",status="200"}'
    assert values[counted] == "1" and values[counted.replace("200", "404")] == "1"
    took = 'amberbox_request_seconds_count{method="GET",route="/api/v1/robots/{robot}"}'
    assert values[took] == "2"
    assert "secret_name" not in found.text and "nothing/there" not in found.text
    assert all(_LINE.fullmatch(line) for line in found.text.splitlines() if line[0] != "#")


def test_labels_are_escaped_and_buckets_add_up(home: House) -> None:
    text = metrics_text([MetricFamily("x", "gauge", "a\nb", [MetricSample(1.5, {"l": 'a"\\\n'})])])
    assert text == '# HELP x a\\nb\n# TYPE x gauge\nx{l="a\\"\\\\\\n"} 1.5\n'
    counts = home.app.state.requests
    for took_s in (0.001, 0.005, 0.3, 60.0):
        counts.add("GET", "/a", 200, took_s)
    shown = metrics_text(counts.families())
    assert '_bucket{method="GET",route="/a",le="0.005"} 2\n' in shown
    assert '_bucket{method="GET",route="/a",le="+Inf"} 4\n' in shown


def test_figures_are_for_technicians_of_all_robots(home: House) -> None:
    assert home.client("operator").get("/api/v1/metrics").status_code == 403
    assert home.client("nurse").get("/api/v1/metrics").status_code == 403
    scraper = home.token_client("technician", "read:metrics")
    assert scraper.get("/api/v1/metrics").status_code == 200


def test_health_says_no_more_than_needed(home: House) -> None:
    found = home.client().get("/api/v1/health")
    assert (found.status_code, found.json()) == (200, {"status": "ok"})
    home.services.database.engine.dispose()
    (home.services.folder / "server.db").rename(home.services.folder / "gone.db")
    found = home.client().get("/api/v1/health")
    assert (found.status_code, found.json()) == (503, {"status": "bad"})
    (home.services.folder / "gone.db").rename(home.services.folder / "server.db")
