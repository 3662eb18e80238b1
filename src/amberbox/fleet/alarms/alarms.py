"""Opens, changes and closes alarms, and tells who has to know."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from typing import Any, Final

from amberbox.core.clock import NS, Clock
from amberbox.core.errors import AmberboxError
from amberbox.fleet.alarms import inbox as boxes
from amberbox.fleet.alarms.absence import Absence
from amberbox.fleet.alarms.inbox import Came, Inbox, News, Went
from amberbox.fleet.alarms.offline import absent_since_start, miss, returned
from amberbox.fleet.alarms.register import Register
from amberbox.fleet.alarms.reports import Received, is_of_interest, reports
from amberbox.fleet.alarms.settings import NAME, AlarmSettings
from amberbox.fleet.alarms.taking import take, take_explanation
from amberbox.fleet.alarms.timing import Lateness, is_due, move_times, pass_time
from amberbox.fleet.alarms.words import Explanation, explanation_of
from amberbox.fleet.bus import Bus, Change
from amberbox.fleet.database.database import Database
from amberbox.fleet.notifying.sending import Sender
from amberbox.fleet.options.options import read

_TICK_S: Final = 1.0
_STEP_NS: Final = 2 * NS
"""The wall clock was set if it is off by so much since the last look; less is slewing."""


class Alarms:
    """Listens to what robots say and to who is there; ``step`` does what follows from that.

    All of it happens in transactions: what was taken is taken once, whatever happens in between.
    """

    def __init__(self, database: Database, bus: Bus, clock: Clock, public_url: str = "") -> None:
        self._database = database
        self._bus = bus
        self._clock = clock
        self._url = public_url
        self._made_ns = clock.wall_ns()
        self._base_ns = clock.wall_ns() - clock.boot_ns()
        self._inbox = Inbox()
        self._absence: Absence | None = None
        self._late = Lateness()
        self._offsets: dict[tuple[str, str], int] = {}
        self._stepping = threading.Lock()
        self.sender = Sender(database, clock)
        self._forget: list[Callable[[], None]] = [
            bus.on("rows", self._rows), bus.on("connected", self._connected),
            bus.on("gone", self._gone), bus.on("explained", self._explained),
        ]  # fmt: skip

    def _rows(self, change: Change) -> None:
        now_ns = self._clock.wall_ns()
        for row in change.data["rows"]:
            if is_of_interest(row):
                self._inbox.put(Received(change.robot, change.data["store_id"], row, now_ns))

    def _connected(self, change: Change) -> None:
        hello: Any = change.data["hello"]
        now_ns = self._clock.wall_ns()
        self._inbox.put(Came(change.robot, hello.boot_id, now_ns - hello.wall_ns, now_ns))

    def _gone(self, change: Change) -> None:
        self._inbox.put(Went(change.robot, self._clock.boot_ns()))

    def _explained(self, change: Change) -> None:
        found = explanation_of(change.robot, change.data["answer"])
        if found is not None:
            self._inbox.put(found)

    async def run(self) -> None:
        """Work until cancelled."""
        sending = asyncio.create_task(self._send())
        try:
            while True:
                await asyncio.to_thread(self.step)
                await asyncio.sleep(_TICK_S)
        finally:
            sending.cancel()

    async def _send(self) -> None:
        while True:
            try:
                await asyncio.to_thread(self.sender.step)
            except AmberboxError as error:
                logging.getLogger(__name__).error("the outbox waits: %s", error.what)
            except Exception:  # the messages are still there, whatever it was
                logging.getLogger(__name__).exception("the outbox could not be emptied")
            await asyncio.sleep(_TICK_S)

    def step(self) -> None:
        """Take all that is new, and do what is due by now; publishes the alarms that changed."""
        with self._stepping:
            self._follow_clock()
            changed = self._start() if self._absence is None else set()
            while news := self._inbox.next():
                changed |= self._taken(news)
                self._inbox.done(len(news))
            changed |= self._tick()
        for number, robot in sorted(self._robots(changed)):
            self._bus.publish(Change("alarm", robot, {"id": number}))

    def _follow_clock(self) -> None:
        """Move what is timed by the wall clock when that was set: no time has passed by it."""
        boot_ns = self._clock.boot_ns()
        base_ns = self._clock.wall_ns() - boot_ns
        if self._clock.boot_ns() - boot_ns >= _STEP_NS / 2:
            return  # this thread was held up between the two: the next look tells
        step_ns = base_ns - self._base_ns
        if abs(step_ns) >= _STEP_NS:
            with self._database.begin() as connection:
                move_times(connection, self._clock.wall_ns(), step_ns)
            self._offsets = {of: ns + step_ns for of, ns in self._offsets.items()}
            self._late.move(step_ns)
        self._base_ns = base_ns

    def _start(self) -> set[int]:
        """Begin: nobody is missed yet; take what came while nobody looked."""
        with self._database.reading() as connection:
            absence = absent_since_start(Register(connection), self._clock.boot_ns())
            left: list[News] = list(boxes.missed_rows(connection, self._made_ns))
        self._absence = absence
        self._note_clocks(self._inbox.next())
        return self._taken(left) if left else set()

    def _taken(self, news: list[News]) -> set[int]:
        """Take news; what cannot be taken is left out, so that it holds nothing else up.

        Raises AmberboxError when the database is busy: then they are taken later.
        """
        try:
            return self._take(news)
        except AmberboxError:
            raise
        except Exception:  # a defect, or something that no robot should say
            if len(news) > 1:
                return set[int]().union(*[self._taken([one]) for one in news])
            logging.getLogger(__name__).exception("this of %s is left out", news[0].robot)
            return set()

    def _take(self, news: list[News]) -> set[int]:
        """Take news in one transaction."""
        assert self._absence is not None
        now_ns = self._clock.wall_ns()
        rows = [one for one in news if isinstance(one, Received)]
        back = {one.robot for one in news if isinstance(one, Came)}
        self._note_clocks(news)
        with self._database.begin() as connection:
            settings = read(connection, NAME, AlarmSettings)
            register = Register(connection)
            known = boxes.offsets(connection, rows, self._offsets)
            told = list(reports(rows, known, settings.ns("late_s")))
            take(register, told, now_ns, settings)
            for one in news:
                if isinstance(one, Explanation):
                    take_explanation(register, one, now_ns, settings)
            returned(register, back, now_ns)
            if rows:
                boxes.mark(connection, max(one.received_ns for one in rows))
        self._late.note(told, now_ns)
        self._move(news)
        return register.touched

    def _note_clocks(self, news: list[News]) -> None:
        for one in news:
            if isinstance(one, Came):
                self._offsets[one.robot, one.boot_id] = one.offset_ns

    def _move(self, news: list[News]) -> None:
        """Note who came and who went, in order."""
        assert self._absence is not None
        for one in news:
            if isinstance(one, Came):
                self._absence.back(one.robot)
            elif isinstance(one, Went):
                self._absence.gone(one.robot, one.boot_ns)

    def _tick(self) -> set[int]:
        """Do what is due by now."""
        absence, now_ns = self._absence, self._clock.wall_ns()
        assert absence is not None
        with self._database.reading() as connection:
            settings = read(connection, NAME, AlarmSettings)
            waits = is_due(connection, now_ns, settings)
        if not waits and not absence.away.keys() - absence.settled:
            return set()
        before = set(absence.settled)
        try:
            with self._database.begin() as connection:
                register = Register(connection)
                miss(register, absence, now_ns, self._clock.boot_ns(), settings)
                pass_time(register, self._late, now_ns, settings, self._url)
        except BaseException:  # nothing of it is kept: it is decided again
            absence.settled = before
            raise
        return register.touched

    def _robots(self, numbers: set[int]) -> set[tuple[int, str]]:
        if not numbers:
            return set()
        with self._database.reading() as connection:
            register = Register(connection)
            return {(n, alarm.robot) for n in numbers if (alarm := register.alarm(n)) is not None}

    def close(self) -> None:
        """Let go of what is held."""
        for forget in self._forget:
            forget()
        with self._stepping:  # what has begun is finished first
            self.sender.close()
