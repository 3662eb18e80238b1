"""Questions in workers: answered, limited, shared fairly, cancelled."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.server.workers import pool as module
from amberbox.server.workers.pool import ANSWER_BYTES, FairQueue, WorkerPool
from amberbox.server.workers.protocol import (
    BrokenError,
    BusyError,
    CancelledError,
    LimitError,
    Unpacker,
    WorkerTask,
    packed,
)
from amberbox.testing.clock import PATIENCE_S
from tests.server.workers.program import MODULE

PROGRAM = "tests.server.workers.program"


@pytest.fixture(scope="module")
def worker_pool(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WorkerPool]:
    folder = tmp_path_factory.mktemp("server")
    found = WorkerPool(folder, most=6, each=3, program=PROGRAM)
    yield found
    found.close()


def op(name: str) -> str:
    return f"{MODULE}:{name}"


def test_a_question_is_answered(worker_pool: WorkerPool) -> None:
    assert worker_pool.ask_now(op("echo"), {"text": "hello"}) == b"hello"
    assert asyncio.run(worker_pool.ask(op("echo"), {"text": "you"})) == b"you"


def test_workers_stay(worker_pool: WorkerPool) -> None:
    worker_pool.ask_now(op("echo"), {"text": ""})
    before = worker_pool.pids
    for _ in range(4):
        worker_pool.ask_now(op("echo"), {"text": ""})
    assert set(before) <= set(worker_pool.pids)
    assert len(worker_pool.pids) <= 2


def test_what_is_printed_is_not_the_answer(worker_pool: WorkerPool) -> None:
    assert worker_pool.ask_now(op("talk"), {}) == b"the answer"


@pytest.mark.parametrize(
    ("name", "kind", "what"),
    [
        ("usage", UsageError, "there is no such thing"),
        ("known", AmberboxError, "the data are bad"),
        ("wrong", BrokenError, "could not be answered: KeyError"),
        ("absent", BrokenError, "AttributeError"),
    ],
)
def test_errors_come_back_as_they_are(
    worker_pool: WorkerPool, name: str, kind: type[AmberboxError], what: str
) -> None:
    with pytest.raises(kind, match=what) as found:
        worker_pool.ask_now(op(name), {})
    assert isinstance(found.value, UsageError) == (kind is UsageError)


def test_who_thinks_too_long_is_replaced(worker_pool: WorkerPool) -> None:
    before = time.monotonic()
    with pytest.raises(LimitError, match=r"longer than 0\.3 s"):
        worker_pool.ask_now(op("spin"), {}, 0.3)
    assert time.monotonic() - before < PATIENCE_S
    assert worker_pool.ask_now(op("echo"), {"text": "again"}) == b"again"


def test_a_patient_pool_waits_longer_than_the_limit(tmp_path: Path) -> None:
    """What waits for the processor is no question that takes too long."""
    worker_pool = WorkerPool(tmp_path, 1, program=PROGRAM, patience=200)
    assert worker_pool.ask_now(op("echo"), {"text": "late", "wait_s": 0.5}, 0.3) == b"late"
    with pytest.raises(LimitError, match="longer than 2 s"):
        worker_pool.ask_now(op("spin"), {}, 0.01)
    worker_pool.close()


def test_who_takes_too_much_memory_is_replaced(worker_pool: WorkerPool) -> None:
    with pytest.raises(LimitError, match="more memory than 300 MB"):
        worker_pool.ask_now(op("hoard"), {}, memory_bytes=300 << 20)
    assert worker_pool.ask_now(op("echo"), {"text": "again"}) == b"again"


def test_a_worker_that_was_killed_is_started_again(worker_pool: WorkerPool) -> None:
    worker_pool.ask_now(op("echo"), {"text": ""})
    for pid in worker_pool.pids:
        os.kill(pid, signal.SIGKILL)
        os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)  # it is dead, and its pipe closed
    assert worker_pool.ask_now(op("echo"), {"text": "here"}) == b"here"
    assert worker_pool.ask_now(op("echo"), {"text": "here"}) == b"here"


def test_one_of_many_keeps_one_worker_at_most(tmp_path: Path) -> None:
    """What a robot sends may take the longest time there is: others do not wait for it."""
    worker_pool = WorkerPool(tmp_path, 2, program=PROGRAM, at_once=1)
    mine = [WorkerTask(op("spin"), {}, lambda part: None, 60, 1 << 30, "bad") for _ in range(3)]
    for question in mine:
        worker_pool.submit(question)
    for number in range(3):
        assert (
            worker_pool.ask_now(op("echo"), {"text": str(number)}, origin="good") == b"%d" % number
        )
    assert [question.done.running() for question in mine] == [True, False, False]
    mine[0].cancel()  # the next one of them has its turn then
    with pytest.raises(CancelledError):
        mine[0].done.result()
    assert worker_pool.ask_now(op("echo"), {"text": "still"}, origin="good") == b"still"
    worker_pool.close()
    assert all(question.done.done() for question in mine)


def test_only_workers_operations_can_be_asked(worker_pool: WorkerPool) -> None:
    for bad in ("os:system", "amberbox.server.workers.pool:WorkerPool", f"{MODULE}:_private", "x"):
        with pytest.raises(ValueError, match="nothing that a worker does"):
            worker_pool.ask_now(bad, {})


def test_a_long_answer_comes_as_a_file(worker_pool: WorkerPool, tmp_path: Path) -> None:
    arguments = {"count": 9, "size": 3 << 20}
    with asyncio.run(worker_pool.ask_file(op("parts"), arguments)) as file:
        for number in range(9):
            assert file.read(3 << 20) == bytes([number]) * (3 << 20)
        assert file.read() == b""
    with pytest.raises(LimitError, match="longer than 4 MB"):
        asyncio.run(worker_pool.ask_file(op("parts"), arguments, most_bytes=4 << 20))


def test_an_answer_in_memory_has_an_end(worker_pool: WorkerPool) -> None:
    arguments = {"count": (ANSWER_BYTES >> 20) + 1, "size": 1 << 20}
    with pytest.raises(LimitError, match="longer than 64 MB"):
        worker_pool.ask_now(op("parts"), arguments)


def test_who_goes_away_stops_the_worker(worker_pool: WorkerPool) -> None:
    async def leave() -> None:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(worker_pool.ask(op("spin"), {}, 4 * PATIENCE_S), 0.2)
        before = time.monotonic()
        both = (worker_pool.ask(op("echo"), {"text": str(n)}) for n in range(2))
        assert await asyncio.gather(*both) == [b"0", b"1"]
        assert time.monotonic() - before < PATIENCE_S

    asyncio.run(leave())


def test_too_many_questions_are_refused(worker_pool: WorkerPool) -> None:
    async def crowd() -> list[Any]:
        slow = [
            worker_pool.ask(op("echo"), {"text": "", "wait_s": 0.2}, origin=f"user:{n}")
            for n in range(12)
        ]
        return await asyncio.gather(*slow, return_exceptions=True)

    found = asyncio.run(crowd())
    refused = [one for one in found if isinstance(one, BusyError)]
    assert refused
    assert found.count(b"") + len(refused) == 12
    assert found.count(b"") >= 6


def test_one_asker_cannot_fill_the_queue() -> None:
    waiting = FairQueue(most=6, each=2)
    for _ in range(2):
        waiting.add(_question("user:a"))
    with pytest.raises(BusyError, match="2 of your questions"):
        waiting.add(_question("user:a"))
    waiting.add(_question("user:b"))


def test_askers_take_turns() -> None:
    waiting = FairQueue(most=99, each=99)
    for origin in "aaabbc":
        waiting.add(_question(origin))
    taken = [waiting.take() for _ in range(6)]
    assert "".join(one.origin for one in taken if one) == "abcaba"


def test_closing_lets_go_of_those_who_wait(tmp_path: Path) -> None:
    pool = WorkerPool(tmp_path, 1, program=PROGRAM)
    questions = [_question("", op("spin")) for _ in range(3)]
    for question in questions:
        pool.submit(question)
    while not pool.pids:
        time.sleep(0.01)  # until the first question is at work
    (pid,) = pool.pids
    pool.close()
    assert all(isinstance(one.done.exception(), AmberboxError) for one in questions)
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    with pytest.raises(BusyError):
        pool.submit(_question(""))


def test_a_worker_without_its_server_ends(tmp_path: Path) -> None:
    command = [sys.executable, "-m", PROGRAM, str(tmp_path)]
    worker = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert worker.stdin is not None
    worker.stdin.write(packed({"op": op("echo"), "arguments": {}})[:-3])
    worker.stdin.close()
    assert worker.wait(PATIENCE_S) == 0


def test_frames_come_in_pieces() -> None:
    sent = packed({"part": b"abc"}) + packed({"error": "x"})
    unpacker, found = Unpacker(), []
    for number in range(len(sent)):
        found += list(unpacker.feed(sent[number : number + 1]))
    assert found == [{"part": b"abc"}, {"error": "x"}]
    with pytest.raises(ValueError, match="a frame of"):
        list(Unpacker().feed(b"\xff\xff\xff\xff"))


def test_workers_are_started_before_somebody_asks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_WARM_S", 0.0)
    fresh = WorkerPool(tmp_path)

    async def run() -> None:
        task = asyncio.create_task(fresh.run())
        async with asyncio.timeout(PATIENCE_S):
            while len(fresh.pids) < 2:
                await asyncio.sleep(0.05)
        task.cancel()

    try:
        asyncio.run(run())
    finally:
        fresh.close()


def test_many_threads_ask_at_once(worker_pool: WorkerPool) -> None:
    with ThreadPoolExecutor(4) as threads:
        found = threads.map(lambda n: worker_pool.ask_now(op("echo"), {"text": str(n)}), range(4))
    assert sorted(found) == [b"0", b"1", b"2", b"3"]


def _question(origin: str, operation: str = f"{MODULE}:echo") -> WorkerTask:
    return WorkerTask(operation, {"text": ""}, lambda part: None, 20.0, 1 << 30, origin)
