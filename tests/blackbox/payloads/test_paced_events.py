"""Events of peers, limited, and the number of those that were left out."""

from __future__ import annotations

from amberbox.blackbox.payloads.paced_events import AT_ONCE, PER_S, PacedEvents
from amberbox.testing.contract import MemorySink


def test_a_flood_is_cut_and_counted() -> None:
    sink, now_s = MemorySink(), [0.0]
    events = PacedEvents(sink, lambda: now_s[0])
    for number in range(AT_ONCE + 10):
        events.add("came", f"peer {number}", number=number)
    assert len(sink.events) == AT_ONCE
    now_s[0] = 1.0 / PER_S
    events.add("came", "x" * 1000)
    assert [(kind, len(text)) for kind, text, _ in sink.events[AT_ONCE + 1 :]] == [("came", 500)]
    assert sink.events[AT_ONCE][2] == {"count": 10}


def test_the_same_is_recorded_once_until_forgotten() -> None:
    sink = MemorySink()
    events = PacedEvents(sink)
    for _ in range(2):
        events.add_once("missing", "no broker")
    events.forget()
    events.add_once("missing", "no broker")
    assert len(sink.events) == 2
