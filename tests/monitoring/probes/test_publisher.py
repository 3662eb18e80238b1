"""Published probes are recorded by the box's own source under the names that monitors use."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

import amberbox
from amberbox.blackbox.recorder.recorder import Recorder
from amberbox.blackbox.sources.zmq import Config, Source
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.probe import ProbeOrder
from amberbox.monitoring.probe_runner import ProbePublisher, Row, encode, is_open, load_probe
from amberbox.testing.clock import wait_until
from amberbox.testing.contract import observe
from tests.support.manual_recorder import recording
from tests.support.processes import free_port

ROW: Row = {"subject": "front läser", "ok": None, "error": "hangs", "n": None, "s": "a\nb"}


@pytest.mark.parametrize(
    ("endpoint", "others"),
    [
        ("tcp://*:5561", True),
        ("tcp://192.168.1.7:5561", True),
        ("tcp://robot:5561", True),
        ("tcp://[::]:5561", True),
        ("tcp://127.0.0.1:5561", False),
        ("tcp://localhost:5561", False),
        ("tcp://[::1]:5561", False),
        ("ipc:///run/probes", False),
    ],
)
def test_it_is_known_who_can_read(endpoint: str, others: bool) -> None:
    assert is_open(endpoint) is others


@pytest.mark.parametrize("endpoint", ["robots/cart", "tcp://*", "tcp://*:70000", "udp://*:5", ""])
def test_what_is_no_address_is_refused(endpoint: str) -> None:
    with pytest.raises(UsageError, match="no address to publish at"):
        ProbePublisher(endpoint)


def test_a_row_is_one_line_of_json() -> None:
    assert encode(ROW).decode() == (
        '{"subject": "front läser", "ok": null, "error": "hangs", "n": null, "s": "a\\nb"}'
    )
    with pytest.raises(ValueError, match="JSON"):
        encode({"x": math.nan})


def test_the_zmq_source_hears_topic_and_row() -> None:
    order = ProbeOrder("path_exists", "/dev/front laser")
    with (
        ProbePublisher("tcp://127.0.0.1:0") as publisher,
        observe(Source(Config(endpoint=publisher.endpoint), "probe")) as sink,
    ):
        wait_until(lambda: _heard(publisher, order, sink.of(order.topic)), "a row")
        assert sink.of(order.topic)[0] == encode(ROW)
        assert {topic.message_encoding for topic in sink.topics} == {"json"}


def _heard(publisher: ProbePublisher, order: ProbeOrder, rows: object) -> bool:
    publisher.put(order, ROW)
    return bool(rows)


def test_a_port_that_is_taken_is_said() -> None:
    with ProbePublisher("tcp://127.0.0.1:0") as first:
        with pytest.raises(AmberboxError, match="cannot publish at") as refused:
            ProbePublisher(first.endpoint)
        assert "another" in refused.value.hint


def test_after_close_a_row_of_a_late_thread_is_dropped() -> None:
    publisher = ProbePublisher("tcp://127.0.0.1:0")
    publisher.close()
    publisher.put(ProbeOrder("path_exists", "/dev/null"), ROW)


def test_the_box_records_each_probe_as_the_item_that_monitors_name(tmp_path: Path) -> None:
    port = free_port()
    folder, device = tmp_path / "robot", tmp_path / "Front Laser.1"
    folder.mkdir()
    (folder / "robot.yaml").write_text("id: cart\n")
    box = f"- zmq: {{name: probe, endpoint: tcp://127.0.0.1:{port}}}\n"
    (folder / "black_box.yaml").write_text(box)
    orders = [
        ProbeOrder("path_exists", str(device)),
        ProbeOrder("network_interface", "lo"),
        ProbeOrder("disk", str(tmp_path)),
        ProbeOrder("memory", "ram"),
    ]
    with recording(folder) as recorder, ProbePublisher(f"tcp://127.0.0.1:{port}") as publisher:
        looks = 0

        def heard_after_a_look() -> set[str]:
            nonlocal looks
            looks += 1
            for order in orders:
                publisher.put(order, load_probe(order.kind).measure_once(order.subject))
            return {item.name for item in recorder.state().items}

        items = {order.item for order in orders}
        wait_until(lambda: items <= heard_after_a_look(), "every probe is heard")
        device.touch()
        before = looks  # some of them may still be on their way
        wait_until(
            lambda: heard_after_a_look() and _received(recorder, orders[0].item) > before,
            "a look at the device that is there",
        )
    with amberbox.open(folder) as record:
        assert items <= {item.name for item in record.items()}
        columns = [column.name for column in record.variables("probe_memory_ram").columns]
        assert columns == ["subject", "ok", "error", "used_percent", "available_bytes"]
        known = record.query(orders[0].item).columns["ok"]
        assert [known[0], known[-1]] == [False, True]


def _received(recorder: Recorder, name: str) -> int:
    return sum(item.received for item in recorder.state().items if item.name == name)
