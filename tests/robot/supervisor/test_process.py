"""Real processes: signs of life, output, hanging, and who dies with whom."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from amberbox.link.backoff import Backoff
from amberbox.robot.supervisor.child import Child
from amberbox.robot.supervisor.life import Life
from amberbox.robot.supervisor.output import Voice
from amberbox.robot.supervisor.process import MARK, Process, RealProcess
from amberbox.testing.patience import PATIENCE_S, wait_until
from tests.robot.supervisor.puppet import Theatre

LIVELY = """\
import os, socket, time
link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
address = "\\0" + os.environ["NOTIFY_SOCKET"][1:]
print("begins", flush=True)
link.sendto(b"READY=1\\nSTATUS=well", address)
while True:
    link.sendto(b"WATCHDOG=1", address)
    time.sleep(0.05)
"""


def child(text: str, **more: float | bool) -> Child:
    made = Child("one", [sys.executable, "-S", "-c", text], watchdog_s=0.5, start_s=10.0)
    return replace(made, **more)  # type: ignore[arg-type]  # each test knows the types it gives


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def lives(said: list[str]) -> Iterator[Callable[[Child], tuple[Life, Theatre]]]:
    begun: list[Life] = []

    def begin(child: Child) -> tuple[Life, Theatre]:
        theatre = Theatre()

        def launch(child: Child) -> RealProcess:
            return RealProcess(child, "store", Voice(child.name, said.append))

        life = Life(child, launch, theatre.tell, Backoff(least_s=0.01))
        life.want(0.0)
        begun.append(life)
        return life, theatre

    yield begin
    for life in begun:
        if life.process is not None:
            end(life.process)


def end(process: Process) -> None:
    """Kill a process, and wait until it is gone."""
    process.send(signal.SIGKILL)
    wait_until(lambda: process.poll() is not None)
    process.close()


Begin = Callable[[Child], tuple[Life, Theatre]]


def stepped(life: Life, is_so: Callable[[], bool]) -> None:
    """Step until something is so."""

    def look() -> bool:
        life.step(time.monotonic())
        return is_so()

    wait_until(look)


def test_a_child_that_hangs_is_killed_and_begins_again(lives: Begin, said: list[str]) -> None:
    life, theatre = lives(child(LIVELY))
    stepped(life, lambda: life.is_up)
    assert life.process is not None and life.status == "well"
    first = life.process.pid
    os.kill(first, signal.SIGSTOP)
    stepped(life, lambda: life.is_up and life.process is not None and life.process.pid != first)
    assert [kind for kind, _ in theatre.told] == ["process_hung"]
    assert said == ["one: begins"] * 2


def test_kill_9_is_seen_at_once(lives: Begin) -> None:
    life, theatre = lives(child(LIVELY))
    stepped(life, lambda: life.is_up)
    assert life.process is not None
    os.kill(life.process.pid, signal.SIGKILL)
    stepped(life, lambda: life.restarts == 1)
    assert "was killed by SIGKILL" in theatre.told[0][1]


def test_exit_2_is_a_refusal_with_its_reason(lives: Begin) -> None:
    life, theatre = lives(child("print('error: no such item'); raise SystemExit(2)"))
    stepped(life, lambda: life.state == "refused")
    assert "no such item" in theatre.told[0][1]


def test_signs_of_life_of_others_do_not_count(lives: Begin) -> None:
    life, _ = lives(child("import os, time; print(os.environ['NOTIFY_SOCKET']); time.sleep(60)"))
    process: list[RealProcess] = []
    life.step(0.0)
    assert isinstance(life.process, RealProcess)
    process.append(life.process)
    name = process[0]._ear._socket.getsockname()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(b"READY=1", name)
    assert list(process[0].heard()) == []


def test_a_child_gives_way_and_says_for_which_store_it_runs(lives: Begin, said: list[str]) -> None:
    text = f"import os; print(os.nice(0), os.environ['{MARK}'], os.getpgid(0) == os.getpid())"
    life, _ = lives(child(text, nice=7))
    stepped(life, lambda: bool(said))
    assert said[0] == f"one: {min(19, os.nice(0) + 7)} store True"


def test_one_that_nobody_listens_to_is_not_held_up(lives: Begin) -> None:
    flood = (
        "import os\ntry:\n    while True: os.write(1, b'x' * 4096)\nexcept BlockingIOError: pass\n"
    )
    life, _ = lives(child(flood))
    life.step(0.0)
    assert isinstance(life.process, RealProcess)
    assert life.process._process.wait(PATIENCE_S) == 0


PARENT = """\
import sys, time
sys.path[:0] = {path!r}
from amberbox.robot.supervisor.child import Child
from amberbox.robot.supervisor.output import Voice
from amberbox.robot.supervisor.process import RealProcess
command = [sys.executable, "-S", "-c", "import os, time; os.write(1, b'up'); time.sleep(60)"]
def say(text): pass
made = []
for outlives in (False, True):
    process = RealProcess(Child("one", command, outlives=outlives), "s", Voice("one", say))
    made.append(process)
    process.filenos()
    import select
    select.select([process.filenos()[0]], [], [], 10)
print(*[process.pid for process in made], flush=True)
time.sleep(60)
"""


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_when_the_supervisor_is_killed_the_recorder_lives_on() -> None:
    path = [entry for entry in sys.path if entry]
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT.format(path=path)], stdout=subprocess.PIPE, text=True
    )
    assert parent.stdout is not None
    leashed, free = map(int, parent.stdout.readline().split())
    try:
        assert is_alive(leashed) and is_alive(free)
        parent.kill()
        parent.wait()
        wait_until(lambda: not is_alive(leashed))
        assert is_alive(free)
    finally:
        os.kill(free, signal.SIGKILL)
        parent.stdout.close()
