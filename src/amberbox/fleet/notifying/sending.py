"""Deliver what is in the outbox: in the order it was put in, to several destinations at a time."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from sqlalchemy import RowMapping

from amberbox.core.clock import Clock
from amberbox.fleet.database.database import Database
from amberbox.fleet.notifying import outbox
from amberbox.fleet.notifying.delivering import Deliver, deliver
from amberbox.fleet.notifying.settings import NAME, Destination, Notifications
from amberbox.fleet.options.options import read

_AT_ONCE = 4


@dataclass(slots=True, eq=False)
class Sender:
    """Takes messages from the outbox; what does not arrive is tried again later."""

    database: Database
    clock: Clock
    deliver: Deliver = deliver
    _stepping: threading.Lock = field(default_factory=threading.Lock)
    _closed: bool = False
    _pool: ThreadPoolExecutor = field(
        default_factory=lambda: ThreadPoolExecutor(_AT_ONCE, "notifying")
    )

    def step(self) -> int:
        """Deliver what is due now; return how many messages have arrived."""
        with self._stepping:
            return 0 if self._closed else self._step()

    def _step(self) -> int:
        now_ns = self.clock.wall_ns()
        with self.database.reading() as connection:
            setting = read(connection, NAME, Notifications)
            waiting = outbox.due(connection, now_ns)
            if not waiting and not outbox.held(connection, now_ns):
                return 0
        with self.database.begin() as connection:
            outbox.drop_untold(connection)
            outbox.gather(connection, now_ns, setting)
            waiting = outbox.due(connection, now_ns)
        of: dict[str, list[RowMapping]] = {}
        for row in waiting:
            of.setdefault(row["destination"], []).append(row)
        work = [self._pool.submit(self._to, name, rows, setting) for name, rows in of.items()]
        return sum(one.result() for one in work)

    def _to(self, name: str, rows: Sequence[RowMapping], setting: Notifications) -> int:
        """Deliver the messages of one destination, up to the first that does not arrive."""
        to = setting.destination(name)
        for number, row in enumerate(rows):
            if trouble := self._one(to, row, setting):
                self._note(rows[number:], trouble, final=to is None)
                return number
        return len(rows)

    def _one(self, to: Destination | None, row: RowMapping, setting: Notifications) -> str:
        if to is None:
            return "this destination is not in the settings any more"
        trouble = self.deliver(to, outbox.message_of(row), setting, self.clock.wall_ns())
        if not trouble:
            with self.database.begin() as connection:
                outbox.delivered(connection, [row["number"]], self.clock.wall_ns())
        return trouble

    def _note(self, rows: Sequence[RowMapping], trouble: str, *, final: bool) -> None:
        with self.database.begin() as connection:
            for row in rows:
                outbox.troubled(connection, row, self.clock.wall_ns(), trouble, final=final)

    def close(self) -> None:
        """Wait for what is being delivered."""
        with self._stepping:
            self._closed = True
        self._pool.shutdown()
