"""Robots' diagnoses in words: each is worked out by a worker once, then remembered."""

from __future__ import annotations

import asyncio
import json
import logging
import threading
from collections import OrderedDict
from collections.abc import Mapping
from functools import partial
from typing import Any, TypeAlias

from sqlalchemy import select

from amberbox.core.clock import Clock
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Diagnosis
from amberbox.fleet.accounts.tables import ROBOTS
from amberbox.fleet.archive.folder import FolderArchive
from amberbox.fleet.asking.asking import Asking
from amberbox.fleet.bus import Bus, Change
from amberbox.fleet.database.database import Database
from amberbox.fleet.knowledge import notebook
from amberbox.fleet.knowledge.asked import AskDiagnosis, written
from amberbox.fleet.knowledge.listing import Known, find, newest

OP = "amberbox.fleet.knowledge.worker:diagnose"
LIMIT_S = 20.0
MEMORY_BYTES = 1 << 30
_REMEMBERED = 200

Answer: TypeAlias = Mapping[str, Any]
"""What ``POST .../diagnose`` answers."""
Key: TypeAlias = tuple[str, str, int, str, tuple[tuple[str, str], ...]]


def key_of(robot: str, diagnosis: Diagnosis, answers: Mapping[str, str]) -> Key:
    """Return what an explanation depends on: the revision, and what tests gave."""
    given = tuple(sorted(answers.items()))
    return robot, diagnosis.id, diagnosis.revision, diagnosis.state, given


def given_answers(database: Database, robot: str, diagnosis: str) -> dict[str, str]:
    """Return the answers to tests of a diagnosis that count."""
    with database.reading() as connection:
        return notebook.counting(notebook.given(connection, robot, diagnosis))


def made_answers(database: Database, robot: str, diagnosis: str) -> list[notebook.Revision]:
    """Return what the server made of a diagnosis with answers to tests."""
    with database.reading() as connection:
        return notebook.revisions(connection, robot, diagnosis)


class Explained:
    """Explanations by revision; ``known`` never waits, threads may share it.

    While it runs, each diagnosis that comes from a robot is explained before anybody asks, by the
    workers ``preparing``; ``asking`` are those for people.
    """

    def __init__(
        self, database: Database, archive: FolderArchive, bus: Bus, clock: Clock, asking: Asking,
        preparing: Asking,
    ) -> None:  # fmt: skip
        self.database = database
        self.archive = archive
        self._bus = bus
        self._clock = clock
        self._asking = asking
        self._preparing = preparing
        self._lock = threading.Lock()
        self._known: OrderedDict[Key, Answer] = OrderedDict()
        self._asked: dict[Key, asyncio.Task[Answer]] = {}
        self._wanted: asyncio.Queue[tuple[str, str]] = asyncio.Queue()

    def known(self, robot: str, diagnosis: Diagnosis, answers: Mapping[str, str]) -> Answer | None:
        """Return the explanation of a revision if it is there."""
        with self._lock:
            return self._known.get(key_of(robot, diagnosis, answers))

    async def read(
        self, robot: str, diagnosis: Diagnosis, answers: Mapping[str, str], asker: str
    ) -> Answer:
        """Return the explanation; several who want it wait for the same one.

        Raises AmberboxError where there is none, such as without the robot's folder.
        """
        found = self.known(robot, diagnosis, answers)
        if found is not None:
            return found
        key = key_of(robot, diagnosis, answers)
        task = self._asked.get(key)
        if task is None:
            task = asyncio.create_task(self._ask(key, answers, asker))
            self._asked[key] = task
            task.add_done_callback(partial(self._over, key))
        return await asyncio.shield(task)

    def _over(self, key: Key, task: asyncio.Task[Answer]) -> None:
        """Forget who worked on it; whoever waited, if still there, is told what went wrong."""
        self._asked.pop(key, None)
        if not task.cancelled():
            task.exception()  # looked at, so that nobody complains when all have gone

    async def run(self) -> None:
        """Explain what stands, then what comes from robots, one after the other."""
        ends = [self._bus.on("diagnosis", self._note), self._bus.on("robot", self._robot)]
        try:
            for robot in await asyncio.to_thread(self._robots):
                self._wanted.put_nowait((robot, ""))
            while True:
                robot, name = await self._wanted.get()
                await self._prepare(robot, name)
        finally:
            for end in ends:
                end()

    def close(self) -> None:
        """Let go of what is held."""
        self._known.clear()

    def _note(self, change: Change) -> None:
        self._wanted.put_nowait((change.robot, str(change.data["id"])))

    def _robot(self, change: Change) -> None:
        """Look again when a robot's folder came."""
        if change.robot:
            self._wanted.put_nowait((change.robot, ""))

    def _robots(self) -> list[str]:
        with self.database.reading() as connection:
            return list(connection.execute(select(ROBOTS.c.robot)).scalars())

    async def _prepare(self, robot: str, name: str) -> None:
        """Explain a diagnosis that stands, the newest without a name."""
        try:
            known = await asyncio.to_thread(self._find, robot, name)
            if known is not None and known.last.state == "open":
                of = robot, known.id
                answers = await asyncio.to_thread(given_answers, self.database, *of)
                made = await asyncio.to_thread(made_answers, self.database, *of)
                kept = kept_answer(known, made)
                if kept is not None:
                    self._keep(key_of(robot, known.last, answers), kept)
                await self.read(robot, known.last, answers, robot)
        except AmberboxError as error:  # whoever looks at it is told, and asks again
            logging.getLogger(__name__).info("%s: %s", robot, error.what)
        except Exception:  # of a robot whose files are damaged; the others have theirs
            logging.getLogger(__name__).exception("the diagnoses of %s cannot be read", robot)

    def _find(self, robot: str, name: str) -> Known | None:
        return find(self, robot, name) if name else newest(self, robot)

    async def _ask(self, key: Key, answers: Mapping[str, str], asker: str) -> Answer:
        robot, name = key[0], key[1]
        asked = AskDiagnosis(
            robot=robot, now_ns=self._clock.wall_ns(), diagnosis=name, revision=key[2],
            answers=dict(answers),
        )  # fmt: skip
        workers = self._preparing if asker == robot else self._asking
        found = await workers.ask(OP, written(asked), LIMIT_S, MEMORY_BYTES, asker=asker)
        answer: Answer = json.loads(found)
        self._keep(key, answer)
        return answer

    def _keep(self, key: Key, answer: Answer) -> None:
        with self._lock:
            self._known[key] = answer
            while len(self._known) > _REMEMBERED:
                self._known.popitem(last=False)
        self._bus.publish(Change("explained", key[0], {"answer": answer}))


def kept_answer(known: Known, made: list[notebook.Revision]) -> Answer | None:
    """Return what the server made of the newest revision with the answers that count."""
    last = made[-1].body if made else None
    same = last is not None and (last["revision"], last["state"]) == (
        known.last.revision, known.last.state,
    )  # fmt: skip
    return last if same else None
