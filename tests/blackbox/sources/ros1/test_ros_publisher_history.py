"""The stored history of publishers, latched messages and the last time each was seen."""

from __future__ import annotations

import threading

from amberbox.blackbox.sources.ros1.subscription import (
    MOST_PER_TOPIC,
    LatchedFilter,
    PublisherAbsence,
    PublisherHistory,
    digest,
)
from amberbox.testing.clock import PATIENCE_S, wait_until
from amberbox.testing.contract import MemorySink


def test_publishers_are_remembered_across_restarts() -> None:
    sink = MemorySink()
    memory = PublisherHistory(sink)
    memory.remember("/a", "/n", "http://h:1/", "a/B")
    memory.use_port(4711)
    memory.save()
    again = PublisherHistory(sink)
    assert again.uris("/a") == ["http://h:1/"]
    assert again.knows("/a", "/n", "http://h:1/") and not again.knows("/a", "/n", "http://h:2/")
    assert again.port == 4711


def test_a_node_that_moved_is_remembered_once_and_forgotten_when_it_leaves() -> None:
    sink = MemorySink()
    memory = PublisherHistory(sink)
    memory.remember("/a", "/n", "http://h:1/", "a/B")
    memory.latch("/a", "/n", "digest")
    memory.remember("/a", "/n", "http://h:2/", "a/B")
    assert memory.uris("/a") == ["http://h:2/"]
    memory.forget("/a", "http://h:2/")
    memory.save()
    assert (
        PublisherHistory(sink).uris("/a") == []
        and PublisherHistory(sink).latched("/a", "/n") is None
    )


def test_anonymous_nodes_do_not_pile_up() -> None:
    memory = PublisherHistory(MemorySink())
    for number in range(MOST_PER_TOPIC + 5):
        memory.remember("/a", f"/n{number}", f"http://h:{number}/", "a/B")
    uris = memory.uris("/a")
    assert len(uris) == MOST_PER_TOPIC and uris[-1] == f"http://h:{MOST_PER_TOPIC + 4}/"


def test_nothing_is_saved_without_a_change() -> None:
    sink = MemorySink(saved={"port": 7, "publishers": "garbage"})
    memory = PublisherHistory(sink)
    memory.use_port(7)
    memory.save()
    assert sink.saved == {"port": 7, "publishers": "garbage"} and memory.uris("/a") == []


def test_changes_are_saved_by_a_thread_of_their_own() -> None:
    sink = MemorySink()
    memory = PublisherHistory(sink)
    thread = threading.Thread(target=memory.keep_saving)
    thread.start()
    memory.remember("/a", "/n", "http://h:1/", "a/B")
    wait_until(lambda: sink.saved, "saved")
    memory.end_saving()
    thread.join(PATIENCE_S)
    assert not thread.is_alive() and PublisherHistory(sink).uris("/a") == ["http://h:1/"]


def test_a_digest_leaves_the_sequence_number_out() -> None:
    assert digest(b"\1\0\0\0rest", True) == digest(b"\2\0\0\0rest", True)
    assert digest(b"\1\0\0\0rest", False) != digest(b"\2\0\0\0rest", False)


def filtered(
    known: frozenset[str], messages: list[bytes], has_header: bool = False, every_s: float = 0.0
) -> tuple[list[bytes], int]:
    kept: list[bytes] = []
    repeats: list[None] = []
    latched = LatchedFilter(
        "/map",
        "/n",
        has_header,
        known,
        PublisherHistory(MemorySink()),
        lambda data, _: kept.append(data),
        lambda: repeats.append(None),
    )
    for place, message in enumerate(messages):
        latched(message, round(place * every_s * 1e9))
    return kept, len(repeats)


def test_only_a_first_message_that_is_known_is_left_out() -> None:
    known = frozenset({digest(b"map", False)})
    assert filtered(known, [b"map", b"map", b"new"]) == ([b"map", b"new"], 1)
    assert filtered(known, [b"new", b"map"]) == ([b"new", b"map"], 0)
    assert filtered(frozenset(), [b"map"]) == ([b"map"], 0)


def test_a_message_that_comes_twice_as_the_link_begins_is_kept_once() -> None:
    twice = [b"\1\0\0\0map", b"\2\0\0\0map"]
    assert filtered(frozenset(), twice, has_header=True) == (twice[:1], 1)
    assert filtered(frozenset(), twice, has_header=True, every_s=1.5) == (twice, 0)


def test_a_publisher_is_absent_until_the_question_before_the_first_that_named_it() -> None:
    sightings = PublisherAbsence(start_ns=100)
    assert sightings.absent_until_ns("/n") == 100
    sightings.polled(200, [])
    assert sightings.absent_until_ns("/n") == 200
    sightings.polled(300, ["/n"])
    sightings.polled(400, ["/n"])
    assert sightings.absent_until_ns("/n") == 200
    assert sightings.absent_until_ns("/other") == 400
    sightings.polled(500, [])
    assert sightings.absent_until_ns("/n") == 500
