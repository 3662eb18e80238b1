"""Reads the supplies again and again and says to the sink what they say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec

from amberbox.blackbox.sources.power.judge import Judge, Limits
from amberbox.blackbox.sources.power.reading import Reading, UnreadableError, together
from amberbox.blackbox.sources.power.supply import Reader, Supply
from amberbox.core.source import Power, Sink
from amberbox.core.types import Topic

TOPIC = "supply"
_FIRST_BACKOFF_S = 1.0
_MAX_BACKOFF_S = 10.0
_WORDS: dict[Power, str] = {
    "mains": "on external power",
    "battery": "external power is lost",
    "low": "the battery is low",
}


class Message(msgspec.Struct, omit_defaults=True):
    """What is recorded; values that no supply tells are left out."""

    state: str
    online: bool
    on_battery: bool
    percentage: float | None = None
    voltage: float | None = None
    current: float | None = None
    minutes_left: float | None = None


@dataclass
class _Watched:
    """One supply: its last reading, which stays valid while it cannot be read."""

    supply: Supply
    reader: Reader
    reading: Reading | None = None
    is_up: bool = False
    not_before_s: float = 0.0
    backoff_s: float = _FIRST_BACKOFF_S
    trouble: str = ""

    @property
    def topic(self) -> str:
        """Topic of this supply alone."""
        return f"{TOPIC}/{self.supply.title}"


class Watch:
    """The supplies of a block; ``poll`` reads them once."""

    def __init__(
        self, supplies: Sequence[Supply], limits: Limits, record_s: float, sink: Sink
    ) -> None:
        self._watched = [_Watched(supply, supply.reader()) for supply in supplies]
        self._judge = Judge(limits)
        self._record_s = record_s
        self._sink = sink
        self._recorded_s: float | None = None

    def poll(self, now_s: float) -> None:
        """Read what is due; tell a change of power at once, and record."""
        for watched in self._watched:
            if now_s >= watched.not_before_s:
                self._read(watched, now_s)
        readings = [w.reading for w in self._watched if w.reading is not None]
        if not readings:
            return
        whole = together(readings)
        changed = self._judge.heard(whole.state, now_s)
        if changed and self._judge.state is not None:
            self._sink.power(self._judge.state, self._text(self._judge.state, whole))
        due = self._recorded_s is None or now_s - self._recorded_s >= self._record_s
        if any(watched.is_up for watched in self._watched) and (changed or due):
            self._recorded_s = now_s
            self._record(whole)

    def close(self) -> None:
        """Say that nothing more is read."""
        for watched in self._watched:
            self._down(watched, "stopped")
            watched.reader.close()

    def _read(self, watched: _Watched, now_s: float) -> None:
        try:
            reading = watched.supply.judged(watched.reader.read())
        except UnreadableError as error:
            self._note_trouble(watched, str(error), now_s)
            return
        if watched.trouble:
            text = f"{watched.supply.title} can be read again"
            self._sink.event("power_readable", text, supply=watched.supply.title)
        watched.reading, watched.trouble = reading, ""
        watched.backoff_s, watched.not_before_s = _FIRST_BACKOFF_S, now_s
        self._up(watched)

    def _note_trouble(self, watched: _Watched, trouble: str, now_s: float) -> None:
        """Say once what is wrong, try again later; what was read last stays valid."""
        if trouble != watched.trouble:
            watched.trouble = trouble
            text = f"{watched.supply.title} cannot be read: {trouble}; it is tried again"
            self._sink.event("power_unreadable", text, supply=watched.supply.title)
        self._down(watched, trouble)
        watched.not_before_s = now_s + watched.backoff_s
        watched.backoff_s = min(2 * watched.backoff_s, _MAX_BACKOFF_S)

    def _up(self, watched: _Watched) -> None:
        if not watched.is_up:
            watched.is_up = True
            for topic in self._topics(watched):
                self._sink.link_up(topic, watched.supply.title)

    def _down(self, watched: _Watched, reason: str) -> None:
        if watched.is_up:
            watched.is_up = False
            for topic in self._topics(watched):
                self._sink.link_down(topic, watched.supply.title, reason)

    def _topics(self, watched: _Watched) -> tuple[str, ...]:
        """Return the topics a supply is heard on: several have one each, beside the common one."""
        return (TOPIC, watched.topic) if len(self._watched) > 1 else (TOPIC,)

    def _record(self, whole: Reading) -> None:
        state = self._judge.state or whole.state
        self._send(TOPIC, whole, state)
        for watched in self._watched:
            if len(self._watched) > 1 and watched.is_up and watched.reading is not None:
                self._send(watched.topic, watched.reading, watched.reading.state)

    def _send(self, topic: str, reading: Reading, state: Power) -> None:
        values = (reading.percentage, reading.voltage, reading.current, reading.minutes_left)
        message = Message(state, state == "mains", state != "mains", *values)
        stream = self._sink.topic(Topic(topic, "json"))
        self._sink.message(stream, msgspec.json.encode(message), self._sink.now_ns())

    def _text(self, state: Power, whole: Reading) -> str:
        """Say the change in one line; several supplies are named."""
        named = [w.supply.title for w in self._watched if w.reading and w.reading.state == state]
        by = f" ({', '.join(named)})" if len(self._watched) > 1 and named else ""
        facts = f": {whole.text()}" if whole.text() else ""
        return f"{_WORDS[state]}{by}{facts}"
