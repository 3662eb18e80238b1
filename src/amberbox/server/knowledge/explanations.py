"""Explained diagnoses: computed once by a worker, then cached; answers and causes from people."""

from __future__ import annotations

import asyncio
import json
import logging
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeAlias

import msgspec
from sqlalchemy import Connection, Row, Table, select

from amberbox.blackbox.journal import channels
from amberbox.core.clock import NS, Clock
from amberbox.core.errors import AmberboxError
from amberbox.core.given_answers import RecordedAnswer
from amberbox.core.record_commands import DiagnosisAnswer
from amberbox.core.types import Diagnosis
from amberbox.server import record_orders
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.database import ServerDatabase
from amberbox.server.knowledge.diagnoses import DiagnosisHistory, find_diagnosis, newest_diagnosis
from amberbox.server.knowledge.questions import LIMIT_S, MEMORY_BYTES, AskDiagnosis, encode_question
from amberbox.server.schema import ANSWER, CAUSE, REVISION, ROBOTS
from amberbox.server.workers.pool import WorkerPool


@dataclass(frozen=True, slots=True)
class GivenAnswer:
    """An answer of a person to a test: what, by whom, when."""

    test: str
    answer: str
    who: str
    at_ns: int


@dataclass(frozen=True, slots=True)
class GivenCause:
    """The actual cause of a diagnosis as a person entered it."""

    failure_mode: str
    note: str
    who: str
    at_ns: int


@dataclass(frozen=True, slots=True)
class Revision:
    """A diagnosis with the server's new ranking after an answer to a test."""

    number: int
    who: str
    at_ns: int
    body: dict[str, Any]


# A row of a robot may be read twice, with clock offsets that differ a little
_SAME_NS = 5 * NS


class AnswerReport(Protocol):
    """Where and when an answer at a robot was written; times in ns, ``written_ns`` by its clock."""

    @property
    def robot(self) -> str:
        """Return the robot's id."""

    @property
    def written_ns(self) -> int:
        """Return when it was written."""

    @property
    def offset_ns(self) -> int:
        """Return the server's clock minus the robot's."""


def read_answers(connection: Connection, robot: str, diagnosis: str) -> list[GivenAnswer]:
    """Return all answers given to the tests of a diagnosis, in order of time."""
    rows = sorted(_rows(connection, ANSWER, robot, diagnosis), key=lambda row: row.at_ns)
    return [GivenAnswer(row.test, row.answer, row.who, row.at_ns) for row in rows]


def latest_by_test(answers: list[GivenAnswer]) -> dict[str, str]:
    """Return the last answer to each test, by test."""
    return {one.test: one.answer for one in answers}


def read_causes(connection: Connection, robot: str, diagnosis: str) -> list[GivenCause]:
    """Return the causes that people entered for a diagnosis, in order."""
    rows = _rows(connection, CAUSE, robot, diagnosis)
    return [GivenCause(row.failure_mode, row.note, row.who, row.at_ns) for row in rows]


def modes_named(
    connection: Connection, robot: str, diagnoses: Sequence[str]
) -> dict[str, list[str]]:
    """Return the failure modes that people entered as causes, by diagnosis, in order."""
    chosen = select(CAUSE).where(CAUSE.c.robot == robot, CAUSE.c.diagnosis.in_(diagnoses))
    found: dict[str, list[str]] = {one: [] for one in diagnoses}
    for row in connection.execute(chosen.order_by(CAUSE.c.number)):
        found[row.diagnosis].append(row.failure_mode)
    return found


def read_revisions(connection: Connection, robot: str, diagnosis: str) -> list[Revision]:
    """Return the revisions that the server made of a diagnosis, in order, numbered from 1."""
    rows = _rows(connection, REVISION, robot, diagnosis)
    return [
        Revision(number, row.who, row.at_ns, msgspec.json.decode(row.body))
        for number, row in enumerate(rows, 1)
    ]


def keep_answer(
    connection: Connection, robot: str, diagnosis: str, one: GivenAnswer, body: bytes,
    also: Sequence[GivenAnswer] = (),
) -> None:  # fmt: skip
    """Store an answer, others given with it, and the diagnosis with the new ranking (``body``,
    JSON).
    """
    about = {"robot": robot, "diagnosis": diagnosis, "who": one.who, "at_ns": one.at_ns}
    rows = [{**about, "test": of.test, "answer": of.answer} for of in (one, *also)]
    connection.execute(ANSWER.insert(), rows)
    connection.execute(REVISION.insert(), [{**about, "body": body.decode()}])


def send_answers(
    connection: Connection, now_ns: int, robot: str, diagnosis: str, given: Sequence[GivenAnswer]
) -> bool:
    """Let the robot's own diagnosis know what people answered; return whether a command was made.

    The caller publishes ``command`` for the robot after the transaction.
    """
    made = []
    for one in given:
        about, who = f"answer:{diagnosis}:{one.test}", record_orders.person_label(one.who)
        wanted = DiagnosisAnswer(diagnosis, one.test, one.answer, who)
        made.append(record_orders.order(connection, now_ns, robot, about, wanted, who))
    return any(made)


def take_answer(
    connection: Connection, now_ns: int, report: AnswerReport, given: RecordedAnswer
) -> bool:
    """Take an answer from a robot's record; return whether the robot is told that another counts.

    One that was given there is stored once, an echo of a command is only noted. Of several answers
    to one test the last one counts, by the server's estimate of the time; the robot counts the one
    that came last.
    """
    if given.command:
        about = f"answer:{given.diagnosis}:{given.test}"
        record_orders.see(connection, report.robot, about, given.command)
        order = record_orders.find(connection, report.robot, about)
        if order is not None and order.command == given.command:
            return False
    else:
        _keep_given(connection, report, given)
    known = read_answers(connection, report.robot, given.diagnosis[:128])
    last = next((one for one in reversed(known) if one.test == given.test), None)
    if last is None or last.answer == given.answer:
        return False
    return send_answers(connection, now_ns, report.robot, given.diagnosis, [last])


def _keep_given(connection: Connection, report: AnswerReport, given: RecordedAnswer) -> None:
    row: dict[str, Any] = {
        "robot": report.robot, "diagnosis": given.diagnosis[:128], "test": given.test[:512],
        "answer": given.answer[:128], "who": f"{given.who} at the robot",
        "at_ns": min(max(report.written_ns + report.offset_ns, 0), 1 << 62),
    }  # fmt: skip
    row = {name: v.replace("\0", "") if isinstance(v, str) else v for name, v in row.items()}
    same = [ANSWER.c[name] == row[name] for name in ("robot", "diagnosis", "test", "answer", "who")]
    near = ANSWER.c.at_ns.between(row["at_ns"] - _SAME_NS, row["at_ns"] + _SAME_NS)
    if connection.execute(select(ANSWER.c.number).where(*same, near).limit(1)).first() is None:
        connection.execute(ANSWER.insert(), [row])


def keep_cause(connection: Connection, robot: str, diagnosis: str, cause: GivenCause) -> None:
    """Store the actual cause of a diagnosis."""
    row = {
        "robot": robot, "diagnosis": diagnosis, "failure_mode": cause.failure_mode,
        "note": cause.note, "who": cause.who, "at_ns": cause.at_ns,
    }  # fmt: skip
    connection.execute(CAUSE.insert(), [row])


def _rows(connection: Connection, table: Table, robot: str, diagnosis: str) -> list[Row[Any]]:
    chosen = select(table).where(table.c.robot == robot, table.c.diagnosis == diagnosis)
    return list(connection.execute(chosen.order_by(table.c.number)))


OP = "amberbox.server.knowledge.worker:diagnose"
_REMEMBERED = 200

Answer: TypeAlias = Mapping[str, Any]
"""What ``POST .../diagnose`` answers."""
Key: TypeAlias = tuple[str, str, int, str, tuple[tuple[str, str], ...]]


def key_of(robot: str, diagnosis: Diagnosis, answers: Mapping[str, str]) -> Key:
    """Return the key of an explanation in the cache: robot, revision of the diagnosis, answers."""
    given = tuple(sorted(answers.items()))
    return robot, diagnosis.id, diagnosis.revision, diagnosis.state, given


def given_answers(database: ServerDatabase, robot: str, diagnosis: str) -> dict[str, str]:
    """Return the last answer to each test of a diagnosis, by test."""
    with database.reading() as connection:
        return latest_by_test(read_answers(connection, robot, diagnosis))


def made_answers(database: ServerDatabase, robot: str, diagnosis: str) -> list[Revision]:
    """Return the revisions that the server made of a diagnosis."""
    with database.reading() as connection:
        return read_revisions(connection, robot, diagnosis)


class Explained:
    """A cache of explanations by revision; ``known`` never waits, threads may share it.

    While ``run`` runs, each diagnosis that a robot sends is explained in advance, by the workers
    for robots; questions of people go to other workers.
    """

    def __init__(
        self,
        database: ServerDatabase,
        archive: FolderArchive,
        bus: EventBus,
        clock: Clock,
        worker_pool: WorkerPool,
        robot_worker_pool: WorkerPool,
    ) -> None:
        self.database = database
        self.archive = archive
        self._bus = bus
        self._clock = clock
        self._worker_pool = worker_pool
        self._robot_worker_pool = robot_worker_pool
        self._lock = threading.Lock()
        self._known: OrderedDict[Key, Answer] = OrderedDict()
        self._running: dict[tuple[Key, bool], asyncio.Task[Answer]] = {}  # whether in advance
        self._wanted: asyncio.Queue[tuple[str, str]] = asyncio.Queue()

    def known(self, robot: str, diagnosis: Diagnosis, answers: Mapping[str, str]) -> Answer | None:
        """Return the cached explanation of a revision; None if there is none."""
        with self._lock:
            return self._known.get(key_of(robot, diagnosis, answers))

    async def read(
        self, robot: str, diagnosis: Diagnosis, answers: Mapping[str, str], origin: str
    ) -> Answer:
        """Return the explanation; concurrent callers wait for the same computation.

        People never wait for one that is computed in advance: its low priority may take long on a
        busy machine. Raises AmberboxError if it cannot be computed, such as without the robot's
        folder.
        """
        found = self.known(robot, diagnosis, answers)
        if found is not None:
            return found
        key = key_of(robot, diagnosis, answers)
        shared = key, origin == robot
        task = self._running.get(shared)
        if task is None:
            task = asyncio.create_task(self._explain_in_worker(key, answers, origin))
            self._running[shared] = task
            task.add_done_callback(partial(self._over, shared))
        return await asyncio.shield(task)

    def _over(self, shared: tuple[Key, bool], task: asyncio.Task[Answer]) -> None:
        """Forget a finished task; its exception goes to the callers that still wait for it."""
        self._running.pop(shared, None)
        if not task.cancelled():
            task.exception()  # retrieved, so that asyncio does not log it without callers

    async def run(self) -> None:
        """Explain the newest diagnosis of each robot, then new diagnoses in order of arrival."""
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
        """Empty the cache."""
        self._known.clear()

    def _note(self, change: ServerChange) -> None:
        self._wanted.put_nowait((change.robot, str(change.data["id"])))

    def _robot(self, change: ServerChange) -> None:
        """Queue the newest diagnosis of a robot whose folder has arrived."""
        if change.robot:
            self._wanted.put_nowait((change.robot, ""))

    def _robots(self) -> list[str]:
        with self.database.reading() as connection:
            return list(connection.execute(select(ROBOTS.c.robot)).scalars())

    async def _prepare(self, robot: str, name: str) -> None:
        """Explain an open diagnosis; without a name, the robot's newest one."""
        try:
            known = await asyncio.to_thread(self._find, robot, name)
            if known is not None and known.last.state == "open":
                of = robot, known.id
                answers = await asyncio.to_thread(given_answers, self.database, *of)
                made = await asyncio.to_thread(made_answers, self.database, *of)
                kept = latest_answer(known, made)
                if kept is not None:
                    self._keep(key_of(robot, known.last, answers), kept)
                await self.read(robot, known.last, answers, robot)
        except AmberboxError as error:  # a page that needs it asks again, and shows the error
            logging.getLogger(__name__).info("%s: %s", robot, error.what)
        except Exception:  # damaged files; go on with other robots
            logging.getLogger(__name__).exception("the diagnoses of %s cannot be read", robot)

    def _find(self, robot: str, name: str) -> DiagnosisHistory | None:
        return find_diagnosis(self, robot, name) if name else newest_diagnosis(self, robot)

    async def _explain_in_worker(self, key: Key, answers: Mapping[str, str], origin: str) -> Answer:
        robot, name = key[0], key[1]
        asked = AskDiagnosis(
            robot=robot, now_ns=self._clock.wall_ns(), diagnosis=name, revision=key[2],
            answers=dict(answers),
        )  # fmt: skip
        workers = self._robot_worker_pool if origin == robot else self._worker_pool
        found = await workers.ask(OP, encode_question(asked), LIMIT_S, MEMORY_BYTES, origin=origin)
        answer: Answer = json.loads(found)
        self._keep(key, answer)
        return answer

    def _keep(self, key: Key, answer: Answer) -> None:
        with self._lock:
            self._known[key] = answer
            while len(self._known) > _REMEMBERED:
                self._known.popitem(last=False)
        self._bus.publish(ServerChange("explained", key[0], {"answer": answer}))


def latest_answer(known: DiagnosisHistory, made: list[Revision]) -> Answer | None:
    """Return the server's last revision of a diagnosis if it is of the robot's newest revision."""
    last = made[-1].body if made else None
    same = last is not None and (last["revision"], last["state"]) == (
        known.last.revision, known.last.state,
    )  # fmt: skip
    return last if same else None


class _Diagnosis(msgspec.Struct):
    """The id of a recorded diagnosis."""

    id: str


_DECODER = msgspec.json.Decoder(_Diagnosis)


def publish_diagnoses(bus: EventBus) -> None:
    """Publish a change for each diagnosis among the rows that robots send."""

    def on_rows(change: ServerChange) -> None:
        names: dict[str, None] = {}
        for row in change.data["rows"]:
            if row.channel == channels.DIAGNOSIS:
                names.update(_name(row.data))
        for name in names:
            bus.publish(ServerChange("diagnosis", change.robot, {"id": name}))

    bus.on("rows", on_rows)


def _name(data: bytes) -> dict[str, None]:
    try:
        return {_DECODER.decode(data).id: None}
    except msgspec.MsgspecError:
        return {}  # not readable
