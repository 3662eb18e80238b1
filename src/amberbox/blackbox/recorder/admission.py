"""What is let into the journals: everything, or on a full disk nothing but the box's own events."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field

from amberbox.blackbox.recorder.filtering import Message
from amberbox.blackbox.recorder.gaplog import GapLog
from amberbox.blackbox.recorder.intake import Intake
from amberbox.blackbox.recorder.room import Room
from amberbox.blackbox.recorder.streams import Item, Tell
from amberbox.core.clock import NS

ACCOUNT_NS = (NS, 60 * NS)
"""Drops are written down after the first, then ever less often up to the second: the room that is
left for events shall last."""


@dataclass
class Admission:
    """Turns messages away while there is no room, and accounts for every one of them.

    Items of the ``elsewhere`` writers are kept on another disk and go on. Of a latched topic the
    last message is held back, and recorded when there is room: nobody will say it again.
    """

    room: Room
    intake: Intake
    gaps: GapLog
    tell: Tell
    elsewhere: Collection[str] = ()
    _said: str = ""
    _said_trouble: str = ""
    _dropped: Counter[str] = field(default_factory=Counter)
    _held: dict[int, Message] = field(default_factory=dict)
    _account_at_ns: int | None = None
    _account_pause_ns: int = ACCOUNT_NS[0]
    _ends: bool = False

    def put_off(self, taken: list[Message], written_bytes: int) -> list[Message]:
        """Look for room; without any, let messages of files wait, and return the others."""
        self.room.look(written_bytes, self.intake.size_bytes)
        self.say()
        if not self.room.reason or self._ends:
            return taken
        self.intake.give_back([message for message in taken if message[0].item.waits])
        return [message for message in taken if not message[0].item.waits]

    def admit(self, messages: list[Message], now_ns: int) -> list[Message]:
        """Return what may be recorded of what was received; count the rest."""
        if not self.room.reason:
            return [*self._let_in(messages, now_ns), *messages]
        admitted = [m for m in messages if m[0].item.writer in self.elsewhere]
        refused = [m for m in messages if m[0].item.writer not in self.elsewhere]
        self.refuse(self._given_up(refused), self.room.reason)
        return admitted

    def _let_in(self, messages: Sequence[Message], now_ns: int) -> list[Message]:
        """Return what was held back, as if it came just now."""
        at_ns = messages[0][2] if messages else now_ns
        held, self._held = self._held, {}
        return [(stream, data, at_ns) for stream, data, _ in held.values()]

    def _given_up(self, refused: Iterable[Message]) -> list[tuple[Item, int]]:
        """Hold the last message of each latched stream back; return what is not kept at all."""
        given_up = []
        for message in refused:
            replaced: Message | None = message
            if message[0].topic.latched:
                replaced = self._held.get(id(message[0]))
                self._held[id(message[0])] = message
            given_up += [] if replaced is None else [replaced]
        if self._ends:
            given_up += self._held.values()
            self._held = {}
        return [(stream.item, received_ns) for stream, _, received_ns in given_up]

    def refuse(self, messages: Sequence[tuple[Item, int]], reason: str) -> None:
        """Count messages as dropped; the first of an item opens its gap."""
        firsts = {item.name: (item, received_ns) for item, received_ns in reversed(messages)}
        for item, received_ns in firsts.values():
            if reason not in item.drops:
                self.gaps.dropping(item.name, received_ns, reason)
        self._dropped.update(item.name for item, _ in messages)
        self.intake.refuse(messages, reason)

    def say(self) -> None:
        """Write an event when the room has gone, or come back."""
        reason, trouble = self.room.reason, self.room.trouble
        if trouble and trouble != self._said_trouble:
            self.tell("no_reserve", f"there is no reserve for the last events: {trouble}")
        self._said_trouble = trouble
        if reason == self._said:
            return
        self._said = reason
        if reason:
            self.tell("events_only", f"{reason}: only events are recorded until there is room")
            return
        total, items = self._dropped.total(), len(self._dropped)
        text = f"there is room: recording goes on; {total} messages of {items} items were dropped"
        self.tell("recording_resumed", text, dropped=dict(self._dropped))
        self._dropped.clear()

    def account_due(self, now_ns: int) -> bool:
        """Tell whether counters and drops are to be written down now."""
        if not self.room.reason or self._ends:
            self._account_at_ns, self._account_pause_ns = None, ACCOUNT_NS[0]
            return True
        if self._account_at_ns is None:
            self._account_at_ns = now_ns + self._account_pause_ns
        if now_ns < self._account_at_ns:
            return False
        self._account_pause_ns = min(2 * self._account_pause_ns, ACCOUNT_NS[1])
        self._account_at_ns = now_ns + self._account_pause_ns
        return True

    def end(self) -> None:
        """Say that the run ends: what was held back is given up, and all is written down."""
        self._ends = True
