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

from amberbox.agent.process import SUPERVISED_MARK, ChildProcess, Process, RealProcess
from amberbox.agent.supervisor import ChildLifecycle
from amberbox.core.child_process import ChildOutput
from amberbox.core.pacing import Backoff
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.agent.fake_process import FakeLauncher

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


def child(text: str, **more: float | bool) -> ChildProcess:
    made = ChildProcess("one", [sys.executable, "-S", "-c", text], watchdog_s=60.0, start_s=60.0)
    return replace(made, **more)  # type: ignore[arg-type]  # each test knows the types it gives


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def lifecycles(
    said: list[str],
) -> Iterator[Callable[[ChildProcess], tuple[ChildLifecycle, FakeLauncher]]]:
    begun: list[ChildLifecycle] = []

    def begin(child: ChildProcess) -> tuple[ChildLifecycle, FakeLauncher]:
        launcher = FakeLauncher()

        def launch(child: ChildProcess) -> RealProcess:
            return RealProcess(child, "store", ChildOutput(child.name, said.append))

        lifecycle = ChildLifecycle(child, launch, launcher.tell, Backoff(least_s=0.01))
        lifecycle.want(0.0)
        begun.append(lifecycle)
        return lifecycle, launcher

    yield begin
    for lifecycle in begun:
        if lifecycle.process is not None:
            end(lifecycle.process)


def end(process: Process) -> None:
    """Kill a process, and wait until it is gone."""
    process.send(signal.SIGKILL)
    wait_until(lambda: process.poll() is not None)
    process.close()


Begin = Callable[[ChildProcess], tuple[ChildLifecycle, FakeLauncher]]


def stepped(lifecycle: ChildLifecycle, is_so: Callable[[], bool]) -> None:
    """Step until something is so."""

    def look() -> bool:
        lifecycle.step(time.monotonic())
        return is_so()

    wait_until(look)


def test_a_child_that_hangs_is_killed_and_begins_again(lifecycles: Begin, said: list[str]) -> None:
    lifecycle, launcher = lifecycles(child(LIVELY, watchdog_s=2.0))
    stepped(lifecycle, lambda: lifecycle.is_up)
    assert lifecycle.process is not None and lifecycle.status == "well"
    first = lifecycle.process.pid
    os.kill(first, signal.SIGSTOP)
    stepped(
        lifecycle,
        lambda: (
            lifecycle.is_up and lifecycle.process is not None and lifecycle.process.pid != first
        ),
    )
    assert [kind for kind, _ in launcher.told] == ["process_hung"]
    assert said == ["one: begins"] * 2


def test_kill_9_is_seen_at_once(lifecycles: Begin) -> None:
    lifecycle, launcher = lifecycles(child(LIVELY))
    stepped(lifecycle, lambda: lifecycle.is_up)
    assert lifecycle.process is not None
    os.kill(lifecycle.process.pid, signal.SIGKILL)
    stepped(lifecycle, lambda: lifecycle.restarts == 1)
    assert "was killed by SIGKILL" in launcher.told[0][1]


def test_exit_2_is_a_refusal_with_its_reason(lifecycles: Begin) -> None:
    lifecycle, launcher = lifecycles(child("print('error: no such item'); raise SystemExit(2)"))
    stepped(lifecycle, lambda: lifecycle.state == "refused")
    assert "no such item" in launcher.told[0][1]


def test_signs_of_life_of_others_do_not_count(lifecycles: Begin) -> None:
    lifecycle, _ = lifecycles(
        child("import os, time; print(os.environ['NOTIFY_SOCKET']); time.sleep(60)")
    )
    process: list[RealProcess] = []
    lifecycle.step(0.0)
    assert isinstance(lifecycle.process, RealProcess)
    process.append(lifecycle.process)
    name = process[0]._notify_socket._socket.getsockname()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(b"READY=1", name)
    assert list(process[0].received()) == []


def test_a_child_gives_way_and_says_for_which_store_it_runs(
    lifecycles: Begin, said: list[str]
) -> None:
    mark = f"os.environ['{SUPERVISED_MARK}']"
    text = f"import os; print(os.nice(0), {mark}, os.getpgid(0) == os.getpid())"
    lifecycle, _ = lifecycles(child(text, nice=7))
    stepped(lifecycle, lambda: bool(said))
    assert said[0] == f"one: {min(19, os.nice(0) + 7)} store True"


def test_one_that_nobody_listens_to_is_not_held_up(lifecycles: Begin) -> None:
    flood = (
        "import os\ntry:\n    while True: os.write(1, b'x' * 4096)\nexcept BlockingIOError: pass\n"
    )
    lifecycle, _ = lifecycles(child(flood))
    lifecycle.step(0.0)
    assert isinstance(lifecycle.process, RealProcess)
    assert lifecycle.process._process.wait(PATIENCE_S) == 0


PARENT = """\
import sys, time
sys.path[:0] = {path!r}
from amberbox.agent.process import ChildProcess, RealProcess
from amberbox.core.child_process import ChildOutput
command = [sys.executable, "-S", "-c", "import os, time; os.write(1, b'up'); time.sleep(60)"]
def say(text): pass
made = []
for outlives in (False, True):
    child = ChildProcess("one", command, outlives=outlives)
    process = RealProcess(child, "s", ChildOutput("one", say))
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
