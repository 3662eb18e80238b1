"""Real processes: found by name, script or command line, and their usage."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import psutil
import pytest

from amberbox.core.errors import UsageError
from amberbox.core.host import ProcessUsage, find_processes, usage
from amberbox.monitoring.probes.process import judge, measure
from amberbox.testing.clock import wait_until

PROC = Path("/proc")
Start = Callable[..., "subprocess.Popen[bytes]"]


def find(subject: str) -> list[int]:
    return [process.pid for process in find_processes(subject)]


@pytest.fixture
def start() -> Iterator[Start]:
    running: list[subprocess.Popen[bytes]] = []

    def start_one(*command: str) -> subprocess.Popen[bytes]:
        running.append(subprocess.Popen(command, stdout=subprocess.PIPE))
        return running[-1]

    yield start_one
    for process in running:
        process.kill()
        process.wait()


def script(folder: Path, name: str, code: str) -> Sequence[str]:
    path = folder / name
    path.write_text(code)
    return [sys.executable, "-u", str(path), "--name", "amber_x"]


def test_a_program_is_found_by_its_name_while_it_runs(tmp_path: Path, start: Start) -> None:
    program = tmp_path / "laser_driver_amber"
    shutil.copy2(shutil.which("sleep") or "/bin/sleep", program)
    assert measure("laser_driver_amber")["ok"] is False
    first, second = start(str(program), "60"), start(str(program), "60")
    wait_until(lambda: len(find("laser_driver_amber")) == 2, "both run")
    found = measure("laser_driver_amber")
    assert (found["ok"], found["count"]) == (True, 2)
    assert 0.1 < found["rss_mb"] < 100
    assert found["cpu_percent"] < 50
    for process in (first, second):
        process.kill()
        process.wait()
    assert measure("laser_driver_amber") == {
        "ok": False,
        "count": 0,
        "cpu_percent": None,
        "rss_mb": None,
    }


def test_a_busy_script_is_found_by_its_file_or_command_line(tmp_path: Path, start: Start) -> None:
    busy = start(*script(tmp_path, "planner_amber.py", "print(1)\nwhile True: pass"))
    assert busy.stdout is not None
    busy.stdout.readline()
    assert find("planner_amber.py") == [busy.pid]
    assert find("*planner_amber.py --name amber_?") == [busy.pid]
    assert find("planner_amber") == []
    assert find("amber_x") == [], "an argument is no name"
    assert measure("planner_amber.py")["cpu_percent"] > 2


def test_a_process_that_is_dead_but_not_buried_does_not_count(start: Start) -> None:
    process = start("sleep", "60")
    process.send_signal(signal.SIGKILL)
    stat = PROC / str(process.pid) / "stat"
    wait_until(lambda: ") Z " in stat.read_text(), "the process is a zombie")
    assert usage([psutil.Process(process.pid)]) == {}


def test_what_is_used_is_the_difference_of_two_looks() -> None:
    before = {1: ProcessUsage(10.0, 5.0), 2: ProcessUsage(1.0, 1.0)}
    after = {1: ProcessUsage(10.25, 6.0), 3: ProcessUsage(0.5, 2.0)}
    assert judge(before, after, 0.5) == {
        "ok": True,
        "count": 2,
        "cpu_percent": 50.0,
        "rss_mb": 8.0,
    }


@pytest.fixture
def proc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Yield a ``/proc`` that psutil reads."""
    monkeypatch.setattr(psutil, "PROCFS_PATH", str(tmp_path))
    psutil.process_iter.cache_clear()
    (tmp_path / "stat").write_text("btime 1700000000\n")
    yield tmp_path
    psutil.process_iter.cache_clear()


def entry(proc: Path, pid: int, name: str) -> None:
    numbers = " ".join(["S", *["0"] * 10, "150", "50", *["0"] * 4, "3", *["0"] * 40])
    place = proc / str(pid)
    place.mkdir()
    (place / "stat").write_text(f"{pid} ({name}) {numbers}\n")
    (place / "status").write_text("Threads:\t3\n")
    (place / "statm").write_text("5000 1000 0 0 0 0 0\n")
    (place / "cmdline").write_text("")


def test_a_name_with_brackets_and_spaces_is_read(proc: Path) -> None:
    entry(proc, 7, "a) Z (b")
    (process,) = psutil.process_iter()
    tick, page = os.sysconf("SC_CLK_TCK"), os.sysconf("SC_PAGE_SIZE")
    assert usage([process]) == {7: ProcessUsage(200 / tick, page * 1000 / 1e6, 3)}


def test_where_others_are_hidden_a_missing_process_is_unknown(proc: Path) -> None:
    entry(proc, os.getpid(), "pytest")
    with pytest.raises(PermissionError, match="hidepid"):
        find("laser_driver")
    entry(proc, 1, "systemd")
    assert find("laser_driver") == []


def test_a_kernel_thread_goes_by_its_own_name(proc: Path) -> None:
    for pid, name in ((1, "systemd"), (9, "irq/35-can0")):
        entry(proc, pid, name)
    assert find("irq/35-can0") == [9]


@pytest.mark.parametrize("name", ["a_long_name_of_", "a_long_name_of_a_driver"])
def test_a_name_that_the_kernel_cuts_is_found_both_ways(
    tmp_path: Path, start: Start, name: str
) -> None:
    program = tmp_path / "a_long_name_of_a_driver"
    shutil.copy2(shutil.which("sleep") or "/bin/sleep", program)
    process = start(str(program), "60")
    wait_until(lambda: find(name) == [process.pid], "it is found")


def test_no_name_is_refused() -> None:
    with pytest.raises(UsageError, match="no process is named"):
        measure(" ")
