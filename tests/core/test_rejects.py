"""Counts of rejected input: each loss is reported once, events are few."""

from __future__ import annotations

from dataclasses import dataclass

from amberbox.core.clock import NS
from amberbox.core.rejects import RejectCounter
from amberbox.testing.contract import MemorySink


@dataclass
class TimedSink(MemorySink):
    """A sink whose time is moved by hand."""

    time_ns: int = 1000 * NS

    def now_ns(self) -> int:
        return self.time_ns


def test_losses_are_summed_up_each_second_and_events_each_minute() -> None:
    sink = TimedSink()
    counter = RejectCounter(sink, "lines", "/dev/ttyX")
    for _ in range(3):
        counter.add("too long", b"\xff\x1b[31m" + b"x" * 1000)
    sink.time_ns += 1
    counter.add("no JSON")
    counter.report()
    assert sink.losses == [
        ("lines", "/dev/ttyX", 1000 * NS, 1000 * NS, 3, "too long"),
        ("lines", "/dev/ttyX", 1000 * NS + 1, 1000 * NS + 1, 1, "no JSON"),
    ]
    counter.add("no JSON")
    counter.report()
    assert len(sink.losses) == 2, "not within the same second"
    sink.time_ns += NS
    counter.add("no JSON")
    counter.report()
    assert sink.losses[2][2:5] == (1000 * NS + 1, 1001 * NS + 1, 2)
    counter.report(now=True)
    assert len(sink.losses) == 3, "nothing is reported twice"
    ((kind, text, _),) = sink.events
    assert kind == "malformed_input"
    assert text.startswith("/dev/ttyX: too long: \ufffd\\u001b[31mx") and len(text) < 120
    sink.time_ns += 60 * NS
    counter.add("no JSON", "{")
    assert sink.events[1][1] == "/dev/ttyX: no JSON: {"
    counter.report(now=True)
    assert sink.losses[3][4] == 1
