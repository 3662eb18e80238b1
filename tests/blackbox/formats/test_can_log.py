"""Logs of CAN buses: the same columns from each format, damage, times."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.blackbox.columns.unroll import unroller
from amberbox.blackbox.formats import can_log
from amberbox.blackbox.formats._open import open_recording
from amberbox.blackbox.formats._recording import ReadOptions, RecordingReader
from amberbox.cli.main import main
from amberbox.core.errors import AmberboxError
from tests.support.can_bus import DBC, EDS, columns_of, frames

FORMATS = ("log", "asc", "blf", "trc")
START_NS = 1_700_000_000_000_000_000


@pytest.fixture
def options(tmp_path: Path) -> ReadOptions:
    (tmp_path / "base.dbc").write_text(DBC)
    (tmp_path / "lift.eds").write_text(EDS)
    return ReadOptions(dbc=[tmp_path / "base.dbc"], eds=[f"0x5={tmp_path / 'lift.eds'}"])


def write(path: Path, sent: Sequence[can.Message]) -> Path:
    with can.Logger(path) as log:
        for frame in sent:
            log(frame)
    return path


def messages(recording: RecordingReader) -> dict[str, list[tuple[int, bytes]]]:
    found: dict[str, list[tuple[int, bytes]]] = {}
    for place, time_ns, _, data in recording.messages():
        found.setdefault(recording.topics[place].name, []).append((time_ns, data))
    return found


def expected(sent: Sequence[can.Message]) -> dict[str, list[bytes]]:
    names = {513: "MOTORS", 0x320: "BATTERY", 514: "LAMP"}
    found: dict[str, list[bytes]] = {}
    for frame in sent:
        if frame.arbitration_id in names:
            found.setdefault(names[frame.arbitration_id], []).append(bytes(frame.data))
    return found


@pytest.mark.parametrize("suffix", FORMATS)
def test_each_format_gives_what_was_sent(
    tmp_path: Path, options: ReadOptions, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(can_log, "_BLOCK", 64)
    monkeypatch.setattr("amberbox.blackbox.formats._recording.ROOM_BYTES", 5000)
    sent = frames(1000)
    with open_recording(write(tmp_path / f"drive.{suffix}", sent), options) as recording:
        found = messages(recording)
        raw = next(topic for topic in recording.topics if topic.name == "frames")
        assert recording.report.damage == [] and recording.report.accounts[0].total == 1000
        assert {origin.source for origin in recording.origins} == {"can"}
    for name, data in expected(sent).items():
        assert [message for _, message in found[name]] == data
        times = np.array([time_ns for time_ns, _ in found[name]])
        first = next(n for n, f in enumerate(sent) if bytes(f.data) == data[0])
        assert np.array_equal(times - times[0], np.arange(len(times)) * 4_000_000)
        if suffix in ("log", "blf"):
            assert times[0] == START_NS + first * 1_000_000
    ids = columns_of(unroller(raw).rows([data for _, data in found["frames"]]))["id"]
    assert set(ids) == {0x7A1}


def test_lines_of_candump(tmp_path: Path) -> None:
    log = tmp_path / "bus.log"
    log.write_text(
        "(1700000000.000001) can0 123#0102\n"
        "(1700000000.000002) can0 00000123#R4\n"
        "nonsense\n"
        "(1700000000.000003) can1 12345678##3" + "AB" * 64 + " R\n"
        "(1700000000.000004) can0 20000044#0001000000000000\n"
        "(1700000000.000005) can0 123#010\n"
    )
    with open_recording(log) as recording:
        found = {t.name: t for t in recording.topics}
        data = messages(recording)
        origins = [
            (t.name, o.source) for t, o in zip(recording.topics, recording.origins, strict=True)
        ]
        damage = [(d.offset, d.length) for d in recording.report.damage]
    assert origins == [("frames", "can0"), ("frames", "can1"), ("errors", "can0")]
    assert [log.read_bytes()[at : at + length] for at, length in damage] == [
        b"nonsense", b"(1700000000.000005) can0 123#010",
    ]  # fmt: skip
    columns = columns_of(unroller(found["frames"]).rows([d for _, d in data["frames"]]))
    assert columns["id"] == [0x123, 0x123, 0x12345678]
    assert columns["remote"] == [False, True, False]
    assert columns["length"] == [2, 4, 64]
    assert columns["bit_rate_switch"] == [False, False, True]
    assert columns["error_state"] == [False, False, True]
    errors = columns_of(unroller(found["errors"]).rows([d for _, d in data["errors"]]))
    assert (errors["bus_off"], errors["controller_state"]) == ([True], [1])


@pytest.mark.parametrize("suffix", ["asc", "trc"])
def test_a_damaged_line_costs_only_itself(tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path / f"drive.{suffix}", frames(200))
    lines = path.read_text().splitlines(keepends=True)
    lines[100] = lines[100].replace("8  ", "z  ").replace(" 8 ", " zz ").replace(" 1 ", " 1z ")
    path.write_text("".join(lines))
    with open_recording(path) as recording:
        left = sum(len(found) for found in messages(recording).values())
    assert left == 199


def test_a_cut_blf_is_read_up_to_the_cut(tmp_path: Path) -> None:
    path = write(tmp_path / "drive.blf", frames(20_000))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with open_recording(path) as recording:
        left = sum(len(found) for found in messages(recording).values())
        assert len(recording.report.damage) == 1
    assert 0 < left < 20_000


def test_times_that_are_no_dates_begin_as_given(tmp_path: Path) -> None:
    log = tmp_path / "bus.log"
    log.write_text("(000000012.500000) can0 123#01\n(000000013.000000) can0 123#02\n")
    with open_recording(log) as recording:
        assert any("--start" in note for note in recording.report.notes)
    with open_recording(log, ReadOptions(start_ns=START_NS)) as recording:
        times = [time_ns for time_ns, _ in messages(recording)["frames"]]
    assert times == [START_NS, START_NS + 500_000_000]


@pytest.mark.parametrize("node", ["lift.eds", "200=lift.eds", "x=lift.eds"])
def test_a_node_without_a_number_is_an_error(tmp_path: Path, node: str) -> None:
    log = tmp_path / "bus.log"
    log.write_text("(000000012.500000) can0 123#01\n")
    with pytest.raises(AmberboxError, match=r"^--eds: ") as caught:
        open_recording(log, ReadOptions(eds=[node]))
    assert "NODE=FILE" in caught.value.hint


def test_import_by_the_command_line(
    tmp_path: Path, options: ReadOptions, capsys: pytest.CaptureFixture[str]
) -> None:
    log = write(tmp_path / "drive.log", frames(100))
    arguments = ["import", str(log), "--dbc", str(options.dbc[0]), "--store", str(tmp_path / "s")]
    assert main([*arguments, "--eds", f"5={tmp_path / 'lift.eds'}"]) == 0
    assert "can_MOTORS: 25, by its definition" in capsys.readouterr().out


@pytest.mark.needs_data
def test_signals_of_a_real_car_are_those_of_cantools(shared_data: Path) -> None:
    import cantools

    log, dbc = (shared_data / "can" / name for name in ("can_sample.log", "sample_can_spec.dbc"))
    database: Any = cantools.database.load_file(dbc)
    truth: dict[str, list[dict[str, Any]]] = {}
    with can.LogReader(log) as reader:
        known = {message.frame_id: message for message in database.messages}
        for frame in reader:
            if frame.arbitration_id in known:
                message = known[frame.arbitration_id]
                values = message.decode(frame.data, decode_choices=False, allow_truncated=True)
                truth.setdefault(message.name, []).append(values)
    with open_recording(log, ReadOptions(dbc=[dbc])) as recording:
        found = messages(recording)
        topics = {topic.name: topic for topic in recording.topics}
    assert sum(map(len, truth.values())) == 38_015
    assert sum(map(len, found.values())) == 82_558
    for name, rows in truth.items():
        columns = columns_of(unroller(topics[name]).rows([data for _, data in found[name]]))
        for signal, column in columns.items():
            assert column == pytest.approx([row.get(signal) for row in rows])


@pytest.mark.fuzz
@given(st.data())
def test_hostile_logs_are_errors_or_recordings(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    suffix = data.draw(st.sampled_from(FORMATS))
    path = write(tmp_path_factory.mktemp("log") / f"drive.{suffix}", frames(12))
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, 999)) * len(content) // 1000
        content[at : at + data.draw(st.integers(0, 6))] = data.draw(st.binary(max_size=6))
    path.write_bytes(content)
    try:
        with open_recording(path) as recording:
            found = messages(recording)
            topics = {topic.name: topic for topic in recording.topics}
    except AmberboxError as error:
        assert "\n" not in error.what
        return
    for name, recorded in found.items():
        unroller(topics[name]).rows([message for _, message in recorded])
