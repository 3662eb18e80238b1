"""Imports that are repeated, broken off, of damaged files, or of the box's own journals."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

import amberbox
from amberbox.blackbox.columns import ros_definition
from amberbox.blackbox.formats._open import open_recording
from amberbox.blackbox.formats._recording import RecordingReader
from amberbox.blackbox.query.importing import import_recordings
from amberbox.blackbox.retention.maintenance import seal
from amberbox.blackbox.store import batches
from amberbox.blackbox.store.store import open_store
from amberbox.cli.main import main
from amberbox.core import files as core_files
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.source import TopicOptions
from amberbox.testing.clock import PATIENCE_S
from tests.support.manual_recorder import (
    COUNT,
    ManualBox,
    events,
    last_counters,
    number,
    own_records,
)

TYPES = get_typestore(Stores.ROS1_NOETIC)
COUNT_MESSAGES = 4000
START_NS = 1_600_000_000 * 10**9


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_bag(tmp_path / "count.bag", COUNT_MESSAGES)


def write_bag(path: Path, count: int, size: int = 300) -> Path:
    """Write numbered texts that do not compress, 10 ms apart."""
    kind = "std_msgs/msg/String"
    writer = Writer(path)
    writer.chunk_threshold = 20_000
    with writer:
        connection = writer.add_connection("/text", kind, typestore=TYPES)
        for n in range(count):
            text = f"{n} {os.urandom(size // 2).hex()}"
            data = TYPES.serialize_ros1(TYPES.types[kind](text), kind)
            writer.write(connection, START_NS + n * 10**7, data)
    return path


def numbers(store: Path) -> list[int]:
    texts = amberbox.open(store).query("ros_text").values("data")
    return [int(text.split()[0]) for text in texts]


def test_times_are_those_of_the_recording(bag: Path, tmp_path: Path) -> None:
    import_recordings([bag], tmp_path / "store")
    items = amberbox.open(tmp_path / "store").items()
    (item,) = (item for item in items if item.name == "ros_text")
    assert (item.first_ns, item.rows) == (START_NS, COUNT_MESSAGES)
    assert item.last_ns == START_NS + (COUNT_MESSAGES - 1) * 10**7
    assert all(START_NS <= i.first_ns <= i.last_ns <= item.last_ns for i in items)


def test_what_is_there_is_not_imported_again(bag: Path, tmp_path: Path) -> None:
    store, copy = tmp_path / "store", tmp_path / "another_name.bag"
    copy.write_bytes(bag.read_bytes())
    other = write_bag(tmp_path / "other.bag", 10)
    reports = import_recordings([bag, copy, other], store)
    assert [report.known for report in reports] == [False, True, False]
    assert reports[1].lines() == [f"{copy}: is in the store already, nothing was done"]
    assert len(numbers(store)) == COUNT_MESSAGES + 10
    journals = sorted((store / "journal").iterdir())
    assert [r.known for r in import_recordings([other, bag], store)] == [True, True]
    assert sorted((store / "journal").iterdir()) == journals


def test_an_import_that_is_interrupted_is_done_again_whole(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, original = tmp_path / "store", RecordingReader.messages
    with monkeypatch.context() as patch:

        def interrupted(self: RecordingReader) -> Iterator[Any]:
            for place, message in enumerate(original(self)):
                if place == 3000:
                    raise KeyboardInterrupt
                yield message

        patch.setattr(RecordingReader, "messages", interrupted)
        with pytest.raises(KeyboardInterrupt):
            import_recordings([bag], store)
    assert not [*store.rglob("*.mcap"), *store.glob("importing")]
    (report,) = import_recordings([bag], store)
    assert (report.known, report.notes, report.messages) == (False, [], COUNT_MESSAGES)
    assert numbers(store) == list(range(COUNT_MESSAGES))
    assert import_recordings([bag], store)[0].known


def killed(bag: Path, store: Path, after: int) -> None:
    """Import with small files, in a process that dies on the way."""
    from amberbox.blackbox.query import importing

    original, patch = RecordingReader.messages, pytest.MonkeyPatch()

    def dying(self: RecordingReader) -> Iterator[Any]:
        for place, message in enumerate(original(self)):
            if place == after:
                os._exit(9)
            yield message

    patch.setattr(RecordingReader, "messages", dying)
    patch.setattr(importing, "PipelineOptions", small_files)
    patch.setattr(importing, "TICK_BYTES", 10_000)
    import_recordings([bag], store)


def run_until_killed(work: Callable[..., None], *arguments: Any) -> None:
    process = multiprocessing.get_context("fork").Process(target=work, args=arguments)
    process.start()
    process.join(PATIENCE_S)
    assert process.exitcode == 9


def small_files(**options: Any) -> Any:
    from amberbox.blackbox.recorder.pipeline import PipelineOptions

    return PipelineOptions(**{**options, "rotate_bytes": 100_000})


@pytest.mark.parametrize("after", [0, 500, 3999])
def test_an_import_that_is_killed_is_done_again_whole(
    bag: Path, tmp_path: Path, after: int
) -> None:
    store = tmp_path / "store"
    run_until_killed(killed, bag, store, after)
    assert len(list((store / "importing/journal").glob("*.mcap"))) > (2 if after == 3999 else -1)
    seal(open_store(store))  # a keeper that comes by finds nothing to build
    (report,) = import_recordings([bag], store)
    assert (report.known, report.notes, report.messages) == (False, [], COUNT_MESSAGES)
    assert numbers(store) == list(range(COUNT_MESSAGES))
    assert not (store / "importing").exists()


def killed_at_the_end(bag: Path, store: Path) -> None:
    """Import with small files, in a process that dies when two of them are in the store."""
    from amberbox.blackbox.query import importing

    original, patch, moved = Path.rename, pytest.MonkeyPatch(), [0]

    def dying(self: Path, target: Path) -> Path:
        moved[0] += self.suffix == ".mcap"
        if moved[0] > 2:
            os._exit(9)
        return original(self, target)

    patch.setattr(Path, "rename", dying)
    patch.setattr(importing, "PipelineOptions", small_files)
    patch.setattr(importing, "TICK_BYTES", 10_000)
    import_recordings([bag], store)


@pytest.mark.parametrize("built", [False, True])
def test_an_import_that_is_killed_as_its_files_move_is_done_again(
    bag: Path, tmp_path: Path, built: bool
) -> None:
    store = tmp_path / "store"
    run_until_killed(killed_at_the_end, bag, store)
    there = len(numbers(store))
    assert 0 < there < COUNT_MESSAGES
    if built:  # in the millisecond between two files a keeper would have to come by
        seal(open_store(store))
    (report,) = import_recordings([bag], store)
    assert (report.known, report.messages) == (False, COUNT_MESSAGES)
    twice = there if built else 0
    assert len(numbers(store)) == COUNT_MESSAGES + twice
    assert bool(report.notes) == built
    assert import_recordings([bag], store)[0].known


def test_a_recording_stays_known_when_its_journals_are_gone(bag: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    import_recordings([bag], store)
    for journal in (store / "journal").iterdir():
        journal.unlink()  # as keeping raw data for a shorter time does
    assert import_recordings([bag], store)[0].known
    assert numbers(store) == list(range(COUNT_MESSAGES))


@pytest.mark.parametrize("share", [0.2, 0.6, 0.99])
def test_a_truncated_bag_gives_what_can_be_read(bag: Path, tmp_path: Path, share: float) -> None:
    torn = tmp_path / "torn.bag"
    content = bag.read_bytes()
    torn.write_bytes(content[: int(share * len(content))])
    (report,) = import_recordings([torn], tmp_path / "store")
    found = numbers(tmp_path / "store")
    assert found == list(range(len(found)))
    assert abs(len(found) / COUNT_MESSAGES - share) < 0.05
    assert report.messages == len(found)
    assert report.damage
    assert "damaged" in "\n".join(report.lines())
    told = events(tmp_path / "store", "recording_damaged")
    assert [event["text"] for event in told] == report.damage


def test_damage_is_a_gap_of_the_time_around_it(tmp_path: Path) -> None:
    """Data before and after the damaged chunk are no gap, nor is anything in an undamaged bag."""
    whole = write_bag(tmp_path / "whole.bag", 400)
    content = bytearray(whole.read_bytes())
    middle = content.find(b"op=\x02", len(content) // 2)
    content[middle : middle + 2000] = bytes(2000)
    broken = tmp_path / "broken.bag"
    broken.write_bytes(content)
    import_recordings([broken], tmp_path / "store")
    record = amberbox.open(tmp_path / "store")
    (gap,) = record.gaps()
    assert gap.reason.startswith("damaged: broken.bag: ")
    missing = sorted({*range(400)} - {*numbers(tmp_path / "store")})
    assert missing
    assert gap.from_ns <= START_NS + missing[0] * 10**7
    assert START_NS + missing[-1] * 10**7 < gap.to_ns
    assert gap.to_ns - gap.from_ns < 200 * 10**7
    with amberbox.open(whole) as record:
        assert record.gaps() == []


def test_items_without_columns_are_listed_with_the_reason_and_can_be_had_raw(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One type has no definition that can be read, messages of the other fit theirs never."""
    with Writer(tmp_path / "a.bag") as writer:
        types = {"/unknown": "float32 ] x\n", "/misfit": "float64 x\n", "/good": "int32 x\n"}
        for topic, text in types.items():
            connection = writer.add_connection(topic, "a/msg/B", msgdef=text, md5sum="0" * 32)
            for n in range(3):
                writer.write(connection, START_NS + n * 10**9, n.to_bytes(4, "little"))
    store, output = str(tmp_path / "store"), str(tmp_path / "raw.mcap")
    import_recordings([tmp_path / "a.bag"], Path(store), segments=False)
    for _ in range(2):
        items = {item.name: item for item in amberbox.open(store).items()}
        for name in ("ros_unknown", "ros_misfit"):
            found = items[name]
            assert (found.rows, found.bytes, found.type, found.rate_hz) == (3, 12, "a/B", 1.0)
            assert (found.first_ns, found.last_ns) == (START_NS, START_NS + 2 * 10**9)
            (gap,) = amberbox.open(store).gaps(name)
            assert (gap.from_ns, gap.to_ns, gap.count) == (START_NS, START_NS + 2 * 10**9 + 1, 3)
        assert "cannot read the definition of a/B" in str(items["ros_unknown"].no_columns)
        assert items["ros_misfit"].no_columns == "no message fits its definition"
        assert items["ros_good"].no_columns is None
        assert amberbox.open(store).gaps("ros_good") == []
        seal(open_store(Path(store)))  # and again from what the manifest says
    assert main(["items", store]) == 0
    assert "ros_unknown has no columns: cannot read" in capsys.readouterr().err
    assert main(["gaps", store, "ros_unknown"]) == 0
    assert "no columns, only in" in capsys.readouterr().out
    assert main(["query", store, "ros_unknown"]) == 2
    error = capsys.readouterr().err
    assert "hint: its messages are kept as they came" in error
    assert "--format mcap --item ros_unknown" in error
    for item, why in (("ros_misfit", "no message fits its definition"),):
        assert main(["query", store, item]) == 0
        assert f"note: {item} has no rows: {why}" in capsys.readouterr().err
    assert main(["query", store, "ros_misfit"]) == 0
    assert "messages do not fit the definition of a/B" in capsys.readouterr().err
    assert main(["export", store, "--item", "ros_unknown", "-o", output]) == 0
    with open_recording(output) as recording:
        assert [m.data[0] for m in recording.messages()] == [0, 1, 2]


def test_a_definition_that_is_understood_later_has_columns_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A store whose segments were built when roslib/Header was not known answers by its journal."""
    header = "MSG: roslib/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
    text = f"Header header\n{'=' * 80}\n{header}"
    with Writer(tmp_path / "a.bag") as writer:
        connection = writer.add_connection("/h", "a/msg/B", msgdef=text, md5sum="0" * 32)
        writer.write(connection, START_NS, (7).to_bytes(4, "little") + bytes(12))
    monkeypatch.setattr(ros_definition, "with_current_names", str)
    batches._unroller.cache_clear()
    import_recordings([tmp_path / "a.bag"], tmp_path / "store")
    monkeypatch.undo()
    batches._unroller.cache_clear()
    record = amberbox.open(tmp_path / "store")
    assert record.query("ros_h", ["header/seq"]).values("header_seq") == [7]
    assert [item.no_columns for item in record.items() if item.name == "ros_h"] == [None]
    assert record.gaps() == []


@pytest.mark.needs_data
def test_the_truncated_recording_gives_what_can_be_read(shared_data: Path, tmp_path: Path) -> None:
    path = shared_data / "recordings/test_truncated.bag"
    (report,) = import_recordings([path], tmp_path / "store")
    assert report.damage
    items = {item.name: item.rows for item in amberbox.open(tmp_path / "store").items()}
    assert {name: count for name, count in report.items.items() if count} == {
        name: rows for name, rows in items.items() if name.startswith("ros_") and "__" not in name
    }
    assert report.messages > 0


def test_a_journal_of_ours_is_imported_without_the_boxs_own_records(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "robot")
    for n in range(100):
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    (journal,) = (box.store / "journal").glob("*.mcap")
    store = tmp_path / "store"
    (report,) = import_recordings([journal], store)
    assert report.items == {"ros_count": 100}
    assert amberbox.open(store).query("ros_count").values("data") == list(range(100))
    assert [run["run"] for run in own_records(store, "amberbox/run")] == [1]
    assert [event["kind"] for event in own_records(store, "amberbox/event")] == ["imported"]


def test_options_thin_out_and_the_import_counts_it(bag: Path, tmp_path: Path) -> None:
    options = [TopicOptions("/text", max_frequency=10.0)]
    (report,) = import_recordings([bag], tmp_path / "store", topics=options)
    counters = last_counters(tmp_path / "store")["ros_text"]
    assert counters["received"] == COUNT_MESSAGES
    assert report.messages == counters["kept"] == pytest.approx(400, abs=12)
    assert import_recordings([bag], tmp_path / "none", topics=[TopicOptions("/x")])[0].items == {}


def test_errors_name_what_is_wrong(tmp_path: Path, bag: Path) -> None:
    with pytest.raises(UsageError, match="no recording at"):
        import_recordings([tmp_path / "nothing.bag"], tmp_path / "store")
    (tmp_path / "text.bag").write_text("not a bag at all, but long enough for its first line")
    with pytest.raises(AmberboxError, match=r"text\.bag"):
        import_recordings([tmp_path / "text.bag"], tmp_path / "store")
    with pytest.raises(AmberboxError, match="cannot write to the store"):
        import_recordings([bag], bag / "store")
    box = ManualBox(tmp_path / "busy")
    with pytest.raises(UsageError, match=f"written by process {os.getpid()}"):
        import_recordings([bag], tmp_path / "busy")
    box.close()


def test_a_full_disk_ends_the_import_with_an_error(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from amberbox.blackbox.journal import writer

    write = core_files.write_all

    def refuse(fd: int, data: bytes) -> None:
        if len(data) > 10_000:
            raise OSError(28, "No space left on device")
        write(fd, data)

    with monkeypatch.context() as patch:
        patch.setattr(writer, "write_all", refuse)
        with pytest.raises(AmberboxError, match="No space left on device"):
            import_recordings([bag], tmp_path / "store")
    assert not import_recordings([bag], tmp_path / "store")[0].known
    assert numbers(tmp_path / "store") == list(range(COUNT_MESSAGES))
    assert len(events(tmp_path / "store", "imported")) == 1
