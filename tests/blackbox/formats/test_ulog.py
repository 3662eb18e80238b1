"""ULog files: every value as pyulog has it, damage, appended data, clocks, dropouts."""

from __future__ import annotations

import struct
from io import BytesIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from pyulog import ULog  # type: ignore[import-untyped]  # the package has no type hints

import amberbox
from amberbox.blackbox.columns.unroll import unroller
from amberbox.blackbox.formats import _recording, ulog
from amberbox.blackbox.formats._open import open_recording
from amberbox.blackbox.formats._recording import ReadOptions, RecordingReader
from amberbox.blackbox.query.importing import ImportReport, import_recordings
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Rows
from tests.blackbox.formats.ulog_file import (
    FORMATS,
    GPS_US,
    START_US,
    SYNC,
    UlogFile,
    accel,
    flight,
    text,
)


def rows_of(recording: RecordingReader, topic: str) -> tuple[list[int], Rows]:
    """Return log times and columns of a topic."""
    place = next(n for n, t in enumerate(recording.topics) if t.name == topic)
    found = [m for m in recording.messages() if m.topic_index == place]
    rows = unroller(recording.topics[place]).rows([m.data for m in found])
    return [m.log_time_ns for m in found], rows


def documents(recording: RecordingReader, topic: str) -> list[tuple[int, dict[str, Any]]]:
    place = next(n for n, t in enumerate(recording.topics) if t.name == topic)
    return [
        (m.log_time_ns, msgspec.msgpack.decode(m.data))
        for m in recording.messages()
        if m.topic_index == place
    ]


def check_against_pyulog(path: Path, recording: RecordingReader, base_us: int) -> int:
    """Compare every number of every topic; returns how many were compared."""
    compared = 0
    for data in ULog(str(path)).data_list:
        topic = f"/{data.name}_{data.multi_id}" if data.multi_id else f"/{data.name}"
        times, rows = rows_of(recording, topic)
        assert times == [(base_us + int(t)) * 1000 for t in data.data["timestamp"]]
        for name, values in data.data.items():
            column = {"timestamp": "timestamp_us"}.get(name, name)
            column = column.replace("[", "_").replace("].", "_").replace("]", "").replace(".", "_")
            if column.startswith("word") or "_padding" in column:
                continue  # texts are compared by themselves
            ours = rows.columns[column]
            np.testing.assert_array_equal(np.asarray(ours), values.astype(ours.dtype))  # type: ignore[union-attr]  # no lists in these formats
            compared += len(values)
    return compared


@pytest.mark.parametrize("room", [_recording.ROOM_BYTES, 0])
def test_every_value_is_that_of_pyulog(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    monkeypatch.setattr(
        _recording.ConversionCache, "__init__", lambda self: setattr(self, "room_bytes", room)
    )
    monkeypatch.setattr(ulog, "_BLOCK", 70_000)
    path = flight(3000).write(tmp_path / "flight.ulg")
    with open_recording(path) as recording:
        assert check_against_pyulog(path, recording, GPS_US) > 55_000
        assert recording.report.damage == []


def test_texts_end_at_their_nul(tmp_path: Path) -> None:
    log = UlogFile()
    log.formats("airspeed_text")
    log.subscribe(0, "airspeed_text")
    words = [b"abc", b"", b"twelve chars", b"\xff\xfe", b"a\0b"]
    for n, word in enumerate(words):
        log.put(0, text(START_US + n, word, n))
    with open_recording(log.write(tmp_path / "text.ulg")) as recording:
        _, rows = rows_of(recording, "/airspeed_text")
    found = list(rows.columns["word"])  # type: ignore[arg-type]  # no list column
    assert found[:3] == ["abc", "", "twelve chars"] and found[4] == "a"
    assert list(rows.columns["level"]) == list(range(5))  # type: ignore[arg-type]  # no list column


def test_parameters_infos_and_log_lines_are_items(tmp_path: Path) -> None:
    with open_recording(flight().write(tmp_path / "flight.ulg")) as recording:
        base_ns = GPS_US * 1000
        parameters = documents(recording, "/parameter")
        assert [(p["name"], p["value"]) for _, p in parameters] == [
            ("MC_ROLL_P", 6.5), ("SYS_AUTOSTART", 4001.0), ("MC_ROLL_P", 7.25),
        ]  # fmt: skip
        assert parameters[0][0] == base_ns + START_US * 1000
        infos = documents(recording, "/info")
        assert (infos[0][1]["name"], infos[0][1]["text"]) == ("sys_name", "PX4")
        ((at_ns, line),) = documents(recording, "/log")
        assert (line["level_name"], line["text"], line["tag"]) == (
            "warning", "battery is low", None,
        )  # fmt: skip
        assert at_ns == base_ns + (START_US + 100 * 10_000) * 1000


def test_a_dropout_is_a_gap_of_the_store(tmp_path: Path) -> None:
    path = flight().write(tmp_path / "flight.ulg")
    import_recordings([path], tmp_path / "store")
    (dropout,) = ULog(str(path)).dropouts
    (gap,) = amberbox.open(tmp_path / "store").gaps()
    start_ns = (GPS_US + dropout.timestamp) * 1000
    assert (gap.from_ns, gap.to_ns) == (start_ns, start_ns + dropout.duration * 10**6)
    assert gap.reason == "dropout in the log"


def test_items_are_named_and_counted(tmp_path: Path) -> None:
    path = flight().write(tmp_path / "flight.ulg")
    (report,) = import_recordings([path], tmp_path / "store")
    assert report.items == {
        "ulog_sensor_accel": 200, "ulog_sensor_accel_1": 200, "ulog_nested": 200,
        "ulog_vehicle_gps_position": 20, "ulog_airspeed_text": 20,
        "ulog_parameter": 3, "ulog_info": 2, "ulog_log": 1,
    }  # fmt: skip
    assert report.accounts == ["flight.ulg: 640 data records = 640 messages + 0 refused"]
    assert report.kinds["ulog_nested"] == "typed (nested, from the file)"
    table = amberbox.open(tmp_path / "store").query("ulog_sensor_accel_1")
    assert table.names == [
        "timestamp", "timestamp_us", "device_id", "x", "yz_0", "yz_1", "clipped",
    ]  # fmt: skip
    assert table.values("timestamp")[1] == (GPS_US + START_US + 10_003) * 1000
    assert table.values("timestamp_us")[1] == START_US + 10_003
    assert import_recordings([path], tmp_path / "store")[0].known


# -- clocks


def test_without_gps_times_count_from_the_start_of_the_autopilot(tmp_path: Path) -> None:
    path = flight(with_gps=False).write(tmp_path / "flight.ulg")
    with open_recording(path) as recording:
        assert recording.report.start_ns == START_US * 1000
        assert any("--start TIME" in note for note in recording.report.notes)
        check_against_pyulog(path, recording, 0)
    with open_recording(path, ReadOptions(start_ns=10**18)) as recording:
        assert recording.report.start_ns == 10**18
        check_against_pyulog(path, recording, 10**15 - START_US)


def test_messages_stamped_before_the_log_began_stay_before_it(tmp_path: Path) -> None:
    log = UlogFile()
    log.formats("sensor_accel")
    log.subscribe(0, "sensor_accel")
    log.put(0, accel(START_US - 900_000, 1))
    log.put(0, accel(START_US, 2))
    path = log.write(tmp_path / "early.ulg")
    with open_recording(path, ReadOptions(start_ns=10**18)) as recording:
        times, _ = rows_of(recording, "/sensor_accel")
    assert times == [10**18 - 900_000_000, 10**18]


# -- damage


def small(count: int = 300) -> UlogFile:
    log = UlogFile()
    log.flags()
    log.formats("sensor_accel")
    log.subscribe(0, "sensor_accel")
    for n in range(count):
        log.put(0, accel(START_US + n * 1000, n))
        if n % 100 == 99:
            log.add("S", SYNC)
    return log


def devices(path: Path) -> tuple[list[int], RecordingReader]:
    with open_recording(path) as recording:
        _, rows = rows_of(recording, "/sensor_accel")
        return list(np.asarray(rows.columns["device_id"]) - 1000), recording


@pytest.mark.parametrize("share", [0.3, 0.71, 0.999])
def test_a_cut_file_gives_its_whole_records(tmp_path: Path, share: float) -> None:
    data = bytes(small().data)
    path = tmp_path / "cut.ulg"
    path.write_bytes(data[: int(len(data) * share)])
    found, recording = devices(path)
    assert found == list(range(len(found)))
    assert abs(len(found) / 300 - share) < 0.05
    (damage,) = recording.report.damage
    assert damage.reason == "the file is cut short"


@pytest.mark.parametrize("junk", [bytes(50), b"\xff" * 50, bytes(range(7, 57))])
def test_damage_costs_what_it_touches(tmp_path: Path, junk: bytes) -> None:
    log = small()
    at = len(log.data) // 2
    log.data[at : at + 50] = junk
    found, recording = devices(log.write(tmp_path / "junk.ulg"))
    assert 295 <= len(found) <= 300
    altered = [n for n in found if not 0 <= n < 300]  # ULog has no checksums
    assert len(altered) <= 2 and sorted(set(found) - set(altered)) == sorted(
        n for n in found if n not in altered
    )
    assert recording.report.damage or recording.report.accounts[0].refused


def test_data_after_a_crash_are_read_from_their_offset(tmp_path: Path) -> None:
    log = UlogFile()
    log.flags(1, (1 << 20,))
    log.formats("sensor_accel")
    log.subscribe(0, "sensor_accel")
    log.put(0, accel(START_US, 0))
    log.data += b"\x1b\x00D\x00\x00"  # the crash came in the middle of a record
    offset = len(log.data)
    log.data[16 + 3 + 16 : 16 + 3 + 24] = struct.pack("<Q", offset)
    log.put(0, accel(START_US + 1, 1))
    path = log.write(tmp_path / "appended.ulg")
    found, recording = devices(path)
    assert found == [0, 1]
    assert recording.report.damage == []
    assert "5 bytes before appended data are no whole record" in recording.report.notes


def test_what_a_later_version_needs_is_refused_in_words(tmp_path: Path) -> None:
    log = UlogFile()
    log.flags(2)
    with pytest.raises(AmberboxError, match="needs a newer reader"):
        open_recording(log.write(tmp_path / "later.ulg"))
    (tmp_path / "head.ulg").write_bytes(bytes(log.data[:12]))
    with pytest.raises(AmberboxError, match="ends within its header"):
        open_recording(tmp_path / "head.ulg")


def test_data_that_make_no_sense_are_counted(tmp_path: Path) -> None:
    log = small(10)
    log.put(9, b"nobody said what this is")
    log.put(0, b"short")
    log.put(0, accel(2**60, 7))
    log.add("Z", b"a kind of a later version")
    log.add("P", b"\xf0short")
    (report,) = import_recordings([log.write(tmp_path / "odd.ulg")], tmp_path / "store")
    assert report.messages == 10
    (account,) = report.accounts
    assert account.startswith("odd.ulg: 13 data records = 10 messages + ")
    for reason in ("unknown message number", "wrong length", "impossible time"):
        assert f"1 of an {reason}" in account or f"1 of a {reason}" in account
    assert any("'Z'" in note for note in report.notes)


def test_a_format_that_is_missing_keeps_its_messages_raw(tmp_path: Path) -> None:
    log = UlogFile()
    log.add("F", b"broken:uint64_t timestamp;unheard_of x;")
    log.subscribe(0, "broken")
    log.put(0, struct.pack("<Q", START_US) + b"12345")
    report = imported(log, tmp_path)
    assert report.items == {"ulog_broken": 1}
    assert any("unheard_of is missing" in note for note in report.notes)
    assert report.kinds["ulog_broken"].startswith("kept raw")


def imported(log: UlogFile, folder: Path) -> ImportReport:
    (report,) = import_recordings([log.write(folder / "log.ulg")], folder / "store")
    return report


def test_pyulog_reads_what_the_test_writes() -> None:
    log = ULog(BytesIO(bytes(flight().data)))
    assert {d.name for d in log.data_list} == set(FORMATS) - {"vector"}
    assert not log.file_corruption
